"""Tests of the framework of the fault campaigns. It must report missing figures, and its comparison
with the archive must find lost and doubled rows.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

from fleet_service.app.engine import Engine
from fleet_service.archive.format.segments import Writer
from fleet_service.archive.identity import pseudonyms
from fleet_service.ingest.inbox import Message
from schemas import wire
from schemas.config import ServiceConfig
from schemas.runtime.figures import Figure
from schemas.wire import Batch
from tests.faults.bars import BARS, make_figure
from tests.faults.campaigns import CAMPAIGNS
from tests.faults.census import compare_with_archive, read_journals
from tests.faults.crash_model import run_log_history
from tests.faults.crash_service import ServiceHistory
from tests.faults.crash_spool import spool_history
from tests.faults.frame import RAISED, Campaign, Site, run_campaigns
from tests.faults.link_relay import UDP, Direction, LinkTerms
from tests.fleet_service.examples import SECOND, batch, key
from tests.waiting import until


def test_required_figures_of_campaigns_are_in_the_table_and_unique() -> None:
    owed = [name for campaign in CAMPAIGNS for name in campaign.owes]
    assert set(owed) <= set(BARS)
    assert len(owed) == len(set(owed))


def test_every_campaign_has_a_figure_of_its_extent() -> None:
    assert [
        one.name for one in CAMPAIGNS if not any(BARS[name].better == "more" for name in one.owes)
    ] == []


def test_missing_figure_of_a_campaign_does_not_hold(tmp_path: Path) -> None:
    def run_forgetful(site: Site) -> list[Figure]:
        return [make_figure("faults.kill.doubled", 0)]

    campaign = Campaign("forgetful", run_forgetful, ("faults.kill.doubled", "faults.frozen.lost"))
    found = run_campaigns([campaign], tmp_path, "test", quick=True, seed=0)
    assert {one.name: one.holds for one in found} == {
        "faults.kill.doubled": True,
        "faults.frozen.lost": False,
    }
    written = json.loads((tmp_path / "figures.json").read_text())[1:]
    assert [row["holds"] for row in written] == [True, False]
    assert "DOES NOT HOLD" in (tmp_path / "figures.md").read_text()


RAISES = """
import subprocess, threading
from pathlib import Path
from tests.faults.frame import Campaign, run_and_exit, run_campaigns

def run(site):
    child = subprocess.Popen(["sleep", "600"])
    Path("child").write_text(str(child.pid))
    threading.Thread(target=threading.Event().wait).start()  # as a session that nobody closed
    raise TimeoutError("not within 60 s")

