"""Colours of all plots and pages, distinguishable with three kinds of colour blindness and in greyscale.

`GRIP` is viridis (van der Walt and Smith 2015). Its lightness increases monotonically, so darker is more slippery in
print too. Unmeasured areas have no colour: they are white and hatched. `tests/test_palette.py` computes the distances.
"""

from __future__ import annotations

from typing import Final, NamedTuple

GRIP: Final = (
    "#440154", "#481f70", "#443983", "#3b528b", "#31688e", "#287c8e", "#21918c", "#20a486", "#35b779", "#5ec962",
    "#90d743", "#c8e020", "#fde725",
)  # fmt: skip
GRIP_RANGE: Final = (0.1, 1.0)  # of mu: from wet ice to dry asphalt
SURFACES: Final = {"ice": 0.15, "snow": 0.35, "wet": 0.6, "dry": 0.9}  # peak adhesion that a reader knows them by
HATCH: Final = "//////"  # of what was not measured, on white
UNKNOWN: Final = "not measured: only lower bounds"


class LineStyle(NamedTuple):
    """Style of a line in all plots; `dash` in matplotlib's notation."""

    colour: str
    dash: str = "-"


TRUTH: Final = LineStyle("#000000")
# One colour an estimator, in every plot: Okabe and Ito (2008), with a red brown for black, which is the truth's.
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
OTHER: Final = LineStyle("#777777", ":")  # an estimator from outside


def line_of(estimator: str) -> LineStyle:
    """Return the line style of an estimator by name."""
    return ESTIMATORS.get(estimator, OTHER)


def shade(value: float, low: float, high: float) -> str:
    """Return the colour of a value on GRIP between `low` and `high`; the pages compute the same."""
    at = min(max((value - low) / (high - low), 0.0), 1.0) * (len(GRIP) - 1)
    k = min(int(at), len(GRIP) - 2)
    first, second = (_rgb(GRIP[j]) for j in (k, k + 1))
    mixed = (round(a + (b - a) * (at - k)) for a, b in zip(first, second, strict=True))
    return "#{:02x}{:02x}{:02x}".format(*mixed)


def _rgb(text: str) -> tuple[int, ...]:
    return tuple(int(text[k : k + 2], 16) for k in (1, 3, 5))
