"""Colours in which the live page must draw cells. They are computed a second time here, so that
tests can compare them with the page.
"""

from __future__ import annotations

from fleet_service.page.colours import EDGES, KNOWN_SLIPPERY, MIDDLING, NARROW
from schemas.runtime.palette import FOUR, LITTLE, TWO
from schemas.thresholds import SLIPPERY_MU


def colour_of(mu: float, lower: float, upper: float, p_slippery: float = 0.0) -> str:
    """Return the colour of a cell with a measured friction `mu`, the 5 % and 95 % quantiles `lower`
    and `upper` of its friction, and its probability of being slippery.
    """
    width = round(upper - lower, 6)  # the grid of the records has steps of .005
    if upper < SLIPPERY_MU or width < NARROW:
        return FOUR[sum(mu >= edge for edge in EDGES)]
    if p_slippery > KNOWN_SLIPPERY:
        return TWO[0]
    if width < MIDDLING:
        return TWO[int(mu >= SLIPPERY_MU)]
    return LITTLE
