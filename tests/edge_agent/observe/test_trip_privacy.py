"""Tests of trip privacy: the agent must publish nothing near the start and the end of a trip, and
everything in between.
"""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from edge_agent.observe.observation_builder import RecordBlock
from edge_agent.observe.trip_privacy import TripEnds
from schemas.numeric import IntArray
from schemas.thresholds import NS
from schemas.wire import Kind

SPEED = 10.0


def states(time: IntArray, vehicle: int = 0) -> RecordBlock:
    n = len(time)
    return RecordBlock(Kind.STATE, {"time": time}, np.full(n, vehicle), np.zeros(n, bool))


def list_passed_times(ends: TripEnds, seconds: int, block_s: float = 0.5) -> list[float]:
    """Simulate a trip of `seconds` at SPEED, with one state record per second. Return the times [s]
    of the records that pass the filter `ends`, which removes records near both ends of a trip.
    """
    out = []
    steps = round(1.0 / 0.1 * block_s)
    for block in range(round(seconds / block_s)):
        t = (block * block_s + 0.1 * np.arange(1, steps + 1))[:, None]
        time = np.rint(t * NS).astype(np.int64)
        ends.advance(time / NS, time, np.full(time.shape, SPEED))
        out += (
            ends.release_records(states(time[time % NS == 0].ravel())).columns["time"] / NS
        ).tolist()
    return out


def test_without_the_setting_every_record_passes_at_once() -> None:
    assert list_passed_times(TripEnds(1, 0.0, 0.0), 20) == list(range(1, 21))


@pytest.mark.parametrize(
    ("metres", "seconds", "cut"), [(50.0, 0.0, 5.0), (0.0, 7.0, 7.0), (30.0, 8.0, 8.0)]
)
def test_both_ends_are_cut_by_the_larger_of_way_and_time(
    metres: float, seconds: float, cut: float
) -> None:
    found = list_passed_times(TripEnds(1, metres, seconds), 40)
    assert min(found) == pytest.approx(cut, abs=1.01)
    assert max(found) == pytest.approx(40.0 - cut, abs=1.01)
    assert found == sorted(found)
    assert len(found) == len(set(found)) == max(found) - min(found) + 1


def test_standing_vehicle_has_not_left_the_start_of_its_trip() -> None:
    ends = TripEnds(1, 50.0, 0.0)
    for k in range(1, 100):
        time = np.array([[k * NS]])
        ends.advance(time / NS, time, np.zeros((1, 1)))
        assert not len(ends.release_records(states(time[0])).vehicle)


@pytest.mark.parametrize("clock_off_s", [-1e9, 3600.0])
def test_a_clock_corrected_at_the_first_fix_does_not_change_the_trip_ends(
    clock_off_s: float,
) -> None:
    ends = TripEnds(1, 50.0, 0.0)
    published = []
    for second in range(40):
        off_ns = round(clock_off_s * NS) if second < 3 else 0
        time = np.array([[2_000_000_000 * NS + second * NS + off_ns]])
        ends.advance(np.array([[float(second)]]), time, np.full((1, 1), SPEED))
        found = ends.release_records(states(time[0] if second >= 3 else time[0, :0]))
        published += (found.columns["time"] // NS - 2_000_000_000).tolist()
    assert published == list(range(5, 35))


def test_waiting_records_take_no_more_memory_while_the_vehicle_stands() -> None:
    ends = TripEnds(1, 50.0, 0.0)
    sizes = []
    for second in range(1000):
        time = np.array([[second * NS]])
        ends.advance(time / NS, time, np.full((1, 1), SPEED if second < 20 else 0.0))
        ends.release_records(states(time[0] if second < 20 else time[0, :0]))
        sizes.append(len(pickle.dumps(ends)))
    assert sizes[-1] == sizes[30], "the effort per block would grow with the time of standing"
