"""Tests of kill -9 of the service while vehicles publish: every acknowledged batch is stored
exactly once.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import zenoh

from fleet_service.archive.format import reading
from fleet_service.archive.identity.pseudonyms import Pseudonyms
from schemas.config import ZenohSettings
from schemas.wire import Kind
from tests.fleet_service.app.test_service import Fleet
from tests.fleet_service.examples import SECOND, batch
from tests.waiting import PATIENCE_S, until

VEHICLES = 6
BATCHES = 60
KILLS = 3


@contextmanager
def service(router: ZenohSettings, folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Yield a service process that is ready, and end it after the `with` block."""
    config = folder / "service.json"
    config.write_text(json.dumps({"zenoh": {"connect": router.connect}, "segment_s": 0.05}))
    words = ["run", "--config", str(config), "--archive", str(folder / "archive")]
    process = subprocess.Popen(
        [sys.executable, "-m", "fleet_service.cli", *words], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready: ")
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.mark.campaign
def test_killed_service_keeps_acknowledged_reports_and_doubles_none(
    router: ZenohSettings, session: zenoh.Session, tmp_path: Path
) -> None:
    rng = np.random.default_rng(7)
    sent = [
        batch(f"sim-{vehicle:03}", seq, time.time_ns() - SECOND, [0.8, 0.7, 0.6])
        for seq in range(1, BATCHES + 1)
        for vehicle in range(VEHICLES)
    ]
    fleet = Fleet(session)
    for turn in range(KILLS + 1):
        with service(router, tmp_path) as process:
            waiting = fleet.list_unsettled(sent)
            left = 0 if turn == KILLS else len(waiting) - int(rng.integers(1, len(waiting) // 2))

            def few_enough(left: int = left) -> bool:
                for one in fleet.list_unsettled(sent)[:20]:
                    fleet.publish(one)
                return len(fleet.list_unsettled(sent)) <= left

            until(few_enough)
            for one in fleet.list_unsettled(sent):
                fleet.publish(one)
            if turn == KILLS:
                process.terminate()
                assert process.wait(PATIENCE_S) == 0
        held = list_archived(tmp_path)
        assert all(one in held for one in identities(fleet, tmp_path))
    assert len(held) == len(set(held)) == 3 * len(sent)


def identities(fleet: Fleet, folder: Path) -> list[tuple[int, int, int]]:
    """Return the identity of every row that the service acknowledged: pseudonym of the agent's
    start (boot), number of the batch (seq), and place in the batch (row).
    """
    pseudonyms = Pseudonyms(folder / "archive" / "keys")
    now = time.time_ns()
    boots = {
        name: pseudonyms.boot(name, batch(name, 1, 0, [0.8]).boot, now) for name in fleet.durable
    }
    return [
        (boots[v], seq, row)
        for v, seqs in list(fleet.durable.items())
        for seq in list(seqs)
        for row in range(3)
    ]


def list_archived(folder: Path) -> list[tuple[int, int, int]]:
    """Return the identity of every row in the archive: pseudonym of the agent's start (boot),
    number of the batch (seq), and place in the batch (row).
    """
    table = pa.concat_tables(
        reading.read_tables(folder / "archive", Kind.OBSERVATION, ["boot", "seq", "row"])
    )
    return list(zip(*(table[name].to_pylist() for name in ("boot", "seq", "row")), strict=True))
