"""Federated filter of planar motion that papers 000 and 001 share. It has two cubature sub-filters
and a master that fuses their results.

State [v_x, v_y, a_x, a_y, r, r'] (the papers use the moment Gamma = I_z*r' instead of r').
Sub-filter 1 measures [a_x, a_y, r], sub-filter 2 [a_y, r] (000, below equation 53). Equations of
one step: share the information (15) to (17), predict (21) to (25), update (31) to (39), fuse (49),
(50).

Departures from the papers: (1) Both sub-filters use the same measured a_y and r. Therefore each
sub-filter uses twice the variance, so that the fused estimate equals that of one filter. (2)
Sub-filter 1 also measures the speed of the wheels, corrected for the slip that their force needs,
because nothing in the printed measurements observes v_x.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from edge_agent.dynamics.loads import wheel_loads
from edge_agent.dynamics.parameters import Parameter, body_of
from edge_agent.dynamics.slip import wheel_velocity
from edge_agent.estimators.common.inputs import InputTrack, wheel_force
from edge_agent.estimators.common.motion import FIRST_V_STD, UNKNOWN_V_STD
from edge_agent.estimators.common.readings import rolling_speed
from edge_agent.estimators.common.run import PaperMemory
from edge_agent.estimators.gaussian.planar import (
    POINTS,
    PlanarState,
    PlanarStep,
    propagate_points,
)
from edge_agent.filters.federated import fuse_estimates, share_information
from edge_agent.filters.householder import Measurement, predict, update
from edge_agent.filters.points import axis_points, centred_deviations, weighted_mean
from edge_agent.filters.sigma import cubature_rule
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.runtime.records import RecordArray
from schemas.signals import S

STATES = 6
ROWS = 4
RULE = cubature_rule(STATES)
XI = RULE.xi
WEIGHT = RULE.w_cov
STEP_S = 0.02  # [s] time to which the process variances refer
# Process standard deviations per STEP_S. They cover offsets of the accelerometers, drag and slopes
# that torque does not show, and errors of the tyre model. The papers give 100, 1 and .01 for all
# states, without a unit.
PROCESS = np.sqrt(np.array([4e-6, 4e-6, 5e-2, 5e-2, 1e-6, 5e-2]))
START = np.sqrt(np.array([FIRST_V_STD**2, FIRST_V_STD**2, 0.2, 0.2, 0.01, 0.2]))
# Error of the vehicle speed according to the wheels
SPEED_STD = 0.03  # [m/s] constant part
SPEED_SHARE = 0.003  # [1] relative part, from the wheel radii
SLIP_SHARE = 0.3  # [1] relative error of the slip computed from force
# [1] innovation, in standard deviations, beyond which the error of the wheels' speed is increased
FARTHEST = 2.0
LEAST_BETA = 0.1  # [1] smallest information share, so that both sub-filters keep some information


class MotionSetting(NamedTuple):
    """Variances of the filter of planar motion (velocity, acceleration, yaw rate): process noise
    per STEP_S, initial state, and measurement noise of each sub-filter.
    """

    process: tuple[float, ...] = tuple(map(float, PROCESS**2))
    start: tuple[float, ...] = tuple(map(float, START**2))
    # Measurement noise with some model error. The variances of a_y and r are doubled, because both
    # sub-filters use them. The papers choose theirs for each manoeuvre.
    first: tuple[float, float, float] = (0.01, 0.02, 2e-4)  # a_x, a_y, r
    second: tuple[float, float] = (0.02, 2e-4)  # a_y, r
    wheel_speed: bool = True  # True if sub-filter 1 also measures the speed of the wheels


class FederatedMotion:
    """Data of the filter of planar motion for one vehicle: variances, state of the master,
    information shares of the sub-filters, and latest innovations (measurement minus prediction).
    """

    process: Annotated[FloatArray, STATES]  # standard deviations per STEP_S
    start: Annotated[FloatArray, STATES]  # standard deviations
    noise: Annotated[FloatArray, 2, 3]  # variances of a_x, a_y and r in each sub-filter
    wheel_speed: bool
    mean: Annotated[FloatArray, STATES]
    root: Annotated[FloatArray, STATES, STATES]
    beta: float  # [1] information share of sub-filter 1
    factor: Annotated[FloatArray, 2]  # [1] factor on R of each sub-filter
    gamma: Annotated[FloatArray, 2]  # [1] squared innovation over its expectation, per sub-filter
    innovation: Annotated[FloatArray, 2, ROWS]
    expected: Annotated[FloatArray, 2, ROWS]  # innovation variances with nominal R
    # Trace of each sub-filter's covariance, each variance over its initial value
    size: Annotated[FloatArray, 2]


class FederatedMemory(PaperMemory):
    """Fields that the filter records of papers 000 and 001 share. A record keeps the state of one
    vehicle's filter between samples.
    """

    motion: FederatedMotion


class SubFilter(NamedTuple):
    """Mean and covariance root of one of the two sub-filters of the motion filter during a step,
    with scratch arrays.
    """

    number: int  # 0 or 1
    mean: FloatArray
    root: FloatArray
    points: FloatArray
    work: FloatArray


def set_motion(filters: RecordArray, setting: MotionSetting) -> None:
    """Write the settings (variances) of the motion filter into the filter records of all vehicles;
    call this once, before the first sample.
    """
    motion = filters["motion"]
    # For the default setting, use PROCESS and START themselves. The square roots of their rounded
    # squares may differ from them in the last bit.
    usual = MotionSetting()
    motion["process"] = PROCESS if setting.process == usual.process else np.sqrt(setting.process)
    motion["start"] = START if setting.start == usual.start else np.sqrt(setting.start)
    motion["noise"][:, 0] = setting.first
    motion["noise"][:, 1, 1:] = setting.second
    motion["wheel_speed"] = setting.wheel_speed


@compiled
def begin_motion(memory: FederatedMemory) -> None:
    """Begin the motion filter: initial v_x is the speed of the wheels."""
    motion = memory.motion
    use = memory.track.inputs
    mean = motion.mean
    root = motion.root
    speed = rolling_speed(memory.row, memory.track.now)
    known = not math.isnan(speed)
    mean[:] = 0.0
    mean[PlanarState.VX] = speed if known else 0.0
    mean[PlanarState.AX] = use[S.AX]
    mean[PlanarState.AY] = use[S.AY]
    mean[PlanarState.YAW_RATE] = use[S.YAW_RATE]
    root[:, :] = 0.0
    for i in range(STATES):
        root[i, i] = motion.start[i]
    if not known:
        root[PlanarState.VX, PlanarState.VX] = UNKNOWN_V_STD
    motion.beta = 0.5
    motion.factor[:] = 1.0
    motion.gamma[:] = 1.0


@compiled
def step_motion(memory: FederatedMemory, friction: FloatArray, dt: float) -> None:
    """Run one step of the motion filter: share the information between both sub-filters, predict by
    `dt` [s], update and fuse them.

    `friction` (4,) is the friction of the wheels, which the filter does not estimate.
    """
    motion = memory.motion
    track = memory.track
    row = memory.row
    root = np.empty((STATES, STATES))
    process = np.zeros((STATES, STATES))
    mean = np.empty(STATES)
    first_mean = np.empty(STATES)
    first_root = np.empty((STATES, STATES))
    points = np.empty((2 * STATES, STATES))
    work = np.empty((2 * STATES, 4 * STATES))
    columns = np.empty((STATES, POINTS))
    memory.nis = 0.0
    memory.log_likelihood = 0.0
    for sub in range(2):
        beta = motion.beta if sub == 0 else 1.0 - motion.beta
        share_information(motion.root, beta, root)
        axis_points(motion.mean, root, XI, points)
        columns[:] = points.T
        propagate_points(row, columns, friction, track, PlanarStep(dt, True, False))
        points[:] = columns.T
        for i in range(STATES):
            process[i, i] = motion.process[i] * math.sqrt(dt / STEP_S / beta)
        predict(points, (WEIGHT, WEIGHT), process, mean, root, work)
        _update_sub_filter(memory, SubFilter(sub, mean, root, points, work), dt)
        if sub == 0:
            first_mean[:] = mean
            first_root[:] = root
    fuse_estimates(first_mean, first_root, mean, root, work)
    motion.mean[:] = first_mean
    motion.root[:] = first_root


@compiled
def _update_sub_filter(memory: FederatedMemory, at: SubFilter, dt: float) -> None:
    motion = memory.motion
    track = memory.track
    row = memory.row
    sub = at.number
    points = at.points
    mean = at.mean
    root = at.root
    outcomes = np.empty((2 * STATES, ROWS))
    predicted = np.empty(ROWS)
    std = np.empty(ROWS)
    state = np.empty((STATES, 2 * STATES))
    measured = np.empty((ROWS, 2 * STATES))
    axis_points(mean, root, XI, points)
    for p in range(points.shape[0]):
        for r in range(3):
            outcomes[p, r] = points[p, PlanarState.AX + r]
        outcomes[p, 3] = mean_wheel_velocity(row, track, points[p], PlanarState.YAW_RATE)
    weighted_mean(outcomes, WEIGHT, predicted)
    centred_deviations(points, mean, WEIGHT, state, 0)
    centred_deviations(outcomes, predicted, WEIGHT, measured, 0)
    innovation = motion.innovation[sub]
    for r in range(3):
        innovation[r] = track.now[r] - predicted[r]
        std[r] = math.sqrt(motion.factor[sub] * motion.noise[sub, r])
    speed, std[3] = slip_free_speed(row, track, dt)
    innovation[3] = speed - predicted[3]
    std[3] = widened_speed_std(std[3], innovation[3])
    if not motion.wheel_speed:
        innovation[3] = math.nan
    if sub == 1:
        innovation[0] = math.nan
        innovation[3] = math.nan
    for r in range(ROWS):
        motion.expected[sub, r] = std[r] ** 2 / (motion.factor[sub] if r < 3 else 1.0)
        for p in range(points.shape[0]):
            motion.expected[sub, r] += measured[r, p] ** 2
    used, log_likelihood, square = update(
        mean, root, state, Measurement(measured, innovation, std), at.work
    )
    motion.gamma[sub] = square / max(used, 1)
    memory.nis += 0.5 * motion.gamma[sub]
    memory.log_likelihood += log_likelihood
    motion.size[sub] = 0.0
    for i in range(STATES):
        for j in range(i + 1):
            motion.size[sub] += (root[i, j] / motion.start[i]) ** 2


@compiled
def mean_wheel_velocity(row: FloatArray, track: InputTrack, x: FloatArray, yaw_rate: int) -> float:
    """Return the mean velocity [m/s] of the wheel centres in their rolling direction, over the
    wheels whose speed is measured.

    The velocity follows from the vehicle's motion in the state `x`: x[0] and x[1] are v_x and v_y,
    x[yaw_rate] is the yaw rate.
    """
    total = 0.0
    count = 0
    use = track.inputs
    for wheel in range(4):
        if not math.isnan(use[S.OMEGA + wheel]):
            total += wheel_velocity(row, wheel, x[0], x[1], x[yaw_rate], use[S.DELTA + wheel])[0]
            count += 1
    return total / max(count, 1)


@compiled
def widened_speed_std(std: float, innovation: float) -> float:
    """Return the standard deviation `std` [m/s] of the measured wheel speed, increased if the
    innovation is large.

    The increase limits the innovation to FARTHEST standard deviations, so that spinning or locked
    wheels have little effect.
    """
    return std if math.isnan(innovation) else max(std, abs(innovation) / FARTHEST)


@compiled
def slip_free_speed(row: FloatArray, track: InputTrack, dt: float) -> tuple[float, float]:
    """Return the vehicle speed according to the wheels, and its standard deviation, both in [m/s]:
    the mean of R*omega/(1 + slip) with radius R and wheel speed omega.

    The slip of a wheel is its longitudinal force over its slip stiffness. The result is NaN if no
    wheel speed is measured.
    """
    use = track.inputs
    loads = wheel_loads(body_of(row), use[S.AX], use[S.AY])
    total = 0.0
    most = 0.0
    count = 0
    for wheel in range(4):
        omega = use[S.OMEGA + wheel]
        if math.isnan(omega):
            continue
        slip = wheel_force(row, track, wheel, dt) / (row[Parameter.SLOPE_X] * loads[wheel])
        slip = min(max(slip, -0.5), 0.5)
        total += row[Parameter.RADIUS] * omega / (1.0 + slip)
        most = max(most, abs(slip))
        count += 1
    if count == 0:
        return math.nan, 1.0
    speed = total / count
    return speed, SPEED_STD + abs(speed) * (SPEED_SHARE + SLIP_SHARE * most)
