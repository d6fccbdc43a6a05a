"""Colours of cells. Less certain cells have fewer possible colours, and a cell with only a lower
bound has none (it is hollow).

Value-suppressing palette (Correll, Moritz and Heer, CHI 2018): four classes of mu if its interval
is narrow, two classes if it is of medium width, one grey if it is wide. There are two exceptions. A
cell that is slippery even at the upper end of its interval keeps its colour, however wide the
interval is. A cell that is more likely slippery than not is never grey or hollow. The colours are
those of `schemas.runtime.palette`.
"""

from __future__ import annotations

from typing import Any, Final

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
from schemas.thresholds import SLIPPERY_MU

# Largest width of an interval for which a place is shown as ice, snow, wet or dry. Half of this
# width is less than the width of a class.
NARROW: Final = 0.25
MIDDLING: Final = 0.6  # largest width for which it is shown as one of two classes
EDGES: Final = (0.2, SLIPPERY_MU, 0.6)  # μ between ice, snow, wet and dry (Pacejka 2012, ch. 1)
KNOWN_SLIPPERY: Final = 0.5  # P(μ < SLIPPERY_MU) above which a place is never shown as unknown
ALERT: Final = "#c4003a"
DARK_ALERT: Final = "#ff6b86"


def as_json() -> dict[str, Any]:
    """Return the palette of map colours for the page as JSON, for light and for dark
    backgrounds.
    """
    light = {"four": FOUR, "two": TWO, "little": LITTLE, "ground": GROUND, "alert": ALERT}
    dark = {
        "four": DARK_FOUR,
        "two": DARK_TWO,
        "little": DARK_LITTLE,
        "ground": DARK_GROUND,
        "alert": DARK_ALERT,
    }
    return {
        "narrow": NARROW,
        "middling": MIDDLING,
        "edges": EDGES,
        "slippery": SLIPPERY_MU,
        "known": KNOWN_SLIPPERY,
        "light": light,
        "dark": dark,
    }
