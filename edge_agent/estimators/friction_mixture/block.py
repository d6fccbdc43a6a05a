"""From the sums of a block to the few numbers that the measurement equations need.

Legend (index `F` of a feature row)
    COS, SIN, GAIN    mean velocity of the block = rotation(COS, SIN)*v + gains, v at the beginning of the block; the
                      four mean gains of memory.G, x and y each [m/s]
    ROLL              R*omega, mean rolling speed of a wheel [m/s]
    FORCE             F_x/F_z of a wheel [1]
    LOAD              wheel load over axle load [1]
    SIDE, SIDE_LEAK   F_y/F_z of an axle in the wheel's frame, and its derivative by the leak [1]
    NOISE             nominal standard deviation of a residual where the curve rises [1]: four wheels, two axles
    SLIP_NOISE        variance of the slip in it, as linear force over load [1]; half of it is in NOISE
    TELL_X, TELL_Y    what the force of an axle tells of stiffness, from 0 to 1
    UNLIKE            slip left against right of an axle beyond force and noise, in force over load [1]

Longitudinal force comes from torque, F_x = (T - J*omega')/R; where torque or speed is missing, from a_x shared out by
guess with a spread to match. Lateral axle forces come from m*a_y and Iz*r' (paper 004, equation 2; errata 000 on signs
and arms).
"""

from __future__ import annotations

import math
from enum import IntEnum

from edge_agent.dynamics.body import axle_lateral_forces
from edge_agent.dynamics.loads import wheel_loads
from edge_agent.dynamics.parameters import P, body
from edge_agent.dynamics.slip import wheel_position
from edge_agent.dynamics.wheel import force_from_torque
from edge_agent.estimators import flags
from edge_agent.estimators.friction_mixture.constants import C
from edge_agent.estimators.friction_mixture.memory import H
from schemas.numeric import FloatArray, IntArray
from schemas.runtime.jit import compiled
from schemas.signals import S


class F(IntEnum):
    """Index of a feature of a block; of a per-wheel feature, the index of its first wheel."""

    COS = 0
    SIN = 1
    GAIN = 2
    YAW_RATE = 10
    DEMAND = 11
    ROLL = 12
    FORCE = 16
    LOAD = 20
    STEER_COS = 24
    STEER_SIN = 28
    SIDE = 32
    SIDE_LEAK = 34
    NOISE = 36
    TELL_X = 42
    TELL_Y = 44
    UNLIKE = 46
    SLIP_NOISE = 47
    LENGTH = 53


@compiled
def mean_or(sums: FloatArray, counts: IntArray, channel: int, otherwise: float) -> float:
    """Mean of the valid samples of a channel in the block, or `otherwise`."""
    return sums[channel] / counts[channel] if counts[channel] > 0 else otherwise


@compiled
def _kinematics(held: FloatArray, gain_sum: FloatArray, features: FloatArray) -> None:
    share = 1.0 / held[H.SAMPLES]
    features[F.COS] = held[H.SUM_COS] * share
    features[F.SIN] = held[H.SUM_SIN] * share
    for k in range(4):
        features[F.GAIN + 2 * k] = gain_sum[k, 0] * share
        features[F.GAIN + 2 * k + 1] = gain_sum[k, 1] * share


@compiled
def _driving_share(row: FloatArray, wheel: int, ax: float) -> float:
    """Guess of a wheel's share of the total longitudinal force where torque is missing."""
    split = row[P.DRIVE_FRONT]
    front = 0.6 if ax < 0.0 or math.isnan(split) else split  # brakes favour the front
    return 0.5 * front if wheel < 2 else 0.5 * (1.0 - front)


@compiled
def _forces(
    row: FloatArray,
    constants: FloatArray,
    sums: FloatArray,
    counts: IntArray,
    spin: FloatArray,
    loads: FloatArray,
    features: FloatArray,
) -> int:
    """FORCE and the force part of NOISE of the four wheels; returns health flags."""
    health = 0
    ax = mean_or(sums, counts, S.AX, math.nan)
    for wheel in range(4):
        torque = mean_or(sums, counts, S.TORQUE + wheel, math.nan)
        if not (math.isnan(torque) or math.isnan(features[F.ROLL + wheel])):
            force = force_from_torque(torque, spin[wheel], row[P.WHEEL_INERTIA], row[P.RADIUS])
            spread = constants[C.FORCE_SHARE] * abs(force)
        else:
            if math.isnan(torque):
                health |= flags.NO_TORQUE
            known = 0.0 if math.isnan(ax) else row[P.MASS] * ax
            force = _driving_share(row, wheel, known) * known
            spread = constants[C.NO_TORQUE_SHARE] * abs(known)
            if math.isnan(ax):
                spread = constants[C.NO_TORQUE_SHARE] * loads[wheel]
        features[F.FORCE + wheel] = force / loads[wheel]
        features[F.NOISE + wheel] = spread / loads[wheel]
    return health


