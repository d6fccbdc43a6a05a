"""Colours of the live page: told apart by every kind of sight, and never a promise."""

from __future__ import annotations

import colorsys
from itertools import combinations

import pytest

from fleet_service.page.colours import EDGES, FOUR, GROUND, LITTLE, TWO, colour_of
from tests.sight import SIGHTS, difference, lab

LEAST = 10.0
ALL = (*FOUR, *TWO, LITTLE, GROUND)


@pytest.mark.parametrize("sight", SIGHTS)
def test_any_two_classes_and_the_ground_are_told_apart(sight: str) -> None:
    assert len(set(ALL)) == 8
    assert min(difference(lab(a, sight), lab(b, sight)) for a, b in combinations(ALL, 2)) >= LEAST


def test_nothing_is_green() -> None:
    for colour in ALL:
        red, green, blue = (int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5))
        hue, saturation, _ = colorsys.rgb_to_hsv(red, green, blue)
        assert saturation < 0.05 or not 75 < 360 * hue < 170, colour


def test_darker_is_more_slippery_on_grey_paper_too() -> None:
    four, two = ([float(lab(colour)[0]) for colour in some] for some in (FOUR, TWO))
    assert four == sorted(four)
    assert two == sorted(two)


def test_the_less_is_known_the_fewer_colours() -> None:
    mus = [0.05 + 0.01 * k for k in range(100)]
    for half, classes in ((0.1, 4), (0.2, 2), (0.4, 1)):
        found = {colour_of(mu, mu - half, mu + half) for mu in mus if half == 0.1 or mu + half >= EDGES[1]}
        assert len(found) == classes
    assert {colour_of(mu, 0.05, 1.1) for mu in mus} == {LITTLE}


def test_what_is_slippery_at_its_upper_end_keeps_its_colour() -> None:
    assert colour_of(0.15, 0.05, 0.39) == FOUR[0]
    assert colour_of(0.3, 0.05, 0.39) == FOUR[1]
