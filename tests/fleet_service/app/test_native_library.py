"""Test of the service's shared library of kernels (compiled functions). It must give the results of
Numba, for all that a service does.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

# Modules that a service with native kernels must not load.
HEAVY = ("llvmlite", "numba", "pandas", "scipy")
DRIVE = """import hashlib, pathlib, sys
BEFORE
import numpy as np
from fleet_service.app.engine import Engine
from fleet_service.ingest.inbox import Message
from schemas import keys, wire
from schemas.config import ServiceConfig
from schemas.query import MapQuery
from tests.faults.load import make_visits

NOW = 1_800_000_000 * 10**9
digest = hashlib.sha256()
root = pathlib.Path(sys.argv[1])
counts = []
# The second engine restarts from the archive of the first one.
for number in range(2):
    engine = Engine(ServiceConfig(), root)
    rng = np.random.default_rng(number)
    # Minutes after the first visits. The last visits come too late to be fused in order.
    for minutes in (0, 4, 9, 1):
        now = NOW + (30 * number + minutes) * 60 * 10**9
        columns = make_visits(rng, np.zeros(400, np.int64), now, 256).columns
        home = columns["cell"] >> 22
        messages = []
        for row in np.flatnonzero(home == home[0]):
            taken = {name: column[row : row + 1] for name, column in columns.items()}
            name = f"sim-{number}-{minutes}-{row}"
            region = int(home[0])
            batch = wire.Batch(wire.Kind.OBSERVATION, name, 1, region, 1, 1, taken, "test")
            key, encoding = keys.observation_key(region, name), wire.ENCODING[batch.kind]
            messages.append(Message(batch.kind, key, wire.encode(batch), encoding))
        engine.intake.ingest(messages, max(now, NOW + 30 * number * 60 * 10**9))
        engine.settlement.flush()
    for tile in engine.queries.take_changed(now):
        digest.update(repr(engine.queries.first_tiles([tile], now)).encode())
    box = MapQuery(bbox=(-180.0, -85.0, 180.0, 85.0))
    digest.update(repr(list(engine.queries.answer(box, lambda tile: True, now))).encode())
    engine.alerts.expire(now)
    fusion = engine.state.fusion
    slots = np.arange(fusion.size)
    for array in (fusion.live.key[slots], fusion.beliefs(slots, now), fusion.live.values[slots]):
        digest.update(np.ascontiguousarray(array).tobytes())
    counts.append(fusion.size)
    engine.close()
print(digest.hexdigest(), *counts)
print(*[name for name in HEAVY if name in sys.modules])
"""
NATIVE = """
from fleet_service.app import UNUSED
from schemas.runtime.process import limit_memory
limit_memory(*UNUSED)  # as a service's process begins
from fleet_service.app.native_library import use_service_library
assert use_service_library()
"""


def drive_with(before: str) -> str:
    return f"HEAVY = {HEAVY}\n" + DRIVE.replace("BEFORE", before)


def run_python(code: str, folder: Path) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", code, str(folder)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.campaign
def test_a_native_service_gives_the_same_bits_without_numba(tmp_path: Path) -> None:
    """A service that takes its kernels from the shared library must publish the same tiles and
    answers, and hold the same beliefs, as one whose kernels Numba compiles, bit by bit. This
    includes late reports and a restart. It must not import the modules in HEAVY.
    """
    native, loaded = run_python(drive_with(NATIVE), tmp_path / "native")
    # Beliefs depend on the vehicles' pseudonyms, so both archives have the same keys.
    shutil.copytree(tmp_path / "native" / "keys", tmp_path / "numba" / "keys")
    by_numba, _ = run_python(drive_with(""), tmp_path / "numba")
    assert native == by_numba
    assert int(native.split()[1]) > 100
    assert loaded == ""
