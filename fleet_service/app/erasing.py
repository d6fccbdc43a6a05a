"""Erasure of data in a running service. The thread of the background jobs handles the requests of
`archive.identity.erasure_requests`. (A segment is a file of new rows, a checkpoint a saved state of
the service.)

    1. The service completes a segment, so that all rows that it has accepted are on disk.
    2. A separate process removes the vehicle's rows from the files. It then reads all other rows up
       to this segment, and writes a checkpoint computed from them.
    3. Between two later segments, the service drops its state. It loads the new checkpoint and the
       segments written since step 1.

Checkpoints, snapshots of the map, retention (removal of old rows) and compaction (merging of files)
run in the same thread, so none of them sees an incomplete erasure. Other processes wait for the
compaction lock. During step 3, messages wait as long as a start from a checkpoint takes. If the
service dies during the erasure, its next start finds the request, and no checkpoint contains the
vehicle. Later measurements of the vehicle are accepted as new.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from fleet_service.app import subprocess_job
from fleet_service.app.engine import Engine
from fleet_service.app.state import load_state
from fleet_service.archive.format.layout import Cut
from fleet_service.archive.identity import erasure_requests
from fleet_service.archive.identity.erasure_requests import Erasure
from fleet_service.archive.maintenance.retention import (
    destroy_key,
    erase_files,
    forget_witness,
    key_of,
)
from fleet_service.ingest import weather
from fleet_service.replay import checkpoints
from fleet_service.replication.replica import BucketReplica
from schemas.config import ServiceConfig
from schemas.errors import InputError


def handle_requests(
    engine: Engine, config: ServiceConfig, root: Path, stop: threading.Event
) -> str | None:
    """Handle the waiting erasure requests. Return a line about them for the operator, or None if no
    request was carried out.
    """
    rows = 0
    answered = 0
    for path in erasure_requests.open_requests(root):
        try:
            outcome = _run_erasure(engine, config, root, erasure_requests.read_request(path), stop)
        except InputError as error:
            erasure_requests.answer_request(path, error)
            continue
        if outcome is None:  # the service is stopping; it carries out the request after a restart
            break
        if engine.copy is not None:
            outcome["copy"] = _erase_in_copy(engine.copy)
        erasure_requests.answer_request(path, outcome)
        rows += outcome["rows"]
        answered += 1
    return f"erased: {answered} requests, {rows} rows" if answered else None


def _erase_in_copy(copy: BucketReplica) -> str | None:
    """Remove the erased data from the archive's copy in a bucket (object store) too. Return None on
    success, else the reason why the copy still contains some of the data; a background job then
    removes them later.
    """
    try:
        copy.sync()
    except OSError as error:
        return str(error)
    return None


def _run_erasure(
    engine: Engine, config: ServiceConfig, root: Path, erasure: Erasure, stop: threading.Event
) -> dict[str, Any] | None:
    """Carry out one request to erase data, and return its result; None if the service stops before
    the end.

    Raises:
        InputError: the archive has no key for the month of the request, or a file is damaged.
        OSError: a file cannot be read or written; the erasure is tried again later.
    """
    key_of(root, erasure.month)
    vehicle = erasure.vehicle
    if vehicle is None:
        destroyed = _reload_service(
            engine, lambda: destroy_key(root, erasure.month, engine.state.streams.newest), stop
        )
        return {"rows": 0, "files": []} if destroyed else None
    cut = engine.settlement.run_between_segments(lambda: engine.settlement.newest_segment, stop)
    if cut is None:
        return None
    request = json.dumps(
        {
            **asdict(erasure),
            "config": config.model_dump(mode="json", exclude={"archive"}),
            "cut": cut,
        }
    )
    output = subprocess_job.run_module(
        "erasure", "fleet_service.app.erasing_process", [str(root)], stop, request
    )
    if output is None:
        return None
    answer: dict[str, Any] = json.loads(output)
    return (
        answer
        if _reload_service(engine, lambda: forget_witness(root, vehicle, erasure.month), stop)
        else None
    )


def _reload_service(
    engine: Engine, before: Callable[[], None], stop: threading.Event
) -> bool | None:
    """Call the function `before`, which changes the archive, then load the service's state again.
    This happens between two segments (files of new rows), so all accepted rows are on disk. Return
    True, or None if the service stops first.
    """

    def work() -> bool:
        engine.reload_state(before)
        return True

    return engine.settlement.run_between_segments(work, stop)


def run_erasure_process(root: Path, request: dict[str, Any]) -> dict[str, Any]:
    """Remove the vehicle's rows that `request` names from the archive, and save a checkpoint (saved
    state of the service) without them. This part of an erasure runs in a separate process. Return
    the number of removed rows and the changed files.

    Raises:
        InputError, OSError: a file is damaged, or cannot be read or written.
    """
    # A file that arrives after this call is read twice, which does not change the result.
    known = weather.weather_files(root)
    with erase_files(root, request["vehicle"], request["month"]) as done:
        cut = Cut(*request["cut"])
        checkpoints.save_checkpoint(
            root, load_state(root, ServiceConfig(**request["config"]), until=cut).image(cut, known)
        )
    return {"rows": done.rows, "files": [str(path.relative_to(root)) for path in done.files]}
