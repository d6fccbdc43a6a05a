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
        self.is_enabled = False
        self.text = ""
        self.reported: set[str] = set()
        self.spinner: Any = None
        self.timer: threading.Timer | None = None
        self.lock = threading.Lock()


_state = _State()


def enable_messages(*, quiet: bool = False) -> None:
    """Enable progress messages; only the command lines do this."""
    _state.is_enabled = not quiet
    _state.reported.clear()


def report(line: str) -> None:
    """Print a line about the progress of the command, if progress messages are enabled."""
    if _state.is_enabled:
        print_line(line, sys.stderr)


def report_once(line: str) -> None:
    """Print a progress message, unless this process has already printed the same message."""
    if line not in _state.reported:
        _state.reported.add(line)
        report(line)


def set_status(text: str) -> None:
    """Set the text that the spinner shows: a few words about the command's current activity."""
    with _state.lock:
        _state.text = text
        if _state.spinner is not None:
            _state.spinner.update(0, description=text)


@contextmanager
def show_status(text: str) -> Iterator[None]:
    """Show a spinner with `text` until the `with` block ends. It appears only on a
    terminal, and only after PATIENCE_S.
    """
    if not (_state.is_enabled and sys.stderr.isatty()) or _state.spinner is not None:
        yield
        return
    set_status(text)
    _state.timer = threading.Timer(PATIENCE_S, _show_status)
    _state.timer.daemon = True
    _state.timer.start()
    try:
        yield
    finally:
        stop_status()


def stop_status() -> None:
    """Stop the spinner. Call this when the command has ended, or before it asks the user a
    question.
    """
    timer = _state.timer
    _state.timer = None
    if timer is not None:
        timer.cancel()
        timer.join()
    with _state.lock:
        spinner = _state.spinner
        _state.spinner = None
    if spinner is not None:
        spinner.stop()


def _show_status() -> None:
    began = time.monotonic()
    loading = threading.Thread(target=_import_spinner, daemon=True)
    loading.start()
    # The import of rich takes seconds next to a busy command.
    while loading.is_alive():
        with suppress(OSError):
            waited = PATIENCE_S + time.monotonic() - began
            print(f"{_state.text} … {waited:.0f} s", end="\r", file=sys.stderr, flush=True)
        loading.join(TICK_S)
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    spinner = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=True,
        redirect_stdout=sys.stdout.isatty(),
    )
    spinner.add_task(_state.text, total=None)
    spinner.start()
    with _state.lock:
        _state.spinner = spinner


def _import_spinner() -> None:
    """Import rich, which draws the spinner."""
    importlib.import_module("rich.progress")
