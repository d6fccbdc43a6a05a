"""Tests of the colours of the live page: they are distinguishable for every kind of colour vision,
and none of them is green, which users would read as certain grip.
"""

from __future__ import annotations

import colorsys
from itertools import combinations, pairwise

import pytest

from fleet_service.page.colours import EDGES
from schemas.runtime.palette import (
    DARK_FOUR,
    DARK_GROUND,
    DARK_LITTLE,
    DARK_TWO,
    FOUR,
    GROUND,
    LITTLE,
    TWO,
)
from tests.colour_vision import SIGHTS, colour_difference, to_lab
from tests.fleet_service.page.cell_colours import colour_of
from tests.fleet_service.page.contrast import THEMES, class_contrasts, text_contrasts

LEAST = 10.0
STEP = 5.0  # least difference in lightness between neighbouring classes of danger
ALL = (*FOUR, *TWO, LITTLE, GROUND)
DARK = (*DARK_FOUR, *DARK_TWO, DARK_LITTLE, DARK_GROUND)


def in_danger(four: tuple[str, ...], two: tuple[str, ...]) -> tuple[str, ...]:
    """Return six colours in order of danger: ice, snow, rather slippery, wet, rather not slippery,
    good grip. The colours of the two "rather" classes are those of `two`; the other colours are
    those of `four`.
    """
    return (four[0], four[1], two[0], four[2], two[1], four[3])


@pytest.mark.parametrize("sight", SIGHTS)
@pytest.mark.parametrize("palette", [ALL, DARK], ids=["light", "dark"])
def test_any_two_colours_and_the_background_can_be_distinguished(
    sight: str, palette: tuple[str, ...]
) -> None:
    assert len(set(palette)) == 8
    assert (
        min(
            colour_difference(to_lab(a, sight), to_lab(b, sight))
            for a, b in combinations(palette, 2)
        )
        >= LEAST
    )


@pytest.mark.parametrize("sight", SIGHTS)
def test_lightness_is_the_order_of_danger(sight: str) -> None:
    """The colour of the most dangerous class must be the darkest on a light background and the
    lightest on a dark background. The order of lightness must be the order of danger, so that it
    remains in a grey print.
    """
    for ladder, sign in ((in_danger(FOUR, TWO), 1.0), (in_danger(DARK_FOUR, DARK_TWO), -1.0)):
        light = [sign * float(to_lab(colour, sight)[0]) for colour in ladder]
        assert min(b - a for a, b in pairwise(light)) >= STEP


def test_known_slippery_is_never_grey() -> None:
    assert colour_of(0.35, 0.05, 1.1, 0.51) == TWO[0]
    assert colour_of(0.35, 0.05, 1.1, 0.5) == LITTLE


def test_no_colour_of_the_map_is_green() -> None:
    for colour in (*ALL, *DARK):
        red, green, blue = (int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5))
        hue, saturation, _ = colorsys.rgb_to_hsv(red, green, blue)
        assert saturation < 0.05 or not 75 < 360 * hue < 170, colour


def test_the_less_is_known_the_fewer_colours() -> None:
    mus = [0.05 + 0.01 * k for k in range(100)]
    for half, classes in ((0.1, 4), (0.2, 2), (0.4, 1)):
        found = {
            colour_of(mu, mu - half, mu + half)
            for mu in mus
            if half == 0.1 or mu + half >= EDGES[1]
        }
        assert len(found) == classes
    assert {colour_of(mu, 0.05, 1.1) for mu in mus} == {LITTLE}


def test_cell_with_a_slippery_upper_end_keeps_its_colour() -> None:
    assert colour_of(0.15, 0.05, 0.39) == FOUR[0]
    assert colour_of(0.3, 0.05, 0.39) == FOUR[1]


@pytest.mark.parametrize("sight", SIGHTS)
@pytest.mark.parametrize("theme", THEMES)
def test_text_and_map_classes_have_the_contrast_of_wcag_aa(sight: str, theme: str) -> None:
    """Text must have a contrast of 4.5 : 1 (WCAG 1.4.3). Fill or edge of a map class must have 3 :
    1 against the background (1.4.11).
    """
    assert min(text_contrasts(theme, sight).values()) >= 4.5
    assert min(class_contrasts(theme, sight).values()) >= 3.0
