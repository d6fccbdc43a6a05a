"""`python -m deploy.precompile [papers]`: compile frequently used functions once for this machine.

`make setup` ends with this command, which compiles the functions of service, agent and simulated
vehicle, so that their first start does not have to wait. With `papers`, it instead compiles the
filters from scientific papers, which the tests need. A function that cannot be compiled here is
compiled at its first use.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from edge_agent import known_estimators

SERVICE: Final = (
    "from fleet_service.app.precompile import warm_up; warm_up(); "
    "from fleet_service.app.native_library import use_service_library; use_service_library()"
)
LIBRARY: Final = "from edge_agent.app.native_library import use_agent_library; use_agent_library()"
AGENT: Final = "import sys; from edge_agent.cli import main; sys.exit(main())"
DRIVE: Final = (
    "straight",
    "--duration",
    "1",
    "--seed",
    "0",
    "--out",
    "drive.parquet",
    "--vehicle-out",
    "car.json",
)
DEFAULT: Final = "aco-fckf"


def main(words: list[str]) -> int:
    """Compile the frequently used functions of service and agent, or those of the papers' filters
    if `words` is ["papers"]. Use one process per core. Always return 0.
    """
    began = time.monotonic()
    papers = words == ["papers"]
    print(
        f"compiling {'the filters of the papers' if papers else 'kernels'}, once for this machine",
        flush=True,
    )
    names = [name for name, _ in known_estimators() if name != DEFAULT] if papers else [DEFAULT]
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(os.cpu_count()) as workers:
        service = [] if papers else [workers.submit(_run_process, folder, SERVICE)]
        lines = _run_process(folder, AGENT, "simulate", *DRIVE)
        replays = [
            workers.submit(_run_process, folder, AGENT, "replay", *_estimate_command(name))
            for name in names
        ]
        for done in (*service, *replays):
            lines += done.result()
        if not papers:
            # Build the library of the kernels that the replay has compiled.
            lines += _run_process(folder, LIBRARY)
    print(f"compiled in {time.monotonic() - began:.0f} s", *lines, sep="\n", flush=True)
    return 0


def _estimate_command(name: str) -> tuple[str, ...]:
    return "drive.parquet", "--vehicle", "car.json", "--estimator", name, "--out", f"{name}.parquet"


def _run_process(folder: str, code: str, *words: str) -> list[str]:
    """Run the Python code `code` in a separate process, with the arguments `words`. Return the
    lines of the process's output that contain the word "error".
    """
    done = subprocess.run(
        [sys.executable, "-c", code, *words], cwd=Path(folder), capture_output=True, text=True
    )
    return [line for line in (done.stdout + done.stderr).splitlines() if "error" in line.lower()]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
