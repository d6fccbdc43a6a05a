"""Tests that the colours of the map are distinguishable for every kind of colour vision and when
printed in grey.

Colour vision deficiencies are simulated as by Machado, Oliveira and Fernandes (2009) at full
severity. Distances are CIEDE2000 (Sharma, Wu and Dalal 2005).
"""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest

from edge_agent.estimators import ESTIMATORS as REGISTERED
from schemas.runtime.palette import ESTIMATORS, GRIP, GRIP_RANGE, SURFACES, TRUTH, shade
from tests.colour_vision import SIGHTS, colour_difference, to_lab

LEAST = 10.0  # CIEDE2000 difference; side by side, 2.3 is just noticeable


def test_the_difference_is_the_published_one() -> None:
    """The function `colour_difference` must return the CIEDE2000 differences that Sharma, Wu and
    Dalal (2005) publish in table 1, for the CIELAB colours of pairs 1, 13 and 21.
    """
    pairs = [
        ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
        ((50.0, 2.5, 0.0), (56.0, -27.0, -3.0), 31.9030),
        ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
    ]
    for first, second, expected in pairs:
        assert colour_difference(np.array(first), np.array(second)) == pytest.approx(
            expected, abs=1e-4
        )


@pytest.mark.parametrize("sight", SIGHTS)
def test_ice_snow_wet_and_dry_are_distinguished(sight: str) -> None:
    shades = [to_lab(shade(mu, *GRIP_RANGE), sight) for mu in SURFACES.values()]
    assert min(colour_difference(a, b) for a, b in combinations(shades, 2)) >= LEAST


@pytest.mark.parametrize("sight", SIGHTS)
def test_all_friction_colours_differ_from_white(sight: str) -> None:
    white = to_lab("#ffffff", sight)
    assert (
        min(
            colour_difference(to_lab(shade(mu, *GRIP_RANGE), sight), white)
            for mu in SURFACES.values()
        )
        >= LEAST
    )


def test_colour_scale_lightness_increases_monotonically() -> None:
    light = [float(to_lab(stop)[0]) for stop in GRIP]
    assert all(b > a + 2.0 for a, b in pairwise(light))
    surfaces = [float(to_lab(shade(mu, *GRIP_RANGE))[0]) for mu in SURFACES.values()]
    assert all(b > a + LEAST for a, b in pairwise(surfaces))


@pytest.mark.parametrize("sight", SIGHTS)
def test_lines_of_the_estimators_can_be_distinguished(sight: str) -> None:
    assert set(ESTIMATORS) == set(REGISTERED)
    for (first, a), (second, b) in combinations([*ESTIMATORS.items(), ("truth", TRUTH)], 2):
        assert colour_difference(to_lab(a.colour, sight), to_lab(b.colour, sight)) >= LEAST, (
            first,
            second,
        )


def test_the_old_scale_fails() -> None:
    """The former palette (red to green) must fail the check of distances: to deuteranopes its
    colours for dry road and snow look the same olive.
    """
    snow = to_lab("#b8831b", "deuteranopia")
    dry = to_lab("#1bb83e", "deuteranopia")
    assert colour_difference(snow, dry) < LEAST
