"""`adaptive-federated-ckf`: the federated cubature filter with fuzzy R and adaptive shares of paper 001.

"Driving state estimation of distributed drive electric vehicles by an adaptive fuzzy federated Kalman filter",
Sustainability 2023, 15, 13446 (paper 001). Motion and sub-filters: see `gaussian/federated_motion`. Factor on R of each
sub-filter from the window mismatch of its innovations and the mismatch's rate by 7 x 5 rules (section 3.1, table 1, see
`rules`); shares from the predicted residuals, (30) to (33): beta_i = min(1, c/gamma_i), normalised.

Friction is no state: it is set by hand (section 4.1), here to DRY, and the prior is reported.

Departures, after the errata: the force of the tyre by similarity; e'*S^-1*e per row for gamma, where e*e' over a trace
is printed; the same double counting as paper 000, undone as described there; R is one table for all drives, where the
paper sets it by hand for each; shares are kept from starving a sub-filter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np

from edge_agent.adaptation.rules import ALPHA, RATE, infer_two, rule_table
from edge_agent.estimators.bank import EstimatorBank
from edge_agent.estimators.common.motion import diverged
from edge_agent.estimators.common.output import write_prior, write_states
from edge_agent.estimators.common.run import kernel_of, new_filters
from edge_agent.estimators.estimates import Column
from edge_agent.estimators.gaussian.federated_motion import (
    LEAST_BETA,
    ROWS,
    FederatedMemory,
    begin_motion,
    step_motion,
)
from edge_agent.estimators.gaussian.planar import PlanarState
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.runtime.records import records
from schemas.vehicle import Vehicle

DRY = 0.85  # the friction that is set: the paper's first experiment
WINDOW_S = 0.5  # of the innovation variances; the paper's M is not given
ORDINARY = 1.0  # c of (32): gamma up to here is no sign of trouble; the paper's .85 to 1


class AdaptiveMemory(FederatedMemory):
    """One filter."""

    actual: Annotated[FloatArray, 2, ROWS]  # windowed squared innovations
    expected: Annotated[FloatArray, 2, ROWS]  # windowed innovation variances
    alpha: Annotated[FloatArray, 2]  # mismatch at the sample before


class AdaptiveDesign:
    """What is set by hand."""

    friction: Annotated[FloatArray, 4]
    levels: Annotated[FloatArray, 5, 7]  # of the rules


def bank(vehicles: Sequence[Vehicle], friction: float = DRY) -> EstimatorBank:
    """N of these filters on a road whose friction is set."""
    design = records(AdaptiveDesign, 1)
    design["friction"], design["levels"] = friction, rule_table()
    return EstimatorBank(new_filters(AdaptiveMemory, vehicles), design, KERNEL)


@compiled
def _begin(memory: AdaptiveMemory, design: AdaptiveDesign) -> None:  # noqa: ARG001 the design is the step's
    begin_motion(memory)
    memory.actual[:], memory.expected[:], memory.alpha[:] = 0.0, 0.0, 0.0


@compiled
def _step(memory: AdaptiveMemory, design: AdaptiveDesign, dt: float) -> bool:
    motion = memory.motion
    step_motion(memory, design.friction, dt)
    if diverged(motion.mean, motion.root, PlanarState.YAW_RATE):
        return False
    _adapt(memory, design, dt)
    memory.adaptation = max(motion.factor[0], motion.factor[1])
    return True


@compiled
def _adapt(memory: AdaptiveMemory, design: AdaptiveDesign, dt: float) -> None:
    """Factors on R and shares for the next sample."""
    motion = memory.motion
    keep = 0.5 ** (dt / WINDOW_S)
    raw = np.ones(2)
    for sub in range(2):
        mismatch, count = 0.0, 0
        for r in range(ROWS):
            error = motion.innovation[sub, r]
            if math.isnan(error):
                continue
            memory.actual[sub, r] = keep * memory.actual[sub, r] + (1.0 - keep) * error * error
            memory.expected[sub, r] = keep * memory.expected[sub, r] + (1.0 - keep) * motion.expected[sub, r]
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
def _report(memory: AdaptiveMemory, design: AdaptiveDesign, output: FloatArray) -> float:
    write_states(output, memory.motion.mean, memory.motion.root, PlanarState.YAW_RATE)
    write_prior(output, Column.MU)
    return float(design.friction[0])


KERNEL = kernel_of(_begin, _step, _report)
