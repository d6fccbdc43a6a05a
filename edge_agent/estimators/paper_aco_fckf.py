"""Estimator `paper-aco-fckf`: the fuzzy cubature Kalman filter of paper 004, with its errata
corrected. Numbers in brackets are the paper's equations.

Xiong, Liu, Zhang, Zhu, Liu, "An accurate vehicle and road condition estimation algorithm for
vehicle networking applications", IEEE Access 2019, doi 10.1109/ACCESS.2019.2895413.

State [v_x, v_y, a_x, a_y, r, mu], input [omega, delta], measurement [a_x, a_y, r] (below equation
29); motion (1) to (3), Dugoff tyres (7) to (12), cubature filter (13) to (28), fuzzy factor on R
(30), fuzzy sets tuned by ant colony optimisation (31) to (33).

ELEMENTS lists each element of the paper and every departure with its reason. Friction is limited to
its range, and its standard deviation to that of the prior.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Final, NamedTuple

import numpy as np

from edge_agent.adaptation.fuzzy import FactorLimits, adapted_within
from edge_agent.adaptation.lower_vertices import LowerVertices
from edge_agent.adaptation.memberships import Memberships
from edge_agent.estimators.bank import EstimatorBank
from edge_agent.estimators.common.motion import FIRST_V_STD, UNKNOWN_V_STD, has_diverged
from edge_agent.estimators.common.output import (
    PRIOR_MU,
    PRIOR_MU_STD,
    limit_friction,
    write_friction,
    write_states,
)
from edge_agent.estimators.common.readings import rolling_speed
from edge_agent.estimators.common.run import PaperMemory, kernel_of, new_filters
from edge_agent.estimators.common.tyre_option import TyreOption
from edge_agent.estimators.elements import Element
from edge_agent.estimators.estimates import Column
from edge_agent.estimators.gaussian.planar import (
    POINTS,
    PlanarState,
    PlanarStep,
    propagate_points,
)
from edge_agent.filters.cholesky import variance
from edge_agent.filters.columns import gather_points, spread_points
from edge_agent.filters.householder import LOG_TWO_PI
from edge_agent.filters.sequential import carlson_update
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.runtime.records import records
from schemas.signals import S
from schemas.vehicle import Vehicle

STATES = 6
ROWS = 3
# [s] sampling time of the paper, to which Q and the fuzzy steps refer
STEP_S = 0.02
# Number of points in the table of the fuzzy inference. `Memberships` need five points, and
# `LowerVertices` more.
KNOTS = 48
WINDOW_S = 0.5  # [s] half-life of the innovation averages
# [1] limits of R over its setting; table 2 of the paper varies R by a factor of 5
LEAST_FACTOR = 0.1
LARGEST_FACTOR = 20.0


class Setting(NamedTuple):
    """Variances and initial state of the filter of paper 004, and options of its model."""

    process: tuple[float, ...] = (1e-6, 1e-6, 1e-3, 1e-3, 1e-6, 1e-5)  # Q per STEP_S (errata)
    # P_0, initial variances
    start: tuple[float, ...] = (FIRST_V_STD**2, FIRST_V_STD**2, 0.2, 0.2, 0.01, PRIOR_MU_STD**2)
    # R of ordinary sensors with some model error; the paper uses .05
    noise: tuple[float, ...] = (0.01, 0.01, 1e-4)
    mu: float = PRIOR_MU  # [1] initial friction; the paper starts at the true friction
    # True to start with zero acceleration and yaw rate, as in the paper, instead of measured ones
    straight: bool = False
    tyre: TyreOption = TyreOption()
    # True to compute longitudinal forces from one motor per axle, (4) to (6), instead of from slip
    dual_motor: bool = False


AT_THE_TRUTH = Setting(
    start=(1e-6, 1e-6, 1e-3, 1e-3, 1e-6, 1e-6), noise=(0.05, 0.05, 0.05), mu=0.85, straight=True
)
"""Setting for the paper's experiments: R is known, and the initial state (section IV.A) is so
accurate that the printed error of mu can be reached.
"""


AS_PRINTED = AT_THE_TRUTH._replace(process=(0.1 * STEP_S**2,) * STATES, start=(0.2,) * STATES)
"""Setting as printed: P_0 = .2*I, R = .05*I, and Q = .1*I, interpreted as a variance per second
squared, so a step adds .1*T^2.

