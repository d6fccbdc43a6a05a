"""Tests of the status line: an operator must see why nothing is acknowledged."""

from __future__ import annotations

import errno
import os
import time
from contextlib import closing
from pathlib import Path

import pytest

from fleet_service.app.clock import SteadyClock
from fleet_service.app.engine import Engine
from fleet_service.app.status_line import StatusLine
from fleet_service.ingest.inbox import Inbox
from fleet_service.ingest.rate_limit import RateLimiter
from schemas.config import ServiceConfig
from tests.event_lines import logger_into
from tests.fleet_service.app.test_settlement import ingest_one


def test_status_line_names_the_reason_of_a_failed_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def raise_disk_full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    lines: list[str] = []
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        inbox = Inbox(1, engine.counts, RateLimiter(1.0, 1.0, None, engine.counts))
        status = StatusLine(engine, inbox, SteadyClock(), logger_into(lines))
        ingest_one(engine, 1)
        with monkeypatch.context() as patch:
            patch.setattr(engine.settlement._log._writer, "write", raise_disk_full)
            engine.settlement.flush()
        status.write_line(time.monotonic())
        engine.settlement.flush()
        status.write_line(time.monotonic())
    assert lines[0].endswith("; nothing is acknowledged: No space left on device")
    assert "nothing is acknowledged" not in lines[1]
