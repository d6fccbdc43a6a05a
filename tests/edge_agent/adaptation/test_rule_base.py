"""Tests of the fuzzy rules. The membership (degree to which a value belongs to a fuzzy set) must
rise between foot and peak of the set. Each rule must have the effect that its table states.
"""

import math

import numpy as np
import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.adaptation.rule_base import evidence_share, is_high, plain_rules, rule_base

RULES = rule_base(Memberships())


def test_membership_is_none_at_the_foot_full_at_the_peak_and_even_between() -> None:
    ramp = np.array([1.0, 3.0])
    assert [is_high(value, ramp) for value in (-9.0, 1.0, 1.5, 2.0, 3.0, 9.0)] == [
        0.0,
        0.0,
        0.25,
        0.5,
        1.0,
        1.0,
    ]


def test_plain_rules_give_the_product_of_ramps_whatever_slides_or_strains() -> None:
    plain = plain_rules(steady=0.15)
    share = (0.15 + 0.85 * 0.5) / (1.0 + (0.13 / 0.2) ** 4)
    for slides, strain in ((0.0, 1.0), (1.0, 9.0)):
        asked = evidence_share(plain, slides, 0.2, 0.5, strain)
        assert asked == pytest.approx(math.log(share))
    assert evidence_share(RULES, 1.0, 0.2, 0.5, 9.0) != evidence_share(RULES, 0.0, 0.2, 0.5, 1.0)
