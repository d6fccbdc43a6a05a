"""Batching: records are collected per (vehicle, kind, region) until a batch (one message) is due.
The module is pure: no I/O, and time is an argument.

A batch is due when it is full, when its oldest record has waited long enough, or immediately when a
record is urgent. The batches of a recorded drive do not depend on time (`batch_drive`).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_agent.observe.observation_builder import RecordBlock
from schemas import grid
from schemas.numeric import IntArray
from schemas.thresholds import NS
from schemas.wire import Batch, Columns, Kind, encode

SPAN_NS: Final = 600 * NS  # [ns] largest time span of a batch; a service rejects an hour
_TIME: Final = {Kind.OBSERVATION: "leave_time", Kind.STATE: "time"}
# Step to which the digest of a recorded drive rounds values. Their last bits differ between
# processors. No constant of the estimator lies halfway between two multiples of this step.
DIGEST_STEP: Final = math.pi / 100
UNNUMBERED: Final = 0  # placeholder until the outbox stores and numbers the batch


@dataclass(frozen=True)
class Draft:
    """Batch of records that has no sequence number yet. `encode(seq, first_held)` returns its
    payload with its sequence number `seq`, and with `first_held`, the lowest number of its stream
    that is still in the outbox.
    """

    vehicle: str
    kind: Kind
    region: int
    records: int
    encode: Callable[[int, int], bytes]


class DriveBatches(NamedTuple):
    """All batches of a recorded drive, in the order of sending, and their `boot`."""

    boot: int
    drafts: list[Draft]


class _Place(NamedTuple):
    vehicle: int
    kind: Kind
    region: int


@dataclass
class _Group:
    since: float
    urgent: bool = False
    rows: int = 0
    parts: list[Columns] = field(default_factory=list)


class Batcher:
    """Collector that groups the records of the vehicles `names` into batches (messages). A batch
    has at most `rows` records, and its oldest record waits at most `flush_s` seconds.
    """

    def __init__(
        self, names: Sequence[str], boot: int, estimator: str, *, flush_s: float, rows: int
    ) -> None:
        self._names = tuple(names)
        self._boot = boot
        self._estimator = estimator
        self._flush_s = flush_s
        self._rows = rows
        self._groups: dict[_Place, _Group] = {}

    @property
    def records(self) -> int:
        """Return the number of records that are not yet part of a batch."""
        return sum(group.rows for group in self._groups.values())

    def add(self, records: RecordBlock, now: float) -> None:
        """Add records to the groups of their vehicle, kind and region at time `now` [s]. The
        records of each group keep their order.

        Raises:
            IndexError: a record has a vehicle index without a name.
        """
        if not len(records.vehicle):
            return
        if records.vehicle.min() < 0 or records.vehicle.max() >= len(self._names):
            raise IndexError("records of a vehicle that has no name")
        columns = records.columns
        if records.kind is Kind.OBSERVATION:
            cells = columns["cell"]
        else:
            cells = grid.cell_of(columns["latitude"], columns["longitude"])
        owners = np.stack([records.vehicle, grid.region_of(cells)], axis=1)
        unique, owner_index = np.unique(owners, axis=0, return_inverse=True)
        for index, (vehicle, region) in enumerate(unique.tolist()):
            chosen = np.flatnonzero(owner_index.ravel() == index)
            group = self._groups.setdefault(_Place(vehicle, records.kind, region), _Group(now))
            group.parts.append({name: column[chosen] for name, column in columns.items()})
            group.rows += len(chosen)
            group.urgent |= bool(records.urgent[chosen].any())

    def take_due(self, now: float, *, flush_all: bool = False) -> list[Draft]:
        """Remove the records whose batch is due at time `now` [s] from the collector, and return
        the batches. With `flush_all`, all batches are due.
        """
        drafts: list[Draft] = []
        for place, group in list(self._groups.items()):
            whole = flush_all or group.urgent or now - group.since >= self._flush_s
            ready = group.rows if whole else group.rows - group.rows % self._rows
            if not ready:
                continue
            del self._groups[place]
            joined = {
                name: np.concatenate([part[name] for part in group.parts])
                for name in group.parts[0]
            }
            for first, last in _batch_ranges(joined[_TIME[place.kind]], ready, self._rows):
                drafts.append(self._make_draft(place, _slice_columns(joined, first, last)))
            if ready < group.rows:
                rest = _slice_columns(joined, ready, group.rows)
                self._groups[place] = _Group(now, rows=group.rows - ready, parts=[rest])
        return drafts

    def _make_draft(self, place: _Place, columns: Columns) -> Draft:
        name = self._names[place.vehicle]
        batch = Batch(
            place.kind,
            name,
            self._boot,
            place.region,
            UNNUMBERED,
            UNNUMBERED,
            columns,
            self._estimator,
        )
        return Draft(name, place.kind, place.region, batch.rows, partial(_encode_batch, batch))


def batch_drive(
    records: Sequence[RecordBlock], name: str, estimator: str, rows: int
) -> DriveBatches:
    """Return the batches of a recorded drive of the vehicle `name`, with at most `rows` records
    each.

    `boot` (63 bits) is a digest of the records and of their division into batches. Therefore the
    same records always have the same identity, so that the service counts them once, and other
    records have another identity.
    """
    whole = partial(Batcher, [name], estimator=estimator, flush_s=0.0, rows=rows)
    parts = [
        (one.kind, one.region, one.records) for one in _make_drafts(records, whole(UNNUMBERED))
    ]
    digest = hashlib.sha256(repr((name, estimator, parts)).encode())
    for block in records:
        for column, values in sorted(block.columns.items()):
            digest.update(column.encode() + _rounded_bytes(values))
    boot = int.from_bytes(digest.digest()[:8]) >> 1
    return DriveBatches(boot, _make_drafts(records, whole(boot)))


def _rounded_bytes(values: NDArray[Any]) -> bytes:
    """Return the values of a column as bytes that are the same on each machine: rounded, and with
    one form of zero and of NaN.
    """
    if values.dtype.kind == "f":
        values = np.nan_to_num(np.rint(values / DIGEST_STEP), nan=np.inf) + 0.0
    return values.tobytes()


def _make_drafts(records: Sequence[RecordBlock], batcher: Batcher) -> list[Draft]:
    drafts: list[Draft] = []
    for block in records:
        batcher.add(block, 0.0)
        drafts += batcher.take_due(0.0, flush_all=True)
    return drafts


def _batch_ranges(time: IntArray, ready: int, rows: int) -> Iterator[tuple[int, int]]:
    """Divide the first `ready` records, which have the times `time` [ns], into batches. Yield the
    index range [first, last) of each batch.

    A batch has at most `rows` records. Its time span is limited too, because a replayed drive may
    be long.
    """
    first = 0
    for at in range(1, ready + 1):
        if at == ready or at - first == rows or abs(int(time[at]) - int(time[first])) > SPAN_NS:
            yield first, at
            first = at


def _slice_columns(columns: Columns, first: int, last: int) -> Columns:
    return {name: column[first:last] for name, column in columns.items()}


def _encode_batch(batch: Batch, seq: int, first_held: int) -> bytes:
    """Return the payload of a batch with its sequence number `seq`. The outbox (store on disk)
    assigned this number. `first_held` is the stream's lowest number that is still in the outbox.
    """
    return encode(replace(batch, seq=seq, first_held=first_held))