With Q = .1*I per step, the error of the yaw rate stays near .13 rad/s, which contradicts the
printed tables.
"""


class FuzzyMemory(PaperMemory):
    """State of paper 004's filter for one vehicle, kept from one sample to the next."""

    mean: Annotated[FloatArray, STATES]
    root: Annotated[FloatArray, STATES, STATES]
    actual: Annotated[FloatArray, ROWS]  # averaged squared innovations
    theoretical: Annotated[FloatArray, ROWS]  # averaged innovation variances
    factor: Annotated[FloatArray, ROWS]  # [1] R over its setting


class FuzzyContext:
    """Settings, and scratch arrays that the filters of a thread share. A step writes each scratch
    array before it reads it.
    """

    process: Annotated[FloatArray, STATES]  # standard deviations per STEP_S
    start: Annotated[FloatArray, STATES]  # standard deviations
    noise: Annotated[FloatArray, ROWS]  # variances of the setting
    fuzzy_inputs: Annotated[FloatArray, KNOTS]
    fuzzy_outputs: Annotated[FloatArray, KNOTS]
    mu: float
    straight: bool
    dual_motor: bool
    points: Annotated[FloatArray, STATES, POINTS]
    adapted: Annotated[FloatArray, ROWS]  # noise variances of the current sample
    gain: Annotated[FloatArray, STATES]


def make_bank(
    vehicles: Sequence[Vehicle],
    memberships: Memberships | LowerVertices,
    setting: Setting | None = None,
) -> EstimatorBank:
    """Return a bank of paper 004's filters, one per vehicle, whose fuzzy sets are `memberships`.
    `setting` replaces the default setting, which describes ordinary sensors and an unknown road.
    """
    chosen = Setting() if setting is None else setting
    context = records(FuzzyContext, 1)
    context["process"] = np.sqrt(chosen.process)
    context["start"] = np.sqrt(chosen.start)
    context["noise"] = chosen.noise
    if isinstance(memberships, LowerVertices):
        context["fuzzy_inputs"], context["fuzzy_outputs"] = memberships.knot_table(KNOTS)
    else:
        rest = KNOTS - len(memberships.inputs)
        context["fuzzy_inputs"] = np.pad(memberships.inputs, (0, rest), mode="edge")
        context["fuzzy_outputs"] = np.pad(memberships.outputs, (0, rest), mode="edge")
    context["mu"] = chosen.mu
    context["straight"] = chosen.straight
    context["dual_motor"] = chosen.dual_motor
    return EstimatorBank(new_filters(FuzzyMemory, vehicles, chosen.tyre), context, KERNEL)


@compiled
def _begin_filter(memory: FuzzyMemory, context: FuzzyContext) -> None:
    """Begin the filter of a vehicle at its first sample, with a straight motion at the speed of the
    wheels.
    """
    mean = memory.mean
    root = memory.root
    use = memory.track.inputs
    speed = rolling_speed(memory.row, memory.track.now)
    known = not math.isnan(speed)
    mean[PlanarState.VX] = speed if known else 0.0
    mean[PlanarState.VY] = 0.0
    measured = 0.0 if context.straight else 1.0
    mean[PlanarState.AX] = measured * use[S.AX]
    mean[PlanarState.AY] = measured * use[S.AY]
    mean[PlanarState.YAW_RATE] = measured * use[S.YAW_RATE]
    mean[PlanarState.MU] = context.mu
    root[:, :] = 0.0
    for i in range(STATES):
        root[i, i] = context.start[i]
    if not known:
        root[PlanarState.VX, PlanarState.VX] = UNKNOWN_V_STD
    for r in range(ROWS):
        memory.factor[r] = 1.0
        memory.actual[r] = 0.0
        memory.theoretical[r] = 0.0