CAMPAIGNS = [Campaign("raises", run, ())]
run_and_exit(lambda: len(run_campaigns(CAMPAIGNS, Path("out"), "test", True, 0)))
"""


def test_a_raising_campaign_ends_the_run_with_its_message(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    command = [sys.executable, "-c", RAISES]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True, timeout=120
    )
    assert done.returncode == RAISED
    assert "TimeoutError: not within 60 s" in done.stderr
    child = Path("/proc", (tmp_path / "child").read_text(), "stat")
    until(lambda: not child.exists() or child.read_text().split()[2] == "Z")


@pytest.fixture
def kept(tmp_path: Path) -> list[Batch]:
    """Return three batches, and create an archive that wrongly contains the first batch twice, the
    second once, and the third not at all.
    """
    now = time.time_ns()
    batches = [batch("sim-001", seq, now - SECOND, [0.8, 0.7]) for seq in (1, 2, 3)]
    for turn, shown in enumerate((batches[:2], batches[:1])):
        root = tmp_path / "archive" if not turn else tmp_path / "copy"
        root.mkdir()
        if turn:
            (root / "keys").symlink_to(tmp_path / "archive" / "keys")
        with closing(Engine(ServiceConfig(name=f"shard-{turn}"), root)) as engine:
            engine.intake.ingest(
                [
                    Message(b.kind, key(b.vehicle), wire.encode(b), wire.ENCODING[b.kind])
                    for b in shown
                ],
                time.time_ns(),
            )
            engine.settlement.flush()
    for segment in (tmp_path / "copy" / "inbox").glob("*.parquet"):
        segment.rename(tmp_path / "archive" / "inbox" / segment.name)
    return batches


def test_census_finds_a_lost_batch_and_doubled_rows(kept: list[Batch], tmp_path: Path) -> None:
    journal = tmp_path / "load.journal"
    lines = [f"+ {b.vehicle} {b.boot} {b.kind} {b.region} {b.seq} {b.rows} 1.0" for b in kept]
    lines += [f"- {b.vehicle} {b.boot} {b.kind} {b.region} {b.seq} 0 3.5" for b in kept[1:]]
    journal.write_text("\n".join(lines) + "\n")
    census = compare_with_archive([journal], tmp_path / "archive")
    assert (census.stored, census.settled, census.rows, census.observations) == (3, 2, 6, 6)
    assert (census.lost, census.acknowledged_lost, census.doubled) == (1, 1, 2)
    assert read_journals([journal]).longest_wait(since=2.0) == float("inf")
    journal.write_text("\n".join(lines[1:]) + "\n")
    assert read_journals([journal]).longest_wait(since=2.0) == 1.5


@pytest.mark.campaign
def test_no_history_on_a_disk_that_forgets_loses_or_doubles_anything() -> None:
    # Both histories once lost rows: an interrupted compaction had renamed files without syncing
    # them.
    found_bugs = (
        1064,
        1938,
    )
    assert [
        problem for number in (*range(12), *found_bugs) for problem in run_log_history(number)
    ] == []
    assert [problem for number in range(3) for problem in spool_history(number)] == []


def test_the_disk_that_forgets_catches_a_log_that_does_not_sync(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Writer, "sync", lambda self: None)
    assert any("is lost" in problem for number in range(12) for problem in run_log_history(number))


def find_violations(number: int, folder: Path) -> list[str]:
    (folder / str(number)).mkdir()
    return ServiceHistory(number, folder / str(number)).find_violations()


@pytest.mark.campaign
def test_no_history_on_a_forgetful_disk_loses_or_doubles_anything(tmp_path: Path) -> None:
    # In history 45, the last rows of an erased vehicle were accepted again. In 84, rows of the
    # previous month were fused twice.
    found_bugs = (
        45,
        84,
    )
    assert [
        problem
        for number in (*range(3), *found_bugs)
        for problem in find_violations(number, tmp_path)
    ] == []


def test_forgetful_disk_catches_a_service_that_does_not_sync_its_keys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pseudonyms, "sync_directory", lambda folder: None)
    assert any(
        "key is lost" in problem
        for number in range(6)
        for problem in find_violations(number, tmp_path)
    )


def test_link_relay_follows_loss_delay_rate_and_blocking() -> None:
    draw = random.Random(1)
    packet = bytes(9) + bytes([6]) + bytes(90)
    blocked = LinkTerms(drop_udp=True)
    slow = LinkTerms(delay_s=1.0, bytes_per_s=100.0, queue_bytes=200)
    read, write = os.pipe()
    way = Direction(write)
    way.accept_packet(packet[:9] + bytes([UDP]) + packet[10:], 0.0, blocked, draw)
    assert not way.flying
    for _ in range(5):
        way.accept_packet(packet, 0.0, slow, draw)
    assert [at for at, _, _ in way.flying] == [2.0, 3.0, 4.0], (
        "two wait, a third is on its way, others find no room"
    )
    way.deliver_packets(3.0)
    assert os.read(read, 1000) == 2 * packet
    lossy = Direction(write)
    for _ in range(1000):
        lossy.accept_packet(packet, 0.0, LinkTerms(loss=0.1), draw)
    assert 860 < len(lossy.flying) < 940
