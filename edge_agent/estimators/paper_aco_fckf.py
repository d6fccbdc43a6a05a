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
from typing import Annotated, NamedTuple

import numpy as np

from edge_agent.adaptation.fuzzy import adapted_within
from edge_agent.adaptation.memberships import Memberships
from edge_agent.estimators.bank import EstimatorBank
from edge_agent.estimators.common.motion import FIRST_V_STD, UNKNOWN_V_STD, diverged
from edge_agent.estimators.common.output import (
    PRIOR_MU,
    PRIOR_MU_STD,
    limit_friction,
    write_friction,
    write_states,
)
from edge_agent.estimators.common.readings import rolling_speed
from edge_agent.estimators.common.run import PaperMemory, kernel_of, new_filters
from edge_agent.estimators.estimates import Column
from edge_agent.estimators.gaussian.planar import POINTS, PlanarState, carry
from edge_agent.filters.cholesky import variance
from edge_agent.filters.columns import gather, spread
from edge_agent.filters.householder import LOG_TWO_PI
from edge_agent.filters.sequential import carlson
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.runtime.records import records
from schemas.signals import S
from schemas.vehicle import Vehicle

STATES, ROWS = 6, 3
STEP_S = 0.02  # the paper's sampling; Q and the fuzzy steps are per so much time
WINDOW_S = 0.5  # of the innovation variances
LEAST_FACTOR, LARGEST_FACTOR = 0.1, 20.0  # of R over its setting: table 2 varies it by 5


class Setting(NamedTuple):
    """Variances of the filter and its belief at the start."""

    process: tuple[float, ...] = (1e-6, 1e-6, 1e-3, 1e-3, 1e-6, 1e-5)  # Q per STEP_S (errata)
    start: tuple[float, ...] = (FIRST_V_STD**2, FIRST_V_STD**2, 0.2, 0.2, 0.01, PRIOR_MU_STD**2)  # P_0
    noise: tuple[float, ...] = (0.01, 0.01, 1e-4)  # R of ordinary sensors with some model error; the paper's is .05
    mu: float = PRIOR_MU  # at the start: unknown; the paper begins at the truth
    straight: bool = False  # begin without acceleration and yaw rate, as the paper does, not with those measured


AT_THE_TRUTH = Setting(start=(1e-6, 1e-6, 1e-3, 1e-3, 1e-6, 1e-6), noise=(0.05, 0.05, 0.05), mu=0.85, straight=True)
"""The paper's experiments: R known, and the start (section IV.A) so well known that the printed mu error can be met."""


class FuzzyMemory(PaperMemory):
    """One filter."""

    mean: Annotated[FloatArray, STATES]
    root: Annotated[FloatArray, STATES, STATES]
    actual: Annotated[FloatArray, ROWS]  # windowed innovation variances
    theoretical: Annotated[FloatArray, ROWS]
    factor: Annotated[FloatArray, ROWS]  # on R


class FuzzyContext:
    """What the filters of a thread share: the setting, and arrays that a step writes before it reads them."""

    process: Annotated[FloatArray, STATES]  # standard deviations per STEP_S
    start: Annotated[FloatArray, STATES]  # standard deviations
    noise: Annotated[FloatArray, ROWS]  # variances
    fuzzy_inputs: Annotated[FloatArray, 5]
    fuzzy_outputs: Annotated[FloatArray, 5]
    mu: float
    straight: bool
    points: Annotated[FloatArray, STATES, POINTS]
    adapted: Annotated[FloatArray, ROWS]  # variances
    gain: Annotated[FloatArray, STATES]


def bank(vehicles: Sequence[Vehicle], memberships: Memberships, setting: Setting | None = None) -> EstimatorBank:
    """N of these filters; `setting` replaces the one for ordinary sensors and an unknown road."""
    chosen = Setting() if setting is None else setting
    context = records(FuzzyContext, 1)
    context["process"], context["start"], context["noise"] = (
        np.sqrt(chosen.process),
        np.sqrt(chosen.start),
        chosen.noise,
    )
    context["fuzzy_inputs"], context["fuzzy_outputs"] = memberships.inputs, memberships.outputs
    context["mu"], context["straight"] = chosen.mu, chosen.straight
    return EstimatorBank(new_filters(FuzzyMemory, vehicles), context, KERNEL)


