"""Tests of the outbox, the agent's store of unacknowledged messages on disk.

The numbers of the messages must have no gap, and the outbox must store a message before the agent
sends it. When the service acknowledges or refuses ranges of numbers, these messages must be
removed. Unanswered messages must be sent again at growing intervals. The size of the outbox must be
limited, and only one agent may use it.
"""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
import tracemalloc
from contextlib import closing
from pathlib import Path

import pytest

from edge_agent.publish.batching import Draft, DriveBatches
from edge_agent.publish.held_batches import Stream
from edge_agent.publish.outbox import Outbox, StoredBatch
from edge_agent.publish.pacing import FIRST_WINDOW, LONGEST_PROBE_S, SILENT_S
from edge_agent.publish.resend_schedule import JITTER
from schemas.errors import InputError
from schemas.wire import Kind
from tests.outboxes import read_batches

REGION = 77
BOOT = 5


def draft(
    vehicle: str = "car-a",
    kind: Kind = Kind.OBSERVATION,
    region: int = REGION,
    records: int = 1,
    size: int = 0,
) -> Draft:
    """Return a batch that has no number yet. Its payload will contain its sequence number (`seq`)
    and the lowest stored number (`first_held`).
    """
    return Draft(
        vehicle,
        kind,
        region,
        records,
        lambda seq, first_held: f"{seq}/{first_held}".encode() + b"." * size,
    )


def stream(vehicle: str = "car-a", kind: Kind = Kind.OBSERVATION, boot: int = BOOT) -> Stream:
    return Stream(vehicle, boot, kind, REGION)


def seqs(batches: list[StoredBatch]) -> list[int]:
    return [batch.seq for batch in batches]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "spool.sqlite"


def test_seq_is_dense_from_one_in_each_stream(path: Path) -> None:
    outbox = Outbox(path, boot=BOOT)
    held = outbox.store(
        [draft(), draft(kind=Kind.STATE), draft(), draft("car-b"), draft(region=9)], now=0.0
    )
    held += outbox.store([draft(), draft(kind=Kind.STATE)], now=0.0)
    outbox.close()
    by_stream: dict[Stream, list[int]] = {}
    for batch in held:
        by_stream.setdefault(batch.stream, []).append(batch.seq)
    assert by_stream == {
        stream(): [1, 2, 3],
        stream(kind=Kind.STATE): [1, 2],
        stream("car-b"): [1],
        Stream("car-a", BOOT, Kind.OBSERVATION, 9): [1],
    }


def test_each_start_draws_another_boot_of_63_bits(tmp_path: Path) -> None:
    boots = set()
    for number in range(20):
        outbox = Outbox(tmp_path / str(number))
        boots.add(outbox.boot)
        outbox.close()
    assert len(boots) == 20
    assert all(0 < boot < 2**63 for boot in boots)


def test_settled_ranges_are_removed_and_first_held_advances(path: Path) -> None:
    outbox = Outbox(path, boot=BOOT)
    outbox.store([draft(records=2) for _ in range(6)], now=0.0)
    assert outbox.settle_ranges(stream(), [(1, 2), (4, 4)]) == 6
    assert outbox.store([draft()], now=0.0)[0].payload == b"7/3"
    assert outbox.settle_ranges(stream(), [(1, 7)]) == 7
    assert outbox.store([draft()], now=0.0)[0].payload == b"8/8"
    assert len(outbox.held) == 1
    outbox.close()


DRIVE = DriveBatches(BOOT, [draft(), draft(kind=Kind.STATE), draft(records=2), draft(region=9)])


def test_a_repeated_drive_is_stored_under_the_same_names(path: Path) -> None:
    stored = []
    for turn in range(2):
        outbox = Outbox(path.with_name(str(turn)))
        outbox.store_drive(DRIVE)
        stored.append({(b.stream, b.seq, b.payload) for b in read_batches(outbox)})
        outbox.close()
    assert stored[0] == stored[1]
    assert {(one.kind, one.region, seq, payload) for one, seq, payload in stored[0]} == {
        (Kind.OBSERVATION, REGION, 1, b"1/1"),
        (Kind.STATE, REGION, 1, b"1/1"),
        (Kind.OBSERVATION, REGION, 2, b"2/1"),
        (Kind.OBSERVATION, 9, 1, b"1/1"),
    }


