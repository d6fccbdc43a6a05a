"""What a command tells a person who waits: on stderr, never on stdout, and nothing when it was asked to be quiet.

On a terminal a line with a clock turns while something takes longer than a second; elsewhere what takes long is said in
a line once. A library that is imported says nothing: only the command lines call `speak`.
"""

from __future__ import annotations

import importlib
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, Final

from schemas.runtime.process import print_line

PATIENCE_S: Final = 0.8  # after which a person asks whether it still runs
TICK_S: Final = 1.0
COMPILING: Final = "compiling kernels, once on this machine: about 40 s for the default estimator"


class _Voice:
    """What is said and shown; one of the process."""

    def __init__(self) -> None:
        self.on = False
        self.words = ""
        self.said_once: set[str] = set()
        self.shown: Any = None
        self.timer: threading.Timer | None = None
        self.lock = threading.Lock()


_voice = _Voice()


def speak(*, quiet: bool = False) -> None:
    """Let this process talk to a person; a command line calls it."""
    _voice.on = not quiet
    _voice.said_once.clear()


def say(line: str) -> None:
    """A line of progress."""
    if _voice.on:
        print_line(line, sys.stderr)


def say_once(line: str) -> None:
    """A line of progress that is the same however often it is due; on a terminal it is what turns."""
    if line not in _voice.said_once:
        _voice.said_once.add(line)
        say(line)


def doing(words: str) -> None:
    """What is being done now, for the line that turns."""
    with _voice.lock:
        _voice.words = words
        if _voice.shown is not None:
            _voice.shown.update(0, description=words)


@contextmanager
def busy(words: str) -> Iterator[None]:
    """Show that it still runs, from PATIENCE_S on and only on a terminal."""
    if not (_voice.on and sys.stderr.isatty()) or _voice.shown is not None:
        yield
        return
    doing(words)
    _voice.timer = threading.Timer(PATIENCE_S, _show)
    _voice.timer.daemon = True
    _voice.timer.start()
    try:
        yield
    finally:
        hush()


def hush() -> None:
    """Let nothing turn from here on: the command is over, or asks its person something."""
    timer, _voice.timer = _voice.timer, None
    if timer is not None:
        timer.cancel()
        timer.join()
    with _voice.lock:
        shown, _voice.shown = _voice.shown, None
    if shown is not None:
        shown.stop()


def _show() -> None:
    began = time.monotonic()
    loading = threading.Thread(target=_load, daemon=True)
    loading.start()
    while loading.is_alive():  # seconds, beside a command that computes or loads its own
        with suppress(OSError):
            waited = PATIENCE_S + time.monotonic() - began
            print(f"{_voice.words} … {waited:.0f} s", end="\r", file=sys.stderr, flush=True)
        loading.join(TICK_S)
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    shown = Progress(
        SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn(), console=Console(stderr=True),
        transient=True, redirect_stdout=sys.stdout.isatty(),
    )  # fmt: skip
    shown.add_task(_voice.words, total=None)
    shown.start()
    with _voice.lock:
        _voice.shown = shown


def _load() -> None:
    """What draws, before it is needed."""
    importlib.import_module("rich.progress")
