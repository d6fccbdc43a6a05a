"""`sr-ukf`: the square-root unscented filter for the friction of four wheels of paper 003.

"Estimation of the road adhesion coefficient by a square-root unscented Kalman filter" for distributed drive vehicles
(paper 003; the equations are lost in the text copy, so its sections are cited). Seven degrees of freedom with Dugoff
tyres (section 2), unscented points, time and measurement update (3.1), posterior factor by downdates (3.2).

State [v_x, v_y, r, mu_fl, mu_fr, mu_rl, mu_rr]. The four wheels' degrees of freedom are their torque balances, taken as
measurements: F_x = (T - J*omega')/R. With them each driven wheel is observable; with the paper's a_x, a_y, r alone two
of four frictions are, at most (errata).

Departures: v_x, v_y, r are estimated, where the paper takes them from the simulator; a_x and a_y are inputs of the
kinematics, and the wheel torques stand for a_x in the measurement, with a_y, r and the speed of the wheels freed of
slip; alpha = 1, where .001 gives the centre a weight of -10^6; a downdate that would lose a positive covariance
refuses, and an orthogonal update takes its place, where the paper clips singular values; friction returns to the prior
over the metres driven, and counts only as far as it is used, so that the bounds of a wheel that tells nothing are the
prior's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import Annotated

import numpy as np

from edge_agent.dynamics.body import advance_velocity
from edge_agent.dynamics.chassis import DUGOFF, response, turned, tyre_forces
from edge_agent.dynamics.loads import wheel_loads
from edge_agent.dynamics.parameters import Four, P, body, four
from edge_agent.estimators import flags
from edge_agent.estimators.bank import EstimatorBank
from edge_agent.estimators.common.readings import rolling_speed
from edge_agent.estimators.estimates import FOUR_FRICTIONS, Y
from edge_agent.estimators.gaussian.intake import BEGUN, STEPPED, Track, new_filters, take, wheel_force
from edge_agent.estimators.gaussian.pair import doubted, freed_speed, rolling
from edge_agent.estimators.gaussian.road import FORGET_M, LOOK_S, PRIOR_ROOT, mean_friction, told_share
from edge_agent.estimators.gaussian.telling import (
    FIRST_V_STD,
    PRIOR_MU,
    PRIOR_MU_STD,
    UNKNOWN_V_STD,
    hold_mu,
    interval,
    lost,
    sliding,
    tell_motion,
    tell_no_wheel,
    tell_nothing,
    tell_rest,
    tell_wheel,
)
from edge_agent.filters.cholesky import variance
from edge_agent.filters.downdate import update_by_downdate
from edge_agent.filters.householder import predict
from edge_agent.filters.points import deviations, sigma_points, weighted_mean
from edge_agent.filters.sigma import unscented
from schemas.mugrid import LOWER, UPPER
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled, nogil
from schemas.runtime.records import Nothing, Records, records
from schemas.signals import S
from schemas.thresholds import GRAVITY
from schemas.vehicle import Vehicle

STATES, ROWS = 7, 7  # rows: speed of the wheels, r, a_y, four longitudinal forces
MU = 3  # first friction
RULE = unscented(STATES, 1.0, 2.0, 0.0)
XI, W_MEAN, W_COV = RULE.xi, RULE.w_mean, RULE.w_cov
DRIFT = np.array([0.05, 0.05, 0.1])  # [m/s, m/s, rad/s per s^.5] offsets of the accelerometers; yaw model error
RATE_STD = 0.003  # [rad/s]
AY_STD, AY_SHARE = 0.15, 0.05  # [m/s^2], and of a_y, that the tyre model may miss, per look
FORCE_STD, FORCE_SHARE = 0.01, 0.15  # of the load: rolling resistance; of the force: torque gain and stiffness
SLIP_STD, OMEGA_STD = 0.001, 0.03  # [1] radius differences, [rad/s] noise: through the slip stiffness


class X(IntEnum):
    """Index of a state before the frictions."""

    VX = 0
    VY = 1
    YAW_RATE = 2


class Memory:
    """One filter."""

    row: Annotated[FloatArray, len(P)]  # parameters of the vehicle
    track: Track
    mean: Annotated[FloatArray, STATES]
    root: Annotated[FloatArray, STATES, STATES]
    nis: float  # per row
    log_likelihood: float
    refused: float  # downdates


def bank(vehicles: Sequence[Vehicle]) -> EstimatorBank:
    """N of these filters."""
    return EstimatorBank(new_filters(Memory, vehicles), records(Nothing, 1), _advance, tells=FOUR_FRICTIONS)


@nogil
def _advance(
    filters: Records[Memory], _desks: Records[Nothing], t: FloatArray, signals: FloatArray, tolds: FloatArray,
    _share: int, first: int, last: int,
) -> None:  # fmt: skip
    for n in range(first, last):
        memory = filters[n]
        track, row = memory.track, memory.row
        for k in range(t.shape[0]):
            told = tolds[k, n]
            health, kind, gone = take(track, row, t[k, n], signals[k, n])
            memory.log_likelihood = 0.0
            if kind == STEPPED:
                _step(memory, gone)
                if lost(memory.mean, memory.root, X.VX, X.VY, X.YAW_RATE):
                    health, kind = health | flags.RESET, BEGUN
            if kind == BEGUN:
                _begin(memory, signals[k, n])
            if track.started:
                _report(memory, told)
                health |= sliding(row, track, memory.mean[X.VX], memory.mean[X.VY], told[Y.MU])
            else:
                tell_nothing(told)
                tell_no_wheel(told)
            told[Y.HEALTH] = health


@compiled
def _begin(memory: Memory, sample: FloatArray) -> None:
    mean, root = memory.mean, memory.root
    speed = rolling_speed(memory.row, sample)
    known = not math.isnan(speed)
    mean[X.VX], mean[X.VY], mean[X.YAW_RATE] = speed if known else 0.0, 0.0, memory.track.use[S.YAW_RATE]
    mean[MU:] = PRIOR_MU
    root[:, :] = 0.0
    root[X.VX, X.VX], root[X.VY, X.VY] = FIRST_V_STD if known else UNKNOWN_V_STD, FIRST_V_STD
    root[X.YAW_RATE, X.YAW_RATE] = 0.1
    root[MU:, MU:] = PRIOR_ROOT
    memory.nis = memory.log_likelihood = memory.refused = 0.0


@compiled
def _friction(x: FloatArray, mean: FloatArray, share: float, mu: FloatArray) -> None:
    """mu (4,) of a point x (7,), which deviates from the mean's by `share` of its own, within the range of friction."""
    for wheel in range(4):
        told = mean[MU + wheel] + share * (x[MU + wheel] - mean[MU + wheel])
        mu[wheel] = min(max(told, LOWER), UPPER)


