"""Many payloads → one set of columns. Python is touched per message and per column, never per record.

The protobuf library parses each message; then column by column the values of all messages are taken together. What is
wrong with a message is an error beside the others and never their loss. A column that a sender left out is filled:
floats with NaN, the cell and the sector from the pose, the leaving time from the entering one.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, compress
from operator import attrgetter
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas import grid, mugrid
from schemas.errors import WireError
from schemas.numeric import BoolArray, IntArray
from schemas.wire import ENCODING, MAX_ROWS, MESSAGES, Batch, Columns, Kind, column_types, parse

NEEDED: Final = {
    Kind.OBSERVATION: ("enter_time", "latitude", "longitude"),
    Kind.STATE: ("time", "latitude", "longitude"),
}
_ABSENT: Final = {"abs_active": -1}  # what an absent integer reads as, where it is not 0


class Head(NamedTuple):
    """What a batch says of itself, beside its records."""

    kind: Kind
    vehicle: str
    boot: int
    region: int
    seq: int
    first_held: int
    estimator: str


class Decoded(NamedTuple):
    """The good ones of several messages.

    Attributes:
        places: which messages these are, (k,).
        heads: of each.
        sizes: records of each, (k,).
        columns: every column of the kind's table, all records one after the other, (n,); `log_likelihood` is (n, 32).
        told: whether a record came with a likelihood, (n,).
        errors: place and reason of each message that is no batch.
    """

    places: list[int]
    heads: list[Head]
    sizes: IntArray
    columns: Columns
    told: BoolArray
    errors: list[tuple[int, WireError]]


def decode_many(kind: Kind, payloads: Sequence[tuple[bytes, str]]) -> Decoded:
    """Read batches of one kind from payloads and their encodings."""
    places: list[int] = []
    messages: list[Any] = []
    errors: list[tuple[int, WireError]] = []
    for place, (payload, encoding) in enumerate(payloads):
        try:
            messages.append(parse(payload, encoding, MESSAGES[kind], ENCODING[kind]))
            places.append(place)
        except WireError as error:
            errors.append((place, error))
    fields = _Fields.of(kind, messages)
    if not fields.sound.all():
        errors += [(places[at], _complaint(messages[at], kind)) for at in np.flatnonzero(~fields.sound).tolist()]
        places, messages = (list(compress(those, fields.sound)) for those in (places, messages))
        fields = _Fields.of(kind, messages)
    heads = [
        Head(kind, m.vehicle, m.boot, m.region, m.seq, m.first_held or 1, m.estimator) for m in messages
    ]  # fmt: skip
    return _without_misfits(Decoded(places, heads, *fields.columns(), errors), fields)


def decode(payload: bytes, encoding: str, kind: Kind) -> Batch:
    """Read one batch; the inverse of `wire.encode` for every column that was sent.

    Raises:
        WireError: too large, not the message, no needed column, or columns of unequal length.
    """
    found = decode_many(kind, [(payload, encoding)])
    for _, error in found.errors:
        raise error
    (head,) = found.heads
    if kind is Kind.OBSERVATION and not found.told.all():
        found.columns["log_likelihood"] = found.columns["log_likelihood"][:, :0]
    return Batch(kind, *head[1:-1], found.columns, head.estimator)


def _complaint(message: Any, kind: Kind) -> WireError:  # noqa: ANN401
    """What is wrong with the lengths of a message's columns."""
    first = NEEDED[kind][0]
    n = len(getattr(message, first))
    if not 1 <= n <= MAX_ROWS:
        return WireError(first, f"{n} records", f"send 1 to {MAX_ROWS}")
    for name in column_types(kind):
        given = len(getattr(message, name))
        if name == "log_likelihood":
            if given not in (0, n * mugrid.BINS):
                return WireError(name, f"{given} bytes for {n} records", f"send {mugrid.BINS} a record, or none")
        elif given != n and (given or name in NEEDED[kind]):
            return WireError(name, f"has {given} records, {first} has {n}", "give every column the same length")
    raise AssertionError("nothing is wrong with it")


