"""Output of answers: table for the terminal, Parquet, GeoParquet, GeoJSON, CSV, plot, or an HTML
map that needs no network.
"""

from __future__ import annotations

import json
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet_service.analytics.page import GRIP_SCALE, DrawnCells, Scale, Value, render_page
from fleet_service.analytics.questions import Question
from fleet_service.archive.export import extract
from fleet_service.archive.format import geo
from schemas import grid
from schemas.errors import InputError
from schemas.runtime import commandline
from schemas.runtime.durable import open_durably
from schemas.runtime.installing import install_command

SHOWN_ROWS: Final = 20
PLOTS: Final = (".png", ".svg", ".pdf")
MAP_CELLS: Final = 200_000  # largest number of cells on a page; more make browsers slow
PARTS: Final = "members"  # column of rows that stand for several cells
# columns that the page does not show as text, because its map shows the place
HIDDEN: Final = ("west", "south", "east", "north", "cell")
TIMES: Final = ("onset", "last", "end", "time", "begin")  # seconds since 1970


def format_text(table: pa.Table, question: Question, *, is_written: bool = False) -> str:
    """Return the first rows of an answer, in the order that the question defines, as a text table
    for the terminal. If further rows are not shown, name the option that writes them, unless
    `is_written`.
    """
    shown = add_places(order_rows(table, question).slice(0, SHOWN_ROWS))
    names = [
        name for name in shown.schema.names if not pa.types.is_nested(shown.schema.field(name).type)
    ]
    cells = [
        names,
        *(
            [_cell_text(name, row[name]) for name in names]
            for row in shown.select(names).to_pylist()
        ),
    ]
    widths = [max(len(row[k]) for row in cells) for k in range(len(names))]
    lines = [
        "  ".join(value.rjust(width) for value, width in zip(row, widths, strict=True))
        for row in cells
    ]
    total = f"{table.num_rows} rows"
    if rest := table.num_rows - shown.num_rows:
        total += f", {rest} not shown" + ("" if is_written else " (--out writes all)")
    return "\n".join([*lines, total])


def format_json_lines(table: pa.Table, question: Question) -> str:
    """Return all rows of an answer, in the order that the question defines, as lines of JSON; times
    are ISO 8601, UTC.
    """
    return "\n".join(
        json.dumps({name: _json_value(name, v) for name, v in row.items()}, allow_nan=False)
        for row in add_places(order_rows(table, question)).to_pylist()
    )


def _json_value(name: str, value: object) -> object:
    if isinstance(value, float) and not np.isfinite(value):
        return None
    if name in TIMES and isinstance(value, int):
        return f"{datetime.fromtimestamp(value, UTC):%Y-%m-%dT%H:%M:%SZ}"
    return value.isoformat() if isinstance(value, date) else value  # datetime is a kind of date


def order_rows(table: pa.Table, question: Question) -> pa.Table:
    """Return the rows of an answer in the order that the question defines; rows with equal values
    are ordered by the other columns.
    """
    name = question.order.removeprefix("-")
    others = [f.name for f in table.schema if f.name != name and not pa.types.is_nested(f.type)]
    keys: list[Any] = [(name, "descending" if question.order.startswith("-") else "ascending")]
    return table.sort_by(keys + [(other, "ascending") for other in others])


def _cell_text(name: str, value: object) -> str:
    if value is None or value != value:  # NaN
        return "-"
    if name == "sector":
        return grid.HEADINGS[int(str(value))]
    if name in TIMES and isinstance(value, int):
        return f"{datetime.fromtimestamp(value, UTC):%Y-%m-%dT%H:%M:%SZ}"
    if isinstance(value, float):
        return (
            f"{value:.6f}"
            if name in ("latitude", "longitude", "west", "south", "east", "north")
            else f"{value:.4g}"
        )
    if isinstance(value, datetime):
        return f"{value:%Y-%m-%dT%H:%M:%SZ}"
    return str(value)


def write_file(table: pa.Table, question: Question, path: Path) -> None:
    """Write an answer to a file; the ending of its name selects the format.

    Raises:
        InputError: the ending is unknown, the answer has no coordinates, or the file cannot be
            written.
    """
    table = order_rows(table, question)
    with commandline.report_write_errors(path):
        if path.suffix == ".parquet" and not path.name.endswith(".geo.parquet"):
            with open_durably(path) as file:
                pq.write_table(table, file, compression="zstd")
        elif path.suffix in PLOTS:
            write_plot(table, question, path)
        elif path.suffix == ".html":
            with open_durably(path) as file:
                file.write(make_page(table, question).encode())
        elif path.name.endswith(".geo.parquet"):
            extract.write_extract(add_geometry(table, question), path)
        elif path.suffix == ".geojson":
            extract.write_extract(add_geometry(times_as_timestamps(table), question), path)
        else:
            extract.write_extract(times_as_timestamps(add_places(table)), path)


