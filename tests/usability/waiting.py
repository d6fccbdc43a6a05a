"""How long a person on a terminal waits without a sign of life."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import sys
import time
from pathlib import Path
from typing import Final

LONGEST_S: Final = 400.0
COMMANDS: Final = (
    ["edge-agent", "replay", "{d}/log.parquet", "--vehicle", "{d}/car.json", "--out", "{d}/e.parquet"],
    ["fleet-service", "analyze", "worst", "--archive", "{a}", "--out", "{d}/w.html"],
    ["fleet-service", "export", "map", "--archive", "{a}", "--out", "{d}/m.parquet"],
)


def longest(command: list[str], cache: Path) -> float:
    """The longest time between two signs of life of a command on a terminal, its begin and its end counted [s]."""
    here, there = pty.openpty()
    environment = {**os.environ, "XDG_CACHE_HOME": str(cache), "TERM": "xterm"}
    environment.pop("NUMBA_CACHE_DIR", None)
    last, worst = time.monotonic(), 0.0
    began = last
    program = [str(Path(sys.executable).parent / command[0]), *command[1:]]
    with subprocess.Popen(program, stdin=there, stdout=there, stderr=there, env=environment) as process:
        os.close(there)
        while time.monotonic() - began < LONGEST_S:
            ready, _, _ = select.select([here], [], [], 0.1)
            try:
                heard = bool(ready and os.read(here, 65536))
            except OSError:  # it has left
                break
            if heard:
                worst, last = max(worst, time.monotonic() - last), time.monotonic()
        process.wait(60)
        os.close(here)
    return max(worst, time.monotonic() - last)


def silent_seconds(folder: Path, archive: Path) -> dict[str, float]:
    """The longest silence of each command, with an empty cache of kernels."""
    found = {}
    for command in COMMANDS:
        words = [word.format(d=folder, a=archive) for word in command]
        found[" ".join(command[:2])] = longest(words, folder / "cache")
    return found
