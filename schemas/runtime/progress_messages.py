"""Progress messages of a command: on stderr, never on stdout, and not in quiet mode.

On a terminal, a spinner with a clock appears when an operation takes longer than a second. Without
a terminal, a long operation is reported once as a line. Messages are off by default, so an imported
library prints nothing; only the command lines call `enable_messages`.
"""

from __future__ import annotations

import importlib
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, Final

from schemas.runtime.logs import print_line

PATIENCE_S: Final = 0.8  # delay of the spinner: short commands show none
TICK_S: Final = 1.0
COMPILING: Final = (
    "compiling kernels for this machine: takes up to a minute, once; the next start reuses them"
)


class _State:
    """State of the progress messages of this process: whether they are enabled, and the current
    spinner.
    """

    def __init__(self) -> None:
        self.on = False
        self.words = ""
        self.said_once: set[str] = set()
        self.shown: Any = None
        self.timer: threading.Timer | None = None
        self.lock = threading.Lock()


_voice = _State()


def enable_messages(*, quiet: bool = False) -> None:
    """Enable progress messages; only the command lines do this."""
    _voice.on = not quiet
    _voice.said_once.clear()


def report(line: str) -> None:
    """Print a line about the progress of the command, if progress messages are enabled."""
    if _voice.on:
        print_line(line, sys.stderr)


def report_once(line: str) -> None:
    """Print a progress message, unless this process has already printed the same message."""
    if line not in _voice.said_once:
        _voice.said_once.add(line)
        report(line)


def set_status(words: str) -> None:
    """Set the text that the spinner shows: a few words about the command's current activity."""
    with _voice.lock:
        _voice.words = words
        if _voice.shown is not None:
            _voice.shown.update(0, description=words)


@contextmanager
def show_status(words: str) -> Iterator[None]:
    """Show a spinner with the text `words` until the `with` block ends. It appears only on a
    terminal, and only after PATIENCE_S.
    """
    if not (_voice.on and sys.stderr.isatty()) or _voice.shown is not None:
        yield
        return
    set_status(words)
    _voice.timer = threading.Timer(PATIENCE_S, _show_status)
    _voice.timer.daemon = True
    _voice.timer.start()
    try:
        yield
    finally:
        stop_status()


def stop_status() -> None:
    """Stop the spinner. Call this when the command has ended, or before it asks the user a
    question.
    """
    timer = _voice.timer
    _voice.timer = None
    if timer is not None:
        timer.cancel()
        timer.join()
    with _voice.lock:
        shown = _voice.shown
        _voice.shown = None
    if shown is not None:
        shown.stop()


def _show_status() -> None:
    began = time.monotonic()
    loading = threading.Thread(target=_load_drawing, daemon=True)
    loading.start()
    # The import of the drawing library takes seconds next to a busy command.
    while loading.is_alive():
        with suppress(OSError):
            waited = PATIENCE_S + time.monotonic() - began
            print(f"{_voice.words} … {waited:.0f} s", end="\r", file=sys.stderr, flush=True)
        loading.join(TICK_S)
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    shown = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=True,
        redirect_stdout=sys.stdout.isatty(),
    )
    shown.add_task(_voice.words, total=None)
    shown.start()
    with _voice.lock:
        _voice.shown = shown


def _load_drawing() -> None:
    """Import the library that draws the spinner before it is needed."""
    importlib.import_module("rich.progress")
