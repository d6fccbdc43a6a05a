"""What a vehicle that left grip unused takes the road for. Compiled, pure.

Far from the limit the grip is read from how much the tyre's curve has bent, and so from the shape that the sender
assumes. If the shape is wrong, so is the reading, in the same direction for every vehicle that did the same. Only
readings that came out low look like values, so that what is reported errs low. So a likelihood is compared with each
road under the error that a vehicle would make *there*, having used the share s = u/μ of it:

    L'(μ_i) = Σ_j S_ij·L(μ_j),    S_ij ∝ exp(-½·((μ_j - μ_i)/(μ_i·σ(s_i)))²),    rows sum to 1
    σ(s) = clip(SHAPE_SLOPE·(SHAPE_SHARE - s), 0, SHAPE_MOST)

Near the limit of a road nothing changes; a road of which little was used is hardly contradicted. That is for the belief
about the road. Whether vehicles agree, and whether one reports something new, is judged by what was reported: there the
error is the same on both sides.

Legend
    u    grip used                                                  (n,)
    L    likelihood of a visit as reported, L' as it is used        (n, 32)
    σ    relative standard deviation of the reading                 [-]
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion import constants as c
from fleet_service.fusion.belief import SLIPPERY_SHARE, largest
from schemas import mugrid
from schemas.numeric import ByteArray, Float32Array, FloatArray
from schemas.runtime.jit import compiled, refcount_free_inlined

_USED_STEP: Final = 0.02  # half a bin; of the grip used when a kernel is looked up
_USED_MOST: Final = mugrid.UPPER
_STEPS, _FLOOR = np.float32(mugrid.STEPS_PER_NAT), np.float32(mugrid.FLOOR_STEPS)
_LEAST: Final = np.float32(1e-30)  # far below the floor
_LIKELIHOOD: Final = np.exp(-np.arange(256) / mugrid.STEPS_PER_NAT)


def shape_kernel(used: float) -> FloatArray:
    """S of the grip used, (32, 32)."""
    share = used / mugrid.CENTRES
    std = mugrid.CENTRES * np.clip(c.SHAPE_SLOPE * (c.SHAPE_SHARE - share), 1e-6, c.SHAPE_MOST)
    kernel = np.exp(-0.5 * np.square((mugrid.CENTRES[None, :] - mugrid.CENTRES[:, None]) / std[:, None]))
    return np.asarray(kernel / kernel.sum(axis=1, keepdims=True))


# Column by column, so that a vector's numbers lie side by side.
_KERNELS: Final[Float32Array] = np.stack(
    [shape_kernel(k * _USED_STEP).T for k in range(int(_USED_MOST / _USED_STEP) + 1)]
).astype(np.float32, order="C")
# ln(1 + x)/x on [0, 1] by least squares at Chebyshev's places; off by 4e-7, a step is 6e-2.
_LN: Final = tuple(np.float32(v) for v in (
    0.99999952, -0.49996356, 0.33265257, -0.24453390, 0.17659865, -0.10679931, 0.04365929, -0.00846641,
))  # fmt: skip
_LN_2: Final = np.float32(math.log(2.0))
_MANTISSA, _ONE = np.int32(0x007FFFFF), np.int32(0x3F800000)  # bits of a number of single precision: 2^e·(1 + x)


class Evidence(NamedTuple):
    """Likelihoods as they are used (n, 32) in steps, and values as they were reported (n, 3): mean, standard deviation
    and P(slippery) against the uniform prior; NaN where the likelihood is used as it was reported."""

    steps: ByteArray
    reported: Float32Array


def unshaped(steps: ByteArray, used: NDArray[Any]) -> Evidence:
    """Likelihoods (n, 32) in steps, brought to maximum 0, after visits that used `used` (n,) of the grip, without what
    rests on the tyre's shape alone. Bounds stay as they are, and so does everything where `used` is NaN."""
    out, reported = steps.copy(), np.full((len(steps), 3), np.nan, np.float32)
    _unshape(out, np.asarray(used, np.float64), reported)
    return Evidence(out, reported)


@compiled
def _unshape(steps: ByteArray, used: FloatArray, reported: Float32Array) -> None:
    before, after = np.empty(mugrid.BINS, np.float32), np.empty(mugrid.BINS, np.float32)
    for n in range(len(steps)):
        least = np.uint8(255)
        for j in range(mugrid.BINS):
            least = min(least, steps[n, j])
        for j in range(mugrid.BINS):
            steps[n, j] -= least
        if math.isnan(used[n]) or steps[n, mugrid.BINS - 1] < c.VALUE_DROP_STEPS:
            continue
        kernel = _KERNELS[min(max(int(used[n] / _USED_STEP + 0.5), 0), len(_KERNELS) - 1)]
        for j in range(mugrid.BINS):
            before[j] = _LIKELIHOOD[steps[n, j]]
        _summarise(before, reported[n])
        for i in range(mugrid.BINS):
            after[i] = 0.0
        for j in range(mugrid.BINS):
            for i in range(mugrid.BINS):
                after[i] += kernel[j, i] * before[j]
        most = largest(after)
        for i in range(mugrid.BINS):
            below = _STEPS * _ln(most / max(after[i], _LEAST)) + np.float32(0.5)
            steps[n, i] = np.uint8(min(below, _FLOOR))


@refcount_free_inlined
def _ln(x: np.float32) -> np.float32:
    """Natural logarithm of a normal number, in arithmetic that takes many at once."""
    bits = np.float32(x).view(np.int32)
    f = np.int32((bits & _MANTISSA) | _ONE).view(np.float32) - np.float32(1.0)
    series = _LN[7]
    for k in range(6, -1, -1):
        series = series * f + _LN[k]
    return np.float32(np.int32((bits >> 23) - 127)) * _LN_2 + f * series


@compiled
def _summarise(likelihood: Float32Array, reported: Float32Array) -> None:
    """Mean, standard deviation with the vehicle's own error, and P(slippery) of a likelihood."""
    whole, first, second, slippery = 0.0, 0.0, 0.0, 0.0
    for i in range(mugrid.BINS):
        whole += likelihood[i]
        first += likelihood[i] * mugrid.CENTRES[i]
        slippery += likelihood[i] * SLIPPERY_SHARE[i]
    mean = first / whole
    for i in range(mugrid.BINS):
        second += likelihood[i] * (mugrid.CENTRES[i] - mean) ** 2
    reported[0] = mean
    reported[1] = math.sqrt(second / whole + (c.BIAS_RELATIVE * mean) ** 2 + c.BIAS_ABSOLUTE**2)
    reported[2] = slippery / whole
