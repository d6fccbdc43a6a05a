"""Likelihood of the friction μ from one visit (passage of a cell). The sender reports a
log-likelihood, or a posterior with interval, or only the grip used. Vectorised, pure.

Legend
    ℓ    log-likelihood on the friction grid, maximum 0        (n, 32), nats
    μ̂    posterior median that a sender gave                    (n,)
    u    grip used, a lower bound of μ                           (n,)
    Φ    standard normal distribution function
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion import constants
from fleet_service.fusion.normal import log_distribution
from fleet_service.fusion.reported import Evidence, as_reported
from schemas import mugrid
from schemas.numeric import BoolArray, ByteArray, FloatArray
from schemas.runtime.jit import refcount_free_locked
from schemas.signals import FLAGS
from schemas.thresholds import EXCITED_SHARE, SLIPPERY_MU, Z_95

# Half a standard deviation of the grip used. A bound is flat from the grip used minus this.
_LESS: Final = 0.5 * constants.UTILISED_STD
# Step of the grip used in the table of bounds; the grip used is rounded down. A tenth of its
# standard deviation.
_USED_STEP: Final = constants.UTILISED_STD / 10.0


def make_evidence(columns: Mapping[str, NDArray[Any]], with_likelihood: BoolArray) -> Evidence:
    """Return the likelihood of friction from each of n visits, and the friction values for the
    comparison of vehicles.

    The result has two arrays. `steps` (n, 32) is the log-likelihood, in steps of 1/16 nat below its
    maximum. `reported` (n, 3) contains mean, standard deviation and P(slippery) of each reported
    friction value; NaN if the visit gives only a lower bound.

    Args:
        columns: `log_likelihood` (n, 32); the sender's posterior as median `mu` and interval from
            `mu_lower` to `mu_upper`; `mu_utilised`, the grip used. Except the first, each is (n,)
            and NaN where absent.
        with_likelihood: (n,) True if the sender gave a likelihood.

    If the sender gave a likelihood, it is used. It is a friction value if it falls towards the
    highest friction. Otherwise it is only a lower bound and must not claim more than the grip used
    (`level_above_used`).

    If the sender gave no likelihood, the posterior is used as a friction value where `mu_utilised ≥
    0.6·mu`. If less grip was used, or if `mu` is absent, only the lower bound "μ is at least
    `mu_utilised`" is used. If `mu_utilised` is absent, the likelihood is flat.

    A slide (`find_slides`) is a friction value, see `sliding_likelihood`.
    """
    sent = columns["log_likelihood"]
    steps, reported = as_reported(sent)
    out = bound_by_used(level_above_used(steps, columns["mu_utilised"]), columns["mu_utilised"])
    rest = np.flatnonzero(~with_likelihood)
    if len(rest):
        mu, lower, upper, used = (
            columns[n][rest].astype(np.float64)
            for n in ("mu", "mu_lower", "mu_upper", "mu_utilised")
        )
        value = used >= EXCITED_SHARE * mu  # False where either is NaN
        limited = find_limited(columns, columns["mu_utilised"])
        slides = find_slides(columns, with_likelihood, limited)
        log_likelihood = np.where(
            value[:, None],
            interval_likelihood(mu, lower, upper),
            np.where(slides[rest, None], sliding_likelihood(used), at_least(used)),
        )
        steps, reported[rest] = as_reported(mugrid.encode_log_likelihood(log_likelihood))
        out[rest] = bound_by_used(level_above_used(steps, used), used)
    return Evidence(out, reported)


def bound_by_used(steps: ByteArray, used: NDArray[Any]) -> ByteArray:
    """Return log-likelihoods (n, 32) that contain the lower bound from the grip used (n,): in each
    bin the smaller of the reported likelihood and the likelihood of this bound.

    An estimator reports a flat likelihood when no friction explains its measurements. The grip that
    its accelerometers measured is still a lower bound. Likelihood and bound come from the same
    measurements, so they are not multiplied.
    """
    out = steps.copy()
    _bound_rows(out, np.asarray(used, np.float64), _levelled_bounds())
    return out


@cache
def _levelled_bounds() -> ByteArray:
    """Return a table of log-likelihoods for visits that give only a lower bound of friction, (m,
    32), in steps of 1/16 nat. Row k is for the grip used k·_USED_STEP, up to UTILISED_MOST. The
    part above the grip used is already flat (`level_above_used`).
    """
    used = np.arange(0.0, constants.UTILISED_MOST + 0.5 * _USED_STEP, _USED_STEP)
    return level_above_used(mugrid.encode_log_likelihood(at_least(used)), used)


@refcount_free_locked
def _bound_rows(steps: ByteArray, used: FloatArray, bounds: ByteArray) -> None:
    for n in range(len(steps)):
        if math.isnan(used[n]):
            continue
        bound = bounds[min(max(int(used[n] / _USED_STEP), 0), len(bounds) - 1)]
        least = np.uint8(255)
        for i in range(mugrid.BINS):
            steps[n, i] = max(steps[n, i], bound[i])
            least = min(least, steps[n, i])
        for i in range(mugrid.BINS):
            steps[n, i] -= least


def level_above_used(steps: ByteArray, used: NDArray[Any]) -> ByteArray:
    """Return likelihoods (n, 32) that claim no more grip than the grip used (n,) supports.

    A likelihood that is only a lower bound is made flat from the bin that contains `used` minus
    half the standard deviation of `used`, up to its last maximum from there on, or to the end if
    it falls by noise only. A hundred such bounds together then raise the lower end of the interval
    to at most .95·used + .04. A likelihood that also limits μ from above is not changed, nor is a
    row where `used` is NaN.
    """
    out = steps.copy()
    _level_rows(out, np.asarray(used, np.float64))
    return out


@refcount_free_locked
def _level_rows(steps: ByteArray, used: FloatArray) -> None:
    for n in range(len(steps)):
        if math.isnan(used[n]) or steps[n, mugrid.BINS - 1] >= constants.VALUE_DROP_STEPS:
            continue
        place = min(max(np.searchsorted(mugrid.EDGES, used[n] - _LESS) - 1, 0), mugrid.BINS - 1)
        floor = np.uint8(255)
        for i in range(place + 1):
            floor = min(floor, steps[n, i])
        least = np.uint8(255)
        for i in range(place, mugrid.BINS):
            least = min(least, steps[n, i])
        falling = steps[n, mugrid.BINS - 1] - int(least) > constants.NOISE_DROP_STEPS
        for i in range(mugrid.BINS - 1, place - 1, -1):
            falling = falling and steps[n, i] > least
            steps[n, i] = steps[n, i] - least if falling else 0
        for i in range(place):
            steps[n, i] = max(steps[n, i], floor) - floor


def states_more_grip(columns: Mapping[str, NDArray[Any]], used: NDArray[Any]) -> BoolArray:
    """Return a mask of visits (n,): True if the sender gave a likelihood that is a lower bound and
    states that the road has more grip than was `used` (n,). Its likelihood of a road with just the
    grip used is then at least .75 nat below its maximum. A plain bound with a symmetric error is at
    most ln 2 = .69 nat below, so it states nothing.

    Such a sender would probably have given a value if it had used all of the grip. A sender that
    states nothing may be unable to measure friction, so its silence means nothing.
    """
    sent = columns["log_likelihood"]
    place = np.minimum(np.searchsorted(mugrid.CENTRES, used), mugrid.BINS - 1)
    bound = columns["with_likelihood"] & (sent[:, -1] < constants.VALUE_DROP_STEPS)
    return np.asarray(
        bound & (sent[np.arange(len(sent)), place] >= 0.75 * constants.VALUE_DROP_STEPS)
    )


def at_least(used: FloatArray) -> FloatArray:
    """Return the log-likelihoods (n, 32) of lower bounds of friction: ln Φ((μ - u) / σ_u), where u
    is the grip used and σ_u its standard deviation. They are flat if u is NaN.
    """
    known_use = np.minimum(np.nan_to_num(used, nan=-np.inf), constants.UTILISED_MOST)[:, None]
    return log_distribution((mugrid.CENTRES - known_use) / std_of_used(np.maximum(known_use, 0.0)))


def std_of_used(used: NDArray[Any]) -> NDArray[Any]:
    """Return the standard deviation [1] of the grip used."""
    return np.asarray(np.hypot(constants.UTILISED_STD, constants.UTILISED_RELATIVE * used))


def interval_likelihood(mu: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Return the log-likelihoods (n, 32) of reports that consist of a median `mu` and 5 % and 95 %
    bounds `lower` and `upper`, each (n,). Each is a two-piece normal curve: below the median its
    standard deviation follows from the lower bound, above the median from the upper bound.
    """
    below = _side_std(mu - lower)[:, None]
    above = _side_std(upper - mu)[:, None]
    distance = mugrid.CENTRES - np.nan_to_num(mu)[:, None]
    return -0.5 * np.square(distance / np.where(distance < 0, below, above))


