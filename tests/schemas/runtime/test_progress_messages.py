"""Tests of progress messages. They must appear on a terminal while slow libraries are still being
loaded, and not at all in quiet mode.
"""

from __future__ import annotations

import io
import sys
import threading

import pytest

from schemas.runtime import progress_messages
from tests.waiting import until


class Terminal(io.StringIO):
    """Simulated terminal that collects its output."""

    def isatty(self) -> bool:
        """Return True, because this stream acts as a terminal."""
        return True


def test_progress_is_shown_while_the_drawing_library_still_loads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terminal = Terminal()
    loaded = threading.Event()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(progress_messages, "PATIENCE_S", 0.01)
    monkeypatch.setattr(progress_messages, "TICK_S", 0.01)
    monkeypatch.setattr(progress_messages, "_import_spinner", loaded.wait)
    progress_messages.enable_messages()
    try:
        with progress_messages.show_status("replay"):
            until(lambda: terminal.getvalue().count("replay … 0 s\r") >= 3)
            progress_messages.set_status("compiling step")
            until(lambda: "compiling step … 0 s\r" in terminal.getvalue())
            loaded.set()
            until(lambda: "0:00:00" in terminal.getvalue())  # now the animated line is shown
    finally:
        loaded.set()
        progress_messages.enable_messages(quiet=True)


def test_quiet_run_prints_no_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(progress_messages, "PATIENCE_S", 0.0)
    progress_messages.enable_messages(quiet=True)
    with progress_messages.show_status("replay"):
        progress_messages.report("a line")
    assert terminal.getvalue() == ""
