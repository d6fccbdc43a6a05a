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

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import Annotated, NamedTuple

import numpy as np

from edge_agent.adaptation.fuzzy import adapted_within
from edge_agent.adaptation.memberships import Memberships
from edge_agent.dynamics.parameters import P
from edge_agent.estimators import flags
from edge_agent.estimators.bank import EstimatorBank
from edge_agent.estimators.common.readings import rolling_speed
from edge_agent.estimators.estimates import Y
from edge_agent.estimators.gaussian.intake import BEGUN, STEPPED, Track, new_filters, take
from edge_agent.estimators.gaussian.planar import POINTS, carry
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
    tell_nothing,
    tell_rest,
)
from edge_agent.filters.cholesky import variance
from edge_agent.filters.columns import gather, spread
from edge_agent.filters.householder import LOG_TWO_PI
from edge_agent.filters.sequential import carlson
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled, nogil
from schemas.runtime.records import Records, records
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


class Memory:
    """One filter."""

    row: Annotated[FloatArray, len(P)]  # parameters of the vehicle
    track: Track
    mean: Annotated[FloatArray, STATES]
    root: Annotated[FloatArray, STATES, STATES]
    actual: Annotated[FloatArray, ROWS]  # windowed innovation variances
    theoretical: Annotated[FloatArray, ROWS]
    factor: Annotated[FloatArray, ROWS]  # on R
    nis: float  # per row
    log_likelihood: float


class Design:
    """What all filters of a bank share."""

    process: Annotated[FloatArray, STATES]  # standard deviations per STEP_S
    start: Annotated[FloatArray, STATES]  # standard deviations
    noise: Annotated[FloatArray, ROWS]  # variances
    inputs: Annotated[FloatArray, 5]  # fuzzy sets
    outputs: Annotated[FloatArray, 5]
    mu: float
    straight: bool


class Scratch:
    """What a step writes before it reads it."""

    points: Annotated[FloatArray, STATES, POINTS]
    noise: Annotated[FloatArray, ROWS]  # variances
    gain: Annotated[FloatArray, STATES]


class Desk:
    """What the filters of a thread share."""

    design: Design
    scratch: Scratch


def bank(vehicles: Sequence[Vehicle], memberships: Memberships, setting: Setting | None = None) -> EstimatorBank:
    """N of these filters; `setting` replaces the one for ordinary sensors and an unknown road."""
    chosen = Setting() if setting is None else setting
    desk = records(Desk, 1)
    design = desk["design"]
    design["process"], design["start"], design["noise"] = np.sqrt(chosen.process), np.sqrt(chosen.start), chosen.noise
    design["inputs"], design["outputs"] = memberships.inputs, memberships.outputs
    design["mu"], design["straight"] = chosen.mu, chosen.straight
    return EstimatorBank(new_filters(Memory, vehicles), desk, _advance)


@nogil
def _advance(
    filters: Records[Memory], desks: Records[Desk], t: FloatArray, signals: FloatArray, tolds: FloatArray,
    share: int, first: int, last: int,
) -> None:  # fmt: skip
    desk = desks[share]
    design, scratch = desk.design, desk.scratch
    for n in range(first, last):
        memory = filters[n]
        for k in range(t.shape[0]):
            memory.log_likelihood = 0.0
            told = tolds[k, n]
            health, kind, gone = take(memory.track, memory.row, t[k, n], signals[k, n])
            if kind == STEPPED:
                _step(memory, design, gone, scratch)
                if lost(memory.mean, memory.root, X.VX, X.VY, X.YAW_RATE):
                    health, kind = health | flags.RESET, BEGUN
            if kind == BEGUN:
                _begin(memory, design, signals[k, n])
            if memory.track.started:
                mean = memory.mean
                health |= sliding(memory.row, memory.track, mean[X.VX], mean[X.VY], mean[X.MU])
                _report(memory, told)
            else:
                tell_nothing(told)
            told[Y.HEALTH] = health


@compiled
def _begin(memory: Memory, design: Design, sample: FloatArray) -> None:
    """Begin at the speed of the wheels, straight on."""
    mean, root, use = memory.mean, memory.root, memory.track.use
    speed = rolling_speed(memory.row, sample)
    known = not math.isnan(speed)
    mean[X.VX], mean[X.VY] = speed if known else 0.0, 0.0
    measured = 0.0 if design.straight else 1.0
    mean[X.AX], mean[X.AY], mean[X.YAW_RATE] = (
        measured * use[S.AX], measured * use[S.AY], measured * use[S.YAW_RATE],
    )  # fmt: skip
    mean[X.MU] = design.mu
    root[:, :] = 0.0
    for i in range(STATES):
        root[i, i] = design.start[i]
    if not known:
        root[X.VX, X.VX] = UNKNOWN_V_STD
    for r in range(ROWS):
        memory.factor[r], memory.actual[r], memory.theoretical[r] = 1.0, 0.0, 0.0
    memory.nis = memory.log_likelihood = 0.0


@compiled
def _step(memory: Memory, design: Design, gone: float, scratch: Scratch) -> None:
    mean, root, points = memory.mean, memory.root, scratch.points
    pace = gone / STEP_S
    spread(mean, root, points)
    carry(memory.row, points, memory.factor, memory.track, gone, False)
    gather(points, design.process, math.sqrt(pace), mean, root)
    _adapt(memory, design, pace, math.exp(-math.log(2.0) * gone / WINDOW_S), scratch.noise)
    used, square, determinant = 0, 0.0, 1.0
    for r in range(ROWS):
        # the measurement is linear, a state itself
        reading = memory.track.now[r]
        if not math.isnan(reading):
            far, expected = carlson(mean, root, X.AX + r, reading, scratch.noise[r], scratch.gain)
            used, square, determinant = used + 1, square + far, determinant * expected
    memory.nis = square / max(used, 1)
    memory.log_likelihood = -0.5 * (used * LOG_TWO_PI + math.log(determinant) + square)
    hold_mu(mean, root, X.MU, PRIOR_MU_STD)


@compiled
def _adapt(memory: Memory, design: Design, pace: float, keep: float, noise: FloatArray) -> None:
    """noise (3,) = R of this sample, and the factors on R for the next."""
    for r in range(ROWS):
        noise[r] = memory.factor[r] * design.noise[r]
        innovation = memory.track.now[r] - memory.mean[X.AX + r]
        if not math.isnan(innovation):
            theoretical = variance(memory.root, X.AX + r) + noise[r]
            memory.actual[r] = keep * memory.actual[r] + (1.0 - keep) * innovation * innovation
            memory.theoretical[r] = keep * memory.theoretical[r] + (1.0 - keep) * theoretical
            memory.factor[r] = adapted_within(
                memory.factor[r], memory.actual[r], memory.theoretical[r], design.inputs, design.outputs, pace,
                LEAST_FACTOR, LARGEST_FACTOR,
            )  # fmt: skip


@compiled
def _report(memory: Memory, told: FloatArray) -> None:
    mean, root = memory.mean, memory.root
    tell_motion(
        told, mean[X.VX], mean[X.VY], mean[X.YAW_RATE],
        variance(root, X.VX), variance(root, X.VY), variance(root, X.YAW_RATE),
    )  # fmt: skip
    told[Y.MU], told[Y.MU_LOWER], told[Y.MU_UPPER] = interval(mean[X.MU], math.sqrt(variance(root, X.MU)))
    most = max(memory.factor[0], memory.factor[1], memory.factor[2])
    tell_rest(told, memory.track.used, memory.nis, most, memory.log_likelihood)
