"""Probability that a visit (passage of a map cell) gives a friction value. Pure.

Whether a visit gives a *value* of μ, or only a lower bound, depends on the share u/μ of the grip
that the vehicle used. In ten simulated drives with the default estimator (20 cars, half of them
with the sensor errors of real cars; 296,000 visits to cells of one surface), the share of visits
with a value was:

    share of the grip used   < .5   .5–.6   .6–.7   .7–.8   .8–.9   .9–.95   > .95
    visits with a value      .003   .025    .045    .09     .27     .55      .83
    `value_probability`      0      0       0       0       .25     .62      .87

So a value is itself evidence that the vehicle used almost all of the grip, and a visit without a
value is evidence that it did not.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from schemas.numeric import FloatArray
from schemas.thresholds import VALUE_NATS

_FROM: Final = 0.8
# largest probability of a value: no value is evidence of three nats at most
_MOST: Final = 1.0 - math.exp(-3.0 * VALUE_NATS)


def value_probability(share: FloatArray) -> FloatArray:
    """Return the probability that a visit gives a friction value, for each share of the road's grip
    that the vehicle used.
    """
    return np.clip((share - _FROM) / (1.0 - _FROM), 0.0, _MOST)
