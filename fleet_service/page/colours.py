"""Colours of cells: fewer colours for less certain cells, and none for a mere bound.

Value-suppressing palette (Correll, Moritz and Heer, CHI 2018): four classes of mu if its interval is narrow, two if it
is middling, one grey if it is wide. A cell that is slippery even at the upper end keeps its colour, however wide. Dark
is slippery on light ground. Nothing is green, because a safe colour would be a promise.
`tests/fleet_service/page/test_colours.py` computes the distances for four kinds of sight.
"""

from __future__ import annotations

from typing import Any, Final

from schemas.thresholds import SLIPPERY_MU

NARROW: Final = 0.25  # width of the interval below which four classes are told apart: half of it is less than a class
MIDDLING: Final = 0.6  # ... two
EDGES: Final = (0.2, SLIPPERY_MU, 0.6)  # ice | snow | wet | dry (Pacejka 2012, ch. 1)
FOUR: Final = ("#4c007b", "#aa5271", "#f58c41", "#eeea79")
TWO: Final = ("#663144", "#e7bb9c")
LITTLE: Final = "#c4c3c3"
GROUND: Final = "#ffffff"  # nobody was there
ALERT: Final = "#c4003a"


def colour_of(mu: float, lower: float, upper: float) -> str:
    """Return the colour of a measured mu with its 5 % and 95 % quantiles."""
    width = round(upper - lower, 6)  # a step of the records is .005
    if upper < SLIPPERY_MU or width < NARROW:
        return FOUR[sum(mu >= edge for edge in EDGES)]
    if width < MIDDLING:
        return TWO[int(mu >= SLIPPERY_MU)]
    return LITTLE


def as_json() -> dict[str, Any]:
    """Return the palette for the page."""
    return {
        "narrow": NARROW, "middling": MIDDLING, "edges": EDGES, "slippery": SLIPPERY_MU, "four": FOUR, "two": TWO,
        "little": LITTLE, "ground": GROUND, "alert": ALERT,
    }  # fmt: skip
