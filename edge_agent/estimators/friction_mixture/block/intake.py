"""Intake of a sample: it rejects impossible readings, filters the yaw rate, and adds the sample to
the sums of the block (the samples within 0.05 s).

A missing inertial reading or steering angle is replaced by the last one for a short time, because
signals are often read less often than the log has rows. Later, accelerations are replaced: a_x by
zero and a_y by r*v_x (yaw rate times speed). In both cases the velocity gets the process noise of a
random walk. The yaw rate is then computed from the speed difference of the rear wheels. All other
missing readings are left out of the sums.
"""

from __future__ import annotations

import math

from edge_agent.dynamics.body import advance_velocity
from edge_agent.dynamics.parameters import Parameter
from edge_agent.estimators import flags
from edge_agent.estimators.common.readings import (
    GAP_S,
    INPUTS,
    position_health,
    position_time,
    read_plausible,
)
from edge_agent.estimators.friction_mixture.block.failed_sensors import leave_out_failed
from edge_agent.estimators.friction_mixture.block.grip_guard import note_grip
from edge_agent.estimators.friction_mixture.block.wheel_readings import note_step, refuse_jumps
from edge_agent.estimators.friction_mixture.state.constants import (
    Constants,
    DesignConstants,
    NodeState,
)
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign
from edge_agent.estimators.friction_mixture.state.gap import (
    LOST_WALK,
    UNKNOWN_YAW_VAR,
    YAW_STD,
    bridge_gap,
)
from edge_agent.estimators.friction_mixture.state.memory import (
    LastInputs,
    MixtureMemory,
    PlanarVector,
    VelocityGain,
)
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import S
from schemas.thresholds import SLOWEST_HZ

# [m/s^2] largest change between two readings of an accelerometer. A real jump is accepted at its
# second reading.
JUMP_M_S2 = 3.0
EARLY_S = 1e-6  # [s] tolerance of the block length for rounding of the sample times
YAW_WALK = 3.0  # [rad/s/s^.5] random walk of the yaw rate: yaw acceleration of a lively car
REAR_STD = 0.03  # [rad/s] error of the yaw rate from the rear wheels: noise and slip difference


@compiled
def take_sample(
    memory: MixtureMemory, design: MixtureDesign, time: float, sample: FloatArray
) -> tuple[int, bool]:
    """Add a sample (18,) at `time` [s] to the current block. Return the health flags of the sample,
    and True if the block is complete.
    """
    last = memory.last
    dt = time - last.time
    if not dt > 0.0:
        return flags.TIME_GAP, False
    now = last.now
    # The block decides about NO_STEERING, because a single missing angle is replaced.
    health = read_plausible(sample, now) & ~flags.NO_STEERING
    health |= refuse_jumps(memory.row, now) | leave_out_failed(memory.row, last, time)
    hold_readings(last, time, design.constants.chosen)
    last.position_time = position_time(sample, time, last.position_time)
    health |= position_health(time, last.position_time)
    if dt > GAP_S:
        health |= flags.TIME_GAP | bridge_gap(memory, design, dt)
        last.time = time
        begin_block(memory)
        return health, False
    _filter_yaw_rate(memory, dt)
    ax = _drop_outlier(now[S.AX], last.ax, last.read_ax)
    ay = _drop_outlier(now[S.AY], last.ay, last.read_ay)
    last.read_ax = now[S.AX]
    last.read_ay = now[S.AY]
    last.reading[S.AX] = ax  # an outlier is not held
    last.reading[S.AY] = ay
    if math.isnan(ax + ay) and not math.isnan(last.read_ax + last.read_ay):
        health |= flags.OUTLIER
    _integrate_motion(memory, design.constants, dt, ax, ay, not math.isnan(now[S.YAW_RATE]))
    _add_sample(memory, ax, ay)
    last.time = time
    return health, time - memory.block.time >= design.constants.chosen.block_time - EARLY_S


@compiled
def hold_readings(last: LastInputs, time: float, chosen: DesignConstants) -> None:
    """Note the readings `last.now` of the sample at `time` [s]. Replace a missing inertial reading
    or steering angle by the last one, because rows of a log are often more frequent than some of
    its signals.

    A reading is replaced for a block, or for the signal's longest interval between readings in the
    last seconds (time constant `window`), and at most for a period of SLOWEST_HZ.
    """
    for channel in range(INPUTS):
        age = time - last.reading_time[channel]
        interval = last.reading_interval[channel]
        if not math.isnan(last.now[channel]):
            last.reading_interval[channel] = max(age, interval * math.exp(-age / chosen.window))
            last.reading[channel] = last.now[channel]
            last.reading_time[channel] = time
        elif channel < S.OMEGA:
            longest = min(max(interval, chosen.block_time), 1.0 / SLOWEST_HZ)
            if age <= longest + EARLY_S:
                last.now[channel] = last.reading[channel]


