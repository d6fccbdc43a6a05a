"""Two cubature sub-filters and a master on the planar motion: what papers 000 and 001 have in common.

State [v_x, v_y, a_x, a_y, r, r'] (the papers carry the moment Gamma = I_z*r'). Sub-filter 1 measures [a_x, a_y, r],
sub-filter 2 [a_y, r] (000, below equation 53). A turn: share (15) to (17), predict (21) to (25), update (31) to (39),
fuse (49), (50).

Departures: a_y and r are measured once but used by both sub-filters, so each takes them with twice the variance, and
the fused estimate is that of one filter; sub-filter 1 also measures the speed of the wheels, freed of the slip that
their force needs, because nothing in the printed measurements observes v_x.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Annotated

import numpy as np

from edge_agent.dynamics.loads import wheel_loads
from edge_agent.dynamics.parameters import P, body
from edge_agent.dynamics.slip import wheel_velocity
from edge_agent.estimators.common.readings import rolling_speed
from edge_agent.estimators.gaussian.intake import Track, wheel_force
from edge_agent.estimators.gaussian.planar import POINTS, carry
from edge_agent.estimators.gaussian.telling import FIRST_V_STD, UNKNOWN_V_STD
from edge_agent.filters.federated import fuse, share
from edge_agent.filters.householder import predict, update
from edge_agent.filters.points import axis_points, deviations, weighted_mean
from edge_agent.filters.sigma import cubature
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import S

STATES, ROWS = 6, 4
RULE = cubature(STATES)
XI, WEIGHT = RULE.xi, RULE.w_cov
STEP_S = 0.02  # process variances are per so much time
# variances of the process per STEP_S: offsets of the accelerometers, drag and slopes that torque does not know, and the
# error of the tyre model; the papers' 100, 1 and .01 for all states alike are in no unit
PROCESS = np.sqrt(np.array([4e-6, 4e-6, 5e-2, 5e-2, 1e-6, 5e-2]))
START = np.sqrt(np.array([FIRST_V_STD**2, FIRST_V_STD**2, 0.2, 0.2, 0.01, 0.2]))
# variances of a_x, a_y, r with some model error; the papers set theirs by hand for each manoeuvre
NOISE = np.array([0.01, 0.01, 1e-4])
SPEED_STD, SPEED_SHARE, SLIP_SHARE = 0.03, 0.003, 0.3  # [m/s], radius, and how wrong the slip of a force is
FARTHEST = 2.0  # innovations in standard deviations beyond which the wheels' speed is trusted less
LEAST_BETA = 0.1  # of the information, that no sub-filter is starved


class X(IntEnum):
    """Index of a state."""

    VX = 0
    VY = 1
    AX = 2
    AY = 3
    YAW_RATE = 4
    TURN = 5  # yaw acceleration [rad/s^2]


class Pair:
    """The master's state of one filter, its shares, and what the turn told."""

    mean: Annotated[FloatArray, STATES]
    root: Annotated[FloatArray, STATES, STATES]
    beta: float  # share of sub-filter 1
    factor: Annotated[FloatArray, 2]  # on R of each sub-filter
    gamma: Annotated[FloatArray, 2]  # squared innovation over its expectation, per sub-filter
    innovation: Annotated[FloatArray, 2, ROWS]
    expected: Annotated[FloatArray, 2, ROWS]  # innovation variances if R were nominal
    size: Annotated[FloatArray, 2]  # trace of the sub-filters' covariances over the starting variances
    nis: float
    log_likelihood: float


@compiled
def begin(pair: Pair, track: Track, row: FloatArray, sample: FloatArray) -> None:
    """Begin vehicle n at the speed of its wheels."""
    mean, root, use = pair.mean, pair.root, track.use
    speed = rolling_speed(row, sample)
    known = not math.isnan(speed)
    mean[:] = 0.0
    mean[X.VX] = speed if known else 0.0
    mean[X.AX], mean[X.AY], mean[X.YAW_RATE] = use[S.AX], use[S.AY], use[S.YAW_RATE]
    root[:, :] = 0.0
    for i in range(STATES):
        root[i, i] = START[i]
    if not known:
        root[X.VX, X.VX] = UNKNOWN_V_STD
    pair.beta, pair.factor[:], pair.gamma[:] = 0.5, 1.0, 1.0
    pair.nis = pair.log_likelihood = 0.0


