"""Colours of all plots and pages, distinguishable with three kinds of colour blindness and in
greyscale. The live page, HTML reports, images and QGIS use them.

The class of a place depends on how precisely its friction is known:

- Precisely known: ice, snow, wet or good grip, with the four colours `FOUR`.
- Roughly known: rather slippery or rather not slippery, with the two colours `TWO`.
- Less known: no class, with the colour `LITTLE`.

From most to least dangerous, the order is ice, snow, rather slippery, wet, rather not slippery,
good grip. In this order, lightness rises on a light background and falls on a dark one. Therefore
ice, the most dangerous class, stands out most.

`GRIP` is a colour scale through `FOUR` at the values of `SURFACES`, in steps of equal lightness. No
colour is green, because green would promise safety.
"""

from __future__ import annotations

from typing import Final, NamedTuple

# Colours of ice, snow, wet and good grip.
FOUR: Final = ("#2f005b", "#a3195b", "#f47a3d", "#f2e63e")
TWO: Final = ("#a36f63", "#f3b49b")  # colours of "rather slippery" and "rather not slippery"
LITTLE: Final = "#b4b8bf"
GROUND: Final = "#f6f5f2"
DARK_FOUR: Final = ("#f6e0ff", "#f3b8b3", "#e05219", "#65310b")
DARK_TWO: Final = ("#e478a7", "#9d4e4d")
DARK_LITTLE: Final = "#61626e"
DARK_GROUND: Final = "#15181d"
GRIP: Final = (
    "#22003f",
    "#2f005b",
    "#50015b",
    "#6d065c",
    "#880f5b",
    "#a3195b",
    "#b43157",
    "#c44552",
    "#d4574c",
    "#e46946",
    "#f47a3d",
    "#f58e3e",
    "#f6a03e",
    "#f6b23f",
    "#f5c43f",
    "#f4d53e",
    "#f2e63e",
    "#f6ec73",
    "#f7f2a0",
)
# Friction coefficient mu of the colour scale's ends: wet ice and dry asphalt.
GRIP_RANGE: Final = (0.1, 1.0)
# Typical peak friction coefficients, as marks on the colour scale.
SURFACES: Final = {
    "ice": 0.15,
    "snow": 0.35,
    "wet": 0.6,
    "dry": 0.9,
}
HATCH: Final = "//////"  # hatching, on white, of places that were not measured
UNKNOWN: Final = "not measured: only lower bounds"


class LineStyle(NamedTuple):
    """Style of a line in all plots; `dash` is in matplotlib's notation."""

    colour: str
    dash: str = "-"


TRUTH: Final = LineStyle("#000000")
# Colour of each estimator in all plots, from Okabe and Ito (2008). Black belongs to the true value,
# so a red-brown replaces it.
ESTIMATORS: Final = {
    "aco-fckf": LineStyle("#0072b2"),
    "fckf": LineStyle("#56b4e9", "--"),
    "ckf": LineStyle("#009e73"),
    "federated-ckf": LineStyle("#e69f00"),
    "adaptive-federated-ckf": LineStyle("#f0e442", "--"),
    "compensated-wckf": LineStyle("#cc79a7"),
    "sr-ukf": LineStyle("#7e210d", "--"),
    "paper-aco-fckf": LineStyle("#d55e00"),
}
OTHER: Final = LineStyle("#777777", ":")  # style of an estimator that is not part of this project


def line_of(estimator: str) -> LineStyle:
    """Return the line style of an estimator, given by name."""
    return ESTIMATORS.get(estimator, OTHER)


def shade(value: float, low: float, high: float) -> str:
    """Return the colour of `value` on the colour scale GRIP, whose ends are the colours of the
    values `low` and `high`. The web pages use the same formula.
    """
    at = min(max((value - low) / (high - low), 0.0), 1.0) * (len(GRIP) - 1)
    k = min(int(at), len(GRIP) - 2)
    first, second = (_to_rgb(GRIP[j]) for j in (k, k + 1))
    mixed = (round(a + (b - a) * (at - k)) for a, b in zip(first, second, strict=True))
    return "#{:02x}{:02x}{:02x}".format(*mixed)


def _to_rgb(text: str) -> tuple[int, ...]:
    return tuple(int(text[k : k + 2], 16) for k in (1, 3, 5))
