"""Standard normal distribution for arrays of any shape.

The functions are compiled here, because a library for them would cost the service 15 MB of memory.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from schemas.numeric import FloatArray
from schemas.runtime.jit import refcount_free_locked

# Below this argument, ln Φ is computed from its series, whose relative error is below 10⁻⁶ there.
# Further below, Φ itself is too small for a floating-point number.
_FAR: Final = -12.0


def normal_cdf(x: FloatArray) -> FloatArray:
    """Return the distribution function Φ(x) of the standard normal distribution, in the shape of
    `x`.
    """
    out = np.empty(x.shape)
    _write_cdf(np.ravel(x), out.reshape(-1))
    return out


def log_distribution(x: FloatArray) -> FloatArray:
    """Return ln Φ(x), the logarithm of the standard normal distribution function.

    Below _FAR the function uses the asymptotic series -½x² - ln(-x·√(2π)) + ln(1 - 1/x² + 3/x⁴).
    """
    out = np.empty(x.shape)
    _write_log_distribution(np.ravel(x), out.reshape(-1))
    return out


@refcount_free_locked
def _write_cdf(x: FloatArray, out: FloatArray) -> None:
    for i in range(len(x)):
        out[i] = 0.5 * math.erfc(-x[i] * math.sqrt(0.5))


@refcount_free_locked
def _write_log_distribution(x: FloatArray, out: FloatArray) -> None:
    for i in range(len(x)):
        if x[i] > _FAR:
            out[i] = math.log(0.5 * math.erfc(-x[i] * math.sqrt(0.5)))
        else:
            square = x[i] * x[i]
            series = -1.0 / square + 3.0 / (square * square)
            out[i] = -0.5 * square - math.log(-x[i] * math.sqrt(2.0 * math.pi)) + math.log1p(series)
