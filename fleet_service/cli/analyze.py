"""`fleet-service analyze`: one of the questions, on a part of an archive, in the terminal and as a file."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Final

from fleet_service.analytics.options import Options
from fleet_service.analytics.questions import QUESTIONS
from fleet_service.cli.common import add_part, span
from schemas.config import moment
from schemas.errors import InputError

ENDINGS: Final = (".parquet", ".geo.parquet", ".geojson", ".csv", ".png", ".svg", ".html")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.description = "; ".join(f"{question.name}: {question.about}" for question in QUESTIONS.values())
    parser.add_argument("question", metavar="NAME", help=" | ".join(QUESTIONS))
    parser.add_argument("--archive", metavar="DIR", type=Path, required=True, help="compacted files are read")
    add_part(parser)
    parser.add_argument("--out", metavar="FILE", type=Path, help=f"ends in {', '.join(ENDINGS)}")
    parser.add_argument("--engine", default="duckdb", metavar="duckdb|spark", help="default %(default)s")
    parser.add_argument("--at", metavar="TIME", help="before-after: of the treatment; replay: of the map")
    parser.add_argument("--stations", metavar="FILE", type=Path, help="weather: readings, CSV or Parquet")
    parser.add_argument("--step", metavar="SECONDS", type=float, default=0.0, help="replay: between frames")
    parser.add_argument("--min-vehicles", metavar="K", type=int, default=2, help="worst, spells: default %(default)s")


def run(arguments: argparse.Namespace) -> int:
    """Ask, print the answer, and write it on request."""
    question = QUESTIONS.get(arguments.question)
    if question is None:
        raise InputError("question", f"{arguments.question!r} is none", f"use one of {', '.join(QUESTIONS)}")
    if arguments.out is not None and arguments.out.suffix not in ENDINGS:
        raise InputError("out", f"{arguments.out.name} has no known ending", f"use one of {', '.join(ENDINGS)}")
    from fleet_service.analytics import engines, output
    from fleet_service.archive.export import Extract
    from schemas import query

    if arguments.engine not in engines.ENGINES:
        raise InputError("engine", f"{arguments.engine!r} is none", f"use one of {', '.join(engines.ENGINES)}")
    bbox = query.parse({} if arguments.bbox is None else {"bbox": arguments.bbox}).bbox
    part = Extract(*span(arguments), bbox)
    engine = engines.QueryEngine(arguments.engine, arguments.archive, part, progress=sys.stderr.isatty())
    at = None if arguments.at is None else moment(arguments.at, "at")
    options = Options(
        at=at, stations=arguments.stations, least_vehicles=arguments.min_vehicles,
        step_s=arguments.step, report=_report,
    )  # fmt: skip
    _report(f"{question.name}: {len(engine.files('observations'))} files, {engine.rows():,} observations")
    found = question.ask(engine, options)
    print(output.text(found, question))
    if arguments.out is not None:
        output.write(found, question, arguments.out)
        _report(f"written: {arguments.out}")
    return 0


def _report(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
