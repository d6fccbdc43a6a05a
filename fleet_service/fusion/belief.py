"""Belief about the friction of one cell (32 probabilities), and its change by ageing and by votes.
A vote is the effect of one visit (one pass of a vehicle through the cell). All functions are
compiled.

Legend
    p    belief about the friction that the whole fleet reads: probability per bin (32,)
    q    a belief in packed form: bins of 16 bits, the largest is 65 535          (32,)
    L    likelihood of one visit, decoded from the report (one byte per bin)    (32,)
    B    bias kernel: B[i, j] = P(the vehicle reads μ_j on a road of μ_i)  (32, 32), rows sum to 1
    L̃    B·L divided by its mean: L averaged over the vehicle's bias            (32,)
    s    strength of a vote: a × b × c                                          [-]
         a    share of the visit's information that earlier visits of the vehicle did not give
         b    trust in the vehicle, its weight among all vehicles
         c    weight of the position, below 1 if it is inaccurate (`space`)
    h    P(the road changed within Δt), 1 - exp(-Δt / CHANGE_S)                 [-]
         CHANGE_S    mean time between sudden changes of the road               [s]

Arithmetic is in single precision, which takes half the memory of double precision. Only two digits
of a belief are significant, so this is exact enough.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion import constants
from schemas import mugrid
from schemas.numeric import ByteArray, Float32Array, FloatArray
from schemas.runtime.jit import refcount_free_inlined, refcount_free_locked

PackedArray = NDArray[np.uint16]
Bins = NDArray[np.floating[Any]]


class ReportKind(IntEnum):
    """Kind of a report, see `kind_of`: only a lower bound of friction, or a friction value."""

    BOUND = 0
    VALUE = 1


_BINS: Final = mugrid.BINS
# [bins²/s] Diffusion coefficient of the slow change of μ: half the variance gained per second.
_DIFFUSION: Final = 0.5 * (constants.DRIFT_PER_ROOT_HOUR / constants.BIN_WIDTH) ** 2 / 3600.0
# Largest share of a bin that moves to each neighbouring bin in one diffusion step. A larger share
# makes the scheme unstable or adds ripples.
_STEP: Final = 0.25
# Largest number of diffusion steps: those of one day. After a day, sudden changes have replaced the
# belief by the prior.
_STEPS: Final = math.ceil(_DIFFUSION * 24 * 3600 / _STEP)
# likelihood for each number of steps below the maximum
_LIKELIHOOD: Final = np.exp(-np.arange(256) / mugrid.STEPS_PER_NAT).astype(np.float32)
_CENTRES: Final = mugrid.CENTRES
_PLACES: Final[Float32Array] = mugrid.CENTRES.astype(np.float32)
PRIOR: Final[Float32Array] = mugrid.PRIOR.astype(np.float32)
FULL: Final = np.uint16(65535)
# Number of bins on each side at which the bias kernel is cut off: 3.6 of its largest standard
# deviation.
REACH: Final = 6
PADDED: Final = _BINS + 2 * REACH


def bias_kernel() -> FloatArray:
    """Return the bias kernel B (32, 32): row i holds the probabilities that one vehicle reads
    friction bin j on a road of friction bin i. Each row is a normal distribution around μ_i with
    the standard deviation hypot(BIAS_RELATIVE·μ, BIAS_ABSOLUTE), cut off REACH bins from its
    centre.
    """
    spread = np.hypot(constants.BIAS_RELATIVE * _CENTRES, constants.BIAS_ABSOLUTE)[:, None]
    kernel = np.exp(-0.5 * np.square((_CENTRES[None, :] - _CENTRES[:, None]) / spread))
    kernel[np.abs(np.subtract.outer(np.arange(_BINS), np.arange(_BINS))) > REACH] = 0.0
    return np.asarray(kernel / kernel.sum(axis=1, keepdims=True))


def _kernel_diagonals() -> Float32Array:
    """Return the diagonals of the bias kernel B (how one vehicle reads each road, see
    `bias_kernel`), (2·REACH + 1, 32). In this form the numbers that one step of a convolution reads
    are contiguous in memory.
    """
    kernel = bias_kernel()
    taps = np.zeros((2 * REACH + 1, _BINS), np.float32)
    for i in range(_BINS):
        for j in range(max(i - REACH, 0), min(i + REACH + 1, _BINS)):
            taps[j - i + REACH, i] = kernel[i, j]
    # Weights without an effect in single precision become zero. They would lead to numbers below
    # 1e-38, whose multiplication takes a hundred times as long.
    taps[taps < np.finfo(np.float32).eps] = 0.0
    return taps


_TAPS: Final = _kernel_diagonals()


def quantiles(belief: FloatArray, levels: tuple[float, ...]) -> FloatArray:
    """Return the quantiles of the friction μ of beliefs (k, 32) at the given levels, (levels, k).
    The results equal those of `mugrid.quantiles` bit for bit and take a tenth of the time.
    """
    out = np.empty((len(levels), len(belief)))
    _write_quantiles(belief, np.array(levels), out)
    return out


@refcount_free_locked
def _write_quantiles(belief: FloatArray, levels: FloatArray, out: FloatArray) -> None:
    for k in range(len(belief)):
        whole = 0.0
        for i in range(_BINS):
            whole += belief[k, i]
        for j in range(len(levels)):
            target = levels[j] * whole
            below = 0.0
            place = 0
            while place < _BINS - 1 and below + belief[k, place] < target:
                below += belief[k, place]
                place += 1
            mass = belief[k, place]
            share = (target - below) / mass if mass > 0.0 else 0.0
            out[j, k] = mugrid.LOWER + constants.BIN_WIDTH * (place + min(max(share, 0.0), 1.0))


@refcount_free_inlined
def sum_bins(p: Bins) -> float:
    """Return the sum of an array `p` (32,) with one number per friction bin. Eight partial sums do
    not depend on each other, so the processor computes them in parallel.
    """
    a = p[0]
    b = p[1]
    d = p[2]
    e = p[3]
    f = p[4]
    g = p[5]
    h = p[6]
    j = p[7]
    for i in range(8, _BINS, 8):
        a += p[i]
        b += p[i + 1]
        d += p[i + 2]
        e += p[i + 3]
        f += p[i + 4]
        g += p[i + 5]
        h += p[i + 6]
        j += p[i + 7]
    return ((a + f) + (b + g)) + ((d + h) + (e + j))  # type: ignore[no-any-return]


@refcount_free_inlined
def largest_bin(p: Bins) -> float:
    """Return the largest number of an array `p` (32,) with one number per friction bin. Eight
    partial results do not depend on each other, so the processor computes them in parallel (SIMD).
    """
    a = p[0]
    b = p[1]
    d = p[2]
    e = p[3]
    f = p[4]
    g = p[5]
    h = p[6]
    j = p[7]
    for i in range(8, _BINS, 8):
        a = p[i] if p[i] > a else a
        b = p[i + 1] if p[i + 1] > b else b
        d = p[i + 2] if p[i + 2] > d else d
        e = p[i + 3] if p[i + 3] > e else e
        f = p[i + 4] if p[i + 4] > f else f
        g = p[i + 5] if p[i + 5] > g else g
        h = p[i + 6] if p[i + 6] > h else h
        j = p[i + 7] if p[i + 7] > j else j
    return max(max(max(a, b), max(d, e)), max(max(f, g), max(h, j)))  # type: ignore[no-any-return]


@refcount_free_inlined
def unpack_belief(belief: PackedArray, row: int, p: Bins) -> None:
    """Unpack the belief that one row of 16-bit integers stores, and fill `p` (32,) with its
    probabilities.
    """
    whole = np.uint32(0)
    for i in range(_BINS):
        whole = np.uint32(whole + belief[row, i])
    scale = np.float32(1.0) / np.float32(whole)
    for i in range(_BINS):
        p[i] = np.float32(belief[row, i]) * scale


@refcount_free_inlined
def pack_belief(p: Bins, belief: PackedArray, row: int) -> None:
    """Store a belief `p` (32), normalised or not, as 16-bit integers. Rounding preserves two
    properties: a non-decreasing belief stays non-decreasing, and a uniform belief stays uniform.
    """
    scale = np.float32(FULL) / np.float32(largest_bin(p))
    for i in range(_BINS):
        belief[row, i] = np.uint16(np.float32(p[i]) * scale + np.float32(0.5))


@refcount_free_inlined
def mix_prior(p: Bins, change: float, prior: Float32Array) -> None:
    """Mix the prior into a belief `p` (32,) in place: p ← (1 - h)·p + h·prior, where h = `change`
    is the probability that the road changed.
    """
    h = np.float32(change)
    for i in range(_BINS):
        p[i] += h * (prior[i] - p[i])


@refcount_free_inlined
def forget(p: Bins, drift_s: float, change_s: float, prior: Float32Array, padded: Bins) -> None:
    """Age a belief `p` (32) in place: slow drift of μ over `drift_s` [s], as diffusion with
    reflecting ends, then a possible sudden change of the road over `change_s` [s], which mixes in
    the `prior`.

    Diffusion leaves a uniform belief uniform and a non-decreasing one non-decreasing. Therefore, if
    all reports are lower bounds and the prior is uniform, ageing never lowers the upper end of the
    interval below that of the prior. `padded` (34 or more) is scratch memory.
    """
    if drift_s > 0.0:
        whole = _DIFFUSION * drift_s
        steps = min(math.ceil(whole / _STEP), _STEPS)
        share = np.float32(min(whole / steps, _STEP))
        for _ in range(steps):
            padded[0] = p[0]
            padded[_BINS + 1] = p[_BINS - 1]
            for i in range(_BINS):
                padded[i + 1] = p[i]
            for i in range(_BINS):
                p[i] += share * ((padded[i] - padded[i + 1]) + (padded[i + 2] - padded[i + 1]))
    if change_s > 0.0:
        mix_prior(p, -math.expm1(-change_s / constants.CHANGE_S), prior)


@refcount_free_inlined
def ensure_change(p: Bins, change_s: float, power: float, prior: Float32Array) -> None:
    """Mix the prior into a belief `p` in place, so that a sudden road change has at least the
    probability CHANGE_LEAST·`power`. The part for the time `change_s` [s] was already mixed in by
    `forget` (ageing); only the rest is added.

    If visits follow each other within seconds, `forget` mixes in nearly nothing, and a firm belief
    would resist a real change. `power` is the share of the coming vote (effect of one visit) that
    is new information.
    """
    lacking = constants.CHANGE_LEAST * power + math.expm1(-max(change_s, 0.0) / constants.CHANGE_S)
    if lacking > 0.0:
        mix_prior(p, lacking, prior)


@refcount_free_inlined
def kind_of(evidence: ByteArray) -> ReportKind:
    """Return the kind of a visit's likelihood of friction (32,), VALUE or BOUND. It is VALUE (a
    measurement) if the likelihood falls by at least VALUE_DROP_STEPS from its maximum to the
    highest friction, because it then limits μ from above. Otherwise it is BOUND, only a lower bound
    of μ.
    """
    least = np.uint8(255)
    for i in range(_BINS):
        least = min(least, evidence[i])
    is_value = evidence[_BINS - 1] >= int(least) + constants.VALUE_DROP_STEPS
    return ReportKind.VALUE if is_value else ReportKind.BOUND


@refcount_free_inlined
def convolve_bias(evidence: ByteArray, kind: int, padded: Bins, out: Bins) -> None:
    """Fill `out` (32) with the likelihood L̃ of the road's friction μ from one visit (passage of a
    cell), scaled to mean 1. L̃ allows for the unknown bias of the vehicle's readings.

    Args:
        evidence: the reported log-likelihood (32,), as the distance below its maximum in steps of
            1/16 nat.
        kind: VALUE (a measurement of μ): the likelihood is averaged over the bias, which smooths
            it. BOUND (only a lower bound of μ): the likelihood is not smoothed.
        padded: scratch memory (PADDED); its first and last REACH numbers must be zero.
        out: array for the result.

    A fall of a BOUND above its maximum by up to half a nat is noise and is removed. A larger fall
    is evidence against high friction. In ten tuning drives it makes visits to slippery road more
    probable by .2 to .4 nat each, and visits to dry road not less probable. Smoothed bounds would
    be wrong, because many of them together could exceed the grip that any vehicle used.
    """
    if kind == ReportKind.VALUE:
        for j in range(_BINS):
            padded[REACH + j] = _LIKELIHOOD[evidence[j]]
        for i in range(_BINS):
            whole = np.float32(0.0)
            for k in range(2 * REACH + 1):
                whole += _TAPS[k, i] * padded[i + k]
            out[i] = whole
    else:
        steps = np.uint8(255)
        for j in range(_BINS):
            steps = min(steps, evidence[j])
            out[j] = _LIKELIHOOD[steps]
        if evidence[_BINS - 1] - int(steps) > constants.NOISE_DROP_STEPS:
            for j in range(_BINS - 1, -1, -1):
                if evidence[j] == steps:
                    break
                out[j] = _LIKELIHOOD[evidence[j]]
    scale = np.float32(_BINS) / np.float32(sum_bins(out))
    for i in range(_BINS):
        out[i] *= scale


@refcount_free_inlined
def apply_vote(p: Bins, likelihood: Bins, strength: float) -> None:
    """Multiply a belief `p` (32) in place by the likelihood L̃ (32) of one visit with strength s in
    [0, 1]: p ← p·(s·L̃ + 1 - s). The result is not normalised.
    """
    s = np.float32(strength)
    rest = np.float32(1.0 - strength)
    for i in range(_BINS):
        p[i] *= s * likelihood[i] + rest


@refcount_free_inlined
def mean_of(likelihood: Bins) -> float:
    """Return the posterior mean of μ under a uniform prior, for a likelihood (32) whose mean over
    the bins is 1.
    """
    a = np.float32(0.0)
    b = np.float32(0.0)
    d = np.float32(0.0)
    e = np.float32(0.0)
    f = a
    g = a
    h = a
    j = a
    for i in range(0, _BINS, 8):
        a += likelihood[i] * _PLACES[i]
        b += likelihood[i + 1] * _PLACES[i + 1]
        d += likelihood[i + 2] * _PLACES[i + 2]
        e += likelihood[i + 3] * _PLACES[i + 3]
        f += likelihood[i + 4] * _PLACES[i + 4]
        g += likelihood[i + 5] * _PLACES[i + 5]
        h += likelihood[i + 6] * _PLACES[i + 6]
        j += likelihood[i + 7] * _PLACES[i + 7]
    return float(((a + f) + (b + g)) + ((d + h) + (e + j))) / _BINS


@refcount_free_inlined
def describe_likelihood(likelihood: Bins, mean: float) -> tuple[float, float]:
    """Return two numbers for a likelihood of friction (32,) under a uniform prior: the standard
    deviation of μ around `mean`, and P(slippery). The likelihood must be scaled to mean 1 over the
    bins.
    """
    second = 0.0
    slippery = 0.0
    for i in range(_BINS):
        second += likelihood[i] * (_CENTRES[i] - mean) ** 2
        slippery += likelihood[i] * mugrid.SLIPPERY_SHARE[i]
    return math.sqrt(second / _BINS), slippery / _BINS
