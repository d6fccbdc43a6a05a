"""`paper-aco-fckf`: the fuzzy cubature Kalman filter of paper 004, as printed with the errata corrected.

Xiong, Liu, Zhang, Zhu, Liu, "An accurate vehicle and road condition estimation algorithm for vehicle networking
applications", IEEE Access 2019, doi 10.1109/ACCESS.2019.2895413.

State [v_x, v_y, a_x, a_y, r, mu], input [omega, delta], measurement [a_x, a_y, r] (below equation 29); motion (1) to
(3), Dugoff tyres (7) to (12), cubature filter (13) to (28), fuzzy factor on R (30), sets tuned by ants (31) to (33).

Departures, after the errata: sign of r*v_x in (2); stiffness independent of mu in (7) to (10), combined by similarity,
and no speed factor eps, which is not given; wheel-centre speeds in (11) and (12); sums of products in (19), (24), (25),
held as square roots; the innovation in (30), and R grows where its variance is larger than expected, row by row and
bounded; Q without its seventh entry and of a size that gives the printed tables; Heun's rule instead of Euler's; the
loads from a_x and a_y, which (9) of paper 000 gives. Friction keeps to its range and to the prior's spread.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from edge_agent.adaptation.fuzzy import adapted_within
from edge_agent.adaptation.memberships import Memberships
from edge_agent.dynamics.parameters import parameter_table
from edge_agent.estimators import flags
from edge_agent.estimators.friction_mixture.sample import rolling_speed
from edge_agent.estimators.gaussian.bank import (
    FIRST_V_STD,
    PRIOR_MU,
    PRIOR_MU_STD,
    UNKNOWN_V_STD,
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
from edge_agent.estimators.gaussian.intake import BEGUN, STEPPED, Track, grip_used, take
from edge_agent.estimators.gaussian.planar import carry
from edge_agent.filters.sigma import cubature
from edge_agent.filters.squareroot import predict, sigma_points, update
from schemas.numeric import FloatArray, compiled, released
from schemas.signals import S
from schemas.vehicle import Vehicle

STATES, ROWS = 6, 3
STEP_S = 0.02  # the paper's sampling; Q and the fuzzy steps are per so much time
WINDOW_S = 0.5  # of the innovation variances
LEAST_FACTOR, LARGEST_FACTOR = 0.1, 20.0  # of R over its setting: table 2 varies it by 5


class X(IntEnum):
    """Index of a state."""

    VX = 0
    VY = 1
    AX = 2
    AY = 3
    YAW_RATE = 4
    MU = 5


class Setting(NamedTuple):
    """Variances of the filter and its belief at the start."""

    process: tuple[float, ...] = (1e-6, 1e-6, 1e-3, 1e-3, 1e-6, 1e-5)  # Q per STEP_S (errata)
    start: tuple[float, ...] = (FIRST_V_STD**2, FIRST_V_STD**2, 0.2, 0.2, 0.01, PRIOR_MU_STD**2)  # P_0
    noise: tuple[float, ...] = (0.01, 0.01, 1e-4)  # R of ordinary sensors with some model error; the paper's is .05
    mu: float = PRIOR_MU  # at the start: unknown; the paper begins at the truth
    straight: bool = False  # begin without acceleration and yaw rate, as the paper does, not with those measured


AT_THE_TRUTH = Setting(start=(1e-6, 1e-6, 1e-3, 1e-3, 1e-6, 1e-6), noise=(0.05, 0.05, 0.05), mu=0.85, straight=True)
"""The paper's experiments: R known, and the start (section IV.A) so well known that the printed mu error can be met."""


class Memory(NamedTuple):
    """State and tables of N filters."""

    mean: FloatArray  # (N, 6)
    root: FloatArray  # (N, 6, 6)
    actual: FloatArray  # (N, 3) windowed innovation variances
    theoretical: FloatArray  # (N, 3)
    factor: FloatArray  # (N, 3) on R
    told: FloatArray  # (N, 2) NIS per row, log-likelihood
    xi: FloatArray  # (12, 6)
    weight: FloatArray  # (12,)
    process: FloatArray  # (6,) standard deviations per STEP_S
    start: FloatArray  # (6,) standard deviations
    noise: FloatArray  # (3,) variances
    inputs: FloatArray  # (5,) fuzzy sets
    outputs: FloatArray  # (5,)
    mu: float
    straight: bool


class Scratch(NamedTuple):
    """What a step writes before it reads it."""

    points: FloatArray  # (12, 6)
    noise: FloatArray  # (6, 6), zero off the diagonal
    state: FloatArray  # (6, 6)
    rows: FloatArray  # (3, 6)
    innovation: FloatArray  # (3,)
    std: FloatArray  # (3,)
    work: FloatArray  # (12, 24)


@compiled
def new_scratch() -> Scratch:
    """Room for one thread."""
    return Scratch(
        np.empty((2 * STATES, STATES)), np.zeros((STATES, STATES)), np.empty((STATES, STATES)),
        np.empty((ROWS, STATES)), np.empty(ROWS), np.empty(ROWS), np.zeros((2 * STATES, 4 * STATES)),
    )  # fmt: skip


