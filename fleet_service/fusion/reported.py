"""Values of friction as vehicles reported them: mean, standard deviation and P(slippery) of a
likelihood. Compiled, pure.

Reported values decide three questions: whether vehicles agree, whether a report is new, and which
vehicles an alert may name as sources. The belief uses a wider likelihood (`belief.convolve_bias`).
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion import constants
from schemas import mugrid
from schemas.numeric import ByteArray, Float32Array, FloatArray
from schemas.runtime.jit import refcount_free_locked

_LIKELIHOOD: Final = np.exp(-np.arange(256) / mugrid.STEPS_PER_NAT)


class Evidence(NamedTuple):
    """Likelihoods of friction that visits (passages of cells) contribute to the map, and the
    friction values that the vehicles reported.

    Attributes:
        steps: (n, 32) log-likelihood in steps below its maximum.
        reported: (n, 3) mean, standard deviation and P(slippery) under the uniform prior; NaN for a
            lower bound.
    """

    steps: ByteArray
    reported: Float32Array


def as_reported(steps: NDArray[Any]) -> Evidence:
    """Return two arrays for n received log-likelihoods `steps` (n, 32). The first contains the
    log-likelihoods in steps below the maximum, which becomes 0. The second, (n, 3), contains the
    mean, standard deviation and P(slippery) of each; NaN for a likelihood that is only a lower
    bound.
    """
    out = steps.astype(np.uint8)
    reported = np.full((len(steps), 3), np.nan, np.float32)
    _describe_rows(out, reported, np.empty(mugrid.BINS))
    return Evidence(out, reported)


@refcount_free_locked
def _describe_rows(steps: ByteArray, reported: Float32Array, likelihood: FloatArray) -> None:
    """Subtract its least value from each row of `steps` (n, 32), and write the mean, standard
    deviation and P(slippery) of values to `reported` (n, 3). `likelihood` (32,) is memory for one
    row.
    """
    for n in range(len(steps)):
        least = np.uint8(255)
        for j in range(mugrid.BINS):
            least = min(least, steps[n, j])
        for j in range(mugrid.BINS):
            steps[n, j] -= least
            likelihood[j] = _LIKELIHOOD[steps[n, j]]
        if steps[n, mugrid.BINS - 1] < constants.VALUE_DROP_STEPS:
            continue
        whole = 0.0
        first = 0.0
        second = 0.0
        slippery = 0.0
        for i in range(mugrid.BINS):
            whole += likelihood[i]
            first += likelihood[i] * mugrid.CENTRES[i]
            slippery += likelihood[i] * mugrid.SLIPPERY_SHARE[i]
        mean = first / whole
        for i in range(mugrid.BINS):
            second += likelihood[i] * (mugrid.CENTRES[i] - mean) ** 2
        reported[n, 0] = mean
        reported[n, 1] = math.sqrt(
            second / whole + (constants.BIAS_RELATIVE * mean) ** 2 + constants.BIAS_ABSOLUTE**2
        )
        reported[n, 2] = slippery / whole