def test_repeated_drive_is_stored_once_despite_a_damaged_batch(path: Path) -> None:
    """The first try left some batches, one of them damaged. After the repeat, the outbox must have
    each batch of the drive once, and count the agent's own streams from 1.
    """
    outbox = Outbox(path, boot=BOOT + 1)
    outbox.store_drive(DRIVE)
    expected = {(b.stream, b.seq, b.payload) for b in read_batches(outbox)}
    outbox.settle_ranges(stream(), [(1, 1)])
    outbox.close()
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("UPDATE batch SET payload = X'00' WHERE kind = 'state'")
    again = Outbox(path, boot=BOOT + 2)
    again.store_drive(DRIVE)
    again.delete_settled()
    again.close()
    last = Outbox(path, boot=BOOT + 3)
    found = [(b.stream, b.seq, b.payload) for b in read_batches(last)]
    assert len(found) == len(DRIVE.drafts)
    assert set(found) == expected
    assert seqs(last.store([draft()], now=0.0)) == [1]
    last.close()


def test_a_batch_of_a_drive_is_fresh_when_it_is_sent_first(path: Path) -> None:
    outbox = Outbox(path, first_resend_s=1.0)
    outbox.store_drive(DRIVE)
    assert [batch.fresh for batch in outbox.due_batches(0.0, 9)] == [True] * 4
    assert [batch.fresh for batch in outbox.due_batches(2.0, 9)] == [False] * 4
    outbox.close()


def test_a_drive_larger_than_the_outbox_can_be_completed_later(path: Path) -> None:
    """A batch that was dropped for lack of space must be accepted when a repeat sends it. Therefore
    no payload may claim that it will not arrive.
    """
    outbox = Outbox(path, capacity_bytes=5)
    outbox.store_drive(DRIVE)
    assert outbox.counts.evicted[Kind.OBSERVATION] > 0
    assert {b.payload.partition(b"/")[2] for b in read_batches(outbox)} == {b"1"}
    outbox.close()


def test_acknowledgement_of_an_unknown_batch_is_ignored(path: Path) -> None:
    outbox = Outbox(path, boot=BOOT)
    outbox.store([draft()], now=0.0)
    assert outbox.settle_ranges(stream(boot=BOOT + 1), [(1, 1)]) == 0
    assert outbox.settle_ranges(stream(), [(2, 2**62)]) == 0
    assert len(outbox.held) == 1
    outbox.close()


def test_stored_batches_survive_a_kill_and_are_due_under_their_name(path: Path) -> None:
    """A new process must send the batches that a killed process had stored, under their old
    identifiers.
    """
    script = f"""
import os, pathlib, signal
from edge_agent.publish.batching import Draft, DriveBatches
from edge_agent.publish.outbox import Outbox
from schemas.wire import Kind
outbox = Outbox(pathlib.Path({str(path)!r}), boot={BOOT})
draft = Draft("car-a", Kind.OBSERVATION, {REGION}, 3, lambda s, f: b"kept %d" % s)
outbox.store([draft] * 4, 0.0)
gone = outbox.store([Draft("car-a", Kind.STATE, {REGION}, 3, lambda s, f: b"gone")], 0.0)
outbox.settle_ranges(gone[0].stream, [(1, 1)])
outbox.delete_settled()
os.kill(os.getpid(), signal.SIGKILL)
"""
    child = subprocess.run([sys.executable, "-c", script], check=False)
    assert child.returncode == -9
    outbox = Outbox(path, boot=BOOT + 1)
    assert outbox.held.count_records({"car-a"}) == 12
    left = outbox.due_batches(now=0.0, limit=10)
    assert [(b.stream.boot, b.seq, b.payload) for b in left] == [
        (BOOT, s, b"kept %d" % s) for s in (1, 2, 3, 4)
    ]
    assert outbox.store([draft()], now=0.0)[0].seq == 1
    assert outbox.settle_ranges(stream(), [(1, 4)]) == 12
    assert len(outbox.held) == 1
    outbox.close()


