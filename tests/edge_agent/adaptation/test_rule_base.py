"""The rules: memberships rise between foot and peak, and each rule does what its line in the table says."""

import math
from dataclasses import replace

import numpy as np
import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.adaptation.rule_base import WIDE, contradiction, distrust, hurry, is_high, rule_base, wide_noise

UNTUNED = rule_base(Memberships())
TUNED = rule_base(replace(Memberships(), consequents=(1.0, 0.3)))


def test_membership_is_none_at_the_foot_full_at_the_peak_and_even_between() -> None:
    ramp = np.array([1.0, 3.0])
    assert [is_high(value, ramp) for value in (-9.0, 1.0, 1.5, 2.0, 3.0, 9.0)] == [0.0, 0.0, 0.25, 0.5, 1.0, 1.0]


def test_either_sign_alone_contradicts_and_none_does_not() -> None:
    (least, far), (believed, stretched) = UNTUNED.far, UNTUNED.stretched
    assert contradiction(UNTUNED, least, believed) == 0.0
    assert contradiction(UNTUNED, far, 0.0) == contradiction(UNTUNED, 0.0, stretched) == 1.0
    assert contradiction(UNTUNED, 0.5 * (least + far), 0.0) == pytest.approx(0.5)


def test_distrust_is_of_what_lasts() -> None:
    begins, whole = UNTUNED.lately
    assert distrust(UNTUNED, begins) == 0.0
    assert distrust(UNTUNED, whole) == 1.0


def test_offsets_hurry_where_the_wheels_are_far_and_untuned_ones_never() -> None:
    assert hurry(TUNED, TUNED.far[1]) == 0.3
    assert hurry(TUNED, TUNED.far[0]) == 0.0
    assert hurry(UNTUNED, 100.0) == 0.0


def test_noise_grows_with_the_angle_of_steering_either_way() -> None:
    assert wide_noise(TUNED, 0.5 * WIDE[0]) == wide_noise(UNTUNED, 1.0) == 1.0
    assert wide_noise(TUNED, -WIDE[1]) == wide_noise(TUNED, WIDE[1]) == pytest.approx(math.e)
