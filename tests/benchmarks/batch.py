"""`make batch-bench`: what batch work makes of an archive, beside the archive; writes .batch/figures.json."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Final

from schemas.runtime import figures
from schemas.runtime.figures import Figure
from tests.benchmarks import iceberg
from tests.house import ROOT

FOLDER: Final = ROOT / ".batch"


def main() -> int:
    """Measure; 1 where a bar does not hold."""
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        rows = [Figure("iceberg.rows_different", iceberg.measured(Path(folder)), "rows", 0.0)]
    figures.write(FOLDER / "figures.json", "batch", iceberg.SEEDS, rows)
    print(figures.markdown(rows))
    return 0 if all(row.holds for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
