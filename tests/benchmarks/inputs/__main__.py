"""`python -m tests.benchmarks.inputs [--out DIR] [--recorded LOG] [--quick]`: evaluate the inputs
of the agent: import of recorded files, signal doctor (automatic check of the signals), calibration,
and live sources.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from edge_agent.lab.seeds import FIGURES
from schemas.runtime.figures import Figure, format_table, write_figures
from tests.benchmarks.inputs import calibrated, imports, live_benchmark, planted

TITLE: Final = "inputs"
LEARNED_CARS: Final = 60  # for the errors of the calibration
NARROWED_CARS: Final = 20  # for its benefit
LIVE_S: Final = 60.0
QUICK_S: Final = 10
CARS: Final = 5  # drives with accurate sensors, and the same number with inaccurate ones


def measure_inputs(folder: Path, recorded: Path | None, quick: bool) -> list[Figure]:
    """Run the four evaluations: import of recorded files, signal doctor (automatic check of the
    signals), calibration, and live sources. Return their figures.

    Files are written into `folder`. If the CAN log `recorded` is given, its frames are decoded as
    well. If `quick` is True, drives are fewer and shorter.
    """
    rows: list[Callable[[], list[Figure]]] = [
        lambda: imports.figures(folder, FIGURES, recorded, QUICK_S if quick else imports.DRIVE_S),
        lambda: planted.figures(1 if quick else CARS, FIGURES),
        lambda: calibrated.figures(1 if quick else LEARNED_CARS, FIGURES),
        lambda: calibrated.widths(
            1 if quick else NARROWED_CARS, FIGURES, 2 * QUICK_S if quick else calibrated.JUDGED_S
        ),
        lambda: live_benchmark.figures(
            folder, 1.0 if quick else LIVE_S, 1 if quick else live_benchmark.KILLS
        ),
    ]
    figures: list[Figure] = []
    for row in rows:
        found = row()
        figures += found
        print(format_table(found).partition("|---|---|---|---|\n")[2], file=sys.stderr, flush=True)
    return figures


def main(words: Sequence[str] | None = None) -> int:
    """Run the evaluations of this module with command-line arguments, and write the figures to
    files. Return 0 if every figure with a target meets it, otherwise 1.
    """
    parser = argparse.ArgumentParser(prog="tests.benchmarks.inputs", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(".evaluation/inputs"))
    parser.add_argument("--recorded", type=Path, help="CAN log to decode as well")
    parser.add_argument("--quick", action="store_true", help="smaller numbers")
    args = parser.parse_args(words)
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=args.out) as scratch:
        figures = measure_inputs(Path(scratch), args.recorded, args.quick)
    title = TITLE + " --quick" * args.quick
    write_figures(args.out / "figures.json", title, [FIGURES, FIGURES + 1], figures)
    text = f"# Inputs\n\n{format_table(figures)}\n"
    (args.out / "report.md").write_text(text, encoding="utf-8")
    print(text)
    return 0 if all(figure.holds for figure in figures if figure.bar is not None) else 1


if __name__ == "__main__":
    sys.exit(main())
