"""Computation of `BlockFeatures`, the inputs of the measurement equations, from the sums over a
block (the samples within 0.05 s).

Longitudinal force comes from torque, F_x = (T - J*omega')/R. Where torque or speed is missing, the
force m*a_x is divided among the axles, with a larger standard deviation, because this division is
uncertain (`drive_split.py`). On a slope or bank (lateral slope), an accelerometer also measures a
part of gravity. The tyres must carry this part too, so mass times the reading is the tyre force.
Therefore only the sensor's offsets are subtracted from the reading, not slope and bank.

Lateral axle forces come from m*a_y and Iz*r' (paper 004, equation 2). Signs and lever arms of that
equation are corrected as for paper 000 (see its errata).
"""

from __future__ import annotations

import math

from edge_agent.dynamics.body import axle_lateral_forces, locked_axle_force
from edge_agent.dynamics.loads import wheel_loads
from edge_agent.dynamics.parameters import Parameter, body_of
from edge_agent.dynamics.slip import SLOWEST_M_S as SLOWEST_SLIP_M_S
from edge_agent.dynamics.slip import wheel_position
from edge_agent.dynamics.wheel import force_from_torque
from edge_agent.estimators import flags
from edge_agent.estimators.friction_mixture.block.drive_split import (
    BRAKES_FRONT,
    ENGINE_BRAKE,
    UNLIKE,
    front_share,
)
from edge_agent.estimators.friction_mixture.state.constants import Constants, NodeState
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign
from edge_agent.estimators.friction_mixture.state.gap import SLOWEST_M_S, YAW_STD
from edge_agent.estimators.friction_mixture.state.memory import BlockSums, MixtureMemory, Trust
from edge_agent.estimators.friction_mixture.state.workspace import BlockFeatures
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import S
from schemas.thresholds import GRAVITY

NO_FORCE_SHARE = 0.3  # [1] standard deviation of force over load without torque and a_x
ROUNDING = 1 / math.sqrt(12.0)  # [1] standard deviation of rounding, over the step
# [1] A difference of slip between the sides must exceed this number of standard deviations of the
# wheel-speed noise and of the estimated difference of the wheel radii.
LIKELY = 2.0


@compiled
def strained_noise(trust: Trust, constants: Constants) -> float:
    """Return the factor by which the measurement noise R of the axle forces is multiplied.

    It grows with the strain, the deviation of the estimated vehicle and sensor states from their
    prior. If these states show large errors of the car, errors that the filter does not estimate
    are probably large too.
    """
    factor = (trust.strain / constants.chosen.strain_usual) ** constants.chosen.strain_power
    return float(min(max(factor, constants.guards.strain_least), constants.guards.strain_most))


@compiled
def block_features(memory: MixtureMemory, design: MixtureDesign, features: BlockFeatures) -> int:
    """Compute the inputs of the measurement equations from the sums of the block, and write them to
    `features`; return the health flags. The caller has already set `duration` and `speed` of
    `features`.
    """
    row = memory.row
    last = memory.last
    block = memory.block
    constants = design.constants
    _average_kinematics(block, features)
    features.yaw_rate = mean_or(block, S.YAW_RATE, last.yaw_rate)
    slip = (
        0.5 * row[Parameter.TRACK_REAR] * features.yaw_rate / max(features.speed, SLOWEST_SLIP_M_S)
    )
    features.locked_pull = row[Parameter.REAR_LOCKED] * row[Parameter.SLOPE_X] * slip
    ax = mean_or(block, S.AX, 0.0)
    ay = mean_or(block, S.AY, 0.0)
    loads = features.loads
    loads[0], loads[1], loads[2], loads[3] = wheel_loads(body_of(row), ax, ay)
    for wheel in range(4):
        features.steer_cos[wheel] = math.cos(last.delta[wheel])
        features.steer_sin[wheel] = math.sin(last.delta[wheel])
        _turn_wheel(row, features, wheel)
        features.rolling[wheel] = row[Parameter.RADIUS] * mean_or(block, S.OMEGA + wheel, math.nan)
        # A wheel that is read less often than once per block has changed over a longer time.
        elapsed = last.reading_time[S.OMEGA + wheel] - block.start_omega_time[wheel]
        change = (last.omega[wheel] - block.start_omega[wheel]) / max(elapsed, features.duration)
        features.spin[wheel] = 0.0 if math.isnan(change) else change
    features.steering = 0.5 * (last.delta[0] + last.delta[1])
    features.change = ax
    features.steer_rate = _steer_rate(memory, features.duration)
    health = _compute_wheel_forces(memory, constants, features)
    _compute_side_forces(memory, features)
    health |= _drop_unknown_sides(memory, features)
    _compute_noise(memory, design, features)
    features.demand = grip_demand(features)
    _compute_information(constants, features)
    features.asymmetry = unexplained_slip_difference(memory, constants, features)
    return health


