"""Tests of the removal of repeated batches. The admitted batches must equal those that a plain set
admits, and the number of remembered batches must stay bounded.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_service.ingest import dedup
from fleet_service.ingest.dedup import ArchivedRows, SequenceTracker, SequenceTrackers
from schemas.wire import Kind

KEY = (1, 5, Kind.STATE, 7)
STEPS = st.lists(st.tuples(st.integers(1, 60), st.integers(1, 60)), max_size=80)


@given(STEPS)
def test_sequence_tracker_knows_accepted_and_skipped_numbers(
    steps: list[tuple[int, int]],
) -> None:
    stream = SequenceTracker(KEY)
    accepted = set()
    floor = 0
    for seq, held in steps:
        floor = max(floor, min(held, seq) - 1)
        stream.raise_to(min(held, seq))
        assert stream.has_accepted(seq) == (seq <= floor or seq in accepted)
        stream.accept(seq)
        accepted.add(seq)
    for seq in range(1, 62):
        assert stream.has_accepted(seq) == (seq <= floor or seq in accepted)
    assert all(limit > stream.low + 1 for limit in stream.runs)
    assert all(before < after for before, after in pairwise(stream.runs))


def test_a_stream_without_gaps_is_one_number() -> None:
    stream = SequenceTracker(KEY)
    for seq in range(1, 5001):
        assert stream.accept(seq)
    assert (stream.low, len(stream.runs)) == (5000, 0)


def test_no_seq_however_far_ahead_takes_more_room_than_one_batch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(dedup, "MAX_GAPS", 3)
    stream = SequenceTracker(KEY)
    assert [stream.accept(2**62 - 2 * k) for k in range(4)] == [True, True, True, False]
    assert not stream.has_accepted(2**62 - 6)
    assert stream.accept(1)
    assert stream.low == 1


def test_a_sender_without_first_held_is_accepted_in_a_new_month(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A sender's numbers continue in the stream that begins with its new pseudonym."""
    monkeypatch.setattr(dedup, "MAX_GAPS", 3)
    streams = SequenceTrackers()
    for seq in range(1001, 2001):
        assert streams[KEY].accept(seq)
    again = SequenceTrackers.of(*streams.columns())
    for kept in (streams, again):
        assert all(kept[KEY].has_accepted(seq) for seq in range(1001, 2001))
        assert not kept[KEY].has_accepted(1000)
        assert not kept[KEY].has_accepted(2001)
    assert len(again[KEY].runs) == 2


@pytest.mark.campaign
@given(st.lists(st.tuples(st.integers(0, 1), st.integers(1, 30), st.integers(1, 30)), max_size=60))
def test_rows_of_an_archive_restore_the_streams_that_wrote_them(
    rows: list[tuple[int, int, int]],
) -> None:
    before = SequenceTrackers()
    after = SequenceTrackers()
    for vehicle, seq, held in rows:
        stream = before[vehicle, 5, Kind.STATE, 7]
        stream.raise_to(min(seq, held))
        stream.accept(seq, 100 + seq)
    columns = np.array(rows, np.int64).reshape(-1, 3).T
    fixed = np.ones_like(columns[0])
    held = np.minimum(columns[1], columns[2])
    archived = ArchivedRows(columns[0], 5 * fixed, 7 * fixed, columns[1], held, 100 + columns[1])
    after.restore(Kind.STATE, archived)
    for vehicle in {row[0] for row in rows}:
        one = before[vehicle, 5, Kind.STATE, 7]
        other = after[vehicle, 5, Kind.STATE, 7]
        assert (one.low, list(one.runs), one.newest) == (other.low, list(other.runs), other.newest)
    assert len(before) == len(after)


def test_streams_too_old_to_be_let_in_again_are_forgotten() -> None:
    both = SequenceTrackers()
    both[1, 1, Kind.STATE, 1].accept(1, 100)
    both[2, 1, Kind.STATE, 1].accept(1, 50)
    both[2, 1, Kind.STATE, 1].accept(2, 150)
    both.forget(101)
    assert len(both) == 1
    assert both[2, 1, Kind.STATE, 1].has_accepted(2)