def test_unsettled_batches_are_resent_oldest_first_at_growing_intervals(path: Path) -> None:
    outbox = Outbox(path, boot=BOOT, first_resend_s=1.0)
    outbox.store([draft() for _ in range(5)], now=0.0)
    assert outbox.due_batches(now=1.0 - JITTER - 0.01, limit=9) == []
    assert seqs(outbox.due_batches(now=1.0 + JITTER, limit=3)) == [1, 2, 3]
    assert seqs(outbox.due_batches(now=1.0 + JITTER, limit=3)) == [4, 5]
    second = 1.0 + JITTER
    assert outbox.due_batches(now=second + 2 * (1 - JITTER) - 0.01, limit=9) == []
    assert seqs(outbox.due_batches(now=second + 2 * (1 + JITTER), limit=9)) == [1, 2, 3, 4, 5]
    outbox.close()


def silence_route(outbox: Outbox, now: float = 0.0) -> float:
    """Store messages that no service acknowledges, until the outbox (store of unacknowledged
    messages) treats the service as silent. From then on, the outbox keeps new batches on disk
    instead of sending them at once. Return the simulated time [s] at that moment.
    """
    outbox.store([draft()], now)
    while outbox.store([draft()], now)[0].fresh:
        now += 0.5
        outbox.due_batches(now, limit=99)
        assert now < 60.0
    return now


def test_silent_route_keeps_batches_on_disk_and_probes_every_two_minutes(
    path: Path,
) -> None:
    outbox = Outbox(path, boot=BOOT)
    began = silence_route(outbox)
    assert SILENT_S <= began <= SILENT_S + 8.0
    put = []
    for second in range(0, 3600, 5):
        assert not any(batch.fresh for batch in outbox.store([draft()], began + second))
        put += [(second, batch.seq) for batch in outbox.due_batches(began + second, limit=64)]
    assert 20 <= len(put) <= 50
    assert put[-1][0] - put[-2][0] <= LONGEST_PROBE_S * (1 + JITTER) + 5
    # The outbox must probe with different batches, because a service may be unable to answer a
    # particular one.
    assert len({seq for _, seq in put}) > 5
    outbox.close()


def test_first_answer_releases_batches_oldest_first_and_ever_faster(path: Path) -> None:
    outbox = Outbox(path, boot=BOOT)
    now = silence_route(outbox)
    for _ in range(300):
        outbox.store([draft()], now)
    while not (probe := outbox.due_batches(now, limit=64)):
        now += 1.0
    outbox.settle_ranges(stream(), [(probe[0].seq, probe[0].seq)])
    rounds = []
    out = outbox.due_batches(now, limit=10**6)
    assert seqs(out) == sorted(seqs(out))
    while out:
        rounds.append(len(out))
        now += 1.0
        outbox.settle_ranges(stream(), [(batch.seq, batch.seq) for batch in out])
        out = outbox.due_batches(now, limit=10**6)
    assert len(outbox.held) == 0
    assert FIRST_WINDOW <= rounds[0] <= FIRST_WINDOW + 1
    assert max(rounds) >= 2 * FIRST_WINDOW
    assert outbox.store([draft()], now)[0].fresh
    outbox.close()


def test_unserved_region_does_not_suppress_the_others(path: Path) -> None:
    outbox = Outbox(path, boot=BOOT)
    now = 0.0
    for _ in range(60):
        batches = outbox.store([draft(), draft(region=9)], now)
        outbox.settle_ranges(stream(), [(batches[0].seq, batches[0].seq)])
        outbox.due_batches(now, limit=64)
        now += 1.0
    assert [batch.fresh for batch in outbox.store([draft(), draft(region=9)], now)] == [True, False]
    outbox.close()


def test_reconnect_sends_everything_again_oldest_first_and_once(path: Path) -> None:
    outbox = Outbox(path, boot=BOOT, first_resend_s=4.0)
    outbox.store([draft() for _ in range(5)] + [draft("car-b")], now=0.0)
    outbox.reset_in_flight("car-a", now=1.0)
    assert seqs(outbox.due_batches(now=1.0, limit=9)) == [1, 2, 3, 4, 5]
    assert outbox.due_batches(now=1.0, limit=9) == []
    assert [
        b.stream.vehicle
        for b in outbox.due_batches(now=4.0 * (1 + JITTER) - 0.01, limit=9)
        if b.seq == 1
    ].count("car-a") <= 1
    outbox.close()


