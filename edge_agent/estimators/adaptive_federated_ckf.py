"""Estimator `adaptive-federated-ckf`: the filter of paper 001, a federated cubature filter. Fuzzy
rules adapt its measurement noise R, and its information shares are adaptive. Numbers in brackets
are the paper's equations.

"Driving state estimation of distributed drive electric vehicles by an adaptive fuzzy federated
Kalman filter", Sustainability 2023, 15, 13446 (paper 001). Motion and sub-filters: see
`gaussian/federated_motion`. A fuzzy rule base of 7 x 5 rules scales the measurement noise R of each
sub-filter (section 3.1, table 1, see `rules`). Its inputs are the mismatch between actual and
expected innovation variance over a window, and the rate of that mismatch. The share beta_i of
sub-filter i in the master's information follows from the size gamma_i of its predicted residuals,
(30) to (33): beta_i = min(1, c/gamma_i) with a constant c, normalised.

The filter does not estimate friction: it assumes a constant (section 4.1), here DRY (a dry road).
Therefore the friction that the estimator reports is the prior distribution.

ELEMENTS lists each element of the paper and every departure with its reason.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Final, NamedTuple

import numpy as np

from edge_agent.adaptation.rules import ALPHA, RATE, infer_two, rule_table
from edge_agent.estimators.bank import EstimatorBank
from edge_agent.estimators.common.motion import has_diverged
from edge_agent.estimators.common.output import write_prior, write_states
from edge_agent.estimators.common.run import kernel_of, new_filters
from edge_agent.estimators.common.tyre_option import TyreOption
from edge_agent.estimators.elements import Element
from edge_agent.estimators.estimates import Column
from edge_agent.estimators.gaussian.federated_motion import (
    LEAST_BETA,
    ROWS,
    STEP_S,
    FederatedMemory,
    MotionSetting,
    begin_motion,
    set_motion,
    step_motion,
)
from edge_agent.estimators.gaussian.planar import PlanarState
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.runtime.records import records
from schemas.vehicle import Vehicle

DRY = 0.85  # [1] friction that is set, as in the paper's first experiment
WINDOW_S = 0.5  # [s] half-life of the innovation averages; the paper does not give its M
# [1] c of (32), .85 to 1 in the paper: a larger gamma reduces the share of a sub-filter
ORDINARY = 1.0


class AdaptiveMemory(FederatedMemory):
    """State of paper 001's filter for one vehicle, kept from one sample to the next."""

    actual: Annotated[FloatArray, 2, ROWS]  # averaged squared innovations
    expected: Annotated[FloatArray, 2, ROWS]  # averaged innovation variances
    alpha: Annotated[FloatArray, 2]  # mismatch at the previous sample


class AdaptiveDesign:
    """Parameters of paper 001's filter that are set by hand: the friction of the four wheels [1]
    (`friction`), True if noise R and information shares are adapted (`adaptive`), and the outputs
    of the fuzzy rules (`levels`).
    """

    friction: Annotated[FloatArray, 4]
    adaptive: bool
    levels: Annotated[FloatArray, 5, 7]  # [nat] output of each fuzzy rule


class AdaptiveSetting(NamedTuple):
    """Options of paper 001's filter.

    `adaptive` switches the adaptation of the measurement noise R and of the information shares on
    or off. `tyre` selects the tyre model. `motion` contains the noise variances of the filter that
    estimates velocity, acceleration and yaw rate (`gaussian/federated_motion`).
    """

    adaptive: bool = True  # False: R and shares are constant (comparator FKF)
    tyre: TyreOption = TyreOption()
    motion: MotionSetting = MotionSetting()


FKF: Final = AdaptiveSetting(adaptive=False)
AS_PRINTED: Final = AdaptiveSetting(
    motion=MotionSetting(
        process=(0.01 * STEP_S**2,) * 6,
        start=(1e-6,) * 6,
        first=(0.001, 10.0, 0.1),
        second=(0.001, 0.1),
        wheel_speed=False,
    )
)
"""Q and R of the first experiment in section 4.3. The printed Q is interpreted as a variance per
second squared, so a step adds .01*T^2.

P_0 is 1e-6*I, because the paper starts at the true state. With the printed P_0 = I, the first
samples would change v_x by decimetres per second, because no printed measurement observes v_x.
"""


def make_bank(
    vehicles: Sequence[Vehicle], friction: float = DRY, setting: AdaptiveSetting | None = None
) -> EstimatorBank:
    """Return a bank of paper 001's filters, one per vehicle, which assume a road with the friction
    coefficient `friction`. `setting` replaces the default options of the filter.
    """
    chosen = AdaptiveSetting() if setting is None else setting
    design = records(AdaptiveDesign, 1)
    design["friction"] = friction
    design["adaptive"] = chosen.adaptive
    design["levels"] = rule_table()
    filters = new_filters(AdaptiveMemory, vehicles, chosen.tyre)
    set_motion(filters, chosen.motion)
    return EstimatorBank(filters, design, KERNEL)


@compiled
# `design` is unused, because all filters have this signature.
def _begin_filter(memory: AdaptiveMemory, design: AdaptiveDesign) -> None:  # noqa: ARG001
    begin_motion(memory)
    memory.actual[:] = 0.0
    memory.expected[:] = 0.0
    memory.alpha[:] = 0.0


@compiled
def _step_filter(memory: AdaptiveMemory, design: AdaptiveDesign, dt: float) -> bool:
    motion = memory.motion
    step_motion(memory, design.friction, dt)
    if has_diverged(motion.mean, motion.root, PlanarState.YAW_RATE):
        return False
    if design.adaptive:
        _adapt_noise_and_shares(memory, design, dt)
    memory.adaptation = max(motion.factor[0], motion.factor[1])
    return True


