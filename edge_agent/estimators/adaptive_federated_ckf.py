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
from typing import NamedTuple

import numpy as np

from edge_agent.adaptation.rules import ALPHA, RATE, infer_two, rule_table
from edge_agent.dynamics.parameters import parameter_table
from edge_agent.estimators import flags
from edge_agent.estimators.gaussian import pair
from edge_agent.estimators.gaussian.bank import (
    GaussianBank,
    Stretch,
    lost,
    prior_interval,
    sliding,
    tell_motion,
    tell_nothing,
    variance,
)
from edge_agent.estimators.gaussian.intake import BEGUN, STEPPED, Track, grip_used, take
from edge_agent.estimators.gaussian.pair import X
from schemas.numeric import FloatArray, compiled, released
from schemas.vehicle import Vehicle

DRY = 0.85  # the friction that is set: the paper's first experiment
WINDOW_S = 0.5  # of the innovation variances; the paper's M is not given
ORDINARY = 1.0  # c of (32): gamma up to here is no sign of trouble; the paper's .85 to 1


class Memory(NamedTuple):
    """State of N filters."""

    motion: pair.Pair
    actual: FloatArray  # (N, 2, 4) windowed squared innovations
    expected: FloatArray  # (N, 2, 4) windowed innovation variances
    alpha: FloatArray  # (N, 2) mismatch at the sample before
    friction: FloatArray  # (4,)
    levels: FloatArray  # (5, 7)


def bank(vehicles: Sequence[Vehicle], friction: float = DRY) -> GaussianBank[Memory]:
    """N of these filters on a road whose friction is set."""
    n = len(vehicles)
    shape = (n, 2, pair.ROWS)
    memory = Memory(
        pair.new_pair(n), np.zeros(shape), np.zeros(shape), np.zeros((n, 2)), np.full(4, friction), rule_table()
    )
    return GaussianBank(parameter_table(vehicles), memory, _advance)


@released
def _advance(memory: Memory, track: Track, stretch: Stretch, first: int, last: int) -> None:
    rows, t, signals, out, _wheels, health = stretch
    motion = memory.motion
    for n in range(first, last):
        for k in range(t.shape[0]):
            motion.told[n, 1] = 0.0
            told, kind, gone = take(track, rows[n], n, t[k, n], signals[k, n])
            if kind == STEPPED:
                pair.turn(motion, track, rows[n], n, gone, memory.friction)
                if lost(motion.mean[n], motion.root[n], X.VX, X.VY, X.YAW_RATE):
                    told, kind = told | flags.RESET, BEGUN
                else:
                    _adapt(memory, n, gone)
            if kind == BEGUN:
                pair.begin(motion, track, rows[n], n, signals[k, n])
                memory.actual[n], memory.expected[n], memory.alpha[n] = 0.0, 0.0, 0.0
            if track.started[n]:
                x, root = motion.mean[n], motion.root[n]
                tell_motion(
                    out[:, k, n], x[X.VX], x[X.VY], x[X.YAW_RATE],
                    variance(root, X.VX), variance(root, X.VY), variance(root, X.YAW_RATE),
                )  # fmt: skip
                prior_interval(out[8:11, k, n])
                out[11, k, n], out[12, k, n] = grip_used(track, n), motion.told[n, 0]
                out[13, k, n], out[14, k, n] = motion.factor[n].max(), motion.told[n, 1]
                health[k, n] = told | sliding(rows[n], track.use[n], x[X.VX], x[X.VY], memory.friction[0])
            else:
                health[k, n] = told
                tell_nothing(out[:, k, n])


@compiled
def _adapt(memory: Memory, n: int, gone: float) -> None:
    """Factors on R and shares for the next sample."""
    motion = memory.motion
    keep = 0.5 ** (gone / WINDOW_S)
    raw = np.ones(2)
    for sub in range(2):
        mismatch, count = 0.0, 0
        for r in range(pair.ROWS):
            error = motion.innovation[n, sub, r]
            if math.isnan(error):
                continue
            memory.actual[n, sub, r] = keep * memory.actual[n, sub, r] + (1.0 - keep) * error * error
            memory.expected[n, sub, r] = keep * memory.expected[n, sub, r] + (1.0 - keep) * motion.expected[n, sub, r]
            mismatch += memory.actual[n, sub, r] / memory.expected[n, sub, r] - 1.0
            count += 1
        alpha = mismatch / max(count, 1)
        rate = (alpha - memory.alpha[n, sub]) / gone
        memory.alpha[n, sub] = alpha
        motion.factor[n, sub] = math.exp(infer_two(alpha, rate, ALPHA, RATE, memory.levels))
        if motion.gamma[n, sub] > ORDINARY:
            raw[sub] = ORDINARY / motion.gamma[n, sub]
    motion.beta[n] = min(max(raw[0] / (raw[0] + raw[1]), pair.LEAST_BETA), 1.0 - pair.LEAST_BETA)
