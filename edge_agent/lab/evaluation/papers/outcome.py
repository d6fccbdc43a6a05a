"""Records of a paper's reproduction: table rows, plot curves, and all other parts of a report."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple

from edge_agent.estimators.elements import Element
from schemas.numeric import FloatArray
from schemas.runtime.figures import Figure

COLUMNS: Final = ("printed", "matched", "own plant", "realistic sensors", "default estimator")
NONE: Final = math.nan  # value of a cell that does not exist
Values = dict[str, float]  # measure -> value


class PaperRow(NamedTuple):
    """One number of a paper's table, and our corresponding numbers for comparison.

    Attributes:
        name: name of the result, to which the prefix `papers.NUMBER.` is added.
        what: the number in words, with its unit in brackets.
        printed: the printed number, or NaN if the paper prints none.
        matched: result of the paper's filter under the paper's conditions.
        own: result of the paper's filter on drives simulated with the simulator's own vehicle
            model.
        realistic: result of the paper's estimator with ordinary sensors and a vehicle file with
            errors of a few per cent.
        default: result of the default estimator on the drives of `realistic`.
        bar: target for `matched`. None: the printed number is the target, if there is one. NaN:
            there is no target.
        better: "less" or "more": the side of the target on which `matched` must lie.
        shown: text that replaces the printed number in the report, for example "about 3"; "" if
            none.
    """

    name: str
    what: str
    printed: float
    matched: float
    own: float = NONE
    realistic: float = NONE
    default: float = NONE
    bar: float | None = None
    better: Literal["less", "more"] = "less"
    shown: str = ""

    @property
    def limit(self) -> float | None:
        """Return the target for our result under the paper's conditions (`matched`); None if there
        is no target.
        """
        bar = self.printed if self.bar is None else self.bar
        return None if math.isnan(bar) else bar

    @property
    def unit(self) -> str:
        """Return the unit of the numbers in this row of a paper's table."""
        _, _, unit = self.what.rpartition("[")
        return unit.removesuffix("]") if "[" in self.what else "1"

    @property
    def holds(self) -> bool:
        """Return True if our result under the paper's conditions (`matched`) meets the target
        (`limit`), or if there is no target.
        """
        return self.limit is None or self.figure("papers").holds

    def figure(self, prefix: str) -> Figure:
        """Return our result under the paper's conditions (`matched`), with its target, as a
        `Figure`. The name of the figure is `prefix`, a dot, and the name of this row.
        """
        return Figure(f"{prefix}.{self.name}", self.matched, self.unit, self.limit, self.better)


class Curve(NamedTuple):
    """One curve in a panel of a plot: its name, points (x, y), and its kind, which determines its
    colour.
    """

    name: str
    x: FloatArray
    y: FloatArray
    kind: str = ""  # "truth", "improved", "comparator" or "": determines the colour


class PlotPanel(NamedTuple):
    """One panel of a reproduction's plot: a pair of axes with its curves."""

    title: str
    x: str
    y: str
    curves: tuple[Curve, ...]
    limits: tuple[float, float] | None = None  # range of the y axis
    log: bool = False  # True for a logarithmic y axis


class Heat(NamedTuple):
    """One panel of a reproduction's plot: a matrix of numbers, shown as a colour map."""

    title: str
    x: str
    y: str
    values: FloatArray  # (rows, columns)
    ticks: tuple[str, ...]  # labels of the rows
    label: str


class PaperPlot(NamedTuple):
    """One plot of a reproduction: panels arranged in a grid."""

    name: str
    title: str
    panels: tuple[PlotPanel | Heat, ...]
    columns: int = 1


@dataclass(frozen=True)
class PaperTable:
    """One table of a reproduction's report."""

    title: str
    rows: tuple[PaperRow, ...]


@dataclass
class Reproduction:
    """All results of the reproduction of one paper: tables, plots, and further figures (named
    numbers).
    """

    paper: str
    title: str
    elements: tuple[Element, ...]
    tables: list[PaperTable] = field(default_factory=list)
    # figures in addition to those of the tables
    figures: list[Figure] = field(default_factory=list)
    plots: list[PaperPlot] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def rows(self) -> list[PaperRow]:
        """Return the rows of all tables of the paper's reproduction."""
        return [row for table in self.tables for row in table.rows]

    @property
    def missed_rows(self) -> list[str]:
        """Return the names of the rows whose number under the paper's conditions (`matched`) misses
        its target.
        """
        return [row.name for row in self.rows if not row.holds]

    def all_figures(self) -> list[Figure]:
        """Return all figures of the reproduction: those of its tables first, then the additional
        ones.
        """
        listed = []
        for row in self.rows:
            listed.append(row.figure(f"papers.{self.paper}"))
            for column, value in (
                ("own", row.own),
                ("realistic", row.realistic),
                ("default", row.default),
            ):
                if not math.isnan(value):
                    listed.append(
                        Figure(f"papers.{self.paper}.{column}.{row.name}", value, row.unit)
                    )
        return listed + self.figures
