"""Recordings with a deliberate fault, replayed as by a new user. The replay must mention each
fault.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import pyarrow as pa
import pyarrow.parquet as pq

import edge_agent.cli
from schemas.signals import CHANNELS
from tests.benchmarks.inputs.planted import PLANTED, Recorded, drives

TONNES: Final = "mass in tonnes"
WRONG: Final = (  # faults that once caused undetected false ice or wrong positions, and three more
    "steering in deg",
    "steering wheel",
    "both in g",
    "wheels in km/h",
    "a_y flipped",
    "yaw rate in deg/s",
    TONNES,
    "latitude and longitude",
    "compass for yaw",
    "time in ms",
    "wheels in rpm",
    "a_x flipped",
)


def find_unnoticed(folder: Path, names: Sequence[str], seed: int) -> list[str]:
    """Return the faults that `edge-agent replay` does not mention, plus a message if it complains
    about the correct drive.
    """
    drive = drives(1, seed, rough=False)[0]
    out = [] if not _has_warned(folder, drive) else ["the sound drive is suspected"]
    return out + [name for name in names if not _has_warned(folder, _spoil_drive(name, drive))]


def _spoil_drive(name: str, drive: Recorded) -> Recorded:
    if name != TONNES:
        return PLANTED[name].spoil(drive)
    return drive._replace(
        vehicle=drive.vehicle.model_copy(update={"mass": drive.vehicle.mass / 1000.0})
    )


def _has_warned(folder: Path, drive: Recorded) -> bool:
    t, signals, vehicle = drive
    columns = {name: pa.array(signals[:, k], from_pandas=True) for k, name in enumerate(CHANNELS)}
    pq.write_table(pa.table({"t": pa.array(t), **columns}), folder / "wrong.parquet")
    (folder / "wrong.json").write_text(vehicle.model_dump_json(exclude_none=True))
    stderr = io.StringIO()
    words = [
        "replay",
        str(folder / "wrong.parquet"),
        "--estimator",
        "sr-ukf",
        "--out",
        str(folder / "e.parquet"),
    ]
    with contextlib.redirect_stderr(stderr), contextlib.redirect_stdout(io.StringIO()):
        code = edge_agent.cli.main(words)
    return code == 2 or "warning: " in stderr.getvalue()