@compiled
def _sides(
    row: FloatArray,
    sums: FloatArray,
    counts: IntArray,
    yaw_acceleration: float,
    steer: FloatArray,
    loads: FloatArray,
    features: FloatArray,
) -> None:
    """SIDE and SIDE_LEAK of both axles; NaN without a_y."""
    ay = mean_or(sums, counts, S.AY, math.nan)
    moment = 0.0
    for wheel in range(4):
        y = wheel_position(row, wheel)[1]
        moment -= y * features[F.FORCE + wheel] * loads[wheel] * features[F.STEER_COS + wheel]
    front, rear = axle_lateral_forces(row, ay, yaw_acceleration, moment)
    leak_front, leak_rear = axle_lateral_forces(row, -ay, 0.0, 0.0)
    for axle in range(2):
        left, right = 2 * axle, 2 * axle + 1
        load = loads[left] + loads[right]
        along = features[F.FORCE + left] * loads[left] + features[F.FORCE + right] * loads[right]
        angle = 0.5 * (steer[left] + steer[right])
        cos = math.cos(angle)
        side = (front if axle == 0 else rear) - along * math.sin(angle)
        features[F.SIDE + axle] = side / (cos * load)
        features[F.SIDE_LEAK + axle] = (leak_front if axle == 0 else leak_rear) / (cos * load)
        features[F.LOAD + left] = loads[left] / load
        features[F.LOAD + right] = loads[right] / load


@compiled
def _noise(
    row: FloatArray,
    constants: FloatArray,
    counts: IntArray,
    speed: float,
    scales: FloatArray,
    before: FloatArray,
    duration: float,
    features: FloatArray,
) -> None:
    """NOISE: slip noise and force noise meet under the total-least-squares residual with half the variance each."""
    speed = max(speed, 0.5)
    for wheel in range(4):
        samples = max(counts[S.OMEGA + wheel], 1)
        slip = constants[C.OMEGA_NOISE] / math.sqrt(samples) * row[P.RADIUS] / speed
        white = row[P.SLOPE_X] * slip
        bend = constants[C.BEND_SHARE] * features[F.FORCE + wheel] ** 2
        variance = 0.5 * white**2 + constants[C.FLOOR_X] ** 2 + features[F.NOISE + wheel] ** 2 + bend**2
        features[F.NOISE + wheel] = math.sqrt(variance * scales[0])
        features[F.SLIP_NOISE + wheel] = white**2 * scales[0]
    for axle in range(2):
        side = features[F.SIDE + axle]
        turning = constants[C.GYRO_STD] * (row[P.TO_FRONT] if axle == 0 else row[P.TO_REAR]) / speed
        pointing = constants[C.ANGLE_SHARE] * features[F.STEER_SIN + 2 * axle]
        angle = row[P.SLOPE_Y] * math.sqrt(constants[C.ANGLE_STD] ** 2 + turning**2 + pointing**2)
        share = constants[C.AXLE_SHARE] * side
        bend = constants[C.BEND_SHARE] * side * side
        change = side - before[axle]
        lag = 0.0 if math.isnan(change) else constants[C.LAG] * change / duration
        before[axle] = side
        variance = 0.5 * angle**2 + constants[C.FLOOR_Y] ** 2 + share**2 + bend**2 + lag**2
        features[F.NOISE + 4 + axle] = math.sqrt(variance * scales[1])
        features[F.SLIP_NOISE + 4 + axle] = angle**2 * scales[1]


