"""`make batch-bench`: benchmark of work on many files at once. Spark estimates the friction of
recorded drives and rebuilds a map; the results are compared with those of one process. Iceberg
tables are compared with the archive's files. Writes `.batch/figures.json`.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Final

from schemas.runtime import figures
from schemas.runtime.figures import Figure
from tests.benchmarks import iceberg, spread
from tests.structure import ROOT

FOLDER: Final = ROOT / ".batch"


def measure_all(folder: Path) -> list[Figure]:
    """Run all benchmarks of this module, and return their figures: differences between the results
    of Spark and of one process, differing rows of Iceberg tables, and the speed-up of Spark by a
    second core. Temporary files are written to `folder`.
    """
    logs = spread.simulate_drives(folder / "drives")
    return [
        Figure(
            "iceberg.rows_different", iceberg.count_different_rows(folder / "iceberg"), "rows", 0.0
        ),
        Figure(
            "spark.replay.difference",
            spread.replay_difference(logs, folder / "replay"),
            "files",
            0.0,
        ),
        Figure("spark.rebuild.difference", spread.rebuild_difference(folder / "rebuild"), "", 1e-6),
        Figure(
            "spark.replay.scaling", spread.replay_scaling(logs, folder / "scaling"), "", 1.8, "more"
        ),
    ]


def main() -> int:
    """Run the benchmarks of work on many files at once (Spark, Iceberg), and write and print the
    figures. Return 1 if a figure misses its target, otherwise 0.
    """
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        rows = measure_all(Path(folder))
    figures.write_figures(FOLDER / "figures.json", "batch", (*iceberg.SEEDS, *spread.SEEDS), rows)
    print(figures.format_table(rows))
    return 0 if all(row.holds for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
