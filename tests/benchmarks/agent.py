"""Benchmark of the edge agent as separate processes: time to the first answer, cost of a vehicle,
vehicles per core, and scaling with the number of jobs (worker processes of a replay).
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import gripmap
from edge_agent.app.backfill import estimate_drives, tasks_of
from edge_agent.app.estimator_factory import bank_of
from edge_agent.app.native_library import LIBRARY
from edge_agent.cli import main as edge
from edge_agent.inputs.signal_log import read_log
from schemas.runtime.figures import Figure
from schemas.vehicle import load_vehicle
from tests.benchmarks.inputs.live_benchmark import peer_addresses, run_peer, write_profile
from tests.benchmarks.measure import median_s
from tests.faults.processes import open_stage
from tests.structure import ROOT

EDGE = (sys.executable, "-m", "edge_agent.cli")
FIRST = """import sys
from pathlib import Path
from edge_agent.app.native_library import use_agent_library
from schemas.runtime.process import limit_memory
limit_memory()
use_agent_library()
from edge_agent.app.estimator_factory import bank_of
from edge_agent.inputs.signal_log import read_log
from schemas.vehicle import load_vehicle
bank = bank_of("aco-fckf", [load_vehicle(Path(sys.argv[2]))])
block = next(read_log(Path(sys.argv[1])).blocks(0))
bank.advance(block.t[:1], block.signals[:1])
"""
LOOK_S = 0.05
LIVE_S = 20.0
WARM_S = 1.0  # length of a run that only fills the cache of compiled code
START_S = 5.0  # length of a run that measures only the start
SENT = 100_000  # samples that a live source sends; the agent needs fewer
FLEET = 100
FLEET_RATE_HZ = 50
FLEET_S = 20.0
LOGS = 16
LOG_S = 60.0


def agent() -> list[Figure]:
    """Measure the edge agent's processes: start time, processor share of one vehicle, vehicles per
    core, and the replay of logs with two jobs (worker processes).
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with open_stage(folder / "stage") as stage:
            found = [*measure_live(folder, stage.endpoint), *measure_fleet(folder, stage.endpoint)]
        return [*measure_start(folder), *found, *measure_replay(folder)]


def simulate_drive(folder: Path, name: str, seed: int, seconds: float) -> tuple[Path, Path]:
    """Simulate a drive of `seconds` seconds. Return the paths of its signal log and of its vehicle
    file.
    """
    log = folder / f"{name}.parquet"
    vehicle = folder / f"{name}.json"
    files = [
        "--out",
        str(log),
        "--vehicle-out",
        str(vehicle),
        "--duration",
        str(seconds),
        "--seed",
        str(seed),
    ]
    edge(["simulate", "slalom", *files])
    return log, vehicle


def measure_start(folder: Path) -> list[Figure]:
    """Measure two times of a new process: until it has printed `--help`, and until its first
    estimate. The process is set up as by `edge-agent run`, and its compiled code is cached.
    """
    files = [str(path) for path in simulate_drive(folder, "short", 0, 2.0)]

    def run_process(*words: str) -> None:
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)

    return [
        Figure("bench.start.help_s", median_s(lambda: run_process(*EDGE, "--help")), "s", 0.4),
        Figure(
            "bench.start.first_estimate_s",
            median_s(lambda: run_process(sys.executable, "-c", FIRST, *files)),
            "s",
            0.5,
        ),
        Figure("bench.start.cold_s", measure_cold_start(folder, files), "s, without a cache", 8),
    ]


def measure_cold_start(folder: Path, files: list[str]) -> float:
    """Return the median time [s] that a new process takes to its first estimate on a machine
    without cached compiled functions and without a linker. The process runs a copy of the package
    that contains shared libraries of compiled kernels, as an installed wheel does.
    """
    package = folder / "package"
    unused = shutil.ignore_patterns("__pycache__", "*.so")
    for name in gripmap.PACKAGES:
        shutil.copytree(ROOT / name, package / name, ignore=unused)
    shutil.copy(ROOT / "gripmap.py", package)
    subprocess.run([sys.executable, "-m", LIBRARY.builder], cwd=package, check=True)

    def run_process() -> None:
        with tempfile.TemporaryDirectory() as empty:
            own = os.environ | {"PATH": empty, "XDG_CACHE_HOME": empty, "NUMBA_CACHE_DIR": empty}
            subprocess.run([sys.executable, "-c", FIRST, *files], cwd=package, env=own, check=True)

    return median_s(run_process)


