"""Simulated vehicle: draws the reports of an honest but imperfect agent about a road. Pure (no
I/O).

Legend
    μ      friction of the road                                                      (n,)
    b, a   a vehicle's own relative error [-] and additive error [μ], constant           (V,)
    k      relative error that all vehicles share in one place                         (n,)
    s      share of the grip used in a visit                                           (n,)
    ρ      relative noise of a visit, smaller if more of the grip is used              (n,)
    σ(m)   standard deviation of the noise, hypot(NOISE_ABSOLUTE, ρ·m): the noise of forces is
           proportional to the grip, and the noise of sensors is constant
    m, z   m = μ·(1 + b + k) + a, and the reading z = m + σ(m)·e                       (n,)
    e      a standard normal, correlated along a drive                                 (n,)

A visit (pass through one cell) with s ≥ .6 ("excited") sends ln p(z | μ) = -(z - μ)² / 2σ(μ)² - ln
σ(μ). Except for the errors b, a and k, this likelihood is calibrated, because the e of each single
visit is standard normal.

Any other visit sends a lower bound, the grip used. Above the bound, this log-likelihood rises or
falls linearly, by at most half a nat. Each vehicle has its own constant slope. `schemas/mugrid.py`
defines the log-likelihood. Both likelihoods are rounded to bytes as in the messages.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.random import Generator

from fleet_service.fusion.normal import log_distribution
from schemas import mugrid
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.thresholds import EXCITED_SHARE

BIAS_RELATIVE: Final = 0.05
BIAS_ABSOLUTE: Final = 0.015
# Relative error that all vehicles in a place share: hypot(common, by_manoeuvre) of CLEAN. In six
# end-to-end drives (real estimator), cells with at least 20 excited vehicles had mean errors that
# differed from those of their surface by .059 (dry), .046 (wet) and .044 (snow). These are robust
# standard deviations; plain ones were .088, .088 and .066.
COMMON: Final = 0.05
NOISE_ABSOLUTE: Final = 0.02
NOISE_AT_LIMIT: Final = 0.05  # relative standard deviation if all grip is used
NOISE_PER_SHARE: Final = 0.10  # increase per share of unused grip; .09 in all at EXCITED_SHARE
CORRELATION: Final = 0.5  # correlation of e between a vehicle's visits to neighbouring cells
SLOPE_NATS: Final = 0.5
USED_STD: Final = 0.02
OVERCONFIDENT_STD: Final = 0.02  # standard deviation that a lying vehicle states
BOUND_STD: Final = 0.05  # standard deviation of the grip used, as the agent assumes it


class ErrorModel(NamedTuple):
    """Error model of a fleet; the defaults are those of the standard fleet.

    Attributes:
        bias: standard deviation of the vehicles' own relative errors.
        common: standard deviation of the relative error that all vehicles share in a place.
        by_manoeuvre: standard deviation of the relative error that vehicles with the same manoeuvre
            share in a place.
        tails: degrees of freedom of a visit's noise (Student's t); infinite for normal noise.
        stated: ratio of the standard deviation that a vehicle states to its true one.
        share: smallest and largest share of the grip that an excited visit uses (one that measures
            the friction).
        low: relative error of values of μ that are too low because little grip was used. If the
            share s of the grip is used, the value is too low by `low`·(1 - s)·μ.
        tyres: relative error common to all tyres of the fleet.
        half: relative error that every second vehicle has in addition.
        usual_share: share of the passes at a place in which the vehicle does the place's most
            frequent manoeuvre.
    """

    bias: float = BIAS_RELATIVE
    common: float = 0.03
    by_manoeuvre: float = 0.04
    tails: float = np.inf
    stated: float = 1.0
    share: tuple[float, float] = (EXCITED_SHARE, 1.0)
    low: float = 0.0
    tyres: float = 0.0
    half: float = 0.0
    usual_share: float = 0.7


CLEAN: Final = ErrorModel()


@dataclass(frozen=True)
class Errors:
    """Own errors of V vehicles: relative error, additive error, and slope of the reported
    likelihood above a lower bound of friction [nat]; each (V,).
    """

    relative: FloatArray
    additive: FloatArray
    slope: FloatArray
    model: ErrorModel = CLEAN

    @staticmethod
    def draw(rng: Generator, vehicles: int, model: ErrorModel = CLEAN) -> Errors:
        """Return random persistent errors for the vehicles of a fleet, drawn by the error model."""
        relative = model.bias * rng.normal(size=vehicles)
        return Errors(
            relative + model.tyres + np.where(np.arange(vehicles) % 2, model.half, 0.0),
            BIAS_ABSOLUTE * rng.normal(size=vehicles),
            SLOPE_NATS * rng.uniform(-1.0, 1.0, vehicles),
            model,
        )


class Passes(NamedTuple):
    """Properties of n visits, arrays (n,).

    Attributes:
        vehicle: number of the vehicle.
        mu: friction of the road.
        common: relative error that all vehicles share in the place.
        share: share of the grip that was used.
        e: standard normal noise of the reading.
        manoeuvre: number of the manoeuvre.
        excited: True if enough grip was used to measure the friction.
    """

    vehicle: IntArray
    mu: FloatArray
    common: FloatArray
    share: FloatArray
    e: FloatArray
    manoeuvre: IntArray
    excited: BoolArray


@dataclass(frozen=True)
class SimulatedReports:
    """Reports about n visits: reading z of the friction (n,) and its standard deviation σ (n,),
    grip used (n,), manoeuvre (n,), log-likelihood (n, 32). Reading and standard deviation are NaN
    if too little grip was used to measure the friction.
    """

    reading: FloatArray
    std: FloatArray
    used: FloatArray
    manoeuvre: IntArray
    log_likelihood: FloatArray


def used_shares(rng: Generator, excited: BoolArray, model: ErrorModel = CLEAN) -> FloatArray:
    """Return the share of the grip used in each visit, (n,). In an excited visit (one that measures
    the friction) it is drawn from `model.share`, else from .05 to .5, which is ordinary driving.
    """
    ordinary = rng.uniform(0.05, min(0.5, model.share[1]), excited.shape)
    return np.where(excited, rng.uniform(*model.share, excited.shape), ordinary)


def reading_noise(rng: Generator, along: IntArray, tails: float = np.inf) -> FloatArray:
    """Return the correlated noise of the readings in successive visits, (n,), with standard
    deviation 1. `along` (n,) counts the visits of a drive from 0. If `tails` is finite, the noise
    follows Student's t with this number of degrees of freedom.
    """
    e = rng.normal(size=len(along))
    heavy = 1.0 if np.isinf(tails) else np.sqrt((tails - 2.0) / rng.chisquare(tails, len(along)))
    for step in range(1, int(along.max(initial=0)) + 1):
        here = np.flatnonzero(along == step)
        e[here] = CORRELATION * e[here - 1] + np.sqrt(1.0 - CORRELATION**2) * e[here]
    return np.asarray(heavy * e)


def draw_reports(rng: Generator, errors: Errors, p: Passes) -> SimulatedReports:
    """Draw at random the reports that simulated vehicles with their own `errors` send about the
    visits `p`, (n,).
    """
    model = errors.model
    who = p.vehicle
    relative = NOISE_AT_LIMIT + NOISE_PER_SHARE * (1.0 - p.share)
    shape = -model.low * (1.0 - p.share)
    seen = np.maximum(
        p.mu * (1.0 + errors.relative[who] + p.common + shape) + errors.additive[who], mugrid.LOWER
    )
    std = np.hypot(NOISE_ABSOLUTE, relative * seen)
    reading = seen + std * p.e
    used = np.clip(p.share * p.mu + USED_STD * rng.normal(size=len(p.mu)), 0.02, 1.3)
    bound = log_distribution((mugrid.CENTRES - used[:, None]) / BOUND_STD)
    above = np.clip((mugrid.CENTRES - used[:, None]) / (mugrid.UPPER - mugrid.LOWER), 0.0, 1.0)
    sloping = bound + errors.slope[who, None] * above
    peaked = reading_likelihood(reading, model.stated * relative, model.stated * NOISE_ABSOLUTE)
    std = np.where(p.excited, model.stated * std, np.nan)
    return SimulatedReports(
        np.where(p.excited, reading, np.nan),
        std,
        used,
        p.manoeuvre,
        np.where(p.excited[:, None], peaked, sloping),
    )


def reading_likelihood(
    reading: FloatArray, relative: FloatArray, absolute: float = NOISE_ABSOLUTE
) -> FloatArray:
    """Return the log-likelihood of the friction μ on the friction grid, (n, 32), up to a constant,
    given vehicles' readings of the friction (n,) with `relative` noise (n,) and `absolute` noise.
    """
    std = np.hypot(absolute, relative[:, None] * mugrid.CENTRES)
    return -0.5 * np.square((reading[:, None] - mugrid.CENTRES) / std) - np.log(std)


def overconfident_likelihood(claim: FloatArray | float) -> FloatArray:
    """Return the normal log-likelihoods (n, 32) that a misbehaving vehicle sends if it claims the
    friction `claim` (n,) with the standard deviation OVERCONFIDENT_STD, although its error is
    larger.
    """
    deviation = (mugrid.CENTRES - np.reshape(claim, (-1, 1))) / OVERCONFIDENT_STD
    return np.asarray(-0.5 * np.square(deviation))
