"""Compilation of the numerical functions before the service is ready. Otherwise the first vehicles
would wait for seconds while functions are compiled.
"""

from __future__ import annotations

import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

import numpy as np

from fleet_service.fusion import Fusion, Observations
from fleet_service.fusion.constants import EPOCH_NS
from fleet_service.fusion.likelihoods import at_least, bound_by_used, level_above_used
from fleet_service.fusion.reported import as_reported
from fleet_service.fusion.space import own_share
from fleet_service.fusion.witnesses import stretch_sources
from fleet_service.ingest.batch_decoder import decode_many
from fleet_service.ingest.grouping import group_rows, largest_of
from fleet_service.ingest.paths import VehiclePaths
from fleet_service.serve.alerts import Alerts
from fleet_service.serve.encode import cell_table
from schemas import mugrid, wire
from schemas.runtime.jit import kernel_cache, uses_native_kernels

CELLS: Final = 1 << 14  # more cells than a new map has space for, so that its growth is exercised
COMPILE: Final = "from fleet_service.app.precompile import exercise_map; exercise_map()"
DONE: Final = "fleet_service.compiled"  # marker file in the cache: all functions are compiled


def warm_up() -> None:
    """Load all compiled functions before they are needed. A process that takes them from a shared
    library (`native_library`) needs no more than that library.

    If they were never compiled, a separate process compiles them first. The compiler leaves a
    hundred megabytes of fragmented memory, which the service would otherwise keep for hours.
    """
    if uses_native_kernels():
        return
    done = Path(kernel_cache("fleet_service")) / DONE
    if not done.exists():
        compilation = subprocess.run(
            [sys.executable, "-c", COMPILE], stderr=subprocess.DEVNULL, check=False
        )
        if compilation.returncode == 0:
            with suppress(OSError):  # without the marker, the next start runs this process again
                done.parent.mkdir(parents=True, exist_ok=True)
                done.touch()
    exercise_map()


def exercise_map() -> None:
    """Call every compiled function once, with a small temporary map: update it with reports, let it
    grow, advance in time, update it with late reports (before and after their time is final), and
    read beliefs (probability of each friction value).
    """
    fusion = Fusion(2 * EPOCH_NS * 1e-9)
    for epoch, cells in ((1, 2), (2, CELLS), (1, 2), (9, 2), (1, 2)):
        observations = _make_visits(epoch * EPOCH_NS, cells)
        Alerts(fusion).update(fusion.update(observations).slots)
        fusion.slots_of(observations.cell, observations.sector)
    at_least(np.zeros(1))
    bound_by_used(level_above_used(np.zeros((1, mugrid.BINS), np.uint8), np.zeros(1)), np.zeros(1))
    column = np.zeros(1, np.int64)  # read-only, like an array that Arrow returns
    column.flags.writeable = False
    group, _ = group_rows(np.zeros(1, np.int64), column, column)
    largest_of(column, group, 1)
    VehiclePaths().find_implausible(column, np.zeros(1, np.int64), np.zeros(1), np.zeros(1))
    own_share(np.ones(1), np.ones(1))
    stretch_sources(fusion, np.arange(2), np.zeros(2, np.int64))
    cell_table(fusion, np.arange(2), 10 * EPOCH_NS)
    for kind in wire.Kind:
        columns = {name: np.zeros(1, dtype) for name, dtype in wire.column_types(kind).items()}
        batch = wire.Batch(kind, "precompiled", 1, 1, 1, 1, columns, "none")
        decode_many(kind, 2 * [(wire.encode(batch), wire.ENCODING[kind])])


def _make_visits(time: int, cells: int) -> Observations:
    """Return one visit (a vehicle's passage) to each of `cells` cells, each by a vehicle of its
    own.
    """
    one = np.ones(cells, np.int64)
    number = np.arange(cells)
    sector = np.zeros(cells, np.int8)
    flat = as_reported(mugrid.encode_log_likelihood(np.zeros((cells, mugrid.BINS))))
    return Observations(
        time=time * one,
        cell=number,
        sector=sector,
        second=(sector - 1).astype(np.int8),
        vehicle=number,
        boot=one,
        region=one,
        sequence=number,
        evidence=flat.steps,
        reported=flat.reported,
        used=np.full(cells, 0.9, np.float32),
        manoeuvre=np.full(cells, -1, np.int8),
        limited=np.zeros(cells, np.int8),
        share=np.ones(cells, np.float32),
    )