@compiled
def _adapt_noise_and_shares(memory: AdaptiveMemory, design: AdaptiveDesign, dt: float) -> None:
    """Adapt the federated filter after a sample, for use at the next sample. Compute the factors on
    the measurement noise R of both sub-filters, and the share of the master filter's information
    that each sub-filter gets.

    `dt` [s] is the time since the last sample.
    """
    motion = memory.motion
    keep = 0.5 ** (dt / WINDOW_S)
    raw = np.ones(2)
    for sub in range(2):
        mismatch = 0.0
        count = 0
        for r in range(ROWS):
            error = motion.innovation[sub, r]
            if math.isnan(error):
                continue
            memory.actual[sub, r] = keep * memory.actual[sub, r] + (1.0 - keep) * error * error
            memory.expected[sub, r] = (
                keep * memory.expected[sub, r] + (1.0 - keep) * motion.expected[sub, r]
            )
            mismatch += memory.actual[sub, r] / memory.expected[sub, r] - 1.0
            count += 1
        alpha = mismatch / max(count, 1)
        rate = (alpha - memory.alpha[sub]) / dt
        memory.alpha[sub] = alpha
        motion.factor[sub] = math.exp(infer_two(alpha, rate, ALPHA, RATE, design.levels))
        if motion.gamma[sub] > ORDINARY:
            raw[sub] = ORDINARY / motion.gamma[sub]
    motion.beta = min(max(raw[0] / (raw[0] + raw[1]), LEAST_BETA), 1.0 - LEAST_BETA)


@compiled
def _write_estimates(memory: AdaptiveMemory, design: AdaptiveDesign, output: FloatArray) -> float:
    write_states(output, memory.motion.mean, memory.motion.root, PlanarState.YAW_RATE)
    write_prior(output, Column.MU)
    return float(design.friction[0])


KERNEL = kernel_of(_begin_filter, _step_filter, _write_estimates)

ELEMENTS: Final[tuple[Element, ...]] = (
    Element(
        "(1) to (7)",
        "3-DOF model, F_x from wheel torque",
        "corrected",
        "minus signs are lost in the text; u' has lost its dot",
        "dynamics.chassis, common.inputs",
    ),
    Element(
        "(8) to (13)",
        "Dugoff tyre, slip angles, loads, slip",
        "corrected",
        "1/2 and mu*F_z are missing in L; the driving slip's denominator is R_e*omega",
        "dynamics",
    ),
    Element(
        "(14)",
        "stiffness polynomial m*F_z - n*F_z^2",
        "option",
        "m and n are not given; by default stiffness is in proportion to load",
        "common.tyre_option.quadratic",
    ),
    Element(
        "(16)",
        "innovation covariance C_k over a window of M samples",
        "corrected",
        "exponential window, half-life .5 s: M is not given, and a box needs M innovations in "
        "memory",
        "adaptive_federated_ckf._adapt_noise_and_shares",
    ),
    Element(
        "(17), (18)",
        "mismatch alpha = tr C - tr P_zz",
        "corrected",
        "mean of ratios less one: the traces add squares of unlike units",
        "adaptive_federated_ckf._adapt_noise_and_shares",
    ),
    Element("(19)", "R times the factor epsilon", "as printed", where="gaussian.federated_motion"),
    Element(
        "table 1",
        "35 fuzzy rules",
        "corrected",
        "the left half grows R where alpha is negative: turned round; PMB and PSM, which no set "
        "has, are taken as the steps beside PM",
        "adaptation.rules",
    ),
    Element(
        "figures 3, 4",
        "sets of alpha, its rate and epsilon",
        "corrected",
        "their vertices are not given",
        "adaptation.rules",
    ),
    Element(
        "(30) to (33)",
        "adaptive shares",
        "corrected",
        "e'*S^-1*e, where e*e' over a trace is printed; no sub-filter is starved",
        "adaptive_federated_ckf._adapt_noise_and_shares",
    ),
    Element(
        "(34) to (52)",
        "sub-filters and master",
        "corrected",
        "a_y and r, used by both sub-filters, have twice the variance in each; sub-filter 1 also "
        "measures the wheels' speed, off by wheel_speed=False",
        "gaussian.federated_motion",
    ),
    Element(
        "(53)",
        "ratio of the rear to the front steering angle",
        "as printed",
        where="lab.evaluation.scenarios.steered_behind",
    ),
    Element(
        "section 4.3",
        "P_0, Q, R of the double lane change",
        "option",
        "R by hand for each drive, Q in no unit (read as .01*T^2); by default one table for all "
        "drives",
        "AS_PRINTED",
    ),
    Element(
        "section 4.3, 5",
        "P_0, Q, R of the other four drives",
        "left out",
        "no number is printed that they could be compared with",
    ),
    Element(
        "table 3",
        "MAE and RMSE of v_x, v_y, beta; FKF and improved",
        "corrected",
        "beta is printed in degrees: that of the printed v_y is in radians",
        "lab.evaluation.papers",
    ),
    Element("table 3", "comparator FKF", "as printed", where="FKF"),
    Element(
        "figures 7 to 11",
        "v_x, v_y, beta of five drives, both filters",
        "as printed",
        where="lab.evaluation.papers",
    ),
    Element(
        "figure 2", "tyre forces over load", "left out", "measured by the paper's authors; no data"
    ),
    Element(
        "section 5", "hardware in the loop", "left out", "the two drives are simulated instead"
    ),
)
"""Elements of the paper, and the treatment of each one in the code."""
