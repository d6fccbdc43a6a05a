"""Tests of the segment log (writer of new rows): no batch is acknowledged before it is durable, and
a failed write loses no row.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from fleet_service.archive.format import layout, segments
from fleet_service.archive.identity.pseudonyms import load_or_create_key
from fleet_service.archive.segment_log import SegmentLog
from schemas.wire import Kind
from tests.faults.crash_disk import CrashDisk
from tests.fleet_service.archive.rows import identities, rows_of
from tests.waiting import until


@pytest.fixture
def log(tmp_path: Path) -> Iterator[SegmentLog[str]]:
    made: SegmentLog[str] = SegmentLog(tmp_path, "shard-0")
    yield made
    made.close()


def add(log: SegmentLog[str], name: str, seed: int, kind: Kind = Kind.OBSERVATION) -> None:
    """Add a batch of three rows to the segment log (the writer of new rows)."""
    log.add(kind, rows_of(kind, 3, seed), [name])


def test_rows_added_while_a_segment_is_written_wait_for_the_next(
    log: SegmentLog[str], tmp_path: Path
) -> None:
    add(log, "first", 1)
    log.begin()
    add(log, "second", 2)
    log.begin()  # does nothing: the first segment has not ended yet
    assert log.unsettled == 2
    assert log.end() == ["first"]
    assert (log.rows, log.unsettled) == (3, 1)
    assert {boot for boot, _ in identities(tmp_path, Kind.OBSERVATION)} == {1}
    log.begin()
    until(lambda: log.ended)
    assert log.end() == ["second"]
    assert (log.rows, log.unsettled, log.end()) == (0, 0, [])
    assert len(identities(tmp_path, Kind.OBSERVATION)) == 6


def test_flush_settles_the_open_segment_and_later_rows(log: SegmentLog[str]) -> None:
    add(log, "first", 1)
    log.begin()
    add(log, "second", 2)
    assert log.flush() == ["first", "second"]
    assert log.flush() == []


def test_failed_writes_are_settled_once_by_the_next_write(
    log: SegmentLog[str], tmp_path: Path
) -> None:
    inbox = segments.segment_folder(tmp_path, Kind.STATE)
    away = tmp_path / "away"
    add(log, "seen", 1)
    add(log, "state", 2, Kind.STATE)
    inbox.rename(away)
    log.begin()
    with pytest.raises(OSError, match="states"):
        log.end()
    # The observations are written, but are settled only together with the states.
    assert (log.rows, log.unsettled) == (
        3,
        2,
    )
    add(log, "later", 3)
    with pytest.raises(OSError, match="states"):
        log.flush()
    away.rename(inbox)
    assert sorted(log.flush()) == ["later", "seen", "state"]
    assert len(identities(tmp_path, Kind.OBSERVATION)) == 6
    assert len(identities(tmp_path, Kind.STATE)) == 3


def test_segment_order_does_not_depend_on_the_number_of_digits() -> None:
    newer, older = (
        layout.segment_name("shard-0-0000000007", number) for number in (100_000_000, 99_999_999)
    )
    assert sorted([newer, older], key=layout.age_key) == [older, newer]


def test_new_pseudonym_key_survives_a_power_loss(tmp_path: Path) -> None:
    """A new pseudonym key, from which archived names are computed, must survive a power loss right
    after its creation. With another key, the service would not recognise archived batches, and
    would accept them a second time.
    """
    for seed in range(20):
        live = tmp_path / f"live-{seed}"
        after = tmp_path / f"after-{seed}"
        live.mkdir()
        disk = CrashDisk(live, random.Random(seed), None, range(0))
        with disk.intercept_calls():
            key = load_or_create_key(live / "keys" / "2026-01.key")
        disk.write_image(after)
        assert (after / "keys" / "2026-01.key").exists()
        assert load_or_create_key(after / "keys" / "2026-01.key") == key


def test_segments_are_newer_than_a_checkpoint_of_a_clock_that_was_ahead(tmp_path: Path) -> None:
    ahead = 9_999_999_000
    (tmp_path / layout.CHECKPOINTS / f"{ahead:010d}-{0:012d}").mkdir(parents=True)
    log: SegmentLog[str] = SegmentLog(tmp_path, "shard-0")
    # Otherwise no restart would read these segments, and their reports would be accepted again.
    assert log.newest > layout.Cut(ahead, 0)
    log.close()