@compiled
def _turn_wheel(row: FloatArray, features: BlockFeatures, wheel: int) -> None:
    """Compute the part of the velocity of a wheel's centre that the car's yaw rate causes, along
    and across the wheel [m/s], and write it to `features`.
    """
    x, y = wheel_position(row, wheel)
    ahead = -y * features.yaw_rate
    left = x * features.yaw_rate
    cos = features.steer_cos[wheel]
    sin = features.steer_sin[wheel]
    features.turn_along[wheel] = cos * ahead + sin * left
    features.turn_across[wheel] = cos * left - sin * ahead


@compiled
def mean_or(block: BlockSums, channel: int, default: float) -> float:
    """Return the mean of the valid samples of a channel in the block, or `default` if the channel
    has no valid sample.
    """
    return block.sums[channel] / block.counts[channel] if block.counts[channel] > 0 else default


@compiled
def _average_kinematics(block: BlockSums, features: BlockFeatures) -> None:
    share = 1.0 / block.samples
    features.cos = block.cos_sum * share
    features.sin = block.sin_sum * share
    mean = features.gain
    total = block.gain_sum
    mean.measured.x = total.measured.x * share
    mean.measured.y = total.measured.y * share
    mean.leak_y.x = total.leak_y.x * share
    mean.leak_y.y = total.leak_y.y * share
    mean.unit.x = total.unit.x * share
    mean.unit.y = total.unit.y * share


@compiled
def _steer_rate(memory: MixtureMemory, duration: float) -> float:
    """Return the rate of change of the mean front steering angle within the block [rad/s]."""
    now = memory.last.delta
    before = memory.last.delta_before
    return float(0.5 * (now[0] + now[1] - before[0] - before[1]) / duration)


@compiled
def _compute_wheel_forces(
    memory: MixtureMemory, constants: Constants, features: BlockFeatures
) -> int:
    """Compute the longitudinal force over load of the four wheels, and return the health flags. The
    standard deviations of these forces are written to `features.noise_std`; `_compute_noise` later
    adds the other noise.
    """
    health = 0
    loads = features.loads
    row = memory.row
    block = memory.block
    ax = mean_or(block, S.AX, math.nan)
    front, front_std = front_share(row, memory.drive_odds, features.change)
    lone = lone_axle(memory, features)
    brakes = lone >= 0 and brakes_untold(memory, features, lone)
    for wheel in range(4):
        torque = math.nan if brakes else mean_or(block, S.TORQUE + wheel, math.nan)
        if not (math.isnan(torque) or math.isnan(features.rolling[wheel])):
            force = force_from_torque(
                torque, features.spin[wheel], row[Parameter.WHEEL_INERTIA], row[Parameter.RADIUS]
            )
            inertial = row[Parameter.WHEEL_INERTIA] * features.spin[wheel] / row[Parameter.RADIUS]
            spread = math.hypot(
                constants.physical.force_share * force, constants.physical.spin_share * inertial
            )
            unit = 0.0
        else:
            if math.isnan(torque):
                health |= flags.NO_TORQUE
            known = row[Parameter.MASS] * features.change
            unit = 0.5 * (front if wheel < 2 else 1.0 - front) * row[Parameter.MASS]
            force = unit * features.change
            model_spread = math.hypot(
                constants.physical.force_share * force, 0.5 * front_std * known
            )
            spread = math.hypot(model_spread, constants.physical.floor_x * loads[wheel])
            if math.isnan(ax):
                unit = 0.0
                spread = NO_FORCE_SHARE * loads[wheel]
            elif lone >= 0 and not brakes:  # the other axle provides the rest of the force m*a_x
                unit = 0.5 * row[Parameter.MASS]
                force = 0.5 * (known - axle_force(memory, features, lone))
                spread = math.hypot(spread, constants.physical.force_share * unit * features.change)
        features.force[wheel] = force / loads[wheel]
        features.force_unit[wheel] = unit / loads[wheel]
        features.noise_std[wheel] = spread / loads[wheel]
    return health


