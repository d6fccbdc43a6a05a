"""Likelihood of friction that an observation reports: the estimator's likelihood of the visit
(passage of a map cell), weighed by how often visits give a value. Pure (no I/O).

A visit gives a *value* of μ if its likelihood falls towards the highest friction, and otherwise
only a lower bound. Whether it gives a value depends on the share u/μ of the road's grip that the
vehicle used. In ten simulated drives with the default estimator (20 cars, half of them with the
sensor errors of real cars; 296,000 visits to cells of one surface), the share of visits with a
value was:

    share of the grip used   < .5   .5–.6   .6–.7   .7–.8   .8–.9   .9–.95   > .95
    visits with a value      .003   .025    .045    .09     .27     .55      .83

So a value is itself evidence that the vehicle used almost all of the grip, and a visit without a
value is evidence that it did not. The estimator's likelihood ℓ contains neither. Without them,
values of gentle drivers, most of them wrong, count as much as those of drivers at the limit. The
report's probability given the friction is therefore

    ln p(report | μ) = ℓ(μ) + ln clip(u/μ, EXCITED_SHARE, 1)              for a value
                       ℓ(μ) + ln(1 - LIMIT_TOLD·P(μ))                     for a bound
    P(μ) = clip((u/μ - EXCITED_SHARE)/(1 - EXCITED_SHARE), 0, 1)³

P fits the table. A visit in which the friction changed keeps ℓ, because its parts used different
shares, and so does a likelihood that excludes nothing. The factor of a value changes the ratio of
two frictions by 1/EXCITED_SHARE at most, much less than the table shows, because visits to one
place share their errors.

Legend
    ℓ   log-likelihood of the estimator, at the friction values `mugrid.CENTRES`   (n, 32) [nat]
    u   grip used                                                                  (n,)
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas import mugrid
from schemas.numeric import FloatArray
from schemas.runtime.records import RecordArray
from schemas.thresholds import EXCITED_SHARE, VALUE_NATS

# share of the visits at the limit of the road's grip that are taken to give a value: two nats, .86
LIMIT_TOLD: Final = 1.0 - math.exp(-2.0 * VALUE_NATS)


def encode_likelihoods(
    ended: RecordArray, evidence: FloatArray | None, used: FloatArray
) -> NDArray[np.uint8]:
    """Return the likelihoods of n visits (passages of a map cell) in the encoding of the message,
    (n, 32); (n, 0) for an estimator without `evidence` (likelihood of friction). `used` (n,) is the
    grip used in each visit.

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
    share = np.clip(used[:, None] / mugrid.CENTRES, EXCITED_SHARE, 1.0)
    probability = ((share - EXCITED_SHARE) / (1.0 - EXCITED_SHARE)) ** 3
    added = np.select(
        [value[:, None], bound[:, None]], [np.log(share), np.log(1.0 - LIMIT_TOLD * probability)]
    )
    return log_likelihood + np.where(np.isfinite(used)[:, None], added, 0.0)
