"""Tests of the watchdog signals of a service: the signals stop when a thread other than the worker
(which processes messages) hangs.
"""

from __future__ import annotations

import socket
import time
from contextlib import closing, suppress
from pathlib import Path

import pytest

from fleet_service.app import service, status_line
from schemas.config import ZenohSettings
from tests.fleet_service.conftest import running
from tests.waiting import until

LIFE = b"READY=1\nWATCHDOG=1"
SAID = "watchdog signal withheld: a tile of an answer has been in progress for "


def test_signs_of_life_end_with_a_reason_when_an_answer_hangs(
    router: ZenohSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)) as manager:
        manager.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setattr(status_line, "STATUS_S", 0.02)
        with running(router, tmp_path / "archive") as run:
            assert [manager.recv(64) for _ in range(3)] == [LIFE] * 3
            run.service._replies._busy_since = time.monotonic() - 2 * service.HANGS_S

            def count_said() -> int:
                return sum(line.startswith(SAID) for line in run.lines)

            until(count_said)
            manager.setblocking(False)
            with suppress(BlockingIOError):  # discard earlier notifications
                while manager.recv(64):
                    pass
            before = count_said()
            until(lambda: count_said() > before + 2)
            with pytest.raises(BlockingIOError):
                manager.recv(64)