@compiled
def lone_axle(memory: MixtureMemory, features: BlockFeatures) -> int:
    """Return the index of the only axle with known torque: 0 front, 1 rear; -1 if torque is known
    on both axles or on neither.
    """
    known = 0
    axle = -1
    for k in range(2):
        left = 2 * k
        both = features.rolling[left] + features.rolling[left + 1]
        both += mean_or(memory.block, S.TORQUE + left, math.nan)
        both += mean_or(memory.block, S.TORQUE + left + 1, math.nan)
        if not math.isnan(both):
            known += 1
            axle = k
    return axle if known == 1 else -1


@compiled
def brakes_untold(memory: MixtureMemory, features: BlockFeatures, axle: int) -> bool:
    """Return True if the torque signal of an axle apparently does not include the brakes.

    This is the case while the car brakes but the known torque is less than half of the usual brake
    torque of that axle. For example, a signal of powertrain torque does not include the brakes.
    """
    usual = BRAKES_FRONT if axle == 0 else 1.0 - BRAKES_FRONT
    least = 0.5 * usual * memory.row[Parameter.MASS] * features.change
    return features.change < -ENGINE_BRAKE and axle_force(memory, features, axle) > least


@compiled
def axle_force(memory: MixtureMemory, features: BlockFeatures, axle: int) -> float:
    """Return the longitudinal force [N] of the axle with index `axle`, computed from the torques of
    its two wheels.
    """
    row = memory.row
    total = 0.0
    for wheel in range(2 * axle, 2 * axle + 2):
        torque = mean_or(memory.block, S.TORQUE + wheel, math.nan)
        total += force_from_torque(
            torque, features.spin[wheel], row[Parameter.WHEEL_INERTIA], row[Parameter.RADIUS]
        )
    return total


@compiled
def _compute_side_forces(memory: MixtureMemory, features: BlockFeatures) -> None:
    """Compute the lateral force over load of both axles, and each wheel's share of the axle load.
    The lateral force is NaN if a_y is missing.

    Also compute two derivatives of the lateral force over load: with respect to a_y, and with
    respect to the leak. Body roll tilts the accelerometer, so that a part of the measured a_y is
    gravity. The leak is this part as a share of a_y.
    """
    row = memory.row
    loads = features.loads
    delta = memory.last.delta
    ay = mean_or(memory.block, S.AY, math.nan)
    yaw_acceleration = (memory.last.yaw_rate - memory.block.start_yaw_rate) / features.duration
    moment = 0.0
    for wheel in range(4):
        y = wheel_position(row, wheel)[1]
        moment -= y * features.force[wheel] * loads[wheel] * features.steer_cos[wheel]
    front, rear = axle_lateral_forces(row, ay, yaw_acceleration, moment)
    leak_front, leak_rear = axle_lateral_forces(row, -ay, 0.0, 0.0)
    for axle in range(2):
        left = 2 * axle
        right = 2 * axle + 1
        load = loads[left] + loads[right]
        along = features.force[left] * loads[left] + features.force[right] * loads[right]
        angle = 0.5 * (delta[left] + delta[right])
        cos = math.cos(angle)
        side = (front if axle == 0 else rear) - along * math.sin(angle)
        features.side[axle] = side / (cos * load)
        features.side_unit[axle] = 1.0 / (GRAVITY * cos)
        features.side_leak[axle] = (leak_front if axle == 0 else leak_rear) / (cos * load)
        features.load_share[left] = loads[left] / load
        features.load_share[right] = loads[right] / load


