"""All constants of the friction mixture (default estimator), each with unit and reason, in a record
that the compiled functions read.

Values marked (vehicle) follow from typical uncertainty of a vehicle and its sensors: mass 3 %,
inertia 5 %, stiffness 10 to 12 %, torque 3 %, and white noise and offsets of ordinary inertial
sensors. Values marked (errata) were measured; the errata of the papers describe how.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from schemas.runtime.records import LANES

# Number of hypotheses of one friction. They are equidistant in the square root of mu, so that the
# grid is fine where mu is small.
NODES = 20
# Number of hypotheses of a split road: a low friction on one side and a high one on the other.
SPLIT_NODES = 30
ALL_NODES = NODES + SPLIT_NODES
# Memory layout: node j is lane j % LANES of group j // LANES. Some lanes of the last group are
# unused. A group may contain active and inactive nodes.
GROUPS = -(-ALL_NODES // LANES)
PLACES = GROUPS * LANES
PATCH_NODES = 5  # number of nodes that stand for ice: the first ones, up to mu = .195
ROWS = 6  # number of measurements: four wheels (longitudinal), then two axles (lateral)


class NodeState(IntEnum):
    """Index of a state in the state vector of a node (the filter of one friction hypothesis)."""

    VX = 0  # [m/s] forward velocity
    VY = 1  # [m/s] velocity to the left, at the centre of gravity
    LN_KX = 2  # [1] ln of true over nominal longitudinal stiffness
    LN_KY = 3  # [1] ln of true over nominal cornering stiffness
    STEER = 4  # [rad] offset of the front steering angle relative to the rear axle
    LEAK_Y = 5  # [1] share of measured lateral acceleration that is gravity, due to body roll
    SHAPE = 6  # [1] shape of the tyre curve: 0 usual, 1 sharp, -1 round
    GAIN = 7  # [1] relative error of the longitudinal force over load, from torque gain and mass
    # [m/s^2] part of a_y that no tyre force causes: sensor offset, tilted mount, and the offset of
    # the yaw rate times speed
    BIAS_Y = 8
    BIAS_X = 9  # [m/s^2] part of a_x that no tyre force causes
    RADIUS = 10  # [1] relative error of the radius of each of four wheels (states 10 to 13)
    LAG_WHEEL = 14  # [s] delay of the wheel speeds relative to the accelerometers
    LAG_STEER = 15  # [s] delay of the steering signal relative to the gyroscope
    # [rad] front slip angle lost to the yield of steering column and bushings, per lateral force
    # over load
    COMPLIANCE = 16
    STEER_GAIN = 17  # [1] relative error of the front steering angle
    # [m/s^2] gravity along the road, as a_x measures it. Tyre forces balance it, so the car does
    # not accelerate.
    SLOPE = 18
    BANK = 19  # [m/s^2] gravity across the road, as a_y (to the left) measures it


# Number of states in which the measurement equations are nonlinear: those before STEER.
CURVED = int(NodeState.STEER)
# For the states before this one, the measurements are differentiated one state at a time. The
# derivatives by the later states follow from these and from the speeds.
STRAIGHT = int(NodeState.RADIUS)
# Number of states that affect the measurements of a block: those before SLOPE.
ACTIVE = int(NodeState.SLOPE)
STATES = NodeState.BANK + 1


class PhysicalConstants(NamedTuple):
    """Properties of cars, tyres, sensors and roads that the filter assumes before it measures. A
    comment above each one gives its unit and reason.
    """

    # --- Time constants of the measurement update ---
    # [s] time within which tyre and wheel-speed errors are correlated (errata). R of a block is
    # multiplied by this time over the block's length.
    correlation_time: float = 0.28

    # --- Road changes ---
    # [1] friction up to which all values are equally likely without measurements; above it, the
    # prior density falls linearly to 0 at 1.2. Dry asphalt has .8 to .9 on average (Wong, Theory of
    # Ground Vehicles, table 1.2), and few tyres reach 1.1. With a uniform prior, a drive at .6 g
    # on a road of .85 was reported as 1.03.
    common_mu: float = 0.9
    # [1/m] rate of changes to any other friction: one per 270 m. With one per 190 m, the belief
    # faded before the car used grip again.
    hazard: float = 1 / 270
    # [1/m] rate of slow changes to a neighbouring node
    diffusion: float = 0.0024
    # [m] distance over which the probability of an unnoticed ice patch grows to its prior: two car
    # lengths. With 18 m, .05 less of the ice in town was covered.
    patch_length: float = 9.0
    # [1] probability of a split road at its first sign (see `split_asymmetry`). With .05 split
    # roads were recognised late.
    split_prior: float = 0.2

    # --- Tyre ---
    # [1] shape factor C of the Magic Formula, between 1.3 (lateral) and 1.65 (longitudinal) of
    # passenger car tyres
    curve_c: float = 1.45
    # [1] standard deviation of the state SHAPE: most tyres lie between -1 (round) and 1 (sharp)
    shape_std: float = 0.85
    # [1] standard deviation of ln of the stiffness factors, longitudinal and cornering (vehicle).
    # Vehicle files of real cars are a third off (BMW M8, AV-21), which is within 3.6 standard
    # deviations.
    stiffness_std: float = 0.12
    # [s] time in which vehicle, sensor and road states return to their prior, because the errors
    # they describe change with load, bend and road. With 300 s the stated deviations were half of
    # the actual errors.
    return_time: float = 60.0

    # --- Accelerometers and slope of the road ---
    # [1] share of measured a_y that is gravity, due to body roll: mean and standard deviation
    # (errata: .07 and .05 of the true a_y). With .06, late steering looked like body roll.
    leak: float = 0.05
    # [m/s^2] standard deviation of the offsets of a_x and a_y from tilted mount and sensor (.07 to
    # .96 on logs of real cars), and of the gravity due to slope and bank of the road (a grade of
    # 3 %, a crossfall of 1 to 3 %)
    offset_std: float = 0.25
    # [m] distance over which slope and bank change: road waves are 100 to 400 m long. They also
    # change with the direction of the car: once per radian (`prepare_prediction`).
    slope_length: float = 120.0

    # --- Steering ---
    # [rad] standard deviation of the direction of an axle's wheels, from steering offset and toe: 1
    # to 17 mrad on logs of real cars, mostly below 4
    steer_std: float = 0.004
    # [1] standard deviation of the steering gain: steering ratios in vehicle files of real
    # cars are 3 to 8 % off. With .02, slow turns on dry road of a car with such an error read as
    # ice.
    steer_gain_std: float = 0.04
    # [rad] mean steering compliance per lateral force over load: 0 to .035 on production cars
    # (front C/F_z of 10 to 20)
    compliance_mean: float = 0.005
    # [rad] standard deviation of the compliance
    compliance_std: float = 0.01

    # --- Wheel radii and delays ---
    # [1] standard deviation of one wheel's radius relative to the others: pressure, wear, and
    # different tyres on the axles (1 % on BMW M8 and AV-21). The common radius error, which no
    # sensor here measures, and the speed computed from agreeing wheels have the same relative
    # error. Wheels agree if their speeds differ by less than twice as much.
    wheel_std: float = 0.011
    # [s] delay that all sensors share: 60 ms are common, .2 s occur. No sensor measures it, so it
    # only increases the stated deviation of v_x.
    common_lag: float = 0.05
    # [s] standard deviation of the delay of wheel speeds and steering relative to the inertial
    # sensors, which reaches 60 ms
    lag_std: float = 0.025

    # --- Noise of accelerometers, wheel speeds and steering ---
    # [m/s/s^.5] white noise of a_x and a_y, and random walk of their offsets (vehicle)
    drift: float = 0.025
    # [rad/s] error of wheel speeds: noise, undetected resolution steps, teeth, wobbling tyres
    omega_noise: float = 0.06
    # [1] share of a sudden change of slip that counts as noise: a bump changes the rolling radius,
    # and the relaxation of a tyre is known roughly.
    abrupt_share: float = 0.4
    # [s] time in which a change of wheel speed stops being sudden. A bump lasts .05 s; a wheel
    # locks or spins up in .1 to .3 s. The forces are smoothed over the same time before they count
    # as grip in use.
    abrupt_time: float = 0.15

    # --- Noise of the forces ---
    # [1] error of the longitudinal force over load from rolling resistance
    floor_x: float = 0.006
    # [1] error of the lateral force over load from toe, compliance, and the imperfect relation of
    # steering and a_y
    floor_y: float = 0.014
    # [1] relative error of the longitudinal force: torque gain, mass and load 3 % each (vehicle).
    # The state GAIN, which is the constant part of this error, and the grip in use near 1 have the
    # same standard deviation. Without torque: relative difference between the forces of an axle's
    # wheels.
    force_share: float = 0.045
    # [1] relative error of an axle's lateral force: load transfer and inertia (vehicle). It hardly
    # matters in towns; without it the recorded drive of a racing car contradicts the model.
    axle_share: float = 0.02
    # [1] error of the tyre curve's shape, per squared lateral force over load. Without it a racing
    # car that uses all its grip contradicts the model for a third of a drive.
    shape_share: float = 0.05
    # [m] distance over which a tyre builds up its force after a change of slip (`relaxation.py`):
    # .1 to .3 along and .3 to .6 across for tyres of passenger cars
    relaxation_length: float = 0.15
    # [1] share of the slip that acts at once. With 0, wheels that spin under traction control were
    # noticed late.
    direct_slip: float = 0.2
    # [s] delay of lateral force behind slip that relaxation does not explain (roll). The error is
    # this time multiplied by the rate of the force.
    lag: float = 0.01
    # [1] relative error of the force that accelerates a wheel's rotation. Torque and wheel speed
    # are sampled at different times, and ABS acts at 8 Hz. Without it, snow was reported as wet
    # road between pulses of the brake.
    spin_share: float = 0.3

    # --- Road changes where wheels slide ---
    # [1] probability of a road change where a wheel begins to slide
    slip_change: float = 0.3
    # [1/m] rate of road changes where a wheel has slid and grips again under load, because ice
    # comes in patches
    slip_hazard: float = 0.06

    # --- Motion according to standing or rolling wheels (`rolling_motion.py`) ---
    # [1] relative error of slip computed from force over load with the nominal stiffness
    agreeing_slip: float = 0.6


class DesignConstants(NamedTuple):
    """Choices of the method: times, weights and thresholds of its rules. A comment above each one
    gives its unit and reason.
    """

    # --- Time constants of the measurement update ---
    # [s] length of a block, after which one measurement update is made. Model errors are correlated
    # over a longer time, so joining samples loses nothing.
    block_time: float = 0.05
    # [s] averaging time of the innovation variances, of a_x at standstill, and of forces and slips
    # (only a change from their averages is new evidence); time for which the wheels must agree
    # before the speed is computed from them, and stand before the car counts as standing
    window: float = 1.0

    # --- Road changes ---
    # [1] sign of a split road: difference between left and right slip that the forces do not
    # explain, as force over load of a linear tyre
    split_asymmetry: float = 0.12

    # --- Weight of the evidence on friction ---
    # [1] change of force over load from its average at which the evidence counts as new by half
    steady_half: float = 0.02
    # [1] share of the evidence, and of the axles' information, that is used while nothing changes.
    # Errors of tyre curve and offsets then repeat from block to block. With .7, dry road in a
    # circle of 12 m had too low an upper end.
    steady_share: float = 0.4
    # [1] slope of the tyre curve below which a wheel counts as sliding
    sliding_slope: float = 0.38
    # [1] weight of the penalty for the slip of sliding wheels, which may have any value. Weight 0
    # favours nodes in which the wheels slide.
    freedom_penalty: float = 0.2

    # --- Tyre ---
    # [1] exponent of the stiffness factor by which a wheel's residual is divided. It exceeds 1
    # because slip is noisier than force.
    stiffness_power_x: float = 1.4
    # [1] exponent of the stiffness factor by which an axle's residual is divided. It is small,
    # because slip and force of an axle are both noisy.
    stiffness_power_y: float = 0.3
    # [1] force over load at which a wheel or axle has half of its largest effect on the stiffness
    # states. At smaller forces slip is mostly noise.
    informing: float = 0.06

    # --- Road changes where wheels slide ---
    # [1] tyre force over that of the slippery road from which gripping again shows a road change.
    # With less force (the driver has released the brake) a wheel grips on ice too.
    carried_share: float = 0.4
    # [1] factor on R of the rear axle until it reaches the place where a front wheel began to slide
    rear_unlike: float = 10.0

    # --- Motion according to standing or rolling wheels (`rolling_motion.py`) ---
    # [1] a_y over g up to which the rear axle is assumed not to slide. Beyond it, a sliding axle
    # cannot be distinguished from one that follows.
    following_most: float = 0.15

    # --- Strain (`trust.py`) ---
    # [1] weight, in degrees of freedom, of the initial strain of 1, because a few measurements do
    # not determine the strain yet
    strain_prior: float = 2.0
    # [1] strain at which R of the axles has its stated value: .2 to .5 on level drives, .5 to 2 on
    # rough ones
    strain_usual: float = 0.99
    # [1] exponent of strain over `strain_usual` in the factor on R of the axles: how much known
    # errors say about unknown ones. With 1, a car with late steering was not contradicted, and
    # called ice.
    strain_power: float = 2.0

    # --- Contradiction of the model (`trust.py`) ---
    # [nat] log-likelihood ratio at which the model counts as contradicted. Axle errors of three
    # times the stated size reach it in about 3 s.
    odd_least: float = 12.0
    # [s] time before the model is tried again after the first contradiction. A manoeuvre that the
    # model does not describe is over by then. With 120 s cars with right models were silent four
    # times as long, and false ice of cars with wrong ones did not change by more than .004.
    patience: float = 30.0
    # [1] While the model counts as contradicted (distrusted), R of the axles is multiplied by 1
    # plus this value.
    distrust_noise: float = 1000.0
    # [m/s/s^.5] random walk of v_y while the model is distrusted
    distrust_drift: float = 3.0
    # [s] time in which vehicle, sensor and road states return to their prior while the model is
    # distrusted
    distrust_forget: float = 5.0


class GuardConstants(NamedTuple):
    """Limits that keep single errors from spreading. A comment above each one gives its unit and
    reason.
    """

    # --- Weight of the evidence on friction ---
    # [nat] loss of log-likelihood in a block that is plausible at a wrong friction. The part beyond
    # it counts in full at any force, because the node's velocity must be wrong.
    plausible_loss: float = 1.7
    # [nat] most that one block takes from a node or from a kind of drive, so that two later blocks
    # compensate for a spike
    largest_loss: float = 3.0

    # --- Limits of states and innovations ---
    # [1] limit of vehicle and sensor states: standard deviations from their prior
    farthest: float = 3.6
    # [1] innovation, in standard deviations, beyond which R of a measurement is increased
    huber: float = 1.95
    # [m/s] difference of v_x or v_y from the most probable node beyond which a node has diverged.
    # The accelerometers exclude such a difference.
    diverged: float = 1.0

    # --- Strain (`trust.py`) ---
    # [1] smallest factor of strain on R of the axles. A search for the best R of the axles found
    # .24 on level drives. Without it, the snowy side of a split road had too high an upper end.
    strain_least: float = 0.25
    # [1] largest factor of strain on R of the axles. Without it, late steering was contradicted
    # twice as late.
    strain_most: float = 3.0


class Constants(NamedTuple):
    """Constants of the default estimator's filter, in three groups.

    Fifteen values (such as `correlation_time`, `huber` and `axle_share`) come from a search
    (separable CMA-ES) on drives of two simulators. The search minimised the interval score and the
    missed and false reports of ice. The values had to meet these conditions:

    - The filter still reports a contradiction of the model if the steering signal is delayed.
    - Tilted sensors increase the strain (deviation of the states from their prior).
    - On split roads, the friction interval contains the true friction.
    - The checks with logs of real cars pass.
    - On long drives in towns, no less ice is found than before.

    For a study, `replace_values` returns them with other values.
    """

    physical: PhysicalConstants = PhysicalConstants()
    chosen: DesignConstants = DesignConstants()
    guards: GuardConstants = GuardConstants()

    def replace_values(self, **values: float) -> Constants:
        """Return the constants with other `values`, given by name.

        Raises:
            KeyError: there is no constant of such a name.
        """
        if unknown := set(values) - set(self.by_name()):
            raise KeyError(f"unknown constants {', '.join(sorted(unknown))}")

        def pick(fields: tuple[str, ...]) -> dict[str, float]:
            return {name: value for name, value in values.items() if name in fields}

        return Constants(
            self.physical._replace(**pick(self.physical._fields)),
            self.chosen._replace(**pick(self.chosen._fields)),
            self.guards._replace(**pick(self.guards._fields)),
        )

    def by_name(self) -> dict[str, float]:
        """Return the values of all constants by name."""
        return {name: value for group in self for name, value in group._asdict().items()}
