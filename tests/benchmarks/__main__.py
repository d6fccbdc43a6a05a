"""`make bench`: what each part costs, each against a limit or a peer measured in the same run where there is one.

Writes `.bench/figures.json` and prints the table. `python -m tests.benchmarks NAME ...` runs some parts only.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from schemas import figures
from schemas.figures import Figure
from tests.benchmarks.agent import agent
from tests.benchmarks.contract import contract
from tests.benchmarks.estimators import estimators
from tests.benchmarks.fusion import fusion
from tests.benchmarks.ingest import ingest
from tests.benchmarks.measure import SEED
from tests.benchmarks.service import service
from tests.benchmarks.step import bank, step

FOLDER = Path(".bench")
PARTS: dict[str, Callable[[], list[Figure]]] = {
    part.__name__: part for part in (step, bank, estimators, agent, contract, fusion, ingest, service)
}


def main() -> int:
    """Run the parts asked for, all without names, with progress."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="NAME", help=f"one of {', '.join(PARTS)}; default: all")
    chosen = parser.parse_args().parts or list(PARTS)
    if unknown := set(chosen) - set(PARTS):
        parser.error(f"{', '.join(sorted(unknown))}: unknown; choose from {', '.join(PARTS)}")
    found: list[Figure] = []
    for name in chosen:
        print(f"{name}: {(PARTS[name].__doc__ or '').splitlines()[0]}", flush=True)
        found += PARTS[name]()
    figures.write(FOLDER / "figures.json", "bench", [SEED], found)
    print(f"\n{figures.markdown(found)}\n\n{FOLDER}/figures.json")
    return 0


if __name__ == "__main__":
    sys.exit(main())
