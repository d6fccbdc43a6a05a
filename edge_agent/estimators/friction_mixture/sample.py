"""Taking a sample in: refusal of the impossible, the yaw-rate filter, the kinematics and sums of the block.

Missing readings and what replaces them: a_x by zero and a_y by r*v_x, both with a random walk to match; yaw rate by the
difference of the rear wheels; steering by its last value; the rest is left out of the sums.
"""

from __future__ import annotations

import math

import numpy as np

from edge_agent.dynamics.body import advance_velocity
from edge_agent.dynamics.parameters import P
from edge_agent.estimators import flags
from edge_agent.estimators.friction_mixture.arrays import clear, clear_rows, put, put_pair, put_square
from edge_agent.estimators.friction_mixture.constants import C, X
from edge_agent.estimators.friction_mixture.memory import INPUTS, G, H, Memory
from edge_agent.estimators.friction_mixture.node import Nominal
from edge_agent.estimators.friction_mixture.nodes import quantile
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import S

# beyond these a reading is an error of the sensor, not of the driver
LARGEST_ACCELERATION = 40.0  # [m/s^2]
LARGEST_YAW_RATE = 6.0  # [rad/s]
LARGEST_STEER = 1.3  # [rad]
LARGEST_OMEGA = 500.0  # [rad/s]
LARGEST_TORQUE = 50_000.0  # [N m]
# largest believable size of a reading on each channel before the position
LIMITS = np.array(
    [LARGEST_ACCELERATION] * 2 + [LARGEST_YAW_RATE] + [LARGEST_STEER] * 4 + [LARGEST_OMEGA] * 4 + [LARGEST_TORQUE] * 4
)

JUMP_M_S2 = 3.0  # of an accelerometer from one reading to the next; a real one is believed at the second
HOLD_S = 0.025  # a shorter silence of an accelerometer is bridged by its last reading
GAP_S = 0.5  # a longer silence starts the block anew
POSITION_S = 1.5  # a longer silence of the receiver is told
EARLY_S = 1e-6  # a block is whole although rounding made its last sample early
YAW_WALK = 3.0  # [rad/s/s^.5] yaw acceleration of a lively car as a random walk
YAW_STD = 0.002  # [rad/s] white noise of a gyroscope sample
REAR_STD = 0.03  # [rad/s] yaw rate from the rear wheels: noise and slip difference
LOST_AX = 2.0  # [m/s/s^.5] random walk without a_x
LOST_AY = 0.7  # [m/s/s^.5] random walk without a_y or yaw rate
GAP_ACCELERATION = 2.0  # [m/s^2] that may have acted during a silence
FIRST_VX_STD, FIRST_VY_STD = 0.3, 0.3  # [m/s]
UNKNOWN_VX_STD = 15.0  # [m/s] without any wheel speed


@compiled
def reading(sample: FloatArray, channel: int) -> float:
    """The reading, or NaN where it is missing, infinite or unbelievable."""
    value = sample[channel]
    return value if abs(value) <= LIMITS[channel] else math.nan


@compiled
def rolling_speed(row: FloatArray, sample: FloatArray) -> float:
    """Second largest rolling speed [m/s] (two wheels may be locked, one may spin); NaN without any wheel."""
    first = second = math.nan
    for wheel in range(4):
        speed = row[P.RADIUS] * reading(sample, S.OMEGA + wheel)
        if math.isnan(speed):
            continue
        if math.isnan(first) or speed > first:
            first, second = speed, first
        elif math.isnan(second) or speed > second:
            second = speed
    return first if math.isnan(second) else second