def test_a_backlog_of_two_regions_is_sent_in_the_order_of_the_drive(path: Path) -> None:
    drive = [77] * 6 + [9] * 6 + [77] * 6
    outbox = Outbox(path, boot=BOOT, first_resend_s=4.0)
    stored = outbox.store([draft(region=region) for region in drive], now=0.0)
    outbox.reset_in_flight("car-a", now=1.0)
    sent: list[StoredBatch] = []
    while batches := outbox.due_batches(now=1.0, limit=4):
        sent += batches
    assert [(b.stream, b.seq) for b in sent] == [(b.stream, b.seq) for b in stored]
    outbox.close()


def test_reconnect_probes_a_silent_route_at_once_with_one_batch(path: Path) -> None:
    outbox = Outbox(path, boot=BOOT)
    now = silence_route(outbox)
    for _ in range(12):
        now += LONGEST_PROBE_S
        outbox.due_batches(now, limit=9)
    outbox.reset_in_flight("car-a", now)
    assert len(outbox.due_batches(now, limit=9)) == 1
    outbox.close()


def test_batches_of_a_former_name_are_counted_and_not_sent(path: Path) -> None:
    outbox = Outbox(path, boot=BOOT)
    outbox.store([draft("car-old", records=3), draft("car-new")], now=0.0)
    outbox.close()
    again = Outbox(path, boot=BOOT + 1)
    assert [batch.stream.vehicle for batch in again.due_batches(0.0, 9, {"car-new"})] == ["car-new"]
    assert again.held.count_stranded({"car-new"}) == 3
    again.close()


