"""`python -m tests.benchmarks.ahead [--out DIR] [--seeds N] [--quick]`: evaluate the warnings in
the car, and the fleet's map as a prior of the friction estimate.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

from edge_agent.lab.seeds import FIGURES
from schemas.runtime.figures import Figure, format_table, write_figures
from tests.benchmarks.ahead import approaches, cost, entry, latency

TITLE: Final = "ahead"
SEEDS: Final = 20  # towns that the compared targets are measured on
# [s] length of a campaign. Its 24 cars together drive 0.2 km/s, so 20 towns give 1 200 km. This is
# enough for a target of one false warning in 1 000 km.
APPROACHES_S: Final = 300.0
# Towns for the test of the map as a prior; it runs the estimator itself, which takes longer.
ENTRY_TOWNS: Final = 4


def measure_ahead(seeds: range, quick: bool) -> list[Figure]:
    """Return the figures of the warnings and of the map as a prior of the friction estimate. Each
    seed draws a random town.
    """
    rows: list[Callable[[], list[Figure]]] = [
        lambda: cost.cost_figures(FIGURES, 2e3 if quick else 20e3),
        lambda: latency.latency_figures(
            FIGURES, 20 if quick else 300, 20 if quick else latency.VEHICLES
        ),
        lambda: approaches.approach_figures(
            seeds[:1] if quick else seeds, 60.0 if quick else APPROACHES_S, 6 if quick else 24
        ),
        lambda: entry.entry_figures(
            seeds[:1] if quick else seeds[:ENTRY_TOWNS], 40.0 if quick else 90.0, 6 if quick else 16
        ),
    ]
    figures: list[Figure] = []
    for row in rows:
        found = row()
        figures += found
        print(format_table(found).partition("|---|---|---|---|\n")[2], file=sys.stderr, flush=True)
    return figures


def main() -> int:
    """Measure the warnings in the car and the map as a prior of the friction estimate, and write
    the figures. Return 0 if every figure meets its target, otherwise 1.
    """
    parser = argparse.ArgumentParser(prog="tests.benchmarks.ahead", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(".evaluation/ahead"))
    parser.add_argument("--seeds", type=int, default=SEEDS, help="number of towns")
    parser.add_argument("--quick", action="store_true", help="smaller numbers")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    seeds = range(FIGURES, FIGURES + args.seeds)
    figures = measure_ahead(seeds, args.quick)
    part = ""
    if args.quick:
        part = " --quick"
    elif args.seeds < SEEDS:
        part = f" --seeds {args.seeds}"
    write_figures(args.out / "figures.json", TITLE + part, list(seeds), figures)
    text = f"# Road ahead\n\n{format_table(figures)}\n"
    (args.out / "report.md").write_text(text, encoding="utf-8")
    print(text)
    return 0 if all(figure.holds for figure in figures if figure.bar is not None) else 1


if __name__ == "__main__":
    sys.exit(main())