@compiled
def begin_block(memory: MixtureMemory) -> None:
    """Clear the sums in `memory`, and begin a new block (the samples within the next 0.05 s) at the
    last sample.
    """
    last = memory.last
    block = memory.block
    block.time = last.time
    block.samples = 0
    block.angle = 0.0
    block.cos_sum = 0.0
    block.sin_sum = 0.0
    block.missing_x = 0.0
    block.missing_y = 0.0
    _clear_gain(block.gain)
    _clear_gain(block.gain_sum)
    block.start_yaw_rate = last.yaw_rate
    for channel in range(INPUTS):
        block.sums[channel] = 0.0
        block.counts[channel] = 0
    for wheel in range(4):
        block.start_omega[wheel] = last.omega[wheel]
        last.delta_before[wheel] = last.delta[wheel]
        block.start_omega_time[wheel] = last.reading_time[S.OMEGA + wheel]


@compiled
def _clear_gain(gain: VelocityGain) -> None:
    gain.measured.x = 0.0
    gain.measured.y = 0.0
    gain.leak_y.x = 0.0
    gain.leak_y.y = 0.0
    gain.unit.x = 0.0
    gain.unit.y = 0.0


@compiled
def _filter_yaw_rate(memory: MixtureMemory, dt: float) -> None:
    """Run one step of `dt` [s] of a scalar Kalman filter of the yaw rate in `memory`.

    The model is a random walk. The measurement is the gyroscope or, where it is missing, the speed
    difference of the rear wheels.
    """
    last = memory.last
    now = memory.last.now
    row = memory.row
    variance = last.yaw_rate_var + YAW_WALK**2 * dt
    value = now[S.YAW_RATE]
    noise = YAW_STD
    if math.isnan(value):
        left = now[S.OMEGA + 2]
        right = now[S.OMEGA + 3]
        value = row[Parameter.RADIUS] * (right - left) / row[Parameter.TRACK_REAR]
        noise = REAR_STD
    if math.isnan(value):
        last.yaw_rate_var = min(variance, UNKNOWN_YAW_VAR)
        return
    gain = variance / (variance + noise**2)
    last.yaw_rate += gain * (value - last.yaw_rate)
    last.yaw_rate_var = gain * noise**2


@compiled
def _drop_outlier(value: float, used: float, read: float) -> float:
    """Return the accelerometer's reading `value` [m/s^2], or NaN if it differs by more than
    JUMP_M_S2 from both `used` (last accepted reading) and `read` (last reading, accepted or not).
    """
    jumps = abs(value - read) > JUMP_M_S2 and abs(value - used) > JUMP_M_S2
    return math.nan if jumps else value


@compiled
def _integrate_motion(
    memory: MixtureMemory, constants: Constants, dt: float, ax: float, ay: float, turning: bool
) -> None:
    """Integrate, over a further step of `dt` [s], the velocity that the vehicle has gained since
    the beginning of the block. It is expressed in the current vehicle axes.

    The solution is exact for inputs that are constant over dt. `ax` and `ay` [m/s^2] are NaN where
    missing; `turning` is True if the yaw rate is known.
    """
    last = memory.last
    block = memory.block
    rate = last.yaw_rate
    time = last.time + dt
    if not math.isnan(ax + ay):
        last.inertial_time = time
    elif time - last.inertial_time < 0.5 * constants.chosen.block_time:  # a short gap is filled
        ax = last.ax if math.isnan(ax) else ax
        ay = last.ay if math.isnan(ay) else ay
    leak_y = ay
    if math.isnan(ax):
        ax = 0.0
        block.missing_x += LOST_WALK**2 * dt
    if math.isnan(ay) or not turning:
        block.missing_y += LOST_WALK**2 * dt
    if math.isnan(ay):
        ay = rate * memory.overall_mean[NodeState.VX]
        leak_y = 0.0
    last.ax = ax
    last.ay = ay
    note_grip(memory.grip, constants, ax, ay, dt)
    gain = block.gain
    total = block.gain_sum
    _advance_gain(gain.measured, ax, ay, rate, dt)
    _advance_gain(gain.leak_y, 0.0, leak_y, rate, dt)
    _advance_gain(gain.unit, 1.0, 0.0, rate, dt)
    block.angle += rate * dt
    block.cos_sum += math.cos(block.angle)
    block.sin_sum += math.sin(block.angle)
    _add_vector(total.measured, gain.measured)
    _add_vector(total.leak_y, gain.leak_y)
    _add_vector(total.unit, gain.unit)
    block.samples += 1


@compiled
def _advance_gain(gained: PlanarVector, ax: float, ay: float, rate: float, dt: float) -> None:
    gained.x, gained.y = advance_velocity(gained.x, gained.y, ax, ay, rate, dt)


@compiled
def _add_vector(total: PlanarVector, part: PlanarVector) -> None:
    total.x += part.x
    total.y += part.y


@compiled
def _add_sample(memory: MixtureMemory, ax: float, ay: float) -> None:
    last = memory.last
    now = memory.last.now
    block = memory.block
    for channel in range(INPUTS):
        value = ax if channel == S.AX else ay if channel == S.AY else now[channel]
        if not math.isnan(value):
            block.sums[channel] += value
            block.counts[channel] += 1
    for wheel in range(4):
        omega = now[S.OMEGA + wheel]
        if not math.isnan(omega):
            note_step(last, wheel, omega)
            last.omega[wheel] = omega
        if block.counts[S.DELTA + wheel] > 0:
            last.delta[wheel] = block.sums[S.DELTA + wheel] / block.counts[S.DELTA + wheel]
            if wheel >= 2:
                last.rear_steering = True
