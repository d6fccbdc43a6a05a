"""Writer of a file with the true friction of a simulated fleet's roads: one row per passage of a
map cell (visit), for comparison with the map.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from schemas import grid
from schemas.numeric import FloatArray, IntArray
from schemas.tables import F64, I8, I64, NS, Field, arrow_schema

TRUTH: Final = (
    Field("vehicle", pa.string(), "-", "name of the simulated vehicle"),
    Field("enter_time", NS, "ns since 1970, UTC", "first sample in the cell"),
    Field("leave_time", NS, "ns since 1970, UTC", "last sample in the cell"),
    Field("cell", I64, "quadint z21", "true cell"),
    Field("sector", I8, "0 east, 1 north, 2 west, 3 south", "true heading sector"),
    Field("mu", F64, "-", "peak adhesion under the wheels, mean of wheels and samples"),
    Field("utilisation", F64, "-", "largest share of the grip used, any wheel"),
)


@dataclass
class _Visit:
    cell: int
    sector: int
    enter: int
    leave: int = 0
    samples: int = 0
    mu: float = 0.0
    utilisation: float = 0.0


@dataclass
class TruthRecorder:
    """Recorder of the true friction per visit (passage of a map cell) of the named vehicles. It
    receives the samples block by block.
    """

    names: tuple[str, ...]
    rows: list[tuple[str, _Visit]] = field(default_factory=list)
    _open: dict[int, _Visit] = field(default_factory=dict)

    def add(
        self,
        time: IntArray,
        position: tuple[FloatArray, FloatArray],
        yaw: FloatArray,
        mu: FloatArray,
        used: FloatArray,
    ) -> None:
        """Add one block of T samples: time [ns UTC], position (latitude, longitude) [deg] and yaw
        [rad], (T, N) each; friction, and the used share of the friction, per wheel, (T, N, 4).
        """
        cells = grid.cell_of(*position)
        sectors = grid.sector_of(yaw)
        mean = mu.mean(axis=-1)
        largest = used.max(axis=-1)
        changes = (np.diff(cells, axis=0) != 0) | (np.diff(sectors, axis=0) != 0)
        for n in range(len(self.names)):
            edges = [0, *(np.flatnonzero(changes[:, n]) + 1).tolist(), len(time)]
            for first, last in pairwise(edges):
                visit = self._visit_of(
                    n, int(cells[first, n]), int(sectors[first, n]), int(time[first, n])
                )
                visit.leave = int(time[last - 1, n])
                visit.samples += last - first
                visit.mu += float(mean[first:last, n].sum())
                visit.utilisation = max(visit.utilisation, float(largest[first:last, n].max()))

    def _visit_of(self, n: int, cell: int, sector: int, time: int) -> _Visit:
        visit = self._open.get(n)
        if visit is None or (visit.cell, visit.sector) != (cell, sector):
            visit = _Visit(cell, sector, time)
            self._open[n] = visit
            self.rows.append((self.names[n], visit))
        return visit

    def write(self, path: Path) -> None:
        """Write all recorded visits as a Parquet file, including visits that have not ended."""
        visits = [visit for _, visit in self.rows]
        columns: dict[str, list[str] | list[int] | list[float]] = {
            "vehicle": [name for name, _ in self.rows],
            "enter_time": [v.enter for v in visits],
            "leave_time": [v.leave for v in visits],
            "cell": [v.cell for v in visits],
            "sector": [v.sector for v in visits],
            "mu": [v.mu / v.samples for v in visits],
            "utilisation": [v.utilisation for v in visits],
        }
        pq.write_table(pa.Table.from_pydict(columns, schema=arrow_schema(*TRUTH)), path)