@compiled
def start(
    memory: Memory,
    nominal: Nominal,
    mu: FloatArray,
    prior: FloatArray,
    row: FloatArray,
    time: float,
    sample: FloatArray,
) -> int:
    """Begin the vehicle at its first sample with a finite time."""
    if not math.isfinite(time):
        return flags.TIME_GAP
    held = memory.held
    for k in range(held.shape[0]):
        held[k] = 0.0
    held[H.TIME] = held[H.BLOCK_TIME] = time
    held[H.POSITION_TIME] = held[H.INERTIAL_TIME] = -math.inf
    held[H.TOLD_AX] = held[H.TOLD_AY] = math.nan
    rate = reading(sample, S.YAW_RATE)
    held[H.YAW_RATE] = held[H.START_YAW_RATE] = 0.0 if math.isnan(rate) else rate
    held[H.YAW_RATE_VAR] = 1.0 if math.isnan(rate) else YAW_STD**2
    for wheel in range(4):
        memory.start_omega[wheel] = memory.last_omega[wheel] = reading(sample, S.OMEGA + wheel)
        angle = reading(sample, S.DELTA + wheel)
        memory.last_delta[wheel] = 0.0 if math.isnan(angle) else angle
    speed = rolling_speed(row, sample)
    known = not math.isnan(speed)
    memory.all_mean[X.VX] = speed if known else 0.0
    forget_vehicle(memory, nominal)
    memory.all_covariance[X.VX, X.VX] = (FIRST_VX_STD if known else UNKNOWN_VX_STD) ** 2
    memory.all_covariance[X.VY, X.VY] = FIRST_VY_STD**2
    for j in range(prior.shape[0]):
        memory.weight[j] = memory.visit[j] = prior[j]
        put(memory.mean[j], memory.all_mean)
        put_square(memory.covariance[j], memory.all_covariance)
    for k, level in enumerate((0.5, 0.05, 0.95)):
        held[H.MU + k] = held[H.LEFT + k] = held[H.RIGHT + k] = quantile(mu, prior, prior, level)
    clear_rows(memory.gain)
    clear_rows(memory.gain_sum)
    memory.started = True
    return flags.OK


@compiled
def take_sample(
    memory: Memory, constants: FloatArray, prior: FloatArray, row: FloatArray, time: float, sample: FloatArray
) -> tuple[int, bool]:
    """Add a sample to the block; returns its health flags and whether the block is whole."""
    held = memory.held
    dt = time - held[H.TIME]
    if not dt > 0.0:
        return flags.TIME_GAP, False
    health = _checks(memory, time, sample)
    if dt > GAP_S:
        return health | flags.TIME_GAP | _bridge(memory, constants, prior, row, time, sample), False
    _yaw_rate(memory, row, dt, sample)
    ax, ay = _believed(held, S.AX, H.AX, H.TOLD_AX, sample), _believed(held, S.AY, H.AY, H.TOLD_AY, sample)
    if math.isnan(ax + ay) and not math.isnan(reading(sample, S.AX) + reading(sample, S.AY)):
        health |= flags.OUTLIER
    _kinematics(memory, time, dt, ax, ay, not math.isnan(reading(sample, S.YAW_RATE)))
    _add(memory, ax, ay, sample)
    held[H.TIME] = time
    return health, time - held[H.BLOCK_TIME] >= constants[C.BLOCK] - EARLY_S


@compiled
def _checks(memory: Memory, time: float, sample: FloatArray) -> int:
    health = 0
    for channel in range(INPUTS):
        value = sample[channel]
        if not math.isnan(value) and not abs(value) <= LIMITS[channel]:
            health |= flags.OUTLIER
    if math.isfinite(sample[S.LATITUDE]) and math.isfinite(sample[S.LONGITUDE]):
        memory.held[H.POSITION_TIME] = time
    if not time - memory.held[H.POSITION_TIME] <= POSITION_S:
        health |= flags.NO_POSITION
    if math.isnan(reading(sample, S.AX) + reading(sample, S.AY) + reading(sample, S.YAW_RATE)):
        health |= flags.NO_INERTIAL
    for wheel in range(4):
        if math.isnan(reading(sample, S.OMEGA + wheel)):
            health |= flags.NO_WHEEL_SPEED
        if math.isnan(reading(sample, S.TORQUE + wheel)):
            health |= flags.NO_TORQUE
    return health


