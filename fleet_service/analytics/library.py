"""Questions about an archive from a Python program; answers are Arrow tables."""

from __future__ import annotations

import time
from pathlib import Path

import pyarrow as pa

from fleet_service.analytics import output
from fleet_service.analytics.engines import QueryEngine
from fleet_service.analytics.options import Options
from fleet_service.analytics.past_map import map_at, require_past
from fleet_service.analytics.questions import question_of
from fleet_service.archive.export.extract import Box, Extract
from fleet_service.archive.format.layout import require_archive
from schemas import query
from schemas.config import parse_moment
from schemas.errors import InputError


def _make_extract(period: tuple[str | None, str | None], bbox: Box | None) -> Extract:
    if isinstance(period, str) or len(period) != 2:
        raise InputError(
            "period", f"{period!r} is not a pair", "give (begin, end), each may be None"
        )
    since, until = period
    begin = 0 if since is None else parse_moment(str(since), "period")
    end = time.time_ns() if until is None else parse_moment(str(until), "period")
    if begin >= end:
        raise InputError("period", f"{until or 'now'} is not after {since}", "give a later end")
    box = {} if bbox is None else {"bbox": ",".join(map(str, bbox))}
    return Extract(begin, end, query.parse(box).bbox)


def ask_archive(
    archive: Path | str,
    question: str,
    *,
    period: tuple[str | None, str | None] = (None, None),
    bbox: Box | None = None,
    options: Options | None = None,
    engine: str = "duckdb",
) -> pa.Table:
    """Return the answer to one of the predefined questions about an archive. Only compacted files
    are read, that is, rows that `fleet-service compact` has sorted by cell. `period` is the begin
    and end of the observations, ISO 8601, UTC; None for an open end.

    Raises:
        InputError: there is no such question or archive, no data in the selected part, or an option
            is missing.
    """
    root = Path(archive)
    require_archive(root)
    predefined_question = question_of(question)
    return predefined_question.ask(
        QueryEngine(engine, root, _make_extract(period, bbox)),
        options or Options(report=lambda _: None),
    )


def map_of_archive(
    archive: Path | str, *, at: str | None = None, bbox: Box | None = None
) -> pa.Table:
    """Return the map at the time `at` (default: now), replayed from the archive, as a GeoParquet
    table.

    Raises:
        InputError: there is no such archive, or the time lies in the future.
    """
    root = Path(archive)
    require_archive(root)
    part = _make_extract((None, at), bbox)
    require_past(part.until, "at")
    return map_at(root, part)


def write_answer(table: pa.Table, question: str, path: Path | str) -> None:
    """Write an answer to a file; the ending selects the format: .parquet, .geo.parquet, .geojson,
    .csv, .png, .svg, .pdf, .html.
    """
    output.write_file(table, question_of(question), Path(path))
