"""Tests of the agent's shared library of kernels (compiled functions). It must give the results of
Numba. If it cannot be built or loaded, Numba must take its place.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from edge_agent.app import native_library
from edge_agent.lab.simulation import SimulatedFleet
from schemas.runtime import jit, kernel_library
from schemas.runtime.shipped_library import FEATURES

# Modules that an agent with native kernels must not load.
HEAVY = ("grpc", "llvmlite", "numba", "pandas", "pyarrow", "rich", "scipy", "yaml")
LEVEL = next(iter(FEATURES))
VEHICLES = 2
DRIVE = f"""import hashlib, sys
import numpy as np
{{before}}
from edge_agent.app.estimator_factory import bank_of
from edge_agent.inputs.block import Block
from edge_agent.inputs.driving_direction import sign_wheels
from edge_agent.observe.pipeline import Pipeline
from schemas.config import AgentConfig
from schemas.signals import CONTEXT
from schemas.vehicle import load_vehicle

drive = np.load(sys.argv[1])
t = drive["t"]
signals = drive["signals"]
context = np.random.default_rng(0).integers(0, 2, (*t.shape, len(CONTEXT))).astype(float)
vehicle = load_vehicle("class:compact")
bank = bank_of("aco-fckf", [vehicle] * {VEHICLES})
pipeline = Pipeline(bank, {VEHICLES}, AgentConfig())
digest = hashlib.sha256()
digest.update(sign_wheels(t[:, 0].copy(), signals[:, 0].copy(), vehicle).tobytes())
records = 0
for first in range(0, len(t), 10):
    part = slice(first, first + 10)
    flags = context[part] if first % 200 < 100 else None
    block = Block(t[part], np.rint(t[part] * 1e9).astype(np.int64), signals[part], flags)
    estimates, *kinds = pipeline.step(block)
    arrays = [getattr(estimates, name) for name in type(estimates).__slots__]
    arrays += [column for kind in kinds for column in kind.columns.values()]
    for array in (*arrays, *pipeline.beliefs()):
        digest.update(b"" if array is None else np.ascontiguousarray(array).tobytes())
    records += sum(len(kind.vehicle) for kind in kinds)
last = pipeline.finish()
for column in last.columns.values():
    digest.update(column.tobytes())
print(digest.hexdigest(), records + len(last.vehicle))
"""
# Replace the folder of the wheel's libraries by one that contains a library for other sources.
# Loading that library would crash.
NATIVE = """
from pathlib import Path
from edge_agent.app import native_library
kernels = Path(sys.argv[1]).parent / "kernels"
assert native_library.LIBRARY._replace(shipped=kernels).use()
"""
LOADED = f"""
import edge_agent.app.trip, edge_agent.cli.live, edge_agent.cli.run, edge_agent.publish.publisher
import edge_agent.app.agent, edge_agent.inputs.live.rows, edge_agent.inputs.live.sources
print(*[name for name in {HEAVY} if name in sys.modules])
"""


def write_library(folder: Path, name: str) -> Path:
    """Write a file that is no library into a new folder, and return its path."""
    folder.mkdir()
    path = folder / name
    path.write_bytes(b"no library")
    return path


def run_python(code: str, *words: str) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()


@pytest.mark.campaign
def test_a_native_agent_gives_the_same_bits_without_numba(tmp_path: Path) -> None:
    """The shared library and Numba must give the same estimates, records and beliefs of a drive,
    bit by bit. The process that uses the library must not import the modules in HEAVY.

    At first, the folder `kernels` contains a file that is no valid library. According to the digits
    in its name, it was built from other source files. The agent must not load it.
    """
    write_library(tmp_path / "kernels", f"edge_agent-0123456789abcdef-{LEVEL}.so")
    t, signals = SimulatedFleet("hills", VEHICLES, 3, 100.0, rough=0.5, winter=0.5).step(2000)
    drive = str(tmp_path / "drive.npz")
    np.savez(drive, t=t, signals=signals)
    native, loaded = run_python(DRIVE.format(before=NATIVE) + LOADED, drive)
    (by_numba,) = run_python(DRIVE.format(before=""), drive)
    assert native == by_numba
    assert int(native.split()[1]) > 20
    assert loaded == ""


@pytest.mark.parametrize("missing", ["linker", "folder"])
def test_without_a_linker_or_a_folder_numba_compiles(
    missing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", os.fspath(tmp_path) if missing == "linker" else os.environ["PATH"])
    monkeypatch.setattr(
        kernel_library,
        "native_library_path",
        lambda _: tmp_path / "library.so" if missing == "linker" else None,
    )
    assert not native_library.LIBRARY._replace(shipped=tmp_path).use()
    assert jit._Native.library is None


def test_a_library_that_cannot_be_loaded_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_library(tmp_path / "cache", "library.so")
    monkeypatch.setattr(kernel_library, "native_library_path", lambda _: path)
    assert not native_library.LIBRARY._replace(shipped=tmp_path / "kernels").use()
    assert jit._Native.library is None