@compiled
def _step_filter(memory: FuzzyMemory, context: FuzzyContext, dt: float) -> bool:
    mean = memory.mean
    root = memory.root
    points = context.points
    noise = context.adapted
    pace = dt / STEP_S
    spread_points(mean, root, points)
    step = PlanarStep(dt, False, context.dual_motor)
    propagate_points(memory.row, points, memory.factor, memory.track, step)
    gather_points(points, context.process, math.sqrt(pace), mean, root)
    _adapt_noise(memory, context, pace, math.exp(-math.log(2.0) * dt / WINDOW_S))
    used = 0
    square = 0.0
    determinant = 1.0
    for r in range(ROWS):
        # The measurement is linear, because it is one of the states.
        reading = memory.track.now[r]
        if not math.isnan(reading):
            far, expected = carlson_update(
                mean, root, PlanarState.AX + r, reading, noise[r], context.gain
            )
            used = used + 1
            square = square + far
            determinant = determinant * expected
    memory.nis = square / max(used, 1)
    memory.log_likelihood = -0.5 * (used * LOG_TWO_PI + math.log(determinant) + square)
    limit_friction(mean, root, PlanarState.MU, PRIOR_MU_STD)
    return not has_diverged(mean, root, PlanarState.YAW_RATE)


@compiled
def _adapt_noise(memory: FuzzyMemory, context: FuzzyContext, pace: float, keep: float) -> None:
    """Compute the measurement noise R of this sample (context.adapted). Then compute the fuzzy
    factors on R for the next sample from the innovations (measurement minus prediction). `keep` is
    the weight of the earlier innovations, and `pace` multiplies each change of ln(factor).
    """
    for r in range(ROWS):
        context.adapted[r] = memory.factor[r] * context.noise[r]
        innovation = memory.track.now[r] - memory.mean[PlanarState.AX + r]
        if not math.isnan(innovation):
            theoretical = variance(memory.root, PlanarState.AX + r) + context.adapted[r]
            memory.actual[r] = keep * memory.actual[r] + (1.0 - keep) * innovation * innovation
            memory.theoretical[r] = keep * memory.theoretical[r] + (1.0 - keep) * theoretical
            memory.factor[r] = adapted_within(
                memory.factor[r],
                memory.actual[r],
                memory.theoretical[r],
                context.fuzzy_inputs,
                context.fuzzy_outputs,
                FactorLimits(pace, LEAST_FACTOR, LARGEST_FACTOR),
            )
    memory.adaptation = max(memory.factor[0], memory.factor[1], memory.factor[2])


@compiled
def _write_estimates(
    memory: FuzzyMemory,
    context: FuzzyContext,  # noqa: ARG001 all filters have this signature
    output: FloatArray,
) -> float:
    mean = memory.mean
    root = memory.root
    write_states(output, mean, root, PlanarState.YAW_RATE)
    write_friction(
        output, Column.MU, mean[PlanarState.MU], math.sqrt(variance(root, PlanarState.MU))
    )
    return float(mean[PlanarState.MU])


KERNEL = kernel_of(_begin_filter, _step_filter, _write_estimates)

