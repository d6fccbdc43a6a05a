"""Answers as a table in the terminal, Parquet, GeoParquet, GeoJSON, CSV, a plot, or a map that needs no network."""

from __future__ import annotations

import json
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet_service.analytics.questions import Question
from fleet_service.archive import export, geo
from schemas import grid
from schemas.errors import InputError

SHOWN_ROWS: Final = 20
MAP_CELLS: Final = 200_000  # of a page; more make browsers slow
TIMES: Final = ("onset", "last", "end", "time")  # seconds since 1970
_PAGE: Final = Path(__file__).with_name("map.html")


def text(table: pa.Table, question: Question) -> str:
    """The first rows in the question's order, for the terminal."""
    shown = ordered(table, question).slice(0, SHOWN_ROWS)
    names = [name for name in shown.schema.names if not pa.types.is_nested(shown.schema.field(name).type)]
    cells = [names, *([_text(name, row[name]) for name in names] for row in shown.select(names).to_pylist())]
    widths = [max(len(row[k]) for row in cells) for k in range(len(names))]
    lines = ["  ".join(value.rjust(width) for value, width in zip(row, widths, strict=True)) for row in cells]
    rest = table.num_rows - shown.num_rows
    return "\n".join([*lines, f"{table.num_rows} rows" + (f", {rest} not shown (--out writes all)" if rest else "")])


def ordered(table: pa.Table, question: Question) -> pa.Table:
    """Rows in the question's order; what it does not decide, the other columns do."""
    name = question.order.removeprefix("-")
    others = [f.name for f in table.schema if f.name != name and not pa.types.is_nested(f.type)]
    keys: list[Any] = [(name, "descending" if question.order.startswith("-") else "ascending")]
    return table.sort_by(keys + [(other, "ascending") for other in others])


def _text(name: str, value: object) -> str:
    if value is None:
        return "-"
    if name in TIMES and isinstance(value, int):
        return f"{datetime.fromtimestamp(value, UTC):%Y-%m-%d %H:%M:%S}"
    if isinstance(value, float):
        return f"{value:.6f}" if name in ("latitude", "longitude", "west", "south", "east", "north") else f"{value:.4g}"
    if isinstance(value, datetime):
        return f"{value:%Y-%m-%d %H:%M:%S}"
    return str(value)


def write(table: pa.Table, question: Question, path: Path) -> None:
    """Write an answer as the ending of the name says.

    Raises:
        InputError: an unknown ending, an answer that has no place, or a file that cannot be written.
    """
    table = ordered(table, question)
    try:
        if path.suffix == ".parquet" and not path.name.endswith(".geo.parquet"):
            pq.write_table(table, path, compression="zstd")
        elif path.suffix in (".png", ".svg"):
            plot(table, question, path)
        elif path.suffix == ".html":
            path.write_text(page(table, question), encoding="utf-8")
        elif path.name.endswith(".geo.parquet") or path.suffix == ".geojson":
            export.write(placed(table, question), path)
        else:
            export.write(table, path)
    except OSError as error:
        raise InputError("out", f"cannot write {path} ({error.strerror})", "name a file you may write") from error


def placed(table: pa.Table, question: Question) -> pa.Table:
    """An answer with the polygons of its cells, or of its boxes."""
    if "cell" not in table.schema.names:
        raise InputError("out", f"the answer of {question.name} has no place", "write .parquet, .csv or .png")
    if "west" in table.schema.names:
        return geo.with_boxes(table, *(table[side].to_numpy() for side in ("west", "south", "east", "north")))
    return geo.with_cells(table)


def plot(table: pa.Table, question: Question, path: Path) -> None:
    """Two columns of an answer against each other.

    Raises:
        InputError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError("out", "matplotlib is not installed", "pip install 'gripmap[analytics]'") from error
    canvas = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = canvas.subplots()
    x, y = (_numbers(table, name) for name in question.plot)
    axes.plot(x, y, marker="o", markersize=3, linestyle="none" if len(set(x)) < len(x) or len(x) > 50 else "-")
    axes.set(xlabel=question.plot[0], ylabel=question.plot[1], title=question.about)
    axes.grid(visible=True, alpha=0.3)
    canvas.savefig(path, dpi=130)


def _numbers(table: pa.Table, name: str) -> list[Any]:
    values = table[name].to_pylist()
    if name in TIMES:
        return [datetime.fromtimestamp(value, UTC) for value in values if value is not None]
    return [float("nan") if value is None else value for value in values]


def page(table: pa.Table, question: Question) -> str:
    """A page that draws the answer's cells in colour, frame by frame where it has frames; it needs no network."""
    if question.colour is None or "cell" not in table.schema.names:
        raise InputError("out", f"the answer of {question.name} has no place", "write .parquet, .csv or .png")
    table = table.slice(0, MAP_CELLS)
    sides = (
        [table[side].to_numpy() for side in ("west", "south", "east", "north")]
        if "west" in table.schema.names
        else list(grid.bounds(table["cell"].to_numpy()))
    )
    boxes = np.stack(sides, axis=1).round(7).tolist()
    frames = _frames(table)
    names = [f.name for f in table.schema if f.name not in ("west", "south", "east", "north")]
    rows = [[_text(name, row[name]) for name in names] for row in table.select(names).to_pylist()]
    colours = [None if v is None or np.isnan(v) else round(float(v), 4) for v in table[question.colour].to_pylist()]
    data = {
        "title": question.about, "colour": question.colour, "boxes": boxes, "values": colours, "names": names,
        "rows": rows, "frames": sorted(set(frames)), "frame": frames,
        "sector": table["sector"].to_pylist(),
    }  # fmt: skip
    return _PAGE.read_text(encoding="utf-8").replace("/*DATA*/null", json.dumps(data).replace("</", "<\\/"))


def _frames(table: pa.Table) -> list[str]:
    for name in ("frame", "day"):
        if name in table.schema.names:
            return [f"{v:%Y-%m-%d %H:%M}" if isinstance(v, datetime) else _day(v) for v in table[name].to_pylist()]
    return [""] * table.num_rows


def _day(value: object) -> str:
    return value.isoformat() if isinstance(value, date) else str(value)