@compiled
def _felt(
    row: FloatArray, x: FloatArray, use: FloatArray, steering: FloatArray, mu: FloatArray, unknown: Four
) -> tuple[float, float]:
    """(a_y, yaw acceleration) of the tyres at x (7,)."""
    _, ay, turn = response(
        body(row), x[X.VX], x[X.VY], x[X.YAW_RATE], use[S.AX], use[S.AY], four(steering[:, 0]), four(steering[:, 1]),
        four(use[S.OMEGA : S.OMEGA + 4]), unknown, four(mu),
    )  # fmt: skip
    return ay, turn


@compiled
def _step(memory: Memory, gone: float) -> None:
    row, mean, root, use = memory.row, memory.mean, memory.root, memory.track.use
    count = XI.shape[0]
    points, work = np.empty((count, STATES)), np.empty((ROWS + STATES, count + 2 * STATES))
    noise, unknown, mu = np.zeros((STATES, STATES)), (math.nan, math.nan, math.nan, math.nan), np.empty(4)
    steering = turned(use[S.DELTA : S.DELTA + 4])
    middle, share = mean.copy(), told_share(math.hypot(use[S.AX], use[S.AY]) / GRAVITY)
    keep = math.exp(-abs(mean[X.VX]) * gone / FORGET_M)
    sigma_points(mean, root, XI, points)
    for p in range(count):
        x = points[p]
        _friction(x, middle, share, mu)
        _, turn = _felt(row, x, use, steering, mu, unknown)
        x[X.VX], x[X.VY] = advance_velocity(x[X.VX], x[X.VY], use[S.AX], use[S.AY], x[X.YAW_RATE], gone)
        x[X.YAW_RATE] += gone * turn
        for wheel in range(MU, STATES):
            x[wheel] = PRIOR_MU + keep * (x[wheel] - PRIOR_MU)
    for i in range(3):
        noise[i, i] = DRIFT[i] * math.sqrt(gone)
    noise[MU:, MU:] = math.sqrt(max(1.0 - keep * keep, 0.0)) * PRIOR_ROOT
    predict(points, W_MEAN, W_COV, noise, mean, root, work)
    sigma_points(mean, root, XI, points)
    _measure(memory, gone, share, points, work)
    for wheel in range(4):
        hold_mu(mean, root, MU + wheel, PRIOR_MU_STD)


