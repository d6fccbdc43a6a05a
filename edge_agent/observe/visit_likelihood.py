"""Likelihood of friction that an observation reports: the estimator's likelihood of the visit
(passage of a map cell), weighed by how often visits give a value. Pure (no I/O).

A visit gives a *value* of μ if its likelihood falls towards the highest friction, and otherwise
only a lower bound. Giving a value, or none, is evidence about the share u/μ of the road's grip that
the vehicle used (`schemas.excitation`), which the estimator's likelihood ℓ does not contain.
Without it, values of gentle drivers, most of them wrong, count as much as those of drivers at the
limit. The report's probability given the friction is therefore

    ln p(report | μ) = ℓ(μ) + ln clip(u/μ, EXCITED_SHARE, 1)     for a value
                       ℓ(μ) + ln(1 - P(value | u/μ))             for a bound

A visit in which the friction changed keeps ℓ, because its parts used different shares, and so does
a likelihood that excludes nothing. The factor of a value changes the ratio of two frictions by at
most 1/EXCITED_SHARE, much less than the measured shares, because visits to one place share their
errors.

Legend
    ℓ   log-likelihood of the estimator, at the friction values `mugrid.CENTRES`   (n, 32) [nat]
    u   grip used                                                                  (n,)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from schemas import mugrid
from schemas.excitation import value_probability
from schemas.numeric import FloatArray
from schemas.runtime.records import RecordArray
from schemas.thresholds import EXCITED_SHARE, VALUE_NATS


def encode_likelihoods(
    ended: RecordArray, evidence: FloatArray | None, used: FloatArray
) -> NDArray[np.uint8]:
    """Return the likelihoods of n visits in the encoding of the message, (n, 32); (n, 0) for an
    estimator without `evidence` (likelihood of friction). `used` (n,) is the grip used in each
    visit.

    The likelihood is flat for a visit that the estimator did not process from its start.

    If the friction changed within the cell, the cell contains road with different frictions, but
    the message has only one likelihood per visit. Therefore a friction gets the largest of the
    likelihoods from before and after each change. A friction that either part supports stays
    likely.
    """
    if evidence is None:
        return np.zeros((len(ended), 0), dtype=np.uint8)
    reported = evidence[ended["sample"], ended["vehicle"]]
    several = ended["parts"] > 0
    reported[several] = np.maximum(reported[several], ended["earlier"][several])
    known = np.isfinite(reported).all(axis=-1, keepdims=True)
    reported = np.where(known, reported, 0.0)
    return mugrid.encode_log_likelihood(weigh_by_use(reported, np.where(several, np.nan, used)))


def weigh_by_use(log_likelihood: FloatArray, used: FloatArray) -> FloatArray:
    """Return log-likelihoods (n, 32) [nat] that contain the evidence of giving a value, or none, at
    the grip `used` (n,), see the module. A visit whose grip used is unknown (NaN) does not change.
    """
    most = log_likelihood.max(axis=1, initial=-np.inf)
    value = log_likelihood[:, -1] <= most - VALUE_NATS
    bound = ~value & (log_likelihood.min(axis=1, initial=np.inf) <= most - VALUE_NATS)
    share = used[:, None] / mugrid.CENTRES
    added = np.select(
        [value[:, None], bound[:, None]],
        [np.log(np.clip(share, EXCITED_SHARE, 1.0)), np.log(1.0 - value_probability(share))],
    )
    return log_likelihood + np.where(np.isfinite(used)[:, None], added, 0.0)
