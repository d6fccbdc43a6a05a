"""`federated-ckf`: joint federated cubature filters for motion and for the friction of four wheels, paper 000.

Wu, Li, Fan, "Joint estimation of driving state and road adhesion coefficient for distributed drive electric vehicle",
IEEE Access 2021, doi 10.1109/ACCESS.2021.3081443. Motion: see `pair`. Friction: state [mu_fl, mu_fr, mu_rl, mu_rr],
random walk (28), measurements [a_x, a_y, r] and [a_y, r] in two sub-filters again (40) to (48), fused (51), (52). The
motion goes to the friction filter and the friction to the motion filter's tyres (figure 3). Shares by (54).

Departures, after the errata: signs of the rear axle in (4) to (6), slip angles (7), wheel speeds (8), loads (9), Dugoff
force by similarity (11), (13); stiffness in proportion to load instead of table 1; P_f, not its inverse, in (50) and
(52); shares begin at one half and go by information, the smaller trace getting more, where (54) gives it less; a_y and
r, used by both sub-filters, count half in each. Q = 1 and R = 10 000 (57) say nothing of friction: here R is sensor
noise and model error, and friction returns to the prior over the metres driven, so that what is not observable is as
wide as the prior.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np

from edge_agent.dynamics.chassis import response, turned
from edge_agent.dynamics.parameters import P, body, four
from edge_agent.estimators import flags
from edge_agent.estimators.bank import EstimatorBank
from edge_agent.estimators.estimates import FOUR_FRICTIONS, Y
from edge_agent.estimators.gaussian import pair
from edge_agent.estimators.gaussian.intake import BEGUN, STEPPED, Track, new_filters, take, wheel_force
from edge_agent.estimators.gaussian.pair import Pair, X
from edge_agent.estimators.gaussian.road import PRIOR_ROOT, dependence, mean_friction, return_to_prior
from edge_agent.estimators.gaussian.telling import (
    PRIOR_MU,
    PRIOR_MU_STD,
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
from edge_agent.filters.federated import fuse, share
from edge_agent.filters.householder import update
from edge_agent.filters.points import axis_points, deviations, weighted_mean
from edge_agent.filters.sigma import cubature
from schemas.mugrid import LOWER, UPPER
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled, nogil
from schemas.runtime.records import Nothing, Records, records
from schemas.signals import S
from schemas.thresholds import GRAVITY
from schemas.vehicle import Vehicle

WHEELS, ROWS = 4, 3
RULE = cubature(WHEELS)
XI, WEIGHT = RULE.xi, RULE.w_cov
NOISE_STD = np.array([0.15, 0.15, 0.004])  # of a_x, a_y, r against the tyre model, for one independent look
AY_SHARE = 0.05  # of a_y that the tyre model may miss


class Memory:
    """One joint filter."""

    row: Annotated[FloatArray, len(P)]  # parameters of the vehicle
    track: Track
    motion: Pair
    mean: Annotated[FloatArray, WHEELS]  # friction
    root: Annotated[FloatArray, WHEELS, WHEELS]
    beta: float  # share of friction sub-filter 1
    yaw_rate: float  # of the master at the sample before


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
        motion = memory.motion
        for k in range(t.shape[0]):
            told = tolds[k, n]
            health, kind, gone = take(track, row, t[k, n], signals[k, n])
            motion.log_likelihood = 0.0
            if kind == STEPPED:
                memory.yaw_rate = motion.mean[X.YAW_RATE]
                pair.turn(motion, track, row, gone, memory.mean)
                if lost(motion.mean, motion.root, X.VX, X.VY, X.YAW_RATE):
                    health, kind = health | flags.RESET, BEGUN
                else:
                    motion.beta = share_by_information(motion.size[0], motion.size[1])
                    _friction(memory, gone)
            if kind == BEGUN:
                pair.begin(motion, track, row, signals[k, n])
                memory.mean[:], memory.root[:], memory.beta = PRIOR_MU, PRIOR_ROOT, 0.5
            if track.started:
                _report(memory, told)
                health |= sliding(row, track, motion.mean[X.VX], motion.mean[X.VY], told[Y.MU])
            else:
                tell_nothing(told)
                tell_no_wheel(told)
            told[Y.HEALTH] = health


@compiled
def share_by_information(first: float, second: float) -> float:
    """Share of sub-filter 1 [1] from the traces of the two covariances: the better one gets more (54, turned round)."""
    return min(max(second / (first + second), pair.LEAST_BETA), 1.0 - pair.LEAST_BETA)


@compiled
def _friction(memory: Memory, gone: float) -> None:
    x = memory.motion.mean
    metres = abs(x[X.VX]) * gone
    mean, root = np.empty(WHEELS), np.empty((WHEELS, WHEELS))
    first_mean, first_root = np.empty(WHEELS), np.empty((WHEELS, WHEELS))
    work, sizes = np.empty((2 * WHEELS, 4 * WHEELS)), np.ones(2)
    return_to_prior(memory.mean, memory.root, metres, work)
    for sub in range(2):
        share(memory.root, memory.beta if sub == 0 else 1.0 - memory.beta, root)
        mean[:] = memory.mean
        _measure(memory, sub, gone, mean, root, work)
        sizes[sub] = 0.0
        for i in range(WHEELS):
            sizes[sub] += variance(root, i)
        if sub == 0:
            first_mean[:], first_root[:] = mean, root
    fuse(first_mean, first_root, mean, root, work)
    for i in range(WHEELS):
        hold_mu(first_mean, first_root, i, PRIOR_MU_STD)
    memory.mean[:], memory.root[:] = first_mean, first_root
    memory.beta = share_by_information(sizes[0], sizes[1])


@compiled
def _measure(
    memory: Memory, sub: int, gone: float, mean: FloatArray, root: FloatArray, work: FloatArray
) -> None:  # fmt: skip
    row, track, x = memory.row, memory.track, memory.motion.mean
    now, use = track.now, track.use
    points, outcomes, predicted = np.empty((2 * WHEELS, WHEELS)), np.empty((2 * WHEELS, ROWS)), np.empty(ROWS)
    state, measured = np.empty((WHEELS, 2 * WHEELS)), np.empty((ROWS, 2 * WHEELS))
    known, mu = np.empty(4), np.empty(4)
    innovation, std = np.empty(ROWS), np.empty(ROWS)
    for wheel in range(4):
        known[wheel] = wheel_force(row, track.before, use, wheel, gone)
    axis_points(mean, root, XI, points)
    steering, omega = turned(use[S.DELTA : S.DELTA + 4]), use[S.OMEGA : S.OMEGA + 4]
    for p in range(points.shape[0]):
        for wheel in range(4):
            mu[wheel] = min(max(points[p, wheel], LOWER), UPPER)
        ax, ay, turn = response(
            body(row), x[X.VX], x[X.VY], x[X.YAW_RATE], x[X.AX], x[X.AY], four(steering[:, 0]), four(steering[:, 1]),
            four(omega), four(known), four(mu),
        )  # fmt: skip
        outcomes[p, 0], outcomes[p, 1], outcomes[p, 2] = ax, ay, memory.yaw_rate + gone * turn
    weighted_mean(outcomes, WEIGHT, predicted)
    deviations(points, mean, WEIGHT, state, 0)
    deviations(outcomes, predicted, WEIGHT, measured, 0)
    seldom = dependence(math.hypot(use[S.AX], use[S.AY]) / GRAVITY, gone)
    for r in range(ROWS):
        innovation[r] = now[r] - predicted[r]
        std[r] = seldom * NOISE_STD[r] * (1.0 if r == 0 else math.sqrt(2.0))
    std[1] = math.hypot(std[1], seldom * AY_SHARE * use[S.AY])
    if sub == 1:
        innovation[0] = math.nan
    update(mean, root, state, measured, innovation, std, work)


@compiled
def _report(memory: Memory, told: FloatArray) -> None:
    motion = memory.motion
    x, root = motion.mean, motion.root
    tell_motion(
        told, x[X.VX], x[X.VY], x[X.YAW_RATE],
        variance(root, X.VX), variance(root, X.VY), variance(root, X.YAW_RATE),
    )  # fmt: skip
    for wheel in range(WHEELS):
        tell_wheel(told, wheel, memory.mean[wheel], math.sqrt(variance(memory.root, wheel)))
    mu, std = mean_friction(memory.mean, memory.root, 0)
    told[Y.MU], told[Y.MU_LOWER], told[Y.MU_UPPER] = interval(mu, std)
    tell_rest(told, memory.track.used, motion.nis, 1.0, motion.log_likelihood)