@compiled
def _drop_unknown_sides(memory: MixtureMemory, features: BlockFeatures) -> int:
    """Set the lateral force of an axle to NaN if it cannot be used, and return the health flags.

    The force cannot be used without the steering angle, because the lateral slip of the axle is
    then unknown. It cannot be computed without the yaw rate.
    """
    health = 0
    counts = memory.block.counts
    # Without the steering angle, the slip of the front axle is unknown.
    if counts[S.DELTA] + counts[S.DELTA + 1] == 0:
        features.side[0] = math.nan
        health |= flags.NO_STEERING
    if memory.last.rear_steering and counts[S.DELTA + 2] + counts[S.DELTA + 3] == 0:
        features.side[1] = math.nan
        health |= flags.NO_STEERING
    if counts[S.YAW_RATE] == 0:  # the axle's force and its slip both need the yaw rate
        features.side[0] = math.nan
        features.side[1] = math.nan
    return health


@compiled
def _compute_noise(memory: MixtureMemory, design: MixtureDesign, features: BlockFeatures) -> None:
    """Write the standard deviation of each measurement residual, and the variance of the slip
    noise, to `features`.

    A residual is the distance of the measured point (slip, force) from the tyre curve. Slip is
    scaled so that the curve begins with slope 1. There, an error of the slip changes the distance
    by 1/sqrt(2) of the error. Therefore half of the slip variance is added to the residual's
    variance.
    """
    row = memory.row
    constants = design.constants
    before = memory.last_side
    speed = max(features.speed, SLOWEST_SLIP_M_S)
    scale = design.scales[0]
    for wheel in range(4):
        noise = max(
            constants.physical.omega_noise,
            ROUNDING * memory.last.omega_step[wheel],
            memory.vibration,
        )
        linear = row[Parameter.SLOPE_X] / speed
        slip_variance = (linear * noise * row[Parameter.RADIUS]) ** 2
        features.abrupt_noise[wheel] = (
            linear
            * constants.physical.abrupt_share
            * wheel_speed_jump(memory, constants, features, wheel)
        ) ** 2
        variance = (
            0.5 * slip_variance + constants.physical.floor_x**2 + features.noise_std[wheel] ** 2
        )
        features.noise_std[wheel] = math.sqrt(variance * scale)
        features.slip_noise[wheel] = slip_variance * scale
    scale = (
        design.scales[1]
        * memory.factor
        * (strained_noise(memory.trust, constants) if design.adaptive else 1.0)
    )
    features.axle_scale = scale
    locked = features.locked_pull / math.hypot(1.0, features.locked_pull)
    locked *= UNLIKE * locked_axle_force(row, features.loads)
    for axle in range(2):
        side = features.side[axle]
        place = row[Parameter.TO_FRONT] if axle == 0 else row[Parameter.TO_REAR]
        angle = row[Parameter.SLOPE_Y] * YAW_STD * place / speed
        change = side - before[axle]
        lag = 0.0 if math.isnan(change) else constants.physical.lag * change / features.duration
        before[axle] = side
        share = constants.physical.axle_share * side
        shape = constants.physical.shape_share * side * side
        variance = 0.5 * angle**2 + constants.physical.floor_y**2 + share**2 + shape**2 + lag**2
        variance += (locked / (features.loads[2 * axle] + features.loads[2 * axle + 1])) ** 2
        features.noise_std[4 + axle] = math.sqrt(variance * scale)
        features.slip_noise[4 + axle] = angle**2 * scale


@compiled
def wheel_speed_jump(
    memory: MixtureMemory, constants: Constants, features: BlockFeatures, wheel: int
) -> float:
    """Return the absolute difference [m/s] between the car's speed according to one wheel and the
    smoothed value of this speed; 0 where unknown. The noise of sudden slip is computed from it.

    Before the comparison, the smoothed value is advanced by the car's acceleration. If a wheel
    spins up or locks, the difference lasts for several blocks (of 0.05 s). At a bump in the road it
    lasts for one or two.
    """
    now = at_centre(memory.row, features, wheel)
    usual = memory.usual_rolling
    expected = usual[wheel] + features.change * features.duration
    share = 1.0 - math.exp(-features.duration / constants.physical.abrupt_time)
    jump = now - expected
    if math.isnan(jump):
        usual[wheel] = now if math.isnan(expected) else expected
        return 0.0
    usual[wheel] = expected + share * jump
    return float(abs(jump))


