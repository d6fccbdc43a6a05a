"""The whole way: simulated vehicles with the real estimator, their observations through the fusion, beside the truth.

The vehicles are driven by a command of the deployment, since the service does not know the agent; what it writes is
read.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet_service.fusion import Fusion, Observations, observations_of
from fleet_service.lab.drive import LATENESS_S
from fleet_service.lab.score import Scores, of_beliefs, safe
from fleet_service.serve.map_state import LOWER, UPPER, measured
from schemas import grid, mugrid, wire
from schemas.errors import InputError
from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import EXCITED_SHARE, NS

OBSERVATIONS, TRUTH = "observations.parquet", "truth.parquet"
SEVERAL: Final = 2  # vehicles of a cell that counts: the bar is the map's, and one vehicle is no map
SAME: Final = 0.02  # of friction within a cell of one surface

Drive = Callable[[Path], None]  # drives and writes both files into a folder


def command(vehicles: int, seconds: float) -> Drive:
    """A drive by `python -m deploy.whole_way`."""
    import sys

    def drive(folder: Path) -> None:
        options = ["--out", str(folder), "--vehicles", str(vehicles), "--duration", str(seconds)]
        done = subprocess.run([sys.executable, "-m", "deploy.whole_way", *options], check=False)
        if done.returncode:
            raise InputError("whole-way", "the simulated vehicles failed", "see above, or --skip-whole-way")

    return drive


def measure(drive: Drive, folder: Path) -> dict[str, float]:
    """Coverage of cells with SEVERAL vehicles, error of those among them that are measured, and the counts."""
    drive(folder / "whole_way")
    columns = read(folder / "whole_way" / OBSERVATIONS)
    visits = pq.read_table(folder / "whole_way" / TRUTH)
    fusion = Fusion(LATENESS_S)
    fusion.update(observations_in(columns))
    slots, truth = joined(fusion, visits)
    several = fusion.live.vehicles[slots] >= SEVERAL
    slots, truth = slots[several], truth[several]
    belief = fusion.beliefs(slots, int(fusion.live.time[: fusion.size].max()))
    scores = of_beliefs(belief, truth, excited(fusion, visits)[slots])
    lower, upper = (mugrid.quantiles(belief, q) for q in (LOWER, UPPER))
    with_value = measured(lower, upper, fusion.live.values[slots])
    pure = with_value & one_surface(fusion, visits)[slots]
    return _figures(scores, with_value) | {
        "fusion.whole_way.rmse.one_surface": mean(scores.error[pure] ** 2) ** 0.5,
        "fusion.whole_way.safe95": safe(scores),
        "fusion.whole_way.observations": float(len(columns["cell"])),
    }


def _figures(scores: Scores, measured: np.ndarray[Any, Any]) -> dict[str, float]:
    value = scores.taken(measured)
    return {
        "fusion.whole_way.coverage90": mean(scores.covered),
        "fusion.whole_way.rmse": mean(value.error**2) ** 0.5,
        "fusion.whole_way.coverage90.measured": mean(value.covered),
        "fusion.whole_way.bias.measured": mean(value.error),
        "fusion.whole_way.rmse.excited3": mean(value.error[value.vehicles >= 3] ** 2) ** 0.5,
        "fusion.whole_way.cells": float(len(scores.error)),
        "fusion.whole_way.cells.measured": float(measured.sum()),
    }


def mean(values: np.ndarray[Any, Any]) -> float:
    """The mean, NaN of nothing: a figure that was not measured holds no bar."""
    return float(values.mean()) if len(values) else float("nan")


def read(path: Path) -> dict[str, Any]:
    """Columns of observations as the archive would give them."""
    table, out = pq.read_table(path), {}
    for name, dtype in wire.column_types(wire.Kind.OBSERVATION).items():
        if name == "log_likelihood":
            out[name] = np.frombuffer(
                b"".join(bytes(row) for row in table[name].to_pylist() if row is not None), np.uint8
            ).reshape(table.num_rows, -1)
        else:
            out[name] = table[name].to_numpy().astype(dtype)
    return out | {"vehicle": table["vehicle"].to_numpy()}


def observations_in(columns: dict[str, Any]) -> Observations:
    """As the service would take them, each row a batch of its own."""
    n = len(columns["cell"])
    told = np.full(n, columns["log_likelihood"].shape[1] > 0)
    identity = {
        "boot": columns["vehicle"] + 1, "region": grid.region_of(columns["cell"]), "seq": np.arange(1, n + 1),
        "row": np.zeros(n, np.int32), "told": told,
    }  # fmt: skip
    return observations_of(columns | identity, columns["vehicle"])


def joined(fusion: Fusion, visits: pa.Table) -> tuple[IntArray, FloatArray]:
    """Slots that a vehicle truly visited, and their friction at the last such visit's half minute."""
    cell, sector = visits["cell"].to_numpy(), visits["sector"].to_numpy()
    time = visits["leave_time"].cast(pa.int64()).to_numpy()
    recent = time > time.max() - 30 * NS
    slot = fusion.slots_of(cell, sector.astype(np.int64))
    total, count = np.zeros((2, fusion.size)), np.zeros((2, fusion.size))
    for row, rows in enumerate((slot >= 0, (slot >= 0) & recent)):
        np.add.at(total[row], slot[rows], visits["mu"].to_numpy()[rows])
        np.add.at(count[row], slot[rows], 1)
    known = np.flatnonzero(count[0] > 0)
    row = (count[1] > 0).astype(np.int64)[known]
    return known, total[row, known] / count[row, known]


def one_surface(fusion: Fusion, visits: pa.Table) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Whether all that was truly visited of a slot had one friction, (slots,)."""
    slot = fusion.slots_of(visits["cell"].to_numpy(), visits["sector"].to_numpy().astype(np.int64))
    mu, known = visits["mu"].to_numpy(), slot >= 0
    least, most = np.full(fusion.size, np.inf), np.zeros(fusion.size)
    np.minimum.at(least, slot[known], mu[known])
    np.maximum.at(most, slot[known], mu[known])
    return np.asarray(most - least <= SAME)


def excited(fusion: Fusion, visits: pa.Table) -> IntArray:
    """Distinct vehicles that used EXCITED_SHARE of the grip in each slot, (slots,)."""
    rows = visits["utilisation"].to_numpy() >= EXCITED_SHARE
    slot = fusion.slots_of(visits["cell"].to_numpy(), visits["sector"].to_numpy().astype(np.int64))
    _, who = np.unique(visits["vehicle"].to_numpy(zero_copy_only=False), return_inverse=True)
    pairs = np.unique(np.stack([slot, who])[:, rows & (slot >= 0)], axis=1)
    return np.bincount(pairs[0], minlength=fusion.size)