@compiled
def _begin(memory: FuzzyMemory, context: FuzzyContext) -> None:
    """Begin at the speed of the wheels, straight on."""
    mean, root, use = memory.mean, memory.root, memory.track.inputs
    speed = rolling_speed(memory.row, memory.track.now)
    known = not math.isnan(speed)
    mean[PlanarState.VX], mean[PlanarState.VY] = speed if known else 0.0, 0.0
    measured = 0.0 if context.straight else 1.0
    mean[PlanarState.AX], mean[PlanarState.AY] = measured * use[S.AX], measured * use[S.AY]
    mean[PlanarState.YAW_RATE], mean[PlanarState.MU] = measured * use[S.YAW_RATE], context.mu
    root[:, :] = 0.0
    for i in range(STATES):
        root[i, i] = context.start[i]
    if not known:
        root[PlanarState.VX, PlanarState.VX] = UNKNOWN_V_STD
    for r in range(ROWS):
        memory.factor[r], memory.actual[r], memory.theoretical[r] = 1.0, 0.0, 0.0


@compiled
def _step(memory: FuzzyMemory, context: FuzzyContext, dt: float) -> bool:
    mean, root, points, noise = memory.mean, memory.root, context.points, context.adapted
    pace = dt / STEP_S
    spread(mean, root, points)
    carry(memory.row, points, memory.factor, memory.track, dt, False)
    gather(points, context.process, math.sqrt(pace), mean, root)
    _adapt(memory, context, pace, math.exp(-math.log(2.0) * dt / WINDOW_S))
    used, square, determinant = 0, 0.0, 1.0
    for r in range(ROWS):
        # the measurement is linear, a state itself
        reading = memory.track.now[r]
        if not math.isnan(reading):
            far, expected = carlson(mean, root, PlanarState.AX + r, reading, noise[r], context.gain)
            used, square, determinant = used + 1, square + far, determinant * expected
    memory.nis = square / max(used, 1)
    memory.log_likelihood = -0.5 * (used * LOG_TWO_PI + math.log(determinant) + square)
    limit_friction(mean, root, PlanarState.MU, PRIOR_MU_STD)
    return not diverged(mean, root, PlanarState.YAW_RATE)


@compiled
def _adapt(memory: FuzzyMemory, context: FuzzyContext, pace: float, keep: float) -> None:
    """context.adapted = R of this sample, and the factors on R for the next."""
    for r in range(ROWS):
        context.adapted[r] = memory.factor[r] * context.noise[r]
        innovation = memory.track.now[r] - memory.mean[PlanarState.AX + r]
        if not math.isnan(innovation):
            theoretical = variance(memory.root, PlanarState.AX + r) + context.adapted[r]
            memory.actual[r] = keep * memory.actual[r] + (1.0 - keep) * innovation * innovation
            memory.theoretical[r] = keep * memory.theoretical[r] + (1.0 - keep) * theoretical
            memory.factor[r] = adapted_within(
                memory.factor[r], memory.actual[r], memory.theoretical[r], context.fuzzy_inputs, context.fuzzy_outputs,
                pace, (LEAST_FACTOR, LARGEST_FACTOR),
            )  # fmt: skip
    memory.adaptation = max(memory.factor[0], memory.factor[1], memory.factor[2])


@compiled
def _report(memory: FuzzyMemory, context: FuzzyContext, output: FloatArray) -> float:  # noqa: ARG001 as of all filters
    mean, root = memory.mean, memory.root
    write_states(output, mean, root, PlanarState.YAW_RATE)
    write_friction(output, Column.MU, mean[PlanarState.MU], math.sqrt(variance(root, PlanarState.MU)))
    return float(mean[PlanarState.MU])


KERNEL = kernel_of(_begin, _step, _report)
