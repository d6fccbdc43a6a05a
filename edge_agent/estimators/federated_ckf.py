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
from typing import NamedTuple

import numpy as np

from edge_agent.dynamics.chassis import response, turned
from edge_agent.dynamics.parameters import GRAVITY, body, four, parameter_table
from edge_agent.estimators import flags
from edge_agent.estimators.gaussian import pair
from edge_agent.estimators.gaussian.bank import (
    PRIOR_MU,
    PRIOR_MU_STD,
    GaussianBank,
    Stretch,
    hold_mu,
    interval,
    lost,
    sliding,
    tell_motion,
    tell_nothing,
    variance,
)
from edge_agent.estimators.gaussian.intake import BEGUN, STEPPED, Track, grip_used, take, wheel_force
from edge_agent.estimators.gaussian.pair import X
from edge_agent.estimators.gaussian.road import PRIOR_ROOT, dependence, mean_friction, return_to_prior
from edge_agent.filters.federated import fuse, share
from edge_agent.filters.sigma import cubature
from edge_agent.filters.squareroot import deviations, update, weighted_mean
from edge_agent.filters.svd import axis_points
from schemas.mugrid import LOWER, UPPER
from schemas.numeric import FloatArray, compiled, released
from schemas.signals import S
from schemas.vehicle import Vehicle

WHEELS, ROWS = 4, 3
NOISE_STD = np.array([0.15, 0.15, 0.004])  # of a_x, a_y, r against the tyre model, for one independent look
AY_SHARE = 0.05  # of a_y that the tyre model may miss


class Memory(NamedTuple):
    """State of N joint filters."""

    motion: pair.Pair
    mean: FloatArray  # (N, 4) friction
    root: FloatArray  # (N, 4, 4)
    yaw_rate: FloatArray  # (N,) of the master at the sample before
    beta: FloatArray  # (N,) share of friction sub-filter 1
    xi: FloatArray  # (8, 4)
    weight: FloatArray  # (8,)
    noise: FloatArray  # (3,)


def bank(vehicles: Sequence[Vehicle]) -> GaussianBank[Memory]:
    """N of these filters."""
    n, rule = len(vehicles), cubature(WHEELS)
    memory = Memory(
        pair.new_pair(n), np.full((n, WHEELS), PRIOR_MU), np.tile(PRIOR_ROOT, (n, 1, 1)),
        np.zeros(n), np.full(n, 0.5), rule.xi, rule.w_cov, NOISE_STD,
    )  # fmt: skip
    return GaussianBank(parameter_table(vehicles), memory, _advance, wheels=True)


@released
def _advance(memory: Memory, track: Track, stretch: Stretch, first: int, last: int) -> None:
    rows, t, signals, out, wheels, health = stretch
    motion = memory.motion
    for n in range(first, last):
        for k in range(t.shape[0]):
            motion.told[n, 1] = 0.0
            told, kind, gone = take(track, rows[n], n, t[k, n], signals[k, n])
            if kind == STEPPED:
                memory.yaw_rate[n] = motion.mean[n, X.YAW_RATE]
                pair.turn(motion, track, rows[n], n, gone, memory.mean[n])
                if lost(motion.mean[n], motion.root[n], X.VX, X.VY, X.YAW_RATE):
                    told, kind = told | flags.RESET, BEGUN
                else:
                    motion.beta[n] = share_by_information(motion.size[n, 0], motion.size[n, 1])
                    _friction(memory, track, rows[n], n, gone)
            if kind == BEGUN:
                pair.begin(motion, track, rows[n], n, signals[k, n])
                memory.mean[n], memory.root[n], memory.beta[n] = PRIOR_MU, PRIOR_ROOT, 0.5
            if track.started[n]:
                _report(memory, track, n, out[:, k, n], wheels[k, n])
                x = motion.mean[n]
                health[k, n] = told | sliding(rows[n], track.use[n], x[X.VX], x[X.VY], out[8, k, n])
            else:
                health[k, n] = told
                tell_nothing(out[:, k, n])
                for wheel in range(WHEELS):
                    wheels[k, n, wheel] = out[8:11, k, n]


@compiled
def share_by_information(first: float, second: float) -> float:
    """Share of sub-filter 1 [1] from the traces of the two covariances: the better one gets more (54, turned round)."""
    return min(max(second / (first + second), pair.LEAST_BETA), 1.0 - pair.LEAST_BETA)


