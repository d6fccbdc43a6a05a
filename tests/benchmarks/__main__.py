"""`make bench`: time, memory and bytes of each part, where possible as a ratio to a theoretical
limit or to another program measured in the same run.

Writes `.bench/figures.json` and prints the table. `python -m tests.benchmarks NAME ...` runs only
the named parts.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

from schemas.runtime import figures
from schemas.runtime.figures import Figure
from tests.benchmarks.agent import agent
from tests.benchmarks.cluster import cluster
from tests.benchmarks.contract import contract
from tests.benchmarks.estimators import estimators
from tests.benchmarks.fusion import fusion
from tests.benchmarks.growth import growth
from tests.benchmarks.ingest import ingest
from tests.benchmarks.measure import SEED
from tests.benchmarks.public import public
from tests.benchmarks.service import service
from tests.benchmarks.shards import shards
from tests.benchmarks.sizing import sizing
from tests.benchmarks.state import state
from tests.benchmarks.step import bank, step
from tests.benchmarks.tiles import tiles

FOLDER = Path(".bench")
_ALL = (
    step,
    bank,
    estimators,
    agent,
    contract,
    fusion,
    ingest,
    growth,
    service,
    tiles,
    public,
    shards,
    state,
    sizing,
    cluster,
)
PARTS: dict[str, Callable[[], list[Figure]]] = {part.__name__: part for part in _ALL}


def main() -> int:
    """Run the benchmarks that the command line names (all if it names none), and print progress.
    Return the exit code.
    """
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "parts", nargs="*", metavar="NAME", help=f"one of {', '.join(PARTS)}; default: all"
    )
    chosen = parser.parse_args().parts or list(PARTS)
    if unknown := set(chosen) - set(PARTS):
        parser.error(f"{', '.join(sorted(unknown))}: unknown; choose from {', '.join(PARTS)}")
    found: list[Figure] = []
    began = time.monotonic()
    for number, name in enumerate(chosen, 1):
        print(
            f"{number}/{len(chosen)} {name}: {(PARTS[name].__doc__ or '').splitlines()[0]}",
            flush=True,
        )
        part = time.monotonic()
        found += PARTS[name]()
        print(f"    {time.monotonic() - part:.0f} s", flush=True)
    if len(chosen) == len(PARTS):
        found.append(Figure("bench.total_s", time.monotonic() - began, "s, all parts", 600))
    figures.write_figures(FOLDER / "figures.json", "bench", [SEED], found)
    print(f"\n{figures.format_table(found)}\n\n{FOLDER}/figures.json")
    return 0


if __name__ == "__main__":
    sys.exit(main())
