"""`adaptive-federated-ckf`: the federated cubature filter with fuzzy R and adaptive shares of paper 001.

"Driving state estimation of distributed drive electric vehicles by an adaptive fuzzy federated Kalman filter",
Sustainability 2023, 15, 13446 (paper 001). Motion and sub-filters: see `pair`. Factor on R of each sub-filter from the
window mismatch of its innovations and the mismatch's rate by 7 x 5 rules (section 3.1, table 1, see `rules`); shares
from the predicted residuals, (30) to (33): beta_i = min(1, c/gamma_i), normalised.

Friction is no state: it is set by hand (section 4.1), here to DRY, and the prior is told of it.

Departures, after the errata: the force of the tyre by similarity; e'*S^-1*e per row for gamma, where e*e' over a trace
is printed; the same double counting as paper 000, undone as told in `pair`; R is one table for all drives, where the
paper sets it by hand for each; shares are kept from starving a sub-filter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np

from edge_agent.adaptation.rules import ALPHA, RATE, infer_two, rule_table
from edge_agent.dynamics.parameters import P
from edge_agent.estimators import flags
from edge_agent.estimators.bank import EstimatorBank
from edge_agent.estimators.estimates import Y
from edge_agent.estimators.gaussian import pair
from edge_agent.estimators.gaussian.intake import BEGUN, STEPPED, Track, new_filters, take
from edge_agent.estimators.gaussian.pair import Pair, X
from edge_agent.estimators.gaussian.telling import (
    lost,
    sliding,
    tell_motion,
    tell_nothing,
    tell_prior,
    tell_rest,
)
from edge_agent.filters.cholesky import variance
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled, nogil
from schemas.runtime.records import Records, records
from schemas.vehicle import Vehicle

DRY = 0.85  # the friction that is set: the paper's first experiment
WINDOW_S = 0.5  # of the innovation variances; the paper's M is not given
ORDINARY = 1.0  # c of (32): gamma up to here is no sign of trouble; the paper's .85 to 1


class Memory:
    """One filter."""

    row: Annotated[FloatArray, len(P)]  # parameters of the vehicle
    track: Track
    motion: Pair
    actual: Annotated[FloatArray, 2, pair.ROWS]  # windowed squared innovations
    expected: Annotated[FloatArray, 2, pair.ROWS]  # windowed innovation variances
    alpha: Annotated[FloatArray, 2]  # mismatch at the sample before


class Design:
    """What is set by hand."""

    friction: Annotated[FloatArray, 4]
    levels: Annotated[FloatArray, 5, 7]  # of the rules


def bank(vehicles: Sequence[Vehicle], friction: float = DRY) -> EstimatorBank:
    """N of these filters on a road whose friction is set."""
    design = records(Design, 1)
    design["friction"], design["levels"] = friction, rule_table()
    return EstimatorBank(new_filters(Memory, vehicles), design, _advance)


@nogil
def _advance(
    filters: Records[Memory], desks: Records[Design], t: FloatArray, signals: FloatArray, tolds: FloatArray,
    share: int, first: int, last: int,
) -> None:  # fmt: skip
    design = desks[share]
    for n in range(first, last):
        memory = filters[n]
        track, row = memory.track, memory.row
        motion = memory.motion
        for k in range(t.shape[0]):
            told = tolds[k, n]
            health, kind, gone = take(track, row, t[k, n], signals[k, n])
            motion.log_likelihood = 0.0
            if kind == STEPPED:
                pair.turn(motion, track, row, gone, design.friction)
                if lost(motion.mean, motion.root, X.VX, X.VY, X.YAW_RATE):
                    health, kind = health | flags.RESET, BEGUN
                else:
                    _adapt(memory, design, gone)
            if kind == BEGUN:
                pair.begin(motion, track, row, signals[k, n])
                memory.actual[:], memory.expected[:], memory.alpha[:] = 0.0, 0.0, 0.0
            if track.started:
                x, root = motion.mean, motion.root
                tell_motion(
                    told, x[X.VX], x[X.VY], x[X.YAW_RATE],
                    variance(root, X.VX), variance(root, X.VY), variance(root, X.YAW_RATE),
                )  # fmt: skip
                tell_prior(told)
                tell_rest(told, track.used, motion.nis, max(motion.factor[0], motion.factor[1]), motion.log_likelihood)
                health |= sliding(row, track, x[X.VX], x[X.VY], design.friction[0])
            else:
                tell_nothing(told)
            told[Y.HEALTH] = health


@compiled
def _adapt(memory: Memory, design: Design, gone: float) -> None:
    """Factors on R and shares for the next sample."""
    motion = memory.motion
    keep = 0.5 ** (gone / WINDOW_S)
    raw = np.ones(2)
    for sub in range(2):
        mismatch, count = 0.0, 0
        for r in range(pair.ROWS):
            error = motion.innovation[sub, r]
            if math.isnan(error):
                continue
            memory.actual[sub, r] = keep * memory.actual[sub, r] + (1.0 - keep) * error * error
            memory.expected[sub, r] = keep * memory.expected[sub, r] + (1.0 - keep) * motion.expected[sub, r]
            mismatch += memory.actual[sub, r] / memory.expected[sub, r] - 1.0
            count += 1
        alpha = mismatch / max(count, 1)
        rate = (alpha - memory.alpha[sub]) / gone
        memory.alpha[sub] = alpha
        motion.factor[sub] = math.exp(infer_two(alpha, rate, ALPHA, RATE, design.levels))
        if motion.gamma[sub] > ORDINARY:
            raw[sub] = ORDINARY / motion.gamma[sub]
    motion.beta = min(max(raw[0] / (raw[0] + raw[1]), pair.LEAST_BETA), 1.0 - pair.LEAST_BETA)
