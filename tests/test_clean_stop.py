"""Tests of SIGTERM and Ctrl-C. With and without a working router, agent and service must write
waiting data to disk, deliver as many reports as possible, and end.
"""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.faults.census import compare_with_archive, read_journals
from tests.faults.processes import Stage, open_stage
from tests.waiting import until


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    """Yield a router, a service and two vehicles, after the service has acknowledged a first
    report.
    """
    with open_stage(tmp_path, segment_s=0.2) as stage:
        stage.make_load(["sim-001", "sim-002"], 20.0, flush_s=0.2).start()
        until(lambda: read_journals(stage.journals).settled)
        yield stage


@pytest.mark.campaign
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_agent_and_service_settle_all_records_and_stop(
    stage: Stage, number: signal.Signals
) -> None:
    (load,) = stage.loads
    for part in (load, stage.service):
        assert part.stop(number) == 0
    end = json.loads(load.read_lines()[-1])
    assert end["unsettled"] == 0
    census = compare_with_archive(stage.journals, stage.archive)
    assert (census.lost, census.doubled) == (0, 0)
    # On a busy machine the service may reach its time limit before the last step. No row is lost
    # then, as the check above shows.
    assert any(
        line.startswith(("status: ", "shutdown incomplete")) for line in stage.service.read_lines()
    )


@pytest.mark.campaign
def test_agent_and_service_leave_a_frozen_router_without_loss(stage: Stage) -> None:
    (load,) = stage.loads
    stage.router.freeze()
    stored = len(read_journals(stage.journals).stored)
    until(lambda: len(read_journals(stage.journals).stored) > stored + 4)
    for part in (load, stage.service):
        assert part.stop() == 0
    stage.router.send_signal(signal.SIGCONT)
    stage.service.start()
    stage.service.line_with("ready: ")
    load.start()
    stage.drain(60.0)
    census = compare_with_archive(stage.journals, stage.archive)
    assert (census.lost, census.acknowledged_lost, census.doubled) == (0, 0, 0)