@compiled
def _yaw_rate(memory: Memory, row: FloatArray, dt: float, sample: FloatArray) -> None:
    """Scalar Kalman filter: random walk, gyroscope, and the rear wheels where it is missing."""
    held = memory.held
    variance = held[H.YAW_RATE_VAR] + YAW_WALK**2 * dt
    value, noise = reading(sample, S.YAW_RATE), YAW_STD
    if math.isnan(value):
        left, right = reading(sample, S.OMEGA + 2), reading(sample, S.OMEGA + 3)
        value, noise = row[P.RADIUS] * (right - left) / row[P.TRACK_REAR], REAR_STD
    if math.isnan(value):
        held[H.YAW_RATE_VAR] = min(variance, 1.0)
        return
    gain = variance / (variance + noise**2)
    held[H.YAW_RATE] += gain * (value - held[H.YAW_RATE])
    held[H.YAW_RATE_VAR] = gain * noise**2


@compiled
def _believed(held: FloatArray, channel: int, used: int, told: int, sample: FloatArray) -> float:
    """The accelerometer's reading; NaN where it is far from both the last one that was used and the last one told."""
    value = reading(sample, channel)
    jumps = abs(value - held[told]) > JUMP_M_S2 and abs(value - held[used]) > JUMP_M_S2
    held[told] = value
    return math.nan if jumps else value


@compiled
def _kinematics(memory: Memory, time: float, dt: float, ax: float, ay: float, turning: bool) -> None:
    """Velocity gained since the block began, in the axes of now: the exact solution for inputs constant over dt.

    ax, ay are NaN where they are missing; `turning` is whether the yaw rate is not.
    """
    held = memory.held
    rate = held[H.YAW_RATE]
    if not math.isnan(ax + ay):
        held[H.INERTIAL_TIME] = time
    elif time - held[H.INERTIAL_TIME] < HOLD_S:
        ax = held[H.AX] if math.isnan(ax) else ax
        ay = held[H.AY] if math.isnan(ay) else ay
    leak_x, leak_y = ax, ay
    if math.isnan(ax):
        ax = leak_x = 0.0
        held[H.MISSING_AX] = LOST_AX**2
    if math.isnan(ay) or not turning:
        held[H.MISSING_AY] = LOST_AY**2
    if math.isnan(ay):
        ay, leak_y = rate * memory.all_mean[X.VX], 0.0
    held[H.AX], held[H.AY] = ax, ay
    gain = memory.gain
    put_pair(gain[G.INPUT], advance_velocity(gain[G.INPUT, 0], gain[G.INPUT, 1], ax, ay, rate, dt))
    put_pair(gain[G.LEAK_X], advance_velocity(gain[G.LEAK_X, 0], gain[G.LEAK_X, 1], leak_x, 0.0, rate, dt))
    put_pair(gain[G.LEAK_Y], advance_velocity(gain[G.LEAK_Y, 0], gain[G.LEAK_Y, 1], 0.0, leak_y, rate, dt))
    put_pair(gain[G.UNIT], advance_velocity(gain[G.UNIT, 0], gain[G.UNIT, 1], 1.0, 0.0, rate, dt))
    held[H.ANGLE] += rate * dt
    held[H.SUM_COS] += math.cos(held[H.ANGLE])
    held[H.SUM_SIN] += math.sin(held[H.ANGLE])
    for k in range(gain.shape[0]):
        memory.gain_sum[k, 0] += gain[k, 0]
        memory.gain_sum[k, 1] += gain[k, 1]
    held[H.SAMPLES] += 1.0


