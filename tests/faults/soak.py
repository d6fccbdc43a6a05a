"""`python -m tests.faults.soak [--minutes 30] [--out DIR]`: steady load for half an hour, with a
check that no resource grows.
"""

from __future__ import annotations

import argparse
import time
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from schemas.numeric import FloatArray
from schemas.runtime import figures
from schemas.runtime.figures import Figure
from tests.faults.bars import make_figure
from tests.faults.census import compare_with_archive
from tests.faults.frame import Campaign, Site, run_and_exit, run_campaigns
from tests.faults.processes import Part, open_stage

# Load: 2 000 observations/s in all.
PROCESSES = 2
VEHICLES = 20
RATE = 50.0
# A small area, so that soon every cell is on the map. Growth by new cells would look like a leak.
CELLS_ACROSS: Final = 12
EVERY_S: Final = 5.0
# Share of the time in which buffers, windows and the map's cells are filled.
SETTLED: Final = 1 / 3
MINUTES: Final = 30.0
OWES: Final = (
    *("faults.soak.growth_mb", "faults.soak.handles"),
    *("faults.soak.lost", "faults.soak.observations_per_s"),
)


def memory_mb(part: Part) -> float:
    """Return the resident memory [MB] of a process under test."""
    lines = Path(f"/proc/{part.pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 1024


def count_handles(part: Part) -> int:
    """Return the number of open files and sockets of a process."""
    return sum(1 for _ in Path(f"/proc/{part.pid}/fd").iterdir())


def fit_slope(times: FloatArray, megabytes: FloatArray) -> float:
    """Return the growth of a process's memory [MB per 10 min]: the slope of a line through the
    minimum of each minute.

    Within a minute memory rises and falls because of writing to disk, compactions and queries; the
    minima show the lasting growth.
    """
    minute = (times // 60.0).astype(int)
    least = np.array([megabytes[minute == m].min() for m in np.unique(minute)])
    return (
        10 * float(np.polyfit(np.unique(minute), least, 1)[0]) if len(least) > 1 else float("nan")
    )


def run(site: Site, minutes: float = MINUTES) -> list[Figure]:
    """Run the system under steady load, and return the figures: the steepest growth of memory [MB
    per 10 min] and the largest growth in the number of open files and sockets, of any process. Lost
    and doubled rows are counted too.
    """
    times: list[float] = []
    seen: dict[str, list[tuple[float, int]]] = {}
    with open_stage(site.folder, compact_s=300.0) as stage:
        for number in range(PROCESSES):
            names = [f"sim-{number}{place:02}" for place in range(VEHICLES)]
            stage.make_load(names, RATE, seed=number, cells_across=CELLS_ACROSS).start()
        began = time.monotonic()
        while (now := time.monotonic() - began) < minutes * 60:
            times.append(now)
            for part in stage.parts:
                seen.setdefault(part.name, []).append((memory_mb(part), count_handles(part)))
            if len(times) % 24 == 0:
                site.say(
                    ", ".join(
                        f"{name} {rows[-1][0]:.0f} MB {rows[-1][1]}" for name, rows in seen.items()
                    )
                )
            time.sleep(EVERY_S)
        stage.drain(60.0)
        stage.service.stop()
        census = compare_with_archive(stage.journals, stage.archive)
    first = int(len(times) * SETTLED)
    slopes = {}
    grown = {}
    for name, rows in seen.items():
        kept = np.array(rows[first:])
        slopes[name] = fit_slope(np.array(times[first:]), kept[:, 0])
        third = max(len(kept) // 3, 1)
        grown[name] = float(np.median(kept[-third:, 1]) - np.median(kept[:third, 1]))
    site.say(f"{slopes}; {grown}; {census}")
    return [
        make_figure("faults.soak.growth_mb", max(slopes.values())),
        make_figure("faults.soak.handles", max(grown.values())),
        make_figure("faults.soak.lost", census.lost + census.doubled),
        make_figure("faults.soak.observations_per_s", census.observations / (minutes * 60)),
        *(
            Figure(f"faults.soak.{name}_growth_mb", slope, "MB per 10 min")
            for name, slope in slopes.items()
        ),
        Figure("faults.soak.minutes", minutes, "minutes"),
    ]


def main() -> int:
    """Run the campaign of steady load. Return 0 if every figure meets its target, otherwise 1."""
    parser = argparse.ArgumentParser(
        prog="tests.faults.soak", description="A steady load; does anything grow?"
    )
    parser.add_argument("--minutes", type=float, default=MINUTES, help="how long (default 30)")
    parser.add_argument("--out", type=Path, default=Path(".faults/soak"), help="figures go there")
    args = parser.parse_args()
    campaign = Campaign("soak", partial(run, minutes=args.minutes), OWES)
    found = run_campaigns([campaign], args.out, "soak", quick=False, seed=0)
    print(figures.format_table(found))
    return 0 if all(one.holds for one in found) else 1


if __name__ == "__main__":
    run_and_exit(main)
