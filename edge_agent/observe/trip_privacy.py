"""Privacy of trip ends: records (observations and states of motion) from near the beginning and the
end of a trip are not published.

A parking place identifies the vehicle's owner. Therefore a record is published only if it lies at
least `metres` and `seconds` after the beginning of the trip. The record then waits until the
vehicle has driven on for `metres` and `seconds`. Records that still wait at the end of the trip are
never published. A trip lasts as long as the pipeline object (one run of the agent). If both limits
are zero, every record is published immediately. The module is pure (no I/O).
"""

from __future__ import annotations

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
        self._ns = round(seconds * NS)
        self._driven: FloatArray = np.zeros(vehicles)  # [m] distance up to the last sample
        self._times: list[IntArray] = []
        self._odometers: list[FloatArray] = []
        self._began: IntArray | None = None
        self._waiting: dict[Kind, RecordBlock] = {}

    @property
    def _is_off(self) -> bool:
        return self._metres == 0.0 and self._ns == 0

    def advance(self, time: IntArray, speed: FloatArray) -> None:
        """Update the distance that each of N vehicles has driven with a block of samples: `time`
        (T, N) [ns UTC] and `speed` (T, N) [m/s].
        """
        if self._is_off:
            return
        if self._began is None:
            self._began = time[0].copy()
            self._times.append(time[:1])
            self._odometers.append(self._driven[None].copy())
        before = np.vstack([self._times[-1][-1:], time])
        odometer = self._driven + np.cumsum(np.abs(speed) * np.diff(before, axis=0) / NS, axis=0)
        self._driven = odometer[-1]
        self._times.append(time[-1:])
        self._odometers.append(odometer[-1:])
        self._drop_old_track()

    def release_records(self, records: RecordBlock) -> RecordBlock:
        """Return the records that may be published now. They come from `records` and from the
        records that waited since earlier calls; the others wait on.
        """
        if self._is_off or self._began is None:
            return records
        waiting = self._waiting.get(records.kind)
        both = records if waiting is None else _join_blocks(waiting, records)
        time: IntArray = both.columns[_TIME[records.kind]]
        driven = self._distance_at(time, both.vehicle)
        now = self._times[-1][-1][both.vehicle]
        begun = (driven >= self._metres) & (time - self._began[both.vehicle] >= self._ns)
        passed = (self._driven[both.vehicle] - driven >= self._metres) & (now - time >= self._ns)
        self._waiting[records.kind] = _select_rows(both, begun & ~passed)
        return _select_rows(both, begun & passed)

    def _drop_old_track(self) -> None:
        """Delete the stored times and distances of the vehicles that are older than the oldest
        waiting record, because they are no longer needed.
        """
        waiting = [
            r.columns[_TIME[kind]].min() for kind, r in self._waiting.items() if len(r.vehicle)
        ]
        oldest = min(waiting, default=self._times[-1].min())
        while len(self._times) > 2 and self._times[1].max() <= oldest:
            del self._times[0], self._odometers[0]

    def _distance_at(self, time: IntArray, vehicle: IntArray) -> FloatArray:
        """Return the distances (n,) [m] that n vehicles had driven since the start of the trip.
        Element i is the distance of the vehicle with index `vehicle[i]` at `time[i]` [ns UTC]. It
        is interpolated between the ends of the blocks of samples.
        """
        times = np.vstack(self._times)
        odometers = np.vstack(self._odometers)
        out = np.empty(len(time))
        for n in np.unique(vehicle).tolist():
            rows = vehicle == n
            since = times[0, n]
            out[rows] = np.interp(
                (time[rows] - since) / NS, (times[:, n] - since) / NS, odometers[:, n]
            )
        return out


def _select_rows(
    records: RecordBlock, rows: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> RecordBlock:
    columns = {name: column[rows] for name, column in records.columns.items()}
    return RecordBlock(records.kind, columns, records.vehicle[rows], records.urgent[rows])


def _join_blocks(first: RecordBlock, second: RecordBlock) -> RecordBlock:
    columns = {
        name: np.concatenate([first.columns[name], second.columns[name]]) for name in first.columns
    }
    vehicle, urgent = (
        np.concatenate([getattr(r, n) for r in (first, second)]) for n in ("vehicle", "urgent")
    )
    return RecordBlock(first.kind, columns, vehicle, urgent)
