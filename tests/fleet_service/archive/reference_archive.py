"""Reference archive: a small archive with every kind of file that a service writes, and the map
that it gave when it was written.

    python -m tests.fleet_service.archive.reference_archive [--map] FOLDER

Without --map, write a new archive and its map with the present code. With --map, read an existing
archive, and write only its map, after the fusion has changed.

Commit 1f90692 wrote `data/v1.0`, before files had a version. A stored archive is never written
again, because later code must still be able to read it.

The archive has eight vehicles in two zones (map squares of zoom 7), around midnight. It contains
compacted (sorted) rows with hourly statistics and a map snapshot, a checkpoint (saved state), and
later segments (files of new rows). The rows report dry road, ice and lower bounds; some came too
late. There are also states and a weather report.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from fleet_service.app.engine import Engine
from fleet_service.archive.format import snapshots
from fleet_service.archive.maintenance import rollup
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.archive.maintenance.retention import drop_checkpoints
from fleet_service.ingest.inbox import Message
from fleet_service.ingest.weather import WeatherMessage
from fleet_service.serve.encode import cell_table
from schemas import grid, keys, weather, wire
from schemas.config import ServiceConfig
from schemas.wire import Batch, Kind
from tests.fleet_service.checkpoint_writer import save_checkpoint
from tests.fleet_service.examples import SECOND, batch
from tests.schemas.examples import encode_weather

DATA: Final = Path(__file__).parent / "data"
MIDNIGHT: Final = 20_001 * 86_400 * SECOND
PLACES: Final = ((57.7, 11.97), (48.1, 11.6))  # places in two zones
VEHICLES: Final = 8
ROUNDS: Final = 12  # half of the rounds lie before midnight and before the checkpoint
ROUND_NS: Final = 40 * SECOND
COLUMNS: Final = (
    "cell",
    "sector",
    "mu",
    "mu_lower",
    "mu_upper",
    "p_slippery",
    "basis",
    "vehicles",
    "observations",
)


def now_of(turn: int) -> int:
    """Return the time [ns] at which the service receives the messages of the round number `turn`. A
    round is one step of the simulated drive.
    """
    return MIDNIGHT + (turn - ROUNDS // 2) * ROUND_NS


def make_observations(turn: int, vehicle: int) -> Batch:
    """Return the observations that a vehicle sends in round `turn` (step of the simulated drive).
    Every second cell is icy; every third vehicle reports only lower bounds of friction.
    """
    rng = np.random.default_rng([turn, vehicle])
    latitude, longitude = PLACES[vehicle % 2]
    step = int(rng.integers(0, 4))
    latitude += 2e-4 * step
    cell = int(grid.cell_of(latitude, longitude))
    mu = [(0.2 if step % 2 else 0.8) + float(x) for x in rng.normal(0.0, 0.03, 2)]
    late = 600 * SECOND if (turn, vehicle) == (9, 4) else 0
    where = {"latitude": [latitude] * 2, "longitude": [longitude] * 2, "cell": [cell] * 2}
    with_likelihood = vehicle % 3 > 0
    one = batch(
        f"sim-{vehicle:03}",
        turn + 1,
        now_of(turn) - SECOND - late,
        mu,
        with_likelihood=with_likelihood,
        used=None if with_likelihood else 0.15,
        **where,
    )
    return replace(one, region=int(grid.region_of(cell)))


def make_state(turn: int, vehicle: int) -> Batch:
    """Return the state (position and motion) that a vehicle sends in round `turn` (step of the
    simulated drive).
    """
    latitude, longitude = PLACES[vehicle % 2]
    values = {
        "time": now_of(turn) - SECOND,
        "latitude": latitude,
        "longitude": longitude,
        "yaw": 0.1,
        "vx": 15.0,
    }
    types = wire.column_types(Kind.STATE)
    columns = {name: np.array([value]).astype(types[name]) for name, value in values.items()}
    region = int(grid.region_of(grid.cell_of(latitude, longitude)))
    return Batch(Kind.STATE, f"sim-{vehicle:03}", 7, region, turn + 1, 1, columns, "ckf")


def make_messages(turn: int) -> Iterator[Message]:
    """Yield all messages that the vehicles send in round `turn` (step of the simulated drive)."""
    for vehicle in range(VEHICLES):
        for one, key in (
            (make_observations(turn, vehicle), keys.observation_key),
            (make_state(turn, vehicle), keys.state_key),
        ):
            yield Message(
                one.kind, key(one.region, one.vehicle), wire.encode(one), wire.ENCODING[one.kind]
            )


def read_map(engine: Engine, at: int) -> dict[str, Any]:
    """Return the map at the time `at`: for every cell its columns and its belief (probabilities of
    friction), sorted by cell and heading sector.
    """
    fusion = engine.state.fusion
    slots = np.lexsort((fusion.sector[: fusion.size], fusion.cell[: fusion.size]))
    lines = cell_table(fusion, slots, at).select(COLUMNS).to_pylist()
    return {
        "at": at,
        "cells": lines,
        "beliefs": np.asarray(fusion.beliefs(slots, at), np.float64).tolist(),
    }


def write_reference_archive(root: Path) -> dict[str, Any]:
    """Write the reference archive, and return its final map, alerts and rows."""
    with closing(Engine(ServiceConfig(), root)) as engine:
        for turn in range(ROUNDS):
            if turn == 2:
                report = encode_weather(
                    weather.Report(now_of(2), air_temperature=-3.0, precipitation=1.0)
                )
                region = int(grid.region_of(grid.cell_of(*PLACES[0])))
                engine.intake.weather.enqueue(
                    WeatherMessage(keys.weather_key(region), report, wire.WEATHER_ENCODING)
                )
                engine.intake.update_weather(now_of(2))
            engine.intake.ingest(list(make_messages(turn)), now_of(turn))
            if turn % 2:
                engine.settlement.flush()
            if turn == ROUNDS // 2 - 1:
                compact(root)
                rollup.complete_parts(root)
                snapshots.write_snapshot(root, engine.queries.whole_map(now_of(turn)), now_of(turn))
                save_checkpoint(engine)
        rows = {str(kind): engine.counts.rows[kind] for kind in Kind}
        return read_map(engine, now_of(ROUNDS)) | {
            "alerts": engine.alerts.count,
            "late": engine.counts.late,
            "rows": rows,
        }


def read_again(root: Path, found: dict[str, Any]) -> dict[str, Any]:
    """Return the map, alerts and rows `found` of the reference archive in the folder `root`, with
    the map and the number of alerts that the present code computes from the archive's rows.
    """
    with tempfile.TemporaryDirectory() as copy:
        archive = Path(shutil.copytree(root, Path(copy) / "archive"))
        drop_checkpoints(archive)
        with closing(Engine(ServiceConfig(), archive)) as engine:
            return found | read_map(engine, found["at"]) | {"alerts": engine.alerts.count}


def main() -> None:
    """Create the reference archive in the folder named on the command line, or only its map."""
    folder = Path(sys.argv[-1])
    maps = folder / "map.json"
    if "--map" in sys.argv:
        maps.write_text(json.dumps(read_again(folder / "archive", json.loads(maps.read_text()))))
        return
    found = write_reference_archive(folder / "archive")
    (folder / "lock").unlink(missing_ok=True)
    maps.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
