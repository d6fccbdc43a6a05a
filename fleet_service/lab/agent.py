"""The synthetic vehicle: what an honest but imperfect agent says about a stretch of road. Pure.

Legend
    μ      friction of the road                                                      (n,)
    b, a   a vehicle's own relative and additive error, the same at every visit        (V,)
    k      relative error that all vehicles share in one place                         (n,)
    s      share of the grip used in a visit                                           (n,)
    ρ      relative noise of a visit: the nearer to the limit, the more a tyre tells   (n,)
    σ(m)   hypot(NOISE_ABSOLUTE, ρ·m): forces scale with the grip, sensors do not
    m, z   m = μ·(1 + b + k) + a, and the reading z = m + σ(m)·e                       (n,)
    e      a standard normal, correlated along a drive                                 (n,)

An excited visit (s ≥ .6) sends ln p(z | μ) = -(z - μ)² / 2σ(μ)² - ln σ(μ): apart from b, a and k it is calibrated,
also where e is correlated with that of the visit before, since each visit's e alone is standard normal (a real agent
tempers to get there). An unexcited one sends "at least what I used", with a slope above it that is the sender's own and
stays within half a nat (contract of the log-likelihood). Both are rounded to the wire's bytes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.random import Generator
from scipy.special import log_ndtr

from schemas import mugrid
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.thresholds import EXCITED_SHARE

BIAS_RELATIVE: Final = 0.05
BIAS_ABSOLUTE: Final = 0.015
# What all vehicles of a place share, relative: in six end-to-end drives (real estimator) cells of 20 and more
# excited vehicles err about the mean of their surface by .059 dry, .046 wet and .044 snow (robust standard deviations;
# plain ones are .088, .088 and .066).
COMMON: Final = 0.05
NOISE_ABSOLUTE: Final = 0.02
NOISE_AT_LIMIT: Final = 0.05  # relative
NOISE_PER_SHARE: Final = 0.10  # ... more for each share that was left: .09 at EXCITED_SHARE
CORRELATION: Final = 0.5  # of e between a vehicle's visits to neighbouring cells
SLOPE_NATS: Final = 0.5
USED_STD: Final = 0.02
OVERCONFIDENT_STD: Final = 0.02  # of a liar
BOUND_STD: Final = 0.05  # what the agent admits


@dataclass(frozen=True)
class Errors:
    """Own errors of V vehicles: relative, additive, and the slope of their bounds [nat]; each (V,)."""

    relative: FloatArray
    additive: FloatArray
    slope: FloatArray

    @staticmethod
    def draw(rng: Generator, vehicles: int) -> Errors:
        """A fleet."""
        return Errors(
            BIAS_RELATIVE * rng.normal(size=vehicles),
            BIAS_ABSOLUTE * rng.normal(size=vehicles),
            SLOPE_NATS * rng.uniform(-1.0, 1.0, vehicles),
        )


@dataclass(frozen=True)
class SimulatedReports:
    """What visits report: readings z and σ (n,), NaN where unexcited; grip used (n,); log-likelihood (n, 32)."""

    reading: FloatArray
    std: FloatArray
    used: FloatArray
    log_likelihood: FloatArray


def shares(rng: Generator, excited: BoolArray) -> FloatArray:
    """s of visits: the upper part of the range where excited, ordinary driving else; same shape."""
    return np.where(excited, rng.uniform(EXCITED_SHARE, 1.0, excited.shape), rng.uniform(0.05, 0.5, excited.shape))


def noise(rng: Generator, along: IntArray) -> FloatArray:
    """e of visits that follow each other; `along` (n,) is 0 where a drive begins."""
    e = rng.normal(size=len(along))
    for step in range(1, int(along.max(initial=0)) + 1):
        here = np.flatnonzero(along == step)
        e[here] = CORRELATION * e[here - 1] + np.sqrt(1.0 - CORRELATION**2) * e[here]
    return e


def report(
    rng: Generator, errors: Errors, vehicle: IntArray, mu: FloatArray, common: FloatArray, share: FloatArray,
    e: FloatArray,
) -> SimulatedReports:  # fmt: skip
    """Reports of vehicles (n,) after using `share` of a grip `mu` with a `common` error and noise `e`; all (n,)."""
    excited = share >= EXCITED_SHARE
    relative = NOISE_AT_LIMIT + NOISE_PER_SHARE * (1.0 - share)
    seen = np.maximum(mu * (1.0 + errors.relative[vehicle] + common) + errors.additive[vehicle], mugrid.LOWER)
    std = np.hypot(NOISE_ABSOLUTE, relative * seen)
    reading = seen + std * e
    used = np.clip(share * mu + USED_STD * rng.normal(size=len(mu)), 0.02, 1.3)
    bound = log_ndtr((mugrid.CENTRES - used[:, None]) / BOUND_STD)
    above = np.clip((mugrid.CENTRES - used[:, None]) / (mugrid.UPPER - mugrid.LOWER), 0.0, 1.0)
    sloping = bound + errors.slope[vehicle, None] * above
    log_likelihood = np.where(excited[:, None], likelihood(reading, relative), sloping)
    return SimulatedReports(np.where(excited, reading, np.nan), np.where(excited, std, np.nan), used, log_likelihood)


def likelihood(reading: FloatArray, relative: FloatArray) -> FloatArray:
    """ln p(z | μ) of readings (n,) with relative noise (n,), on the grid (n, 32), up to a constant."""
    std = np.hypot(NOISE_ABSOLUTE, relative[:, None] * mugrid.CENTRES)
    return -0.5 * np.square((reading[:, None] - mugrid.CENTRES) / std) - np.log(std)


def overconfident(claim: FloatArray | float, std: float = OVERCONFIDENT_STD) -> FloatArray:
    """Normal log-likelihoods (n, 32) of one who claims μ (n,) and no doubt."""
    return np.asarray(-0.5 * np.square((mugrid.CENTRES - np.reshape(claim, (-1, 1))) / std))