class _Fields(NamedTuple):
    """The fields of k messages, by column, and their lengths."""

    kind: Kind
    sent: dict[str, list[Any]]
    lengths: dict[str, IntArray]
    sizes: IntArray
    sound: BoolArray

    @staticmethod
    def of(kind: Kind, messages: list[Any]) -> _Fields:
        sent = {name: list(map(attrgetter(name), messages)) for name in column_types(kind)}
        lengths = {name: np.fromiter(map(len, fields), np.int64, len(fields)) for name, fields in sent.items()}
        sizes = lengths[NEEDED[kind][0]]
        sound = (sizes >= 1) & (sizes <= MAX_ROWS)
        for name, given in lengths.items():
            full = sizes * mugrid.BINS if name == "log_likelihood" else sizes
            sound &= (given == full) | ((given == 0) & (name not in NEEDED[kind]))
        return _Fields(kind, sent, lengths, sizes, sound)

    def given(self, name: str) -> BoolArray:
        """Which records come with a column, (n,)."""
        return np.repeat(self.lengths[name] > 0, self.sizes)

    def columns(self) -> tuple[IntArray, Columns, BoolArray]:
        """Sizes, columns as they were sent (integers wide) or filled, and `told`."""
        out: Columns = {}
        told = np.zeros(int(self.sizes.sum()), bool)
        for name, dtype in column_types(self.kind).items():
            given = self.given(name)
            values: NDArray[Any]
            column: NDArray[Any]
            if name == "log_likelihood":
                told, values = given, np.frombuffer(b"".join(self.sent[name]), np.uint8).reshape(-1, mugrid.BINS)
                column = np.zeros((len(told), mugrid.BINS), np.uint8)
            else:
                wide = dtype if dtype.kind == "f" else np.dtype(np.int64)
                values = np.fromiter(chain.from_iterable(self.sent[name]), wide, int(self.lengths[name].sum()))
                column = np.full(len(given), np.nan if dtype.kind == "f" else _ABSENT.get(name, 0), wide)
            if len(values) == len(column):
                column = values
            else:
                column[given] = values
            out[name] = column
        return self.sizes, out, told


def _without_misfits(found: Decoded, fields: _Fields) -> Decoded:
    """Derive what follows from the pose; drop messages of which a number does not fit, or that have no place."""
    kind, columns = fields.kind, found.columns
    bad: dict[int, WireError] = {}
    owner = np.repeat(np.arange(len(found.heads)), found.sizes)

    def refuse(rows: NDArray[np.bool_], error: WireError) -> None:
        for at in np.unique(owner[rows]).tolist():
            bad.setdefault(at, error)

    for name, dtype in column_types(kind).items():
        if dtype.kind == "i" and dtype.itemsize < 8:
            limits = np.iinfo(dtype)
            outside = (columns[name] < limits.min) | (columns[name] > limits.max)
            refuse(outside, WireError(name, f"does not fit {dtype}", "use the values that the .proto names"))
            columns[name] = np.where(outside, 0, columns[name]).astype(dtype)
    placed = fields.given("cell") if kind is Kind.OBSERVATION else np.zeros(len(owner), bool)
    homeless = np.repeat(np.array([not head.region for head in found.heads], bool), found.sizes)
    needs_place = ~placed & (homeless | (kind is Kind.OBSERVATION))
    for name in ("latitude", "longitude"):
        nowhere = ~(np.abs(columns[name]) <= 180.0) & needs_place
        refuse(nowhere, WireError(name, "is not a position", "send finite degrees"))
        needs_place &= ~nowhere
    if kind is Kind.OBSERVATION:
        _derive(columns, fields, needs_place)
    heads = _with_regions(found, columns)
    if not bad:
        return found._replace(heads=heads)
    kept = np.array([at not in bad for at in range(len(heads))])
    rows = kept[owner]
    return Decoded(
        list(compress(found.places, kept)), list(compress(heads, kept)), found.sizes[kept],
        {name: column[rows] for name, column in columns.items()}, found.told[rows],
        found.errors + [(found.places[at], error) for at, error in bad.items()],
    )  # fmt: skip


def _derive(columns: Columns, fields: _Fields, unplaced: BoolArray) -> None:
    """Fill what a sender of observations may leave out. `unplaced`: rows without a cell, at a finite position."""
    without = ~fields.given("leave_time")
    columns["leave_time"] = np.where(without, columns["enter_time"], columns["leave_time"])
    if unplaced.any():
        at = np.flatnonzero(unplaced)
        columns["cell"] = columns["cell"].copy()
        columns["cell"][at] = grid.cell_of(columns["latitude"][at], columns["longitude"][at])
    unsaid = fields.lengths["sector"] == 0
    if unsaid.any():
        starts = np.cumsum(fields.sizes) - fields.sizes
        headed = np.logical_and.reduceat(np.isfinite(columns["yaw"]), starts)
        rows = np.repeat(unsaid & headed, fields.sizes)
        columns["sector"][rows] = grid.sector_of(columns["yaw"][rows])


def _with_regions(found: Decoded, columns: Columns) -> list[Head]:
    """Heads, with the region of the first record where the sender did not name it."""
    starts = np.cumsum(found.sizes) - found.sizes
    heads = list(found.heads)
    for at, head in enumerate(heads):
        if not head.region:
            row = int(starts[at])
            if "cell" in columns:
                cell = columns["cell"][row]
            else:
                cell = grid.cell_of(*(np.nan_to_num(columns[name][row]) for name in ("latitude", "longitude")))
            heads[at] = head._replace(region=int(grid.region_of(cell)))
    return heads
