"""`fleet-service analyze`: answer one of the predefined questions about a part of an archive; print
the answer or write it to a file.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Final

from fleet_service.analytics.options import Options
from fleet_service.analytics.questions import Question, known_questions, question_of
from fleet_service.cli.common import (
    add_part,
    compact_first,
    describe_covered_box,
    duration_s,
    time_span,
)
from schemas import mugrid
from schemas.config import parse_moment
from schemas.errors import InputError
from schemas.runtime import commandline, progress_messages

if TYPE_CHECKING:
    import pyarrow as pa

ENDINGS: Final = (".parquet", ".geo.parquet", ".geojson", ".csv", ".png", ".svg", ".pdf", ".html")
# Questions to which an option applies. For others it is refused, because it would have no effect.
FOR: Final = {
    "at": ("before-after", "replay"),
    "stations": ("weather", "change-rates"),
    "step": ("replay",),
    "min_vehicles": ("worst", "spells", "contract"),
    "roads": ("contract", "grip", "worst", "spells", "replay"),
    "level": ("contract",),
    "within": ("contract",),
}
USUAL_VEHICLES: Final = 2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `fleet-service analyze`."""
    parser.description = "; ".join(
        f"{question.name}: {question.about}" for question in known_questions().values()
    )
    parser.add_argument("question", metavar="NAME", help=" | ".join(known_questions()))
    parser.add_argument(
        "--archive",
        metavar="DIR",
        type=Path,
        required=True,
        help="archive of a service; segments in its log are compacted first",
    )
    add_part(parser)
    parser.add_argument(
        "--out", metavar="FILE", type=Path, help=f"output file ({', '.join(ENDINGS)})"
    )
    parser.add_argument(
        "--engine",
        default="duckdb",
        metavar="duckdb|spark",
        help="engine of the query (default %(default)s)",
    )
    _add_question_arguments(parser)
    parser.add_argument(
        "--as-it-lies",
        action="store_true",
        help="do not compact the log; read compacted files only",
    )
    parser.add_argument("--json", action="store_true", help="print the rows as JSON, one per line")


