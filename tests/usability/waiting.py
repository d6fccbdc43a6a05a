"""Measurement of the longest time in which a command prints nothing on a terminal."""

from __future__ import annotations

import json
import os
import pty
import select
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Final

from deploy.router import open_router

LONGEST_S: Final = 400.0
COMMANDS: Final = (
    ["edge-agent", "simulate", "slalom", "--out", "{d}/s.parquet", "--vehicle-out", "{d}/s.json"],
    ["edge-agent", "check", "{d}/log.parquet", "--vehicle", "{d}/car.json", "--out", "{d}/c.html"],
    ["fleet-service", "compact", "--archive", "{a}"],
    [
        "edge-agent",
        "replay",
        "{d}/log.parquet",
        "--vehicle",
        "{d}/car.json",
        "--out",
        "{d}/e.parquet",
    ],
    ["fleet-service", "analyze", "worst", "--archive", "{a}", "--out", "{d}/w.html"],
    ["fleet-service", "export", "map", "--archive", "{a}", "--out", "{d}/m.parquet"],
)
# Commands that run until a signal, and the output that ends the measured wait.
LASTING: Final = (
    (
        ["fleet-service", "run", "--config", "{d}/lasting.json", "--archive", "{d}/lasting"],
        b"ready: ",
    ),
    (["edge-agent", "run", "--config", "{d}/lasting-agent.json"], b"metrics: "),
)


def longest_silence(command: list[str], cache: Path, ready: bytes | None = None) -> float:
    """Return the longest time [s] between two outputs of a command on a terminal, including start
    and end.

    `ready` is for a command that does not end by itself: it is interrupted as soon as it prints
    this text. The time from then until its end does not count.
    """
    controller, terminal = pty.openpty()
    environment = {**os.environ, "XDG_CACHE_HOME": str(cache), "TERM": "xterm"}
    environment.pop("NUMBA_CACHE_DIR", None)
    last = time.monotonic()
    worst = 0.0
    output = b""
    began = last
    program = [str(Path(sys.executable).parent / command[0]), *command[1:]]
    with subprocess.Popen(
        program, stdin=terminal, stdout=terminal, stderr=terminal, env=environment
    ) as process:
        os.close(terminal)
        while time.monotonic() - began < LONGEST_S:
            waiting, _, _ = select.select([controller], [], [], 0.1)
            try:
                block = os.read(controller, 65536) if waiting else b""
            except OSError:  # the program has ended
                break
            if block:
                worst = max(worst, time.monotonic() - last)
                last = time.monotonic()
            output += block
            if ready is not None and ready in output:
                process.send_signal(signal.SIGINT)
                break
        whole = max(worst, time.monotonic() - last)
        # Read the remaining output, because a full pipe would prevent the program from ending.
        while ready is not None and process.poll() is None:
            if select.select([controller], [], [], 0.1)[0]:
                with suppress(OSError):
                    os.read(controller, 65536)
        process.wait(60)
        os.close(controller)
    return whole


def silent_seconds(folder: Path, archive: Path) -> dict[str, float]:
    """Return for each command the longest time [s] without output, with an empty cache of compiled
    functions.
    """
    found = {}
    for command in COMMANDS:
        words = [word.format(d=folder, a=archive) for word in command]
        found[" ".join(command[:2])] = longest_silence(words, folder / "cache")
    router, endpoints = open_router(listen="tcp/127.0.0.1:0")
    connection = {"zenoh": {"connect": endpoints}}
    (folder / "lasting.json").write_text(json.dumps(connection))
    agent = {**connection, "spool": str(folder / "lasting.sqlite"), "metrics_port": 0}
    (folder / "lasting-agent.json").write_text(json.dumps(agent))
    with router:
        for command, ready in LASTING:
            words = [word.format(d=folder) for word in command]
            found[" ".join(command[:2])] = longest_silence(words, folder / "cache", ready)
    return found
