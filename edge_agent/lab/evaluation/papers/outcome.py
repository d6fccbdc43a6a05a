"""Records of a paper's reproduction: table rows, curves of plots, and everything that a report
needs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple

from edge_agent.estimators.elements import Element
from schemas.numeric import FloatArray
from schemas.runtime.figures import Figure

COLUMNS: Final = ("printed", "matched", "own plant", "realistic sensors", "default estimator")
NONE: Final = math.nan  # a cell that does not exist
Values = dict[str, float]  # measure -> value
Table = dict[str, Values]  # column -> measures


class PaperRow(NamedTuple):
    """One number of a paper's table, next to ours.

    Attributes:
        name: of the figure, below `papers.NUMBER.`.
        what: the number in words, with its unit in brackets.
        printed: the printed number, or NaN where the paper prints none.
        matched: the paper's filter under the paper's conditions.
        own: the same filter on the simulator's own plant.
        realistic: the paper's estimator with ordinary sensors, a vehicle known to a few per cent.
        default: the default estimator on the same drives.
        bar: limit of `matched`; the printed number where it is None and one is printed; NaN for no
        bar.
        better: side of the bar.
        shown: printed number as text, where it is more than a number.
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
        """The bar of the matched figure; None if it is only shown."""
        bar = self.printed if self.bar is None else self.bar
        return None if math.isnan(bar) else bar

    @property
    def unit(self) -> str:
        """Unit of the row."""
        _, _, unit = self.what.rpartition("[")
        return unit.removesuffix("]") if "[" in self.what else "1"

    @property
    def holds(self) -> bool:
        """True if the matched number keeps its bar, or has none."""
        return self.limit is None or self.figure("papers").holds

    def figure(self, prefix: str) -> Figure:
        """Return the matched number as a figure with its bar."""
        return Figure(f"{prefix}.{self.name}", self.matched, self.unit, self.limit, self.better)


class Curve(NamedTuple):
    """One line of a panel."""

    name: str
    x: FloatArray
    y: FloatArray
    kind: str = ""  # "truth", "improved", "comparator" or "": its colour


class PlotPanel(NamedTuple):
    """One pair of axes."""

    title: str
    x: str
    y: str
    curves: tuple[Curve, ...]
    limits: tuple[float, float] | None = None  # of y
    log: bool = False  # logarithmic y


class Heat(NamedTuple):
    """A map of numbers: rows by columns."""

    title: str
    x: str
    y: str
    values: FloatArray  # (rows, columns)
    ticks: tuple[str, ...]  # of the rows
    label: str


class PaperPlot(NamedTuple):
    """One figure: panels in a grid."""

    name: str
    title: str
    panels: tuple[PlotPanel | Heat, ...]
    columns: int = 1


@dataclass(frozen=True)
class PaperTable:
    """One table of the report."""

    title: str
    rows: tuple[PaperRow, ...]


@dataclass
class Reproduction:
    """All results of the reproduction of one paper."""

    paper: str
    title: str
    elements: tuple[Element, ...]
    tables: list[PaperTable] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)  # in addition to those of the tables
    plots: list[PaperPlot] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def rows(self) -> list[PaperRow]:
        """All rows of all tables."""
        return [row for table in self.tables for row in table.rows]

    @property
    def missed_rows(self) -> list[str]:
        """Names of the matched rows that miss their bars."""
        return [row.name for row in self.rows if not row.holds]

    def all_figures(self) -> list[Figure]:
        """Return the figures of the tables, then the others, then elements without a reason."""
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