def times_as_timestamps(table: pa.Table) -> pa.Table:
    """Return the answer with times (seconds since 1970) converted to timestamps, which text files
    contain as ISO 8601.
    """
    for place, field in enumerate(table.schema):
        if field.name in TIMES and pa.types.is_integer(field.type):
            table = table.set_column(
                place, field.name, table[field.name].cast(pa.timestamp("s", "UTC"))
            )
    return table


def add_places(table: pa.Table) -> pa.Table:
    """Return the answer with latitude and longitude of its cells, if it has cells and no
    coordinates yet.
    """
    names = table.schema.names
    if "cell" not in names or "latitude" in names or "west" in names:
        return table
    known = table["cell"].is_valid().to_numpy()
    cells = np.array([cell or 0 for cell in table["cell"].to_pylist()], np.int64)
    for name, values in zip(("latitude", "longitude"), grid.centre(cells), strict=True):
        table = table.append_column(name, pa.array(np.round(values, 6), mask=~known))
    return table


def add_geometry(table: pa.Table, question: Question) -> pa.Table:
    """Return the answer with the polygon of each row's cell; rows with several cells get a
    multi-polygon.
    """
    if "cell" not in table.schema.names:
        raise InputError(
            "out",
            f"the answer of {question.name} has no coordinates",
            "write .parquet, .csv or .png",
        )
    return (
        geo.with_stretches(table, _row_cells(table))
        if PARTS in table.schema.names
        else geo.with_cells(table)
    )


def _row_cells(table: pa.Table) -> list[list[int]]:
    """Return, for each row of an answer, the map cells that it describes."""
    found: list[Any] = table[PARTS].to_pylist()
    return found


def write_plot(table: pa.Table, question: Question, path: Path) -> None:
    """Write the answer to a question as an image with a plot.

    Raises:
        InputError: matplotlib is not installed.
    """
    try:
        from fleet_service.analytics.plots import draw_answer
    except ImportError as error:
        raise InputError(
            "out", "matplotlib is not installed", install_command("analytics")
        ) from error
    draw_answer(table, question.name, question.about, path)


def make_page(table: pa.Table, question: Question) -> str:
    """Return an HTML page with a map of the answer's coloured cells, animated if the answer has
    frames (maps of several moments). The page needs no network.
    """
    if question.colour is None or "cell" not in table.schema.names:
        raise InputError(
            "out",
            f"the answer of {question.name} has no coordinates",
            "write .parquet, .csv or .png",
        )
    rest = max(table.num_rows - MAP_CELLS, 0)
    table = table.slice(0, MAP_CELLS)
    part = None
    cells = table["cell"].to_numpy()
    if PARTS in table.schema.names:
        parts = _row_cells(table)
        part = [row for row, own in enumerate(parts) for _ in own]
        cells = np.array([cell for own in parts for cell in own], np.int64)
    boxes = np.stack(list(grid.bounds(cells)), axis=1).round(7).tolist()
    frames = _frame_labels(table)
    known = sorted(set(frames))
    number = {name: k for k, name in enumerate(known)}
    names = [
        f.name for f in table.schema if f.name not in HIDDEN and not pa.types.is_nested(f.type)
    ]
    rows = [
        [_cell_text(name, row[name]) for name in names] for row in table.select(names).to_pylist()
    ]
    values = [
        None if v is None or np.isnan(v) else round(float(v), 4)
        for v in table[question.colour].to_pylist()
    ]
    lasting: Any = table["lasts"].to_pylist() if "lasts" in table.schema.names else None
    sector: Any = table["sector"].to_pylist()
    frame = [number[name] for name in frames]
    drawn = DrawnCells(
        boxes, sector, {"": values}, names, rows, part, known or [""], frame, lasting
    )
    about = f"{rest:,} more rows are not drawn: choose a smaller box or fewer days." if rest else ""
    return render_page(question.about, drawn, _colour_scale(question, values), about=about)


def _colour_scale(question: Question, values: list[Value]) -> Scale:
    if question.colour is not None and question.colour.startswith("mu"):
        return GRIP_SCALE
    top = max((v for v in values if v is not None), default=1.0) or 1.0
    label = (
        f"{question.colour}, darker is longer"
        if question.colour == "duration_s"
        else str(question.colour)
    )
    ticks = [(share * top, f"{share * top:,.0f} s") for share in (0.0, 0.5, 1.0)]
    return Scale(label, 0.0, top, ticks, dark_is_high=True, unknown="not measured")


def _frame_labels(table: pa.Table) -> list[str]:
    for name in ("frame", "day"):
        if name in table.schema.names:
            return [
                f"{v:%Y-%m-%d %H:%M:%S}" if isinstance(v, datetime) else _day_text(v)
                for v in table[name].to_pylist()
            ]
    return [""] * table.num_rows


def _day_text(value: object) -> str:
    return value.isoformat() if isinstance(value, date) else str(value)