@compiled
def _add(memory: Memory, ax: float, ay: float, sample: FloatArray) -> None:
    for channel in range(INPUTS):
        value = ax if channel == S.AX else ay if channel == S.AY else reading(sample, channel)
        if not math.isnan(value):
            memory.sums[channel] += value
            memory.counts[channel] += 1
    for wheel in range(4):
        omega = reading(sample, S.OMEGA + wheel)
        memory.last_omega[wheel] = memory.last_omega[wheel] if math.isnan(omega) else omega
        if memory.counts[S.DELTA + wheel] > 0:
            memory.last_delta[wheel] = memory.sums[S.DELTA + wheel] / memory.counts[S.DELTA + wheel]
            if wheel >= 2:
                memory.held[H.REAR_STEERING] = 1.0


@compiled
def forget_vehicle(memory: Memory, nominal: Nominal) -> None:
    """The overall moments of what is a property of vehicle or sensor become those of its prior."""
    covariance = memory.all_covariance
    for i in range(X.LN_KX, nominal.mean.shape[0]):
        memory.all_mean[i] = nominal.mean[i]
        for j in range(i + 1):
            covariance[i, j] = covariance[j, i] = 0.0
        covariance[i, i] = nominal.std[i] ** 2
    clear(memory.paid)


@compiled
def fall_asleep(memory: Memory, prior: FloatArray) -> None:
    """The nodes of unlike sides take no part any more; prior (K,) of the others."""
    if memory.held[H.UNLIKE] == 0.0:
        return
    memory.held[H.UNLIKE] = 0.0
    chain = prior.shape[0]
    for weight in (memory.weight, memory.visit):
        total = 0.0
        for j in range(chain):
            total += weight[j]
        for j in range(weight.shape[0]):
            weight[j] = weight[j] / total if j < chain else 0.0


@compiled
def restart_motion(memory: Memory, speed: float, spread: float) -> None:
    """All nodes go on at `speed` [m/s], or, where that is NaN, at the speed they have within `spread`."""
    if not math.isnan(speed):
        memory.all_mean[X.VX], spread = speed, FIRST_VX_STD
    memory.all_mean[X.VY] = 0.0
    covariance = memory.all_covariance
    for i in range(covariance.shape[0]):
        for axis in range(2):
            covariance[i, axis] = covariance[axis, i] = 0.0
    covariance[X.VX, X.VX], covariance[X.VY, X.VY] = spread**2, FIRST_VY_STD**2
    for j in range(memory.mean.shape[0]):
        put(memory.mean[j], memory.all_mean)
        put_square(memory.covariance[j], covariance)


@compiled
def _bridge(
    memory: Memory, constants: FloatArray, prior: FloatArray, row: FloatArray, time: float, sample: FloatArray
) -> int:
    """After a silence: the friction is forgotten over the metres driven meanwhile, the motion starts anew."""
    held = memory.held
    gone = time - held[H.TIME]
    hazard = 1.0 - math.exp(-abs(memory.all_mean[X.VX]) * gone * constants[C.HAZARD])
    fall_asleep(memory, prior)
    for j in range(prior.shape[0]):
        memory.weight[j] += hazard * (prior[j] - memory.weight[j])
        memory.visit[j] += hazard * (prior[j] - memory.visit[j])
    restart_motion(memory, rolling_speed(row, sample), min(GAP_ACCELERATION * gone, UNKNOWN_VX_STD))
    rate = reading(sample, S.YAW_RATE)
    if not math.isnan(rate):
        held[H.YAW_RATE], held[H.YAW_RATE_VAR] = rate, YAW_STD**2
    held[H.TIME] = held[H.BLOCK_TIME] = time
    for k in range(H.ANGLE, H.SAMPLES + 1):
        held[k] = 0.0
    clear_rows(memory.gain)
    clear_rows(memory.gain_sum)
    held[H.START_YAW_RATE] = held[H.YAW_RATE]
    for channel in range(INPUTS):
        memory.sums[channel] = 0.0
        memory.counts[channel] = 0
    for wheel in range(4):
        memory.start_omega[wheel] = memory.last_omega[wheel] = reading(sample, S.OMEGA + wheel)
    return flags.RESET
