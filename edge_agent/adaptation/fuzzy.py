"""Fuzzy inference of a bounded factor on the measurement noise R. Its input is the mismatch between
actual and theoretical variance of the innovations (measurement minus prediction).

Legend
    nu2         actual innovation variance, averaged over a window [unit^2]
    s           theoretical innovation variance (state and measurement noise), same window [unit^2]
    mismatch    nu2/s - 1 [1]
    factor      R over its nominal value [1], within [LEAST_FACTOR, LARGEST_FACTOR]

If the actual variance exceeds the theoretical one, R increases: paper 004, equations 29 to 31, with
the direction of the change corrected (errata), and with bounds that the paper does not have.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from edge_agent.adaptation.memberships import LARGEST_SCALE
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

# [1] limits of the factor on R. It hardly decreases, because R also covers model errors, which may
# return after a stretch with small innovations.
LEAST_FACTOR = 0.8
LARGEST_FACTOR = math.exp(LARGEST_SCALE)


@compiled
def infer_step(mismatch: float, inputs: FloatArray, outputs: FloatArray) -> float:
    """Return the logarithm of the factor on the measurement noise R [nat] for a mismatch of the
    variance of the innovations [1].

    The result is the mean of `outputs` (5,), weighted by the memberships (degrees, 0 to 1) of the
    mismatch in triangular fuzzy sets with peaks `inputs` (5,). Each triangle ends at its
    neighbours' peaks, so the weighted mean is linear between neighbouring peaks.
    """
    last = inputs.shape[0] - 1
    if mismatch <= inputs[0]:
        return float(outputs[0])
    for k in range(last):
        if mismatch < inputs[k + 1]:
            share = (mismatch - inputs[k]) / (inputs[k + 1] - inputs[k])
            return float((1.0 - share) * outputs[k] + share * outputs[k + 1])
    return float(outputs[last])


class FactorLimits(NamedTuple):
    """Limits of a factor on the measurement noise R: the share `pace` multiplies each change of ln
    R; `least` and `largest` bound the factor.
    """

    pace: float
    least: float
    largest: float


@compiled
def adapted_factor(
    factor: float, actual: float, theoretical: float, inputs: FloatArray, outputs: FloatArray
) -> float:
    """Return the next factor on the measurement noise R: factor*exp(infer_step(actual/theoretical -
    1)), limited to [LEAST_FACTOR, LARGEST_FACTOR]. `factor` is the present factor. `actual` and
    `theoretical` are variances of the innovations. `inputs` (5,) are the peaks of the fuzzy sets,
    and `outputs` (5,) the change of ln R for each set.
    """
    limits = FactorLimits(1.0, LEAST_FACTOR, LARGEST_FACTOR)
    return adapted_within(factor, actual, theoretical, inputs, outputs, limits)


@compiled
def adapted_within(
    factor: float,
    actual: float,
    theoretical: float,
    inputs: FloatArray,
    outputs: FloatArray,
    limits: FactorLimits,
) -> float:
    """Return the next factor on the measurement noise R like `adapted_factor`, but with the speed
    and the range of change given by `limits`.
    """
    if not theoretical > 0.0:
        return factor
    step = limits.pace * infer_step(actual / theoretical - 1.0, inputs, outputs)
    return min(max(factor * math.exp(step), limits.least), limits.largest)