@compiled
def _friction(memory: Memory, track: Track, row: FloatArray, n: int, gone: float) -> None:
    x = memory.motion.mean[n]
    metres = abs(x[X.VX]) * gone
    mean, root = np.empty(WHEELS), np.empty((WHEELS, WHEELS))
    first_mean, first_root = np.empty(WHEELS), np.empty((WHEELS, WHEELS))
    work, sizes = np.empty((2 * WHEELS, 4 * WHEELS)), np.ones(2)
    return_to_prior(memory.mean[n], memory.root[n], metres, work)
    for sub in range(2):
        share(memory.root[n], memory.beta[n] if sub == 0 else 1.0 - memory.beta[n], root)
        mean[:] = memory.mean[n]
        _measure(memory, track, row, n, sub, gone, mean, root, work)
        sizes[sub] = 0.0
        for i in range(WHEELS):
            sizes[sub] += variance(root, i)
        if sub == 0:
            first_mean[:], first_root[:] = mean, root
    fuse(first_mean, first_root, mean, root, work)
    for i in range(WHEELS):
        hold_mu(first_mean, first_root, i, PRIOR_MU_STD)
    memory.mean[n], memory.root[n] = first_mean, first_root
    memory.beta[n] = share_by_information(sizes[0], sizes[1])


@compiled
def _measure(
    memory: Memory, track: Track, row: FloatArray, n: int, sub: int, gone: float, mean: FloatArray, root: FloatArray,
    work: FloatArray,
) -> None:  # fmt: skip
    x, now, use = memory.motion.mean[n], track.now[n], track.use[n]
    points, outcomes, predicted = np.empty((2 * WHEELS, WHEELS)), np.empty((2 * WHEELS, ROWS)), np.empty(ROWS)
    state, measured = np.empty((WHEELS, 2 * WHEELS)), np.empty((ROWS, 2 * WHEELS))
    known, mu = np.empty(4), np.empty(4)
    innovation, std = np.empty(ROWS), np.empty(ROWS)
    for wheel in range(4):
        known[wheel] = wheel_force(row, track.before[n], use, wheel, gone)
    axis_points(mean, root, memory.xi, points)
    steering, omega = turned(use[S.DELTA : S.DELTA + 4]), use[S.OMEGA : S.OMEGA + 4]
    for p in range(points.shape[0]):
        for wheel in range(4):
            mu[wheel] = min(max(points[p, wheel], LOWER), UPPER)
        ax, ay, turn = response(
            body(row), x[X.VX], x[X.VY], x[X.YAW_RATE], x[X.AX], x[X.AY], four(steering[:, 0]), four(steering[:, 1]),
            four(omega), four(known), four(mu),
        )  # fmt: skip
        outcomes[p, 0], outcomes[p, 1], outcomes[p, 2] = ax, ay, memory.yaw_rate[n] + gone * turn
    weighted_mean(outcomes, memory.weight, predicted)
    deviations(points, mean, memory.weight, state, 0)
    deviations(outcomes, predicted, memory.weight, measured, 0)
    seldom = dependence(math.hypot(use[S.AX], use[S.AY]) / GRAVITY, gone)
    for r in range(ROWS):
        innovation[r] = now[r] - predicted[r]
        std[r] = seldom * memory.noise[r] * (1.0 if r == 0 else math.sqrt(2.0))
    std[1] = math.hypot(std[1], seldom * AY_SHARE * use[S.AY])
    if sub == 1:
        innovation[0] = math.nan
    update(mean, root, state, measured, innovation, std, work)


@compiled
def _report(memory: Memory, track: Track, n: int, out: FloatArray, wheels: FloatArray) -> None:
    motion = memory.motion
    x, root = motion.mean[n], motion.root[n]
    tell_motion(
        out, x[X.VX], x[X.VY], x[X.YAW_RATE],
        variance(root, X.VX), variance(root, X.VY), variance(root, X.YAW_RATE),
    )  # fmt: skip
    for wheel in range(WHEELS):
        interval(memory.mean[n, wheel], math.sqrt(variance(memory.root[n], wheel)), wheels[wheel])
    mu, std = mean_friction(memory.mean[n], memory.root[n], 0)
    interval(mu, std, out[8:11])
    out[11], out[12], out[13], out[14] = grip_used(track, n), motion.told[n, 0], 1.0, motion.told[n, 1]
