"""The rules: memberships rise between foot and peak, and each rule does what its line in the
table says.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.adaptation.rule_base import WIDE, hurry, is_high, rule_base, wide_noise

IDLE = rule_base(replace(Memberships(), consequents=(0.0, 0.0)))
TUNED = rule_base(replace(Memberships(), consequents=(1.0, 0.3)))


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


def test_offsets_hurry_where_the_wheels_are_far_and_not_where_nothing_is_asked_for() -> None:
    assert hurry(TUNED, TUNED.far[1]) == 0.3
    assert hurry(TUNED, TUNED.far[0]) == 0.0
    assert hurry(IDLE, 100.0) == 0.0


def test_noise_grows_with_the_angle_of_steering_either_way() -> None:
    assert wide_noise(TUNED, 0.5 * WIDE[0]) == wide_noise(IDLE, 1.0) == 1.0
    assert wide_noise(TUNED, -WIDE[1]) == wide_noise(TUNED, WIDE[1]) == pytest.approx(math.e)
