"""Example script to copy: it answers five questions about an archive and plots each answer.

python -m fleet_service.analytics.example --archive DIR --out FOLDER
python -m fleet_service.analytics.example --out FOLDER            # with a synthetic archive
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa

from fleet_service.analytics import output, synthetic
from fleet_service.analytics.engines import QueryEngine
from fleet_service.analytics.options import Options
from fleet_service.analytics.questions import QUESTIONS
from fleet_service.archive.export.extract import Extract
from fleet_service.archive.format import layout
from fleet_service.archive.maintenance.compaction import compact
from schemas.wire import Kind

WORLD = synthetic.SyntheticFleet(rows=60_000, days=3, vehicles=60, roads=16, length=80, icy=4)


def whole_archive(root: Path) -> Extract:
    """Return a selection that contains all days of an archive."""
    days = [
        layout.day_of(folder)
        for folder in layout.day_folders(root, layout.TABLES[Kind.OBSERVATION])
    ]
    return Extract(min(days) * layout.DAY_NS, (max(days) + 1) * layout.DAY_NS)


def draw_figures(root: Path, folder: Path) -> dict[str, pa.Table]:
    """Answer five questions, draw a plot of each answer into `folder`, and return the answers by
    name.
    """
    folder.mkdir(parents=True, exist_ok=True)
    engine = QueryEngine("duckdb", root, whole_archive(root))
    middle = (engine.extract.since + engine.extract.until) // 2
    answers = {}
    for name, ending in (
        ("grip", "html"),
        ("worst", "html"),
        ("spells", "png"),
        ("before-after", "png"),
        ("vehicles", "png"),
    ):
        question = QUESTIONS[name]
        answers[name] = question.ask(engine, Options(at=middle))
        output.write_file(answers[name], question, folder / f"{name}.{ending}")
        print(
            f"\n{name}: {question.about}\n{output.format_text(answers[name].slice(0, 5), question)}"
        )
    return answers


def main(argv: Sequence[str] | None = None) -> int:
    """Draw the example's plots for the archive named in `argv`, or for a synthetic archive; return
    the exit code.
    """
    parser = argparse.ArgumentParser(prog="python -m fleet_service.analytics.example")
    parser.add_argument("--archive", type=Path, help="compacted archive (default: a synthetic one)")
    parser.add_argument("--out", type=Path, required=True, help="output folder for the figures")
    arguments = parser.parse_args(argv)
    root = arguments.archive
    if root is None:
        root = arguments.out / "archive"
        synthetic.write_archive(root, WORLD)
        compact(root)
    draw_figures(root, arguments.out)
    print(f"\nfigures in {arguments.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
