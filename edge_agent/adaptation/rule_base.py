"""Fuzzy rules of the default estimator. They adapt two quantities: the measurement noise R of the
axles, and the share of the evidence on friction that is used.

| if | then | kind |
|---|---|---|
| mismatch of the axles is in one of five sets | ln R changes by the set's step | Sugeno |
| slide, demand, novelty, strain are in certain sets | evidence share changes | Takagi–Sugeno |

Sugeno: the result is the consequent (output) of a rule times its membership (degree, 0 to 1).
Takagi–Sugeno: each combination of the four inputs' sets has a value of ln(evidence share). The
result is the mean of these values, weighted by membership. The first row is implemented in
`fuzzy.py`. The other sets are ramps from a foot (membership 0) to a peak (membership 1);
`Memberships` contains feet, peaks and consequents.

Mismatch is actual over theoretical innovation variance, minus 1. Demand is the force over load of
an axle. Novelty is the degree to which forces or slips differ from their recent averages. Strain is
the deviation of the estimated states of car and sensors from their prior. The rules are evaluated
once per block (0.05 s of samples), after the block has ended. Therefore no rule changes its own
input within a block.

`plain_rules` is the baseline without fuzzy sets: the formula of `plain_share` replaces the second
row. The evaluation divides the score with fuzzy rules by the score of this baseline; the ratio is
the figure `fuzzy.worth`.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from edge_agent.adaptation.memberships import LEAST_SHARE, Memberships
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

DEMAND_PEAKS = (0.06, 0.13, 0.3)  # [1] peaks of the sets low, middle and high of force over load
# [1] foot and peak of the set of strained cars, in chi-square over degrees of freedom
STRAINED = (1.0, 2.5)


class RuleBase(NamedTuple):
    """Consequents (outputs) of the rules that determine the share of the evidence on friction that
    the filter uses [nat]. If `by_sets` is False, the formula of `plain_share` replaces these rules.
    """

    shares: Annotated[FloatArray, 12]
    strained: Annotated[FloatArray, 2]
    by_sets: bool  # True if the fuzzy rules give the share of evidence, False for `plain_share`
    steady: float  # [1] factor of `plain_share` while forces and slips equal their recent averages


def rule_base(memberships: Memberships) -> RuleBase:
    """Return the fuzzy rules with the consequents (outputs) given in `memberships`."""
    return RuleBase(
        np.array(memberships.shares),
        np.array(memberships.strained),
        by_sets=True,
        steady=0.0,
    )


def plain_rules(steady: float) -> RuleBase:
    """Return a rule base without fuzzy sets, as a baseline. The formula of `plain_share` then gives
    the share of the evidence on friction that the filter uses.

    Args:
        steady: factor on the share while forces and slips equal their recent averages [1].
    """
    return rule_base(Memberships())._replace(by_sets=False, steady=steady)


@compiled
def is_high(value: float, ramp: FloatArray | tuple[float, float]) -> float:
    """Return the membership (degree, 0 to 1) of `value` in a fuzzy set that rises from 0 at ramp[0]
    to 1 at ramp[1].
    """
    return float(min(max((value - ramp[0]) / (ramp[1] - ramp[0]), 0.0), 1.0))


@compiled
def demand_weight(demand: float) -> float:
    """Return the weight, 0 to 1, of evidence that grows with the fourth power of force over load,
    `demand` [1]. It is one half at the peak of the middle set of demand.
    """
    used = demand**4
    return float(used / (used + DEMAND_PEAKS[1] ** 4))


@compiled
def plain_share(steady: float, demand: float, new: float) -> float:
    """Return ln of the share of the evidence on friction from a block (0.05 s) that is used if
    there are no fuzzy rules. `demand` is force over load of an axle [1], `new` the degree (0 to 1)
    to which forces or slips differ from their recent averages.

    The share is (steady + (1 - steady)*new)*demand_weight(demand).
    """
    share = (steady + (1.0 - steady) * new) * demand_weight(demand)
    return math.log(max(share, math.exp(LEAST_SHARE)))


@compiled
def evidence_share(
    rules: RuleBase, slides: float, demand: float, new: float, strain: float
) -> float:
    """Return ln of the share of the evidence on friction from a block (0.05 s) that the filter
    uses, at most 0.

    Zero-order Takagi-Sugeno rules with product inference; the memberships of each input sum to one.

    Args:
        rules: the consequents, `shares` (12,) and `strained` (2,) [nat].
        slides: fuzzy degree of "a wheel slides", 0 to 1.
        demand: the larger force over load of the two axles [1].
        new: fuzzy degree of "forces or slips differ from their recent averages", 0 to 1.
        strain: deviation of the estimated states of car and sensors from their prior, as chi-square
            over degrees of freedom [1].
    """
    if not rules.by_sets:
        return plain_share(rules.steady, demand, new)
    rise = is_high(demand, DEMAND_PEAKS[:2])
    top = is_high(demand, DEMAND_PEAKS[1:])
    low = 1.0 - rise
    middle = rise - top
    tense = is_high(strain, STRAINED)
    total = 0.0
    for sliding in range(2):
        of_slide = slides if sliding == 1 else 1.0 - slides
        total += of_slide * tense * rules.strained[sliding]
        for fresh in range(2):
            of_force = new if fresh == 1 else 1.0 - new
            first = 6 * sliding + fresh
            demand_share = (
                low * rules.shares[first]
                + middle * rules.shares[first + 2]
                + top * rules.shares[first + 4]
            )
            total += of_slide * of_force * demand_share
    return min(total, 0.0)
