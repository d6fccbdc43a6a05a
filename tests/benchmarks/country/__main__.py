"""`make country-bench`: simulate a city with routes from SUMO, and then a country of a hundred
thousand vehicles for ten minutes.

Writes `.country/figures.json` and `.country/country.png`, and prints the table. `--city DIR` uses
the observations of an earlier run of the city.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Final

from schemas.runtime import figures
from schemas.runtime.figures import Figure
from tests.benchmarks.country.city import PREFIX, simulate_city
from tests.benchmarks.country.coefficients import measure_coefficients
from tests.benchmarks.country.nation import simulate_nation
from tests.benchmarks.country.paper import estimate_million
from tests.benchmarks.country.plot import draw
from tests.benchmarks.sumo import Sumo

FOLDER: Final = Path(".country")
SEED: Final = 30_000


def main() -> int:
    """Simulate the city and the country, and measure both. Return 1 if a figure misses its target,
    otherwise 0.
    """
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.country", description="A city and a country."
    )
    parser.add_argument(
        "--city", type=Path, help="folder with observations.parquet; default: drive the city first"
    )
    given: Path | None = parser.parse_args().city
    FOLDER.mkdir(exist_ok=True)
    found: list[Figure] = []
    if given is None:
        print("1/3 city: three hundred vehicles on SUMO's routes", flush=True)
        found += simulate_city(Sumo(FOLDER), FOLDER, SEED)
    print("2/3 coefficients: what a vehicle and a cell cost", flush=True)
    each = measure_coefficients()
    print("3/3 country: a hundred thousand vehicles, twenty-one minutes", flush=True)
    with tempfile.TemporaryDirectory() as name:
        course = Path(name)
        found += simulate_nation(given or FOLDER / PREFIX, course, SEED, each)
        draw(course, FOLDER / "country.png")
        shutil.copy(course / "course.npz", FOLDER)
    found += [
        Figure(
            "country.vehicle_bytes", each.vehicle_bytes, "bytes of a service's memory per vehicle"
        ),
        Figure(
            "country.cell_bytes", each.cell_bytes, "bytes of a service's memory per cell and sector"
        ),
        Figure(
            "country.pair_bytes",
            each.pair_bytes,
            "bytes of a service's memory per cell and sector that a vehicle visited recently",
        ),
    ]
    found += estimate_million({figure.name: figure.value for figure in found})
    figures.write_figures(FOLDER / "figures.json", "country", [SEED], found)
    print(f"\n{figures.format_table(found)}\n\n{FOLDER}/figures.json, {FOLDER}/country.png")
    return 0 if all(figure.holds for figure in found) else 1


if __name__ == "__main__":
    sys.exit(main())
