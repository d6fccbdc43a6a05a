"""The fixed grid of friction values, and the meaning of a log-likelihood on it.

Legend
    μ        peak tyre–road adhesion coefficient                      [-]
    EDGES    borders of the 32 equal bins on [0.05, 1.20]             (33,)
    CENTRES  middles of the bins                                      (32,)
    PRIOR    distribution for a road that was never measured: uniform (32,)
    ℓ        log p(measurements of one passage of a cell | μ), up to a constant  (…, 32), nats

A log-likelihood is sent as 32 bytes: steps of 1/16 nat below the maximum, at most 255 steps. A flat
log-likelihood (all zeros) contains no information about μ.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from schemas.numeric import ByteArray, FloatArray
from schemas.thresholds import SLIPPERY_MU

BINS: Final = 32
LOWER: Final = 0.05
UPPER: Final = 1.20
EDGES: Final[FloatArray] = np.linspace(LOWER, UPPER, BINS + 1)
CENTRES: Final[FloatArray] = (EDGES[:-1] + EDGES[1:]) / 2
# share of each bin that lies below SLIPPERY_MU, (32,)
SLIPPERY_SHARE: Final[FloatArray] = np.clip(
    (SLIPPERY_MU - LOWER) / ((UPPER - LOWER) / BINS) - np.arange(BINS), 0.0, 1.0
)
PRIOR: Final[FloatArray] = np.full(BINS, 1.0 / BINS)
STEPS_PER_NAT: Final = 16
FLOOR_STEPS: Final = 255


def quantiles(probability: NDArray[np.floating[Any]], q: float) -> FloatArray:
    """Return the q-quantile of histograms on the friction grid, with linear interpolation inside a
    bin.

    Args:
        probability: (…, 32), non-negative; need not be normalised.
        q: level in [0, 1].

    Returns:
        friction μ, (…,), in [LOWER, UPPER].
    """
    p = np.asarray(probability, dtype=np.float64)
    upto = np.cumsum(p, axis=-1)
    target = q * upto[..., -1:]
    bin_ = np.minimum((upto < target).sum(axis=-1, keepdims=True), BINS - 1)
    mass = np.take_along_axis(p, bin_, -1)
    below = np.where(bin_ > 0, np.take_along_axis(upto, np.maximum(bin_ - 1, 0), -1), 0.0)
    share = np.divide(target - below, mass, out=np.zeros_like(mass), where=mass > 0.0)
    found: FloatArray = LOWER + (UPPER - LOWER) / BINS * (bin_ + np.clip(share, 0.0, 1.0))
    return found[..., 0]


def encode_log_likelihood(log_likelihood: NDArray[np.floating[Any]]) -> ByteArray:
    """Return log-likelihoods ℓ (…, 32) as bytes. Each byte is the number of steps of 1/16 nat below
    the maximum, at most 255; -inf becomes 255 steps. The caller must refuse NaN.
    """
    below = np.max(log_likelihood, axis=-1, keepdims=True) - log_likelihood
    steps: ByteArray = np.clip(np.rint(below * STEPS_PER_NAT), 0, FLOOR_STEPS).astype(np.uint8)
    return steps


def decode_log_likelihood(steps: ByteArray) -> FloatArray:
    """Return log-likelihoods ℓ (…, 32) [nat] from their bytes. Each value lies between -255/16 and
    0. The largest value of a row is 0 if the sender encoded it as `encode_log_likelihood` does.
    """
    return steps.astype(np.float64) / -STEPS_PER_NAT