def test_folders_made_for_an_outbox_are_synced_into_the_ones_above(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[Path] = []
    fsync = os.fsync

    def record_sync(handle: int) -> None:
        synced.append(Path(f"/proc/self/fd/{handle}").resolve())
        fsync(handle)

    monkeypatch.setattr(os, "fsync", record_sync)
    Outbox(tmp_path / "a" / "b" / "spool.sqlite").close()
    assert synced == [tmp_path, tmp_path / "a"]


def test_full_outbox_drops_oldest_states_then_observations_and_counts(path: Path) -> None:
    outbox = Outbox(path, boot=BOOT, capacity_bytes=4_500)
    for _ in range(2):
        outbox.store([draft(size=1_000), draft(kind=Kind.STATE, size=1_000, records=7)], now=0.0)
    outbox.store([draft(size=1_000)], now=0.0)
    assert outbox.counts.evicted == {Kind.STATE: 7, Kind.OBSERVATION: 0}
    outbox.store([draft(size=1_000), draft(size=1_000)], now=0.0)
    assert outbox.counts.evicted == {Kind.STATE: 14, Kind.OBSERVATION: 1}
    assert outbox.held.bytes <= 4_500
    assert seqs(outbox.due_batches(now=2.0 * (1 + JITTER), limit=9)) == [2, 3, 4, 5]
    assert outbox.store([draft()], now=0.0)[0].payload == b"6/2"
    outbox.close()


def test_dropped_batches_do_not_return_after_a_restart(path: Path) -> None:
    outbox = Outbox(path, boot=BOOT, capacity_bytes=2_500)
    outbox.store([draft(size=1_000) for _ in range(4)], now=0.0)
    outbox.close()
    again = Outbox(path, boot=BOOT + 1)
    assert seqs(again.due_batches(now=0.0, limit=9)) == [3, 4]
    again.close()


def test_a_settled_batch_that_a_crash_brings_back_is_offered_again(path: Path) -> None:
    """A crash may undo the deletion of a settled (acknowledged) batch. The outbox must then send
    the batch again; the service knows it and acknowledges it again.
    """
    script = f"""
import os, pathlib, signal
from edge_agent.publish.batching import Draft, DriveBatches
from edge_agent.publish.held_batches import Stream
from edge_agent.publish.outbox import Outbox
from schemas.wire import Kind
outbox = Outbox(pathlib.Path({str(path)!r}), boot={BOOT})
draft = Draft("car-a", Kind.STATE, {REGION}, 3, lambda s, f: b"seen")
held = outbox.store([draft] * 2, 0.0)
outbox.settle_ranges(held[0].stream, [(1, 1)])
os.kill(os.getpid(), signal.SIGKILL)
"""
    subprocess.run([sys.executable, "-c", script], check=False)
    outbox = Outbox(path)
    assert seqs(outbox.due_batches(now=0.0, limit=9)) == [1, 2]
    outbox.close()


def test_a_batch_that_cannot_be_encoded_leaves_no_gap(path: Path) -> None:
    def broken(seq: int, first_held: int) -> bytes:
        raise ValueError(f"{seq} {first_held}")

    outbox = Outbox(path, boot=BOOT)
    with pytest.raises(ValueError, match="2 1"):
        outbox.store([draft(), Draft("car-a", Kind.OBSERVATION, REGION, 1, broken)], now=0.0)
    assert len(outbox.held) == 0
    assert seqs(outbox.store([draft()], now=0.0)) == [1]
    outbox.close()


def test_one_outbox_never_serves_two_agents(path: Path) -> None:
    outbox = Outbox(path)
    with pytest.raises(
        InputError, match="spool: .* is used by another agent; give each agent its own"
    ):
        Outbox(path)
    outbox.close()
    Outbox(path).close()


def test_an_outbox_below_a_file_is_refused(path: Path) -> None:
    path.write_text("no folder")
    with pytest.raises(InputError, match="spool: .* cannot be opened"):
        Outbox(path / "spool.sqlite")


def test_a_file_that_is_no_outbox_is_refused_and_left_alone(path: Path) -> None:
    path.write_bytes(b"my shopping list, and it is longer than a header" * 40)
    with pytest.raises(InputError, match="spool: .* cannot be opened"):
        Outbox(path)
    assert path.read_bytes().startswith(b"my shopping list")


def test_unanswered_batch_is_dropped_before_it_blocks_its_stream(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("edge_agent.publish.held_batches.PASSED_OVER", 40)
    outbox = Outbox(path, boot=BOOT)
    now = 0.0
    for turn in range(60):
        now += 1.0
        fresh = outbox.store([draft(records=2)], now)
        outbox.due_batches(now, 64)
        for batch in fresh:
            if batch.seq != 3:  # stands for a batch that no service can decode
                outbox.settle_ranges(stream(), [(batch.seq, batch.seq)])
        assert outbox.counts.unanswered == 0 or turn >= 42
    assert len(outbox.held) == 0
    assert outbox.counts.unanswered == 2
    assert outbox.store([draft()], now)[0].payload == b"61/61", "older than that never comes"
    outbox.close()


@pytest.mark.campaign
def test_waiting_batches_take_little_memory_and_leave_none_behind(path: Path) -> None:
    """Batches that wait in the outbox must need little memory, and settled (acknowledged) ones
    none. The reports of one vehicle in a day are 170 000 batches.
    """
    count = 20_000
    outbox = Outbox(path, boot=BOOT)
    outbox.store(
        [draft(kind=(Kind.STATE, Kind.OBSERVATION)[k % 2], size=200) for k in range(count)], now=0.0
    )
    outbox.close()
    tracemalloc.start()
    try:
        again = Outbox(path, boot=BOOT + 1)
        assert len(again.held) == count
        assert tracemalloc.get_traced_memory()[0] < 320 * count
        for kind in Kind:
            again.settle_ranges(stream(kind=kind), [(1, count)])
        again.delete_settled()
        held = []
        for turn in range(40):
            again.store([draft(size=200) for _ in range(500)], now=10.0 * turn)
            again.settle_ranges(stream(boot=BOOT + 1), [(1, 500 * (turn + 1))])
            assert again.due_batches(10.0 * turn, 100) == []
            held.append(tracemalloc.get_traced_memory()[0])
        assert max(held[30:]) < 1.5 * max(held[10:20]), "what is gone takes nothing"
    finally:
        tracemalloc.stop()
    again.close()
