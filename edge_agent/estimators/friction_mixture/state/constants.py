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

NODES = 20  # friction hypotheses, equidistant in the square root of mu: fine where mu is small
SPLIT_NODES = 30  # hypotheses of a split road: a low and a high friction, either way round
ALL_NODES = NODES + SPLIT_NODES
# Nodes lie side by side: node j is lane j % LANES of group j // LANES, and the last group has lanes
# to spare. A node in use and a node that sleeps may share a group.
GROUPS = -(-ALL_NODES // LANES)
PLACES = GROUPS * LANES
PATCH_NODES = 5  # the first nodes, of ice: mu up to .195
ROWS = 6  # of measurement: four wheels along, two axles across


class NodeState(IntEnum):
    """Index of a state in the state vector of a node (the filter of one friction hypothesis)."""

    VX = 0  # [m/s]
    VY = 1  # [m/s], at the centre of gravity
    LN_KX = 2  # log of true over nominal longitudinal stiffness
    LN_KY = 3  # the same for cornering stiffness
    STEER = 4  # offset of the front steering against the rear axle [rad]
    LEAK_Y = 5  # share of measured lateral acceleration that is gravity felt by the rolled body
    SHAPE = 6  # shape of the tyre curve: spreads by which it is sharper than the usual one
    GAIN = 7  # error of the longitudinal force over load, relative: torque gain and mass
    # of a_y, that is no force: offset, tilted mount, yaw-rate offset times speed [m/s^2]
    BIAS_Y = 8
    BIAS_X = 9  # the same of a_x
    RADIUS = 10  # relative error of the radius of each of four wheels
    LAG_WHEEL = 14  # of the wheel speeds behind the accelerometers [s]
    LAG_STEER = 15  # of the steering behind the gyroscope [s]
    # slip angle that steering and bushes take from the front axle, per side force over load [rad]
    COMPLIANCE = 16
    STEER_GAIN = 17  # relative error of the front steering angle
    SLOPE = 18  # gravity along the road, felt ahead: a force holds it, but it moves nothing [m/s^2]
    BANK = 19  # gravity across the road, felt to the left [m/s^2]


CURVED = int(NodeState.STEER)  # states in which the rows of measurement are not linear
# states up to this one are differentiated one by one; the others follow from these and from speeds
STRAIGHT = int(NodeState.RADIUS)
ACTIVE = int(NodeState.SLOPE)  # states that the rows see within a block
STATES = NodeState.BANK + 1


class Constants(NamedTuple):
    """Constants of the default estimator's filter. A comment above each one gives its unit and
    reason.

    Fifteen values (such as `correlation_time`, `huber` and `axle_share`) come from a search
    (separable CMA-ES) for a small interval score and few missed and false reports of ice on drives
    of two simulators. Its limits: late steering still contradicts the model, tilted sensors strain
    it, split roads are covered, and logs of real cars hold. Values of the search that told less of
    the ice in long towns were not taken. For a study, `Constants(name=value)` replaces one value.
    """

    # [s] one measurement update per block: model error is correlated over more, so nothing is lost
    block_time: float = 0.05
    # [s] one independent measurement of tyre or wheel speeds per so much time: R is inflated by it
    # over a block (errata)
    correlation_time: float = 0.28
    # [s] window of the innovation variances, and of a_x at rest
    window: float = 1.0

    # [1/m] one road change to anywhere per 270 m (190: beliefs fade before grip is used again)
    hazard: float = 1 / 270
    # [1/m] slow change to a neighbouring node
    diffusion: float = 0.0024
    # [m] in which ice may begin unnoticed: two lengths of a car (18: .05 less of the ice in town is
    # covered)
    patch_length: float = 9.0
    # [1] probability of unlike sides at the first sign of them, slip that force does not ask for
    # (.05: called late)
    split_prior: float = 0.2
    # [1/m] end of such a road
    split_hazard: float = 1 / 60
    # [1] left against right, in force over load, that wakes the split nodes
    split_asymmetry: float = 0.12

    # [1] force over load at which half of the evidence on mu is taken (.12: a gentle slalom reads
    # as ice)
    demand_half: float = 0.13
    # [1] steepness of that
    demand_power: float = 4.0
    # [nat] a larger loss in a block counts whatever the demand: the node has lost the motion
    plausible_loss: float = 1.7
    # [nat] most that a block may take from a node, or a look from a kind of drive: a spike is
    # forgiven within two
    largest_loss: float = 3.0
    # [s] memory of the usual force, against which a new one is judged
    steady_time: float = 2.0
    # [1] change of force over load from the usual at which half of the evidence is new
    steady_half: float = 0.03
    # [1] evidence left, and weight of the axles, where nothing changes: errors of curve and offsets
    # are the same again
    steady_share: float = 0.15
    # [1] slope of the tyre curve below which a wheel counts as sliding
    sliding_slope: float = 0.38
    # [1] weight of the density that sliding spreads over slip: not every braking car slides on all
    # wheels
    sliding_penalty: float = 0.22
    # [1] weight of ln det S of the axles: none favours the flexible node, all of it the saturated
    # one (.28: false ice; .24: less snow is told)
    axle_penalty: float = 0.2

    # [1] prior standard deviations within which stiffness, leaks and offsets are kept; more is a
    # contradiction
    farthest: float = 3.6
    # [1] innovation in standard deviations beyond which a row is trusted less
    huber: float = 1.95
    # [m/s] a node farther than this from the most probable one has diverged: accelerometers forbid
    # it
    diverged_x: float = 0.7
    # [m/s] the same across
    diverged_y: float = 1.0

    # [1] Magic Formula c between the lateral 1.3 and the longitudinal 1.65 of passenger tyres
    curve_c: float = 1.45
    # [1] Magic Formula e, as c
    curve_e: float = -0.1
    # [1] tyres between round and sharp: most of them
    shape_std: float = 0.85
    # [1] log of the factor along: files of real cars are a third off (BMW M8, AV-21), which is
    # within the limit of 3.6 standard deviations
    stiffness_x_std: float = 0.125
    # [1] log of the factor across (vehicle)
    stiffness_y_std: float = 0.12
    # [1] power of the stiffness factor that divides a wheel's residual: slip is noisy, force is
    # quiet
    stiffness_power_x: float = 1.4
    # [1] the same for an axle, where both are
    stiffness_power_y: float = 0.3
    # [1] demand at which a wheel or an axle gives half of its largest information about stiffness:
    # at less demand, noise of the slip dominates
    informing: float = 0.06
    # [1] torque gain 3 %, mass 3 %, load and radius (vehicle)
    gain_std: float = 0.045
    # [s] return of curve shape, stiffness, leaks, offsets, radii, lags, slope and bank to their
    # prior: what they stand for changes with load, bend and road (300: twice too sure)
    return_time: float = 60.0

    # [1] gravity leak of a rolling body, in measured a_y (errata: .07 of true a_y)
    leak_y_mean: float = 0.06
    # [1] its spread (errata)
    leak_y_std: float = 0.05
    # [1] gravity leak of a pitching body, in measured a_x: pitch is stiffer than roll
    leak_x: float = 0.02

    # [m/s^2] offset of a_x: tilted mount and sensor, .22 to .96 on logs of real cars
    bias_x_std: float = 0.25
    # [m/s^2] offset of a_y, .07 to .54 there; a crossfall that the wheels do not steer against
    # reads the same
    bias_y_std: float = 0.2
    # [m/s^2] slope of the road along and across: 3 % of grade, crossfall of 1 to 3 %
    slope_std: float = 0.3
    # [m] over which slope and crossfall are another one: waves of 100 to 400 m
    slope_length: float = 120.0
    # [rad] offset of steering and toe: 1 to 17 mrad on logs of real cars, mostly below 4
    steer_std: float = 0.004
    # [1] gain of the steering ratio: vehicle files of real cars are 3 to 8 % off
    steer_gain_std: float = 0.02
    # [rad] steering compliance per side force over load: production cars have 0 to .035 (front
    # C/F_z of 10 to 20)
    compliance_mean: float = 0.005
    # [rad] its spread
    compliance_std: float = 0.01
    # [s] return of gain and compliance to their prior: they are properties of the car
    steer_time: float = 600.0
    # [1] radius of a wheel against the others: pressure, wear, and axles whose tyres differ (1 % on
    # BMW M8 and AV-21)
    wheel_std: float = 0.011
    # [1] radius of all wheels together: nominal radii of real cars are up to 1.5 % off; nothing
    # here tells it
    radius_std: float = 0.0125
    # [s] lag that all devices share: 60 ms are common, .2 s are met; no sensor tells it, it is in
    # the spread of v_x
    common_lag: float = 0.05
    # [s] lag of wheel speeds and of steering against the inertial sensors: devices up to 60 ms late
    lag_std: float = 0.025

    # [m/s/s^.5] white noise of a_x and a_y, and wander of their offsets (vehicle)
    drift: float = 0.02

    # [rad/s] white noise of a wheel speed sample (vehicle)
    omega_noise: float = 0.03
    # [rad/s] what wheel speeds have wrong beside their noise: steps that cannot be seen, teeth,
    # tyres that wobble
    step_noise: float = 0.06
    # [1] of slip that came just now: a tyre's force needs .3 m, and a bump changes the radius that
    # it rolls on
    abrupt_share: float = 0.5
    # [s] in which it has become usual: a bump lasts .05 s, a wheel locks or spins up in .1 to .3
    abrupt_time: float = 0.15
    # [rad] white noise of steering in a block (vehicle)
    angle_std: float = 0.0003
    # [1] how the wheels of an axle point, of the angle; the common gain of the steering is a state
    angle_share: float = 0.01
    # [1] rolling resistance, in force over load
    floor_x: float = 0.006
    # [1] toe, compliance and what steering and a_y share badly, in force over load
    floor_y: float = 0.014
    # [1] torque gain 3 %, mass 3 %, load 3 % (vehicle)
    force_share: float = 0.04
    # [1] load transfer between axles and inertia (vehicle)
    axle_share: float = 0.02
    # [1] shape error of the tyre curve at full demand, in side force over load
    shape_share: float = 0.05
    # [s] side force behind slip (relaxation, roll), times its rate
    lag: float = 0.015
    # [1] where torque is missing: how unlike the wheels of an axle pull, of the force
    no_torque_share: float = 0.1
    # [m/s^2] where torque is missing: a_x that is not force and not an offset
    no_torque_floor: float = 0.1

    # [1] of the force that spins a wheel up or down: torque and wheel speed have clocks of their
    # own, ABS acts at 8 Hz
    spin_share: float = 0.3

    # [1] probability of a road change where a wheel begins to slide
    slip_change: float = 0.3
    # [1/m] one road change per so much where a wheel has slid and grips again: ice comes in patches
    slip_hazard: float = 0.044
    # [1] factor on R of the rear axle until it reaches the place where a front wheel began to slide
    rear_unlike: float = 10.0

    # [s] that wheels stand before the car does
    standing_time: float = 0.5
    # [s] that four wheels agree before they tell the speed
    agreeing_time: float = 1.0
    # [1] within which they agree, of the speed: radii and slip apart
    agreeing_width: float = 0.02
    # [1] speed that agreeing wheels tell, relative: radii and slip
    agreeing_std: float = 0.01
    # [m/s] the same at standstill: a slower car stands
    agreeing_floor: float = 0.1
    # [1] share by which slip differs from force over load by the nominal stiffness
    agreeing_slip: float = 0.6
    # [1] slip beyond that near the limit, times the cube of force over load
    agreeing_cube: float = 0.05
    # [1] a_y over g up to which the rear axle follows: beyond, sliding may be what it seems
    following_most: float = 0.15
    # [rad] sideslip of a following rear axle beside what the side force asks
    following_std: float = 0.004

    # [1] a node's friction may lie so far below the grip in use: offset of the accelerometers,
    # slope and smoothing
    guard_margin: float = 0.06
    # [1] one standard deviation of that
    guard_std: float = 0.03

    # [1] degrees of freedom with which a car begins as strained as the model: few rows say nothing
    # of it yet
    strain_prior: float = 2.0
    # [1] strain at which the axles are as sure as stated: level drives have .2 to .5, rough ones .5
    # to 2
    strain_usual: float = 0.95
    # [1] power of strain over the usual in R of the axles: what one error says of the next
    strain_power: float = 2.0
    # [1] least of that factor: a level car's axles had .24 of the stated R as the best of a search
    strain_least: float = 0.25
    # [1] most of it
    strain_most: float = 3.0

    # [nat] likelihood ratio at which contradiction is believed: errors that are three times what is
    # stated, for 1 s
    odd_least: float = 12.0
    # [s] before the model is tried again, the first time: a bend or two of a race track would pass,
    # a lap does not
    patience: float = 120.0
    # [1] R of the axles while distrusted, over R
    distrust_noise: float = 1000.0
    # [m/s/s^.5] walk of v_y while distrusted
    distrust_drift: float = 3.0
    # [s] in which while distrusted what was learned of vehicle, sensors and road goes back to the
    # prior
    distrust_forget: float = 5.0