ELEMENTS: Final[tuple[Element, ...]] = (
    Element(
        "(1), (3)",
        "3-DOF planar model, arms t_f/2 and t_r/2",
        "corrected",
        "Heun's rule instead of Euler's: a factor of four in v_y, more than any tuning",
        "gaussian.planar",
    ),
    Element("(2)", "lateral motion", "corrected", "sign: v_y' = a_y - r*v_x", "gaussian.planar"),
    Element(
        "(4) to (6)",
        "dual-motor torque output model",
        "option",
        "the mean of two wheel speeds is the axle's midpoint, the larger is the outer wheel; by "
        "default F_x comes from slip as in (7); i_t and eta_t are not given",
        "dynamics.dual_motor, Setting.dual_motor",
    ),
    Element(
        "(7), (8)",
        "Dugoff tyre, stiffness proportional to mu",
        "option",
        "on a real tyre slip stiffness does not depend on mu; printed form by Setting.tyre",
        "common.tyre_option",
    ),
    Element(
        "(9), (10)",
        "saturation f(L)",
        "corrected",
        "combined by similarity; (10) has stiffness inside eps*v_x, and tan(alpha) is squared",
        "dynamics.tyres.combined_dugoff",
    ),
    Element(
        "(10)",
        "speed factor eps, and 1/(1 - s) on tan(alpha)",
        "left out",
        "eps is not given; s is below .02",
    ),
    Element(
        "(11), (12)",
        "longitudinal slip",
        "corrected",
        "the speed is that of the wheel centre, not v_x",
        "dynamics.slip",
    ),
    Element(
        "(13) to (18), (20) to (23), (26) to (28)",
        "cubature Kalman filter",
        "as printed",
        where="filters.columns, filters.sequential",
    ),
    Element(
        "(19), (24), (25)",
        "covariances of cubature points",
        "corrected",
        "sums of products, printed as products of sums; held as square roots",
        "filters.columns",
    ),
    Element(
        "(29)",
        "state [v_x, v_y, a_x, a_y, r, mu], measurement [a_x, a_y, r]",
        "as printed",
        where="gaussian.planar.PlanarState",
    ),
    Element(
        "below (29)",
        "input [omega, gamma]",
        "corrected",
        "[omega, delta]: yaw rate is measured, steering moves it",
        "gaussian.planar.propagate_points",
    ),
    Element(
        "(30)",
        "mismatch e of actual and theoretical innovation variance",
        "corrected",
        "the innovation, where z-hat is printed; a quotient, row by row, because rows have unlike "
        "units",
        "paper_aco_fckf._adapt_noise",
    ),
    Element(
        "III.B a to c",
        "fuzzy rules for n in R_k = n*R_(k-1)",
        "corrected",
        "R must grow where the actual variance is larger; bounded, or R runs away",
        "adaptation.fuzzy",
    ),
    Element(
        "figures 2, 3",
        "five triangular sets of e and n",
        "as printed",
        where="adaptation.memberships",
    ),
    Element(
        "III.C",
        "lower vertices of the triangles as tuned variables",
        "option",
        "the shipped sets have feet at the neighbours' peaks, which need ten numbers instead of "
        "sixteen",
        "adaptation.lower_vertices",
    ),
    Element(
        "(31)",
        "transition probability with visibility eta",
        "as printed",
        where="lab.tuning.colony, lab.tuning.paper_004_tuning.visibility",
    ),
    Element(
        "(32)",
        "pheromone update, rho = .284",
        "corrected",
        "called residual and evaporation at once: read as what remains; deposits by rank within "
        "bounds",
        "lab.tuning.colony",
    ),
    Element(
        "(33)",
        "objective 1/(1 + e)",
        "option",
        "it has a pole at e = -1: |e|; inflating R wins it, so that it makes the filter worse "
        "(measured)",
        "lab.tuning.paper_004_tuning",
    ),
    Element(
        "IV.A",
        "three tuning runs with R = .1, .05, .01",
        "as printed",
        where="lab.tuning.paper_004_tuning",
    ),
    Element(
        "IV.A",
        "x_0 at the truth, P_0 = .2*I, R = .05*I, T = .02 s",
        "as printed",
        where="AS_PRINTED",
    ),
    Element(
        "IV.A",
        "Q_0 = .1*I with seven entries",
        "corrected",
        "six states; read as .1*T^2 per step",
        "AS_PRINTED",
    ),
    Element("IV.A", "W_0 = 1", "left out", "the paper does not say what it is"),
    Element("table 1", "vehicle", "as printed", where="lab.simulation.presets"),
    Element(
        "table 2",
        "noise variance by schedule, on a_y alone",
        "as printed",
        where="lab.simulation.white",
    ),
    Element(
        "figure 8",
        "double lane change at 80 km/h, mu .85",
        "as printed",
        where="lab.simulation.manoeuvres",
    ),
    Element(
        "tables 3, 4",
        "MAE and RMSE of ACOFCKF and FCKF",
        "corrected",
        "mu MAE .095 exceeds its RMSE: .0095",
        "lab.evaluation.papers",
    ),
    Element(
        "IV.B",
        "relative errors of the peaks of v_x, v_y, yaw rate and mu",
        "as printed",
        where="lab.evaluation.papers.reproduction_004",
    ),
    Element(
        "figures 6, 7, 8 to 18",
        "sets, path, torques, noisy a_y, states against FCKF",
        "as printed",
        where="lab.evaluation.papers",
    ),
    Element(
        "figures 4, 5",
        "flow chart and block diagram",
        "left out",
        "they show nothing that is measured",
    ),
)
"""Elements of the paper, and the treatment of each one in the code."""