def sliding_likelihood(used: FloatArray) -> FloatArray:
    """Return the log-likelihoods (n, 32) of visits in which a slip controller intervened at the
    grip used u (n,). In simulated slides on ice, u was .67 to .92 of μ. So the 90 % interval is
    from u to u/EXCITED_SHARE, and the median is u/SHARED_SHARE; the error of u is added.
    """
    error = Z_95 * std_of_used(used)
    lower = used - error
    upper = used / EXCITED_SHARE + error
    return interval_likelihood(used / constants.SHARED_SHARE, lower, upper)


def find_slides(
    columns: Mapping[str, NDArray[Any]], with_likelihood: BoolArray, limited: BoolArray
) -> BoolArray:
    """Return a mask of visits (n,) whose slide is evidence of slippery road: a slip controller
    intervened at little grip (`limited`, see `find_limited`), and the sender gave neither a
    likelihood nor a value. Otherwise the likelihood or value already contains the slide, which must
    not count twice.
    """
    slides = limited & ~with_likelihood
    if slides.any():
        slides &= ~(columns["mu_utilised"] >= EXCITED_SHARE * columns["mu"])
    return slides


def find_limited(columns: Mapping[str, NDArray[Any]], used: NDArray[Any]) -> BoolArray:
    """Return a mask (n,): True where ABS, ESC or traction control intervened although the grip used
    was below the slippery limit.

    `used` (n,) is first raised by one standard deviation of its error. An intervention at more grip
    is not informative, because it also happens on dry road. A flag that is missing or unknown
    counts as no intervention.
    """
    active = np.zeros(len(used), np.bool_)
    for name in FLAGS:
        if name in columns:
            active |= columns[name] == 1
    return np.asarray(active & (used + std_of_used(used) < SLIPPERY_MU))


def _side_std(to_bound: FloatArray) -> FloatArray:
    std = np.nan_to_num(to_bound / Z_95, nan=constants.POSTERIOR_STD)
    # The grid cannot represent less than half a bin.
    return np.maximum(std, 0.5 * constants.BIN_WIDTH)