@compiled
def _measure(memory: Memory, gone: float, share: float, points: FloatArray, work: FloatArray) -> None:
    row, track, mean, root = memory.row, memory.track, memory.mean, memory.root
    now, use = track.now, track.use
    count = points.shape[0]
    outcomes, predicted, unknown = np.empty((count, ROWS)), np.empty(ROWS), (math.nan, math.nan, math.nan, math.nan)
    state, measured = np.empty((STATES, count)), np.empty((ROWS, count))
    innovation, std = np.empty(ROWS), np.empty(ROWS)
    middle, steering, mu, force_y = mean.copy(), turned(use[S.DELTA : S.DELTA + 4]), np.empty(4), np.empty(4)
    motion = np.array([0.0, 0.0, 0.0, use[S.AX], use[S.AY]])
    for p in range(count):
        outcomes[p, 0], outcomes[p, 1] = rolling(row, use, points[p], X.YAW_RATE), points[p, X.YAW_RATE]
        _friction(points[p], middle, share, mu)
        outcomes[p, 2], _ = _felt(row, points[p], use, steering, mu, unknown)
        motion[:3] = points[p, :3]
        tyre_forces(row, motion, steering, use[S.OMEGA : S.OMEGA + 4], mu, DUGOFF, outcomes[p, 3:], force_y)
    weighted_mean(outcomes, W_MEAN, predicted)
    deviations(points, mean, W_COV, state, 0)
    deviations(outcomes, predicted, W_COV, measured, 0)
    looks = math.sqrt(max(LOOK_S / gone, 1.0))
    speed, std[0] = freed_speed(row, track.before, use, gone)
    innovation[0], innovation[1], innovation[2] = speed, now[S.YAW_RATE], now[S.AY]
    std[1], std[2] = RATE_STD, looks * math.hypot(AY_STD, AY_SHARE * use[S.AY])
    loads = wheel_loads(body(row), use[S.AX], use[S.AY])
    for wheel in range(4):
        force = wheel_force(row, track.before, use, wheel, gone)
        slip_std = SLIP_STD + OMEGA_STD * row[P.RADIUS] / max(abs(mean[X.VX]), 1.0)
        quiet = math.hypot(FORCE_STD * loads[wheel], FORCE_SHARE * force)
        std[3 + wheel] = looks * math.hypot(quiet, row[P.SLOPE_X] * loads[wheel] * slip_std)
        missing = math.isnan(now[S.OMEGA + wheel]) or math.isnan(now[S.TORQUE + wheel])
        innovation[3 + wheel] = math.nan if missing else force
    for r in range(ROWS):
        innovation[r] -= predicted[r]
    std[0] = doubted(std[0], innovation[0])
    used, log_likelihood, square, refused = update_by_downdate(mean, root, state, measured, innovation, std, work)
    memory.nis, memory.log_likelihood = square / max(used, 1), log_likelihood
    memory.refused += 1.0 if refused else 0.0


@compiled
def _report(memory: Memory, told: FloatArray) -> None:
    mean, root = memory.mean, memory.root
    tell_motion(
        told, mean[X.VX], mean[X.VY], mean[X.YAW_RATE],
        variance(root, X.VX), variance(root, X.VY), variance(root, X.YAW_RATE),
    )  # fmt: skip
    for wheel in range(4):
        tell_wheel(told, wheel, mean[MU + wheel], math.sqrt(variance(root, MU + wheel)))
    mu, std = mean_friction(mean, root, MU)
    told[Y.MU], told[Y.MU_LOWER], told[Y.MU_UPPER] = interval(mu, std)
    tell_rest(told, memory.track.used, memory.nis, 1.0, memory.log_likelihood)