def measure_usage(folder: Path, endpoint: str, *words: str) -> tuple[float, float]:
    """Run a command of the edge agent in a process. Return its processor time [s] and its peak
    resident memory [MB].

    Raises:
        ArithmeticError: the command left reports without acknowledgement, so the measured cost
            would be too low.
    """
    config = folder / "agent.json"
    config.write_text(
        json.dumps({"zenoh": {"connect": [endpoint]}, "spool": str(folder / "spool.sqlite")})
    )
    with (folder / "out").open("w+") as out:
        process = subprocess.Popen(
            [*EDGE, *words, "--config", str(config)], stdout=out, stderr=subprocess.DEVNULL
        )
        peak, cost = watch_memory(process.pid)
        out.seek(0)
        counted = json.loads(out.read().splitlines()[-1])
    if counted["unsettled"]:
        raise ArithmeticError(f"{counted['unsettled']} batches were left unsettled")
    return cost.ru_utime + cost.ru_stime, peak


def watch_memory(pid: int) -> tuple[float, resource.struct_rusage]:
    """Wait until a process ends. Return its peak resident memory [MB], which is sampled until then,
    and its resource usage.

    The peak that the system reports cannot be used: it begins at the fork, when the memory was
    still that of the parent.
    """
    peak = 0.0
    gone = 0
    status = Path(f"/proc/{pid}/status")
    while not gone:
        found = [
            int(line.split()[1])
            for line in status.read_text().splitlines()
            if line.startswith("VmHWM")
        ]
        peak = max([peak, *(kilobytes * 1024 / 1e6 for kilobytes in found)])
        time.sleep(LOOK_S)
        gone, _, cost = os.wait4(pid, os.WNOHANG)
    return peak, cost


def measure_live(folder: Path, endpoint: str) -> list[Figure]:
    """Measure the processor time of one vehicle at 100 Hz. It is the difference between the
    processor times of a long and a short run, so the start of the process does not count.
    """
    log, vehicle = simulate_drive(folder, "live", 0, START_S + LIVE_S + 1.0)
    words = (
        "run",
        "--source",
        str(log),
        "--vehicle",
        str(vehicle),
        "--trust",
        "--name",
        "bench-car",
        "--duration",
    )
    measure_usage(folder, endpoint, *words, str(WARM_S))
    short, _ = measure_usage(folder, endpoint, *words, str(START_S))
    long, memory = measure_usage(folder, endpoint, *words, str(START_S + LIVE_S))
    return [
        Figure("bench.agent.core_share", (long - short) / LIVE_S, "of a core, 100 Hz", 0.03),
        Figure("bench.agent.resident_mb", memory, "MB, with a log as source", 130),
        Figure("bench.agent.live_mb", measure_live_source(folder, endpoint, vehicle), "MB", 100),
    ]


def measure_live_source(folder: Path, endpoint: str, vehicle: Path) -> float:
    """Return the peak resident memory [MB] of an agent whose signals come from ROS 2 topics."""
    place, source = peer_addresses("ros2")
    profile, dbc = write_profile("ros2", folder)
    words = ("--source", source, "--profile", profile, "--dbc", str(dbc), "--vehicle", str(vehicle))
    with run_peer("ros2", place, SENT) as sender:
        sender.wait_for("ready")
        sender.send_go()
        live = ("run", *words, "--trust", "--name", "live-car", "--duration", str(START_S))
        return measure_usage(folder, endpoint, *live)[1]


def measure_fleet(folder: Path, endpoint: str) -> list[Figure]:
    """Measure how many vehicles one core can simulate, estimate and publish in real time, from the
    processor time of a whole fleet.
    """
    words = ("fleet", "--rate", str(FLEET_RATE_HZ), "--vehicles", str(FLEET), "--duration")
    measure_usage(folder, endpoint, *words, str(WARM_S))
    short, _ = measure_usage(folder, endpoint, *words, str(START_S))
    long, _ = measure_usage(folder, endpoint, *words, str(START_S + FLEET_S))
    return [
        Figure(
            "bench.fleet.vehicles",
            FLEET * FLEET_S / (long - short),
            "vehicles at 50 Hz on a core",
            200,
            "more",
        )
    ]


def measure_replay(folder: Path) -> list[Figure]:
    """Replay logs with one job and with two (worker processes), including the writing of Parquet.
    Return two figures: the rate of two jobs divided by twice that of one job, and divided by twice
    the rate of the compiled estimator alone on one core.
    """
    logs = [simulate_drive(folder, f"log-{seed:02d}", seed, LOG_S) for seed in range(LOGS)]
    log = read_log(logs[0][0])
    vehicle = load_vehicle(logs[0][1])
    block = next(log.blocks(0))
    kernel = LOGS * median_s(
        lambda: bank_of("aco-fckf", [vehicle]).advance(block.t, block.signals), 3
    )
    tasks = tasks_of([log for log, _ in logs], None, folder / "estimates")
    one = median_s(lambda: list(estimate_drives(tasks, "aco-fckf", 1)), 3)
    two = median_s(lambda: list(estimate_drives(tasks, "aco-fckf", 2)), 3)
    return [
        Figure(
            "bench.replay.scaling", one / (2 * two), "rate of two jobs over twice one", 0.93, "more"
        ),
        Figure(
            "bench.replay.efficiency",
            kernel / (2 * two),
            "of two cores at the kernel's speed",
            0.5,
            "more",
        ),
    ]
