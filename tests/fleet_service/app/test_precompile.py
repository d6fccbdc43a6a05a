"""Tests that the service compiles no function after it has reported that it is ready. Vehicles
would have to wait for the compilation.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from fleet_service.app import precompile

SCRIPT = """
import gc, pathlib, tempfile, time
from numba.core.dispatcher import Dispatcher
from fleet_service.app.engine import Engine
from fleet_service.ingest.inbox import Message
from fleet_service.app.precompile import warm_up
from schemas import keys, wire
from schemas.config import ServiceConfig
from schemas.query import MapQuery
from tests.faults.load import make_visits
import numpy as np

def kernels():
    found = [d for d in gc.get_objects() if isinstance(d, Dispatcher)]
    ours = [d for d in found if d.py_func.__module__.startswith("fleet_service")]
    return {(d.py_func.__name__, str(signature)) for d in ours for signature in d.signatures}

def drive(root):
    engine = Engine(ServiceConfig(), root)
    rng = np.random.default_rng(0)
    columns = make_visits(rng, np.zeros(8000, np.int64), time.time_ns(), 256).columns
    home = columns["cell"] >> 22
    mine = np.flatnonzero(home == home[0])
    messages = []
    # each visit by a vehicle of its own, because no vehicle can be at all these places
    for row in mine:
        taken = {name: column[row : row + 1] for name, column in columns.items()}
        name = f"sim-{row}"
        batch = wire.Batch(wire.Kind.OBSERVATION, name, 1, int(home[0]), 1, 1, taken, "test")
        key, encoding = keys.observation_key(int(home[0]), name), wire.ENCODING[batch.kind]
        messages.append(Message(batch.kind, key, wire.encode(batch), encoding))
    for start in range(0, len(messages), 40):
        engine.intake.ingest(messages[start : start + 40], time.time_ns())
    engine.settlement.flush()
    now = time.time_ns()
    changed = engine.queries.take_changed(now)
    assert all(engine.queries.first_tiles([tile], now)[tile] for tile in changed)
    engine.alerts.expire(time.time_ns())
    list(engine.queries.answer(MapQuery(), lambda tile: True, time.time_ns()))
    assert engine.state.fusion.size > 2100, engine.counts
    engine.close()

warm_up()
warm = kernels()
root = pathlib.Path(tempfile.mkdtemp())
drive(root)
drive(root)
print(sorted(kernels() - warm))
"""


@pytest.mark.campaign
def test_ready_service_compiles_no_kernel() -> None:
    completed = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=False
    )
    assert completed.stdout.strip() == "[]", completed.stdout + completed.stderr


def test_missing_kernels_are_compiled_once_by_a_separate_process(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ran = tmp_path / "ran"
    monkeypatch.setattr(precompile, "kernel_cache", lambda package: str(tmp_path / package))
    monkeypatch.setattr(precompile, "COMPILE", "raise SystemExit(1)")
    precompile.warm_up()
    monkeypatch.setattr(precompile, "COMPILE", f"open({str(ran)!r}, 'a').write('once')")
    for _ in range(3):
        precompile.warm_up()
    assert ran.read_text() == "once"