@compiled
def turn(pair: Pair, track: Track, row: FloatArray, gone: float, friction: FloatArray) -> None:
    """Share, predict and update in both sub-filters, and fuse; friction (4,) is given. `gone` [s]."""
    root, process = np.empty((STATES, STATES)), np.zeros((STATES, STATES))
    mean, first_mean, first_root = np.empty(STATES), np.empty(STATES), np.empty((STATES, STATES))
    points, work = np.empty((2 * STATES, STATES)), np.empty((2 * STATES, 4 * STATES))
    columns = np.empty((STATES, POINTS))
    pair.nis = pair.log_likelihood = 0.0
    for sub in range(2):
        beta = pair.beta if sub == 0 else 1.0 - pair.beta
        share(pair.root, beta, root)
        axis_points(pair.mean, root, XI, points)
        columns[:] = points.T
        carry(row, columns, friction, track, gone, True)
        points[:] = columns.T
        for i in range(STATES):
            process[i, i] = PROCESS[i] * math.sqrt(gone / STEP_S / beta)
        predict(points, WEIGHT, WEIGHT, process, mean, root, work)
        _measure(pair, track, row, sub, gone, mean, root, points, work)
        if sub == 0:
            first_mean[:], first_root[:] = mean, root
    fuse(first_mean, first_root, mean, root, work)
    pair.mean[:], pair.root[:] = first_mean, first_root


@compiled
def _measure(
    pair: Pair, track: Track, row: FloatArray, sub: int, gone: float, mean: FloatArray, root: FloatArray,
    points: FloatArray, work: FloatArray,
) -> None:  # fmt: skip
    now = track.now
    outcomes, predicted, std = np.empty((2 * STATES, ROWS)), np.empty(ROWS), np.empty(ROWS)
    state, measured = np.empty((STATES, 2 * STATES)), np.empty((ROWS, 2 * STATES))
    axis_points(mean, root, XI, points)
    for p in range(points.shape[0]):
        for r in range(3):
            outcomes[p, r] = points[p, X.AX + r]
        outcomes[p, 3] = rolling(row, track.use, points[p], X.YAW_RATE)
    weighted_mean(outcomes, WEIGHT, predicted)
    deviations(points, mean, WEIGHT, state, 0)
    deviations(outcomes, predicted, WEIGHT, measured, 0)
    innovation = pair.innovation[sub]
    twice = np.array([1.0, 2.0, 2.0])
    for r in range(3):
        innovation[r] = now[r] - predicted[r]
        std[r] = math.sqrt(twice[r] * pair.factor[sub] * NOISE[r])
    speed, std[3] = freed_speed(row, track.before, track.use, gone)
    innovation[3] = speed - predicted[3]
    std[3] = doubted(std[3], innovation[3])
    if sub == 1:
        innovation[0] = innovation[3] = math.nan
    for r in range(ROWS):
        pair.expected[sub, r] = std[r] ** 2 / (pair.factor[sub] if r < 3 else 1.0)
        for p in range(points.shape[0]):
            pair.expected[sub, r] += measured[r, p] ** 2
    used, log_likelihood, square = update(mean, root, state, measured, innovation, std, work)
    pair.gamma[sub] = square / max(used, 1)
    pair.nis += 0.5 * pair.gamma[sub]
    pair.log_likelihood += log_likelihood
    pair.size[sub] = 0.0
    for i in range(STATES):
        for j in range(i + 1):
            pair.size[sub] += (root[i, j] / START[i]) ** 2


@compiled
def rolling(row: FloatArray, use: FloatArray, x: FloatArray, rate: int) -> float:
    """Mean speed along the wheels whose speed is measured, in state x whose yaw rate is state `rate`."""
    total, count = 0.0, 0
    for wheel in range(4):
        if not math.isnan(use[S.OMEGA + wheel]):
            total += wheel_velocity(row, wheel, x[X.VX], x[X.VY], x[rate], use[S.DELTA + wheel])[0]
            count += 1
    return total / max(count, 1)


@compiled
def doubted(std: float, innovation: float) -> float:
    """Standard deviation [m/s] of the wheels' speed: spinning or locked wheels count as two of them, at most."""
    return std if math.isnan(innovation) else max(std, abs(innovation) / FARTHEST)


@compiled
def freed_speed(row: FloatArray, before: FloatArray, use: FloatArray, gone: float) -> tuple[float, float]:
    """(mean of R*omega/(1 + slip), its standard deviation) [m/s], the slip being F_x/K; NaN without any wheel."""
    loads = wheel_loads(body(row), use[S.AX], use[S.AY])
    total, most, count = 0.0, 0.0, 0
    for wheel in range(4):
        omega = use[S.OMEGA + wheel]
        if math.isnan(omega):
            continue
        slip = wheel_force(row, before, use, wheel, gone) / (row[P.SLOPE_X] * loads[wheel])
        slip = min(max(slip, -0.5), 0.5)
        total += row[P.RADIUS] * omega / (1.0 + slip)
        most = max(most, abs(slip))
        count += 1
    if count == 0:
        return math.nan, 1.0
    speed = total / count
    return speed, SPEED_STD + abs(speed) * (SPEED_SHARE + SLIP_SHARE * most)
