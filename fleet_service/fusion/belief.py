"""One cell's belief: what time does to it, and what a vote does. Compiled; every function works on one row of 32 bins.

Legend
    p    belief: probability of each bin                                        (32,)
    L    likelihood of one visit, from its bytes                                (32,)
    B    bias kernel: B[i, j] = P(the vehicle takes μ_i for μ_j)                (32, 32), rows sum to 1
    L̃    B·L over its mean: the vote of a vehicle whose bias is unknown          (32,)
    ε    share of votes that say nothing about the road                         [-]
    w    weight: how much of a vote is new (1: all)                             [-]
    h    P(the road changed since), 1 - exp(-Δt / CHANGE_S)                     [-]
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from fleet_service.fusion import constants as c
from schemas import mugrid
from schemas.numeric import ByteArray, FloatArray, compiled

BOUND, VALUE = 0, 1  # kinds of vote
_BINS: Final = mugrid.BINS
_DIFFUSION: Final = 0.5 * (c.DRIFT_PER_ROOT_HOUR / c.BIN_WIDTH) ** 2 / 3600.0  # bins² per second, half the variance
_STEP: Final = 0.25  # largest share that leaves a bin to each side in one diffusion step: stable and without ripple
_STEPS: Final = 64  # one day; by then the change hazard has levelled everything
_LIKELIHOOD: Final = np.exp(-np.arange(256) / mugrid.STEPS_PER_NAT)
_CENTRES: Final = mugrid.CENTRES
_EDGE: Final = (c.SLIPPERY - mugrid.LOWER) / c.BIN_WIDTH
SLIPPERY_SHARE: Final[FloatArray] = np.clip(_EDGE - np.arange(_BINS), 0.0, 1.0)  # of each bin that lies below SLIPPERY


def bias_kernel() -> FloatArray:
    """B, a normal of standard deviation hypot(BIAS_RELATIVE·μ, BIAS_ABSOLUTE), cut at the grid's ends."""
    std = np.hypot(c.BIAS_RELATIVE * _CENTRES, c.BIAS_ABSOLUTE)[:, None]
    kernel = np.exp(-0.5 * np.square((_CENTRES[None, :] - _CENTRES[:, None]) / std))
    return np.asarray(kernel / kernel.sum(axis=1, keepdims=True))


_SPREAD: Final = np.ascontiguousarray(bias_kernel().T)  # [j, i]: the inner loop runs over i


@compiled
def _mix(p: FloatArray, change: float) -> None:
    for i in range(_BINS):
        p[i] += change * (1.0 / _BINS - p[i])


@compiled
def forget(p: FloatArray, seconds: float) -> None:
    """Let `seconds` pass: diffusion with reflecting ends, then p ← (1 - h)·p + h·uniform. In place.

    Both keep the uniform belief and keep a rising one rising, so that time alone never lowers an upper end below the
    prior's.
    """
    if seconds <= 0.0:
        return
    total = _DIFFUSION * seconds
    steps = min(math.ceil(total / _STEP), _STEPS)
    share = min(total / steps, _STEP)
    for _ in range(steps):
        left = p[0]
        for i in range(_BINS - 1):
            here = p[i]
            p[i] += share * (left - 2.0 * here + p[i + 1])
            left = here
        p[_BINS - 1] += share * (left - p[_BINS - 1])
    _mix(p, -math.expm1(-seconds / c.CHANGE_S))


@compiled
def doubt(p: FloatArray, seconds: float, power: float) -> None:
    """Make up what `forget` over `seconds` lacks to CHANGE_LEAST, for a value of which `power` is new. In place."""
    lacking = c.CHANGE_LEAST * power + math.expm1(-max(seconds, 0.0) / c.CHANGE_S)
    if lacking > 0.0:
        _mix(p, lacking)


@compiled
def kind_of(evidence: ByteArray) -> int:
    """VALUE where the likelihood falls towards the upper end by more than senders differ; else BOUND."""
    least = 255
    for i in range(_BINS):
        least = min(least, evidence[i])
    return VALUE if evidence[_BINS - 1] - least >= c.VALUE_DROP_STEPS else BOUND


@compiled
def spread(evidence: ByteArray, kind: int, out: FloatArray) -> None:
    """L̃ of a visit into `out`, mean 1. The fall of a BOUND above its maximum is noise and is levelled."""
    out[:] = 0.0
    steps = 255
    for j in range(_BINS):
        steps = int(evidence[j]) if kind == VALUE else min(steps, int(evidence[j]))
        likelihood = _LIKELIHOOD[steps]
        for i in range(_BINS):
            out[i] += _SPREAD[j, i] * likelihood
    total = 0.0
    for i in range(_BINS):
        total += out[i]
    for i in range(_BINS):
        out[i] *= _BINS / total


@compiled
def vote(p: FloatArray, spread_likelihood: FloatArray, contamination: float, power: float) -> None:
    """p ← p·((1 - ε)·L̃ + ε)^w over its sum. In place."""
    total = 0.0
    for i in range(_BINS):
        factor = (1.0 - contamination) * spread_likelihood[i] + contamination
        p[i] *= factor if power == 1.0 else factor**power
        total += p[i]
    for i in range(_BINS):
        p[i] /= total


@compiled
def describe(likelihood: FloatArray) -> tuple[float, float, float]:
    """Mean, standard deviation and P(slippery) of a likelihood against the uniform prior."""
    total, first, slippery = 0.0, 0.0, 0.0
    for i in range(_BINS):
        total += likelihood[i]
        first += likelihood[i] * _CENTRES[i]
        slippery += likelihood[i] * SLIPPERY_SHARE[i]
    mean = first / total
    second = 0.0
    for i in range(_BINS):
        second += likelihood[i] * (_CENTRES[i] - mean) ** 2
    return mean, math.sqrt(second / total), slippery / total
