"""Privacy of trip ends: records (observations and states of motion) from near the beginning and the
end of a trip are not published.

A parking place identifies the vehicle's owner. Therefore a record is published only if it lies at
least `metres` and `seconds` after the beginning of the trip. The record then waits until the
vehicle has driven on for `metres` and `seconds`. Records that still wait at the end of the trip are
never published. A trip lasts as long as the pipeline object (one run of the agent). If both limits
are zero, every record is published immediately. The module is pure (no I/O).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from edge_agent.observe.observation_builder import RecordBlock
from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import NS
from schemas.wire import Kind

_TIME = {Kind.OBSERVATION: "leave_time", Kind.STATE: "time"}


class TripEnds:
    """Filter that removes the records near the ends of the trips of N vehicles. Call `advance` with
    each block of samples, then `release_records` with the records of the block.

    Args:
        vehicles: number of vehicles.
        metres, seconds: distance and time from either end of a trip; a record is published only
            beyond both.
    """

    def __init__(self, vehicles: int, metres: float, seconds: float) -> None:
        self._metres = metres
        self._seconds = seconds
        # Steady time [s] and distance [m] at the last sample of the previous and of this block.
        self._t: FloatArray = np.zeros((0, vehicles))
        self._driven: FloatArray = np.zeros((1, vehicles))
        self._began: FloatArray | None = None
        self._now: IntArray = np.zeros(vehicles, np.int64)  # [ns UTC] time of the last sample
        self._waiting: dict[Kind, _PlacedRecords] = {}

    @property
    def _is_off(self) -> bool:
        return self._metres == 0.0 and self._seconds == 0.0

    def advance(self, t: FloatArray, time: IntArray, speed: FloatArray) -> None:
        """Update the distance that each of N vehicles has driven with a block of samples: steady
        time `t` (T, N) [s], `time` (T, N) [ns UTC] and `speed` (T, N) [m/s].

        Time and distance of the trip are those of the steady time, because the UTC time jumps when
        the first position fix corrects it.
        """
        if self._is_off:
            return
        if self._began is None:
            self._began = t[0].copy()
            self._t = t[:1].copy()
        passed = np.vstack([self._t[-1:], t])
        driven = self._driven[-1] + (np.abs(speed) * np.diff(passed, axis=0)).sum(axis=0)
        self._t = passed[[0, -1]]
        self._driven = np.vstack([self._driven[-1], driven])
        self._now = time[-1]

    def release_records(self, records: RecordBlock) -> RecordBlock:
        """Return the records that may be published now. They come from `records`, which lie in the
        last block of samples, and from the records that waited since earlier calls; the others wait
        on.
        """
        if self._is_off or self._began is None:
            return records
        both = self._place_records(records)
        if records.kind in self._waiting:
            both = _join_records(self._waiting[records.kind], both)
        vehicle = both.records.vehicle
        begun = (both.driven >= self._metres) & (both.t - self._began[vehicle] >= self._seconds)
        passed = (self._driven[-1, vehicle] - both.driven >= self._metres) & (
            self._t[-1, vehicle] - both.t >= self._seconds
        )
        waiting = begun & ~passed
        self._waiting[records.kind] = _PlacedRecords(
            _select_rows(both.records, waiting), both.t[waiting], both.driven[waiting]
        )
        return _select_rows(both.records, begun & passed)

    def _place_records(self, records: RecordBlock) -> _PlacedRecords:
        """Return the records of the last block with their place in the trip. The distance is
        interpolated between the ends of the blocks of samples.
        """
        vehicle = records.vehicle
        t = self._t[-1, vehicle] - (self._now[vehicle] - records.columns[_TIME[records.kind]]) / NS
        begin = self._t[0, vehicle]
        duration = np.maximum(self._t[1, vehicle] - begin, np.finfo(np.float64).tiny)
        share = np.clip((t - begin) / duration, 0.0, 1.0)
        before = self._driven[0, vehicle]
        return _PlacedRecords(records, t, before + (self._driven[1, vehicle] - before) * share)


class _PlacedRecords(NamedTuple):
    """Records with their places in the trip, (n,) each: the steady time `t` [s], and the distance
    `driven` since the beginning of the trip [m].
    """

    records: RecordBlock
    t: FloatArray
    driven: FloatArray


def _select_rows(
    records: RecordBlock, rows: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> RecordBlock:
    columns = {name: column[rows] for name, column in records.columns.items()}
    return RecordBlock(records.kind, columns, records.vehicle[rows], records.urgent[rows])


def _join_records(first: _PlacedRecords, second: _PlacedRecords) -> _PlacedRecords:
    one = first.records
    other = second.records
    columns = {
        name: np.concatenate([column, other.columns[name]]) for name, column in one.columns.items()
    }
    vehicle = np.concatenate([r.vehicle for r in (one, other)])
    urgent = np.concatenate([r.urgent for r in (one, other)])
    return _PlacedRecords(
        RecordBlock(one.kind, columns, vehicle, urgent),
        np.concatenate([first.t, second.t]),
        np.concatenate([first.driven, second.driven]),
    )
