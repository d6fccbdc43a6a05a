"""Tests that a recorded drive counts once, however often `edge-agent replay --publish` is repeated:
with a real service, after a success, after a missing service, and after a kill.
"""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from edge_agent.cli import main as edge_agent
from edge_agent.cli import replay
from fleet_service.archive.format import reading
from schemas.wire import Kind
from tests.test_end_to_end import ICE, System, run_system

Output = pytest.CaptureFixture[str]
DAY_S = 86_400
# Program that sends three batches, waits until one is acknowledged, and kills itself.
KILLED = """
import os, signal, sys, threading
from edge_agent.cli import main
from edge_agent.publish.ack_settlement import AckSettlement
from edge_agent.publish.session_links import SessionLinks

answered = threading.Event()
sent = []
receive_ack = AckSettlement.receive_ack
put_batch = SessionLinks.put_batch

def receive(self, vehicle, payload):
    receive_ack(self, vehicle, payload)
    answered.set()

def put(self, batch):
    if len(sent) == 3:
        answered.wait(60)
        os.kill(os.getpid(), signal.SIGKILL)
    sent.append(batch)
    return put_batch(self, batch)

AckSettlement.receive_ack = receive
SessionLinks.put_batch = put
main(sys.argv[1:])
"""


@pytest.fixture
def system(tmp_path: Path) -> Iterator[System]:
    """Router and service, with a recorded drive of the vehicle anna; a batch has few records."""
    with run_system(tmp_path) as running:
        settings = json.loads(running.agent.read_text())
        running.agent.write_text(json.dumps(settings | {"batch_rows": 3}))
        running.record_drive("anna", "braking", ICE, 0)
        yield running


def time_text(age_s: float) -> str:
    """Return the time `age_s` seconds ago, as in the option `--start`."""
    return datetime.fromtimestamp(time.time() - age_s, UTC).isoformat()


def list_visits(folder: Path) -> list[tuple[object, ...]]:
    """Return cell, sector and time of each archived observation, sorted."""
    columns = ("cell", "sector", "enter_time")
    tables = reading.read_tables(folder / "archive", Kind.OBSERVATION, columns)
    return sorted(
        row
        for table in tables
        for row in zip(*(table[name].to_pylist() for name in columns), strict=True)
    )


def assert_counted_once(system: System, capsys: Output) -> None:
    """Check that the archive has each observation of the drive once. The last line of output states
    how many there are.
    """
    visits = list_visits(system.folder)
    counts = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert len(visits) == len(set(visits)) == counts["observations_published"] > 9


@pytest.mark.parametrize("age_s", [3600, 20 * DAY_S])
def test_a_drive_replayed_three_times_counts_once(
    system: System, capsys: Output, age_s: float
) -> None:
    words = [*system.replay_words("anna"), "--start", time_text(age_s)]
    assert edge_agent(words) == 0
    cells = system.query_cells()
    assert edge_agent(words) == 0
    system.stop()
    system.start()  # the service must recognise the batches of its archive
    assert edge_agent(words) == 0
    assert_counted_once(system, capsys)
    assert [(one["cell"], one["vehicles"]) for one in system.query_cells()] == [
        (one["cell"], one["vehicles"]) for one in cells
    ]


@pytest.mark.parametrize("is_outbox_kept", [True, False])
def test_a_drive_replayed_after_a_kill_counts_once(
    system: System, capsys: Output, is_outbox_kept: bool
) -> None:
    words = [*system.replay_words("anna"), "--start", time_text(3600)]
    done = subprocess.run([sys.executable, "-c", KILLED, *words], check=False)
    assert done.returncode == -signal.SIGKILL
    if not is_outbox_kept:
        for path in system.folder.glob("spool.sqlite*"):
            path.unlink()
    assert edge_agent(words) == 0
    assert_counted_once(system, capsys)


def test_a_drive_replayed_after_exit_code_1_counts_once(
    system: System, capsys: Output, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replay, "DRAIN_S", 0.5)
    words = system.replay_words("anna")  # the log states no time, so it ends now
    system.stop()
    assert edge_agent(words) == 1
    found = re.search(r"repeat the command with (--start \S+),", capsys.readouterr().err)
    assert found is not None
    system.start()
    monkeypatch.undo()
    assert edge_agent([*words, *found[1].split()]) == 0
    assert_counted_once(system, capsys)
