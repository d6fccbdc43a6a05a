"""The clients in other languages in `deploy/examples/clients`: functions that build each client if
its tools are installed, and run it with a router and a service.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import zenoh

from deploy.router import open_router
from schemas import grid, keys
from schemas.config import ZenohSettings
from schemas.runtime.zenoh_session import open_session
from schemas.wire import JSON
from tests.deploy.remote_api import serve_remote_api
from tests.structure import ROOT

SOURCES: Final = ROOT / "deploy" / "examples" / "clients"
PROTO: Final = ROOT / "schemas" / "proto" / "gripmap.proto"
PLACES: Final = {"c": (57.7, 11.97), "typescript": (57.8, 12.1)}  # place of the ice for each client
PATIENCE_S: Final = 60
SECOND: Final = 10**9
# Library for pkg-config, and the compiler options that it needs.
LIBRARIES: Final = {"zenohpico": ["-DZENOH_LINUX"], "zenohc": ["-DUSE_ZENOH_C"]}


def missing_tool(language: str) -> str:
    """Return the reason why this machine cannot build or run the client in this language, such as a
    missing tool. Return "" if there is none.
    """
    if language == "c":
        for tool in ("cc", "pkg-config"):
            if shutil.which(tool) is None:
                return f"no {tool}"
        return "" if _library() else f"pkg-config finds none of {', '.join(LIBRARIES)}"
    for tool in ("node", "npm"):
        if shutil.which(tool) is None:
            return f"no {tool}"
    version = subprocess.run(["node", "--version"], capture_output=True, text=True, check=True)
    if int(version.stdout[1:].partition(".")[0]) < 20:
        return f"Node.js {version.stdout.strip()} is older than 20"
    return ""


def _library() -> str:
    for name in LIBRARIES:
        if subprocess.run(["pkg-config", "--exists", name], check=False).returncode == 0:
            return name
    return ""


def build_client(language: str, folder: Path) -> list[str]:
    """Build a client in a folder, and return its command without arguments.

    Raises:
        RuntimeError: the client cannot be built.
    """
    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    if language == "c":
        program = folder / "client"
        name = _library()
        flags = shlex.split(_run(["pkg-config", "--cflags", "--libs", name], folder))
        rpath = [f"-Wl,-rpath,{one[2:]}" for one in flags if one.startswith("-L")]
        words = ["cc", "-std=c11", "-Wall", "-Wextra", "-Werror", *LIBRARIES[name]]
        source = str(SOURCES / "c" / "client.c")
        _run([*words, "-o", str(program), source, *flags, *rpath, "-lm", "-lpthread"], folder)
        return [str(program)]
    for path in (SOURCES / "typescript").iterdir():
        if path.is_file():
            shutil.copy(path, folder)
    _run(["npm", "ci", "--silent", "--no-audit", "--no-fund"], folder)
    _run(["npm", "run", "--silent", "build"], folder)
    return ["npm", "--prefix", str(folder), "run", "--silent", "start", "--"]


def _run(words: list[str], folder: Path) -> str:
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(words)}: {done.stdout}{done.stderr}")
    return done.stdout


@contextmanager
def served_map(folder: Path) -> Iterator[str]:
    """Yield the endpoint (address) of a router to which a service is connected; both run in
    separate processes.
    """
    router, endpoints = open_router(listen="tcp/127.0.0.1:0")
    config = folder / "service.json"
    config.write_text(json.dumps({"zenoh": {"connect": endpoints}, "segment_s": 0.1, "put_s": 0.1}))
    files = ["--config", str(config), "--archive", str(folder / "archive")]
    words = [sys.executable, "-m", "fleet_service.cli", "run", *files]
    with (
        router,
        subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        ) as service,
    ):
        try:
            assert service.stdout is not None
            assert service.stdout.readline().startswith("ready: ")
            yield endpoints[0]
        finally:
            service.terminate()
            service.communicate(timeout=60)


def report_ice(endpoint: str, vehicle: str, place: tuple[float, float]) -> None:
    """Publish a report of ice at `place` as the vehicle `vehicle`. The tests call this for a second
    vehicle, because an alert needs two.
    """
    region = int(grid.region_of(int(grid.cell_of(*place))))
    now = time.time_ns()
    given = {"latitude": place[0], "longitude": place[1], "yaw": 1.57, "mu": 0.2}
    given |= {"mu_lower": 0.12, "mu_upper": 0.28, "mu_utilised": 0.19}
    report: dict[str, Any] = {name: [value] * 6 for name, value in given.items()}
    report |= {"vehicle": vehicle, "boot": str(now), "seq": "1"}
    report["enter_time"] = [str(now - k * SECOND) for k in reversed(range(6))]
    session = open_session(ZenohSettings(connect=[endpoint]))
    assert session is not None
    key = keys.observation_key(region, vehicle)
    with session:
        session.put(
            key,
            json.dumps(report),
            encoding=JSON,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )


def run_client(command: list[str], language: str, endpoint: str) -> dict[str, Any]:
    """Let another vehicle report ice at a place, and run a built client there. Each language has a
    place of its own. Return the JSON that the client prints.

    Raises:
        RuntimeError: the client failed.
    """
    place = PLACES[language]
    report_ice(endpoint, f"witness-of-{language}", place)
    arguments = [f"client-in-{language}", str(place[0]), str(place[1]), str(PATIENCE_S)]
    if language == "c":
        words = [*command, endpoint, *arguments]
        return dict(json.loads(_last_line(words)))
    with serve_remote_api(endpoint) as locator:
        return dict(json.loads(_last_line([*command, locator, str(PROTO), *arguments])))


def _last_line(words: list[str]) -> str:
    done = subprocess.run(
        words,
        capture_output=True,
        text=True,
        check=False,
        timeout=4 * PATIENCE_S,
        env={**os.environ, "NO_COLOR": "1"},
    )
    if done.returncode:
        raise RuntimeError(f"{words[0]}: {done.stdout}{done.stderr}")
    return done.stdout.splitlines()[-1]