def _add_question_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options that only some questions use."""
    parser.add_argument(
        "--at", metavar="TIME", help="before-after: time of the treatment; replay: time of the map"
    )
    parser.add_argument(
        "--stations",
        metavar="FILE",
        type=Path,
        help="weather, change-rates: readings, CSV or Parquet",
    )
    parser.add_argument(
        "--step", metavar="SECONDS", type=float, help="replay: seconds between frames"
    )
    parser.add_argument(
        "--min-vehicles",
        metavar="K",
        type=int,
        help="worst, spells, contract: only stretches that K vehicles measured (default "
        f"{USUAL_VEHICLES})",
    )
    parser.add_argument(
        "--roads",
        metavar="FILE",
        type=Path,
        help="file written by `fleet-service roads`: links of contract; others add a column `road`",
    )
    parser.add_argument(
        "--level", metavar="MU", type=float, help="contract: agreed friction, e.g. .35"
    )
    parser.add_argument(
        "--within",
        metavar="TIME",
        help="contract: time within which it must be restored, e.g. 4h or 90min",
    )


def run(arguments: argparse.Namespace) -> int:
    """Answer the question about an archive, print the answer, and write it to a file if
    requested.
    """
    question = _checked_question(arguments)
    progress_messages.set_status(f"{question.name}: loading DuckDB and Ibis")
    from fleet_service.analytics import engines, past_map
    from fleet_service.archive.export.extract import Extract
    from schemas import query

    if arguments.engine not in engines.ENGINES:
        raise InputError(
            "engine", f"{arguments.engine!r} is unknown", f"use one of {', '.join(engines.ENGINES)}"
        )
    # Read before the computation, so that a wrong file is reported at once.
    roads = None if question.name == "contract" else _read_roads(arguments.roads)
    bbox = query.parse({} if arguments.bbox is None else {"bbox": arguments.bbox}).bbox
    part = Extract(*time_span(arguments), bbox)
    options = _options_of(arguments)
    if question.name == "replay":
        past_end = (part.until, "to") if options.at is None else (options.at, "at")
        past_map.require_past(*past_end)
    if not arguments.as_it_lies:
        compact_first(arguments.archive)
    engine = engines.QueryEngine(arguments.engine, arguments.archive, part, progress=False)
    _print_progress(
        f"{question.name}: {len(engine.files('observations'))} files, {engine.rows():,} "
        "observations"
    )
    found = question.ask(engine, options)
    if bbox is not None and not found.num_rows:
        _report_covered_box(arguments, bbox)
    if roads is not None:
        from fleet_service.analytics.roads.join import add_road_names

        found = add_road_names(found, roads)
    _output_answer(found, question, arguments)
    return 0


def _read_roads(path: Path | None) -> pa.Table | None:
    """Return the table of a file written by `fleet-service roads`, or None without a file."""
    if path is None:
        return None
    from fleet_service.analytics.roads.join import read_roads

    return read_roads(path)


def _options_of(arguments: argparse.Namespace) -> Options:
    """Return the options of the question; a default where the user gave none."""
    vehicles = USUAL_VEHICLES if arguments.min_vehicles is None else arguments.min_vehicles
    return Options(
        at=None if arguments.at is None else parse_moment(arguments.at, "at"),
        stations=arguments.stations,
        least_vehicles=vehicles,
        step_s=arguments.step,
        roads=arguments.roads,
        level=arguments.level,
        within_s=_within_seconds(arguments.within),
        report=_print_progress,
    )


def _output_answer(found: pa.Table, question: Question, arguments: argparse.Namespace) -> None:
    """Print the answer as text or JSON, and write it to the output file if there is one."""
    from fleet_service.analytics import output

    is_written = arguments.out is not None
    print(
        output.format_json_lines(found, question)
        if arguments.json
        else output.format_text(found, question, is_written=is_written)
    )
    if is_written:
        output.write_file(found, question, arguments.out)
        _print_progress(f"written: {arguments.out}")


def _report_covered_box(arguments: argparse.Namespace, bbox: tuple[float, ...]) -> None:
    """If a query found no observation in its box, print the box that contains all observations.
    This helps a user who has swapped latitude and longitude.
    """
    from fleet_service.analytics import engines
    from fleet_service.archive.export.extract import Extract

    part = Extract(*time_span(arguments), None)
    engine = engines.QueryEngine(arguments.engine, arguments.archive, part, progress=False)
    t = engine.observations()
    whole = t.aggregate(
        west=t.longitude.min(),
        south=t.latitude.min(),
        east=t.longitude.max(),
        north=t.latitude.max(),
    )
    (box,) = engine.answer(whole).to_pylist()
    if box["west"] is not None:
        _print_progress(describe_covered_box("archive", tuple(box.values()), bbox))


def _within_seconds(text: str | None) -> float | None:
    return None if text is None else duration_s("within", text)


def _checked_question(arguments: argparse.Namespace) -> Question:
    """Check the command's options as far as this is possible before any computation. Return the
    question (predefined analysis) that the user named.

    Raises:
        InputError: the question is unknown, or an option does not apply to it or is out of range.
    """
    question = question_of(arguments.question)
    if arguments.out is not None:
        commandline.check_ending("out", commandline.check_out_file("out", arguments.out), ENDINGS)
        if question.colour is None and arguments.out.name.endswith(
            (".html", ".geojson", ".geo.parquet")
        ):
            raise InputError(
                "out",
                f"the answer of {question.name} has no coordinates",
                "write .parquet, .csv or .png",
            )
    for name, takers in FOR.items():
        if getattr(arguments, name) is not None and question.name not in takers:
            raise InputError(
                name.replace("_", "-"),
                f"does not apply to {question.name}",
                f"it applies to {', '.join(takers)}",
            )
    if arguments.level is not None and not mugrid.LOWER < arguments.level < mugrid.UPPER:
        problem = f"{arguments.level} lies outside {mugrid.LOWER} to {mugrid.UPPER}"
        raise InputError("level", problem, "give a friction, e.g. .35")
    if arguments.step is not None and arguments.at is not None:
        raise InputError("step", "cannot be combined with --at", "give --from and --to")
    _within_seconds(arguments.within)
    if arguments.min_vehicles is not None and arguments.min_vehicles < 1:
        raise InputError(
            "min-vehicles", f"{arguments.min_vehicles} is below 1", "give a whole number from 1"
        )
    return question


def _print_progress(line: str) -> None:
    progress_messages.report(line)