def bank(vehicles: Sequence[Vehicle], memberships: Memberships, setting: Setting | None = None) -> GaussianBank[Memory]:
    """N of these filters; `setting` replaces the one for ordinary sensors and an unknown road."""
    n, rule = len(vehicles), cubature(STATES)
    chosen = Setting() if setting is None else setting
    memory = Memory(
        np.zeros((n, STATES)), np.zeros((n, STATES, STATES)), np.zeros((n, ROWS)), np.zeros((n, ROWS)),
        np.ones((n, ROWS)), np.zeros((n, 2)), rule.xi, rule.w_cov, np.sqrt(np.array(chosen.process)),
        np.sqrt(np.array(chosen.start)), np.array(chosen.noise), np.array(memberships.inputs),
        np.array(memberships.outputs), chosen.mu, chosen.straight,
    )  # fmt: skip
    return GaussianBank(parameter_table(vehicles), memory, _advance)


@released
def _advance(memory: Memory, track: Track, stretch: Stretch, first: int, last: int) -> None:
    rows, t, signals, out, _wheels, health = stretch
    scratch = new_scratch()
    for n in range(first, last):
        for k in range(t.shape[0]):
            memory.told[n, 1] = 0.0
            told, kind, gone = take(track, rows[n], n, t[k, n], signals[k, n])
            if kind == STEPPED:
                _step(memory, track, rows[n], n, gone, scratch)
                if lost(memory.mean[n], memory.root[n], X.VX, X.VY, X.YAW_RATE):
                    told, kind = told | flags.RESET, BEGUN
            if kind == BEGUN:
                _begin(memory, track, rows[n], n, signals[k, n])
            if track.started[n]:
                mean = memory.mean[n]
                health[k, n] = told | sliding(rows[n], track.use[n], mean[X.VX], mean[X.VY], mean[X.MU])
                _report(memory, track, n, out[:, k, n])
            else:
                health[k, n] = told
                tell_nothing(out[:, k, n])


@compiled
def _begin(memory: Memory, track: Track, row: FloatArray, n: int, sample: FloatArray) -> None:
    """Begin at the speed of the wheels, straight on."""
    mean, root, use = memory.mean[n], memory.root[n], track.use[n]
    speed = rolling_speed(row, sample)
    known = speed == speed
    mean[X.VX], mean[X.VY] = speed if known else 0.0, 0.0
    told = 0.0 if memory.straight else 1.0
    mean[X.AX], mean[X.AY], mean[X.YAW_RATE] = told * use[S.AX], told * use[S.AY], told * use[S.YAW_RATE]
    mean[X.MU] = memory.mu
    root[:, :] = 0.0
    for i in range(STATES):
        root[i, i] = memory.start[i]
    if not known:
        root[X.VX, X.VX] = UNKNOWN_V_STD
    memory.factor[n] = 1.0
    memory.actual[n] = 0.0
    memory.theoretical[n] = 0.0
    memory.told[n] = 0.0


@compiled
def _step(memory: Memory, track: Track, row: FloatArray, n: int, gone: float, scratch: Scratch) -> None:
    points, noise, work = scratch.points, scratch.noise, scratch.work
    mean, root, now = memory.mean[n], memory.root[n], track.now[n]
    sigma_points(mean, root, memory.xi, points)
    carry(row, points, memory.factor[n], track.before[n], track.use[n], gone, False)
    pace = gone / STEP_S
    for i in range(STATES):
        noise[i, i] = memory.process[i] * pace**0.5
    predict(points, memory.weight, memory.weight, noise, mean, root, work)
    innovation, std, rows = scratch.innovation, scratch.std, scratch.rows
    keep = 0.5 ** (gone / WINDOW_S)
    for r in range(ROWS):
        # the measurement is linear: the deviations of its points are rows of the factor
        rows[r] = root[X.AX + r]
        innovation[r] = now[r] - mean[X.AX + r]
        theoretical = variance(root, X.AX + r) + memory.factor[n, r] * memory.noise[r]
        std[r] = (memory.factor[n, r] * memory.noise[r]) ** 0.5
        if innovation[r] == innovation[r]:
            memory.actual[n, r] = keep * memory.actual[n, r] + (1.0 - keep) * innovation[r] ** 2
            memory.theoretical[n, r] = keep * memory.theoretical[n, r] + (1.0 - keep) * theoretical
            memory.factor[n, r] = adapted_within(
                memory.factor[n, r], memory.actual[n, r], memory.theoretical[n, r], memory.inputs, memory.outputs,
                pace, LEAST_FACTOR, LARGEST_FACTOR,
            )  # fmt: skip
    scratch.state[:] = root
    used, log_likelihood, square = update(mean, root, scratch.state, rows, innovation, std, work)
    memory.told[n, 0] = square / max(used, 1)
    memory.told[n, 1] = log_likelihood
    hold_mu(mean, root, X.MU, PRIOR_MU_STD)


@compiled
def _report(memory: Memory, track: Track, n: int, out: FloatArray) -> None:
    mean, root = memory.mean[n], memory.root[n]
    tell_motion(
        out, mean[X.VX], mean[X.VY], mean[X.YAW_RATE],
        variance(root, X.VX), variance(root, X.VY), variance(root, X.YAW_RATE),
    )  # fmt: skip
    interval(mean[X.MU], variance(root, X.MU) ** 0.5, out[8:11])
    out[11], out[12], out[13], out[14] = (
        grip_used(track, n), memory.told[n, 0], memory.factor[n].max(), memory.told[n, 1],
    )  # fmt: skip