@compiled
def at_centre(row: FloatArray, features: BlockFeatures, wheel: int) -> float:
    """Return the forward speed [m/s] of the centre of gravity, computed from the speed of one wheel
    under the assumption that it rolls freely; NaN without a reading.
    """
    px, py = wheel_position(row, wheel)
    across = features.steer_sin[wheel] * (row[Parameter.TO_REAR] + px) * features.yaw_rate
    return float(
        (features.rolling[wheel] - across) / features.steer_cos[wheel] + py * features.yaw_rate
    )


@compiled
def _compute_information(constants: Constants, features: BlockFeatures) -> None:
    """Compute features.informs_x and features.informs_y: for each axle, factors from 0 to 1 that
    limit how much the filter learns about longitudinal and lateral tyre stiffness.

    The factors are near 0 at small forces. There the measured slip is mostly noise, and without the
    factors the filter would learn a wrong stiffness from it.
    """
    for axle in range(2):
        along = max(abs(features.force[2 * axle]), abs(features.force[2 * axle + 1]))
        side = features.side[axle]
        features.informs_x[axle] = along * along / (along * along + constants.chosen.informing**2)
        features.informs_y[axle] = (
            0.0 if math.isnan(side) else side * side / (side * side + constants.chosen.informing**2)
        )


@compiled
def unexplained_slip_difference(
    memory: MixtureMemory, constants: Constants, features: BlockFeatures
) -> float:
    """Return the difference in slip between the left and right wheel of an axle that the forces of
    these wheels do not explain. The larger value of the two axles counts.

    The unit is force over load [1]: slip times the tyre's stiffness per load. Wheels of unequal
    radius always differ in slip. Therefore the estimated difference of the radii is removed. An
    allowance for the uncertainty of this difference and for wheel-speed noise is subtracted from
    the result.
    """
    row = memory.row
    block = memory.block
    radius = memory.overall_mean
    first = NodeState.RADIUS
    most = 0.0
    speed = max(features.speed, SLOWEST_M_S)
    covariance = memory.overall_covariance
    for axle in range(2):
        left = 2 * axle
        right = 2 * axle + 1
        track = row[Parameter.TRACK_FRONT] if axle == 0 else row[Parameter.TRACK_REAR]
        turning = track * features.yaw_rate * features.steer_cos[left]
        i = first + left
        j = first + right
        faster = features.rolling[right] * (1.0 + radius[j]) - features.rolling[left] * (
            1.0 + radius[i]
        )
        slip = (faster - turning) / speed
        unknown = math.sqrt(max(covariance[i, i] + covariance[j, j] - 2.0 * covariance[i, j], 0.0))
        samples = max(min(block.counts[S.OMEGA + left], block.counts[S.OMEGA + right]), 1)
        noise = max(constants.physical.omega_noise / math.sqrt(samples), memory.vibration)
        noise *= math.sqrt(2.0) * row[Parameter.RADIUS] / speed
        difference = abs(
            row[Parameter.SLOPE_X] * slip - features.force[right] + features.force[left]
        )
        if not math.isnan(difference):
            most = max(most, difference - row[Parameter.SLOPE_X] * LIKELY * (noise + unknown))
    return most


@compiled
def grip_demand(features: BlockFeatures) -> float:
    """Return the force over load [1], longitudinal and lateral together, of the axle for which it
    is larger. A missing lateral force counts as zero.

    The forces of the two wheels of an axle are added, because the force over load of an almost
    unloaded inner wheel would be unreliable.
    """
    most = 0.0
    for axle in range(2):
        left = 2 * axle
        right = left + 1
        side = features.side[axle]
        across = 0.0 if math.isnan(side) else side
        along = (
            features.load_share[left] * features.force[left]
            + features.load_share[right] * features.force[right]
        )
        most = max(most, math.hypot(along, across))
    return most