@compiled
def block_features(
    row: FloatArray,
    constants: FloatArray,
    scales: FloatArray,
    held: FloatArray,
    side: FloatArray,
    gain_sum: FloatArray,
    sums: FloatArray,
    counts: IntArray,
    start_omega: FloatArray,
    last_omega: FloatArray,
    steer: FloatArray,
    duration: float,
    speed: float,
    loads: FloatArray,
    spin: FloatArray,
    features: FloatArray,
) -> int:
    """Fill `features` (LENGTH,) from the sums of a block; scales (2,) multiply R; returns health flags.

    loads and spin, (4,), are scratch: wheel loads [N] and wheel accelerations [rad/s^2].
    """
    _kinematics(held, gain_sum, features)
    features[F.YAW_RATE] = mean_or(sums, counts, S.YAW_RATE, held[H.YAW_RATE])
    ax, ay = mean_or(sums, counts, S.AX, 0.0), mean_or(sums, counts, S.AY, 0.0)
    fl, fr, rl, rr = wheel_loads(body(row), ax, ay)
    loads[0], loads[1], loads[2], loads[3] = fl, fr, rl, rr
    for wheel in range(4):
        features[F.STEER_COS + wheel] = math.cos(steer[wheel])
        features[F.STEER_SIN + wheel] = math.sin(steer[wheel])
        features[F.ROLL + wheel] = row[P.RADIUS] * mean_or(sums, counts, S.OMEGA + wheel, math.nan)
        change = (last_omega[wheel] - start_omega[wheel]) / duration
        spin[wheel] = 0.0 if math.isnan(change) else change
    health = _forces(row, constants, sums, counts, spin, loads, features)
    yaw_acceleration = (held[H.YAW_RATE] - held[H.START_YAW_RATE]) / duration
    _sides(row, sums, counts, yaw_acceleration, steer, loads, features)
    if counts[S.DELTA] + counts[S.DELTA + 1] == 0:  # without steering the front axle's slip is unknown
        features[F.SIDE] = math.nan
        health |= flags.NO_STEERING
    if held[H.REAR_STEERING] > 0.0 and counts[S.DELTA + 2] + counts[S.DELTA + 3] == 0:
        features[F.SIDE + 1] = math.nan
        health |= flags.NO_STEERING
    if counts[S.YAW_RATE] == 0:  # axle forces need it twice
        features[F.SIDE] = features[F.SIDE + 1] = math.nan
    _noise(row, constants, counts, speed, scales, side, duration, features)
    features[F.DEMAND] = demand(features)
    _tell(constants, features)
    features[F.UNLIKE] = unlike(row, constants, features, counts, speed)
    return health


@compiled
def _tell(constants: FloatArray, features: FloatArray) -> None:
    """TELL_X and TELL_Y: below some force it is noise of the slip that would tell stiffness."""
    for axle in range(2):
        along = max(abs(features[F.FORCE + 2 * axle]), abs(features[F.FORCE + 2 * axle + 1]))
        side = features[F.SIDE + axle]
        features[F.TELL_X + axle] = along * along / (along * along + constants[C.TELLING_X] ** 2)
        features[F.TELL_Y + axle] = (
            0.0 if math.isnan(side) else side * side / (side * side + constants[C.TELLING_Y] ** 2)
        )


@compiled
def unlike(row: FloatArray, constants: FloatArray, features: FloatArray, counts: IntArray, speed: float) -> float:
    """Largest difference between the sides of an axle of slip (as linear force over load) not asked for by force."""
    most, speed = 0.0, max(speed, 1.0)
    for axle in range(2):
        left, right = 2 * axle, 2 * axle + 1
        track = row[P.TRACK_FRONT] if axle == 0 else row[P.TRACK_REAR]
        turning = track * features[F.YAW_RATE] * features[F.STEER_COS + left]
        slip = (features[F.ROLL + right] - features[F.ROLL + left] - turning) / speed
        samples = max(min(counts[S.OMEGA + left], counts[S.OMEGA + right]), 1)
        noise = constants[C.OMEGA_NOISE] * row[P.RADIUS] / speed * math.sqrt(2.0 / samples)
        apart = abs(row[P.SLOPE_X] * slip - features[F.FORCE + right] + features[F.FORCE + left])
        if not math.isnan(apart):
            most = max(most, apart - 4.0 * row[P.SLOPE_X] * noise)
    return most


@compiled
def demand(features: FloatArray) -> float:
    """Largest force over load of any wheel [1]; a missing lateral force counts as none."""
    most = 0.0
    for wheel in range(4):
        side = features[F.SIDE + wheel // 2]
        across = 0.0 if math.isnan(side) else side
        most = max(most, math.hypot(features[F.FORCE + wheel], across))
    return most
