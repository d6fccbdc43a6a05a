"""Many payloads → one set of columns. Python is touched per message and per column, never per record.

A compiled walk (`schemas.reader`) finds the fields in the bytes of all messages; then column by column the values of
all are taken together. What the walk does not understand, JSON among it, the protobuf library reads and writes anew in
the plain form, so that there is one way from bytes to columns. What is wrong with a message is an error beside the
others and never their loss. A column that a sender left out is filled: floats with NaN, the cell and the sector from
the pose, the leaving time from the entering one.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas import grid, mugrid
from schemas.errors import WireError
from schemas.numeric import BoolArray, IntArray
from schemas.reader import NUMBERS, TEXTS, Walked, gather, walk
from schemas.wire import (
    ENCODING,
    MAX_BYTES,
    MAX_ROWS,
    MESSAGES,
    NEEDED,
    PLAIN,
    Batch,
    Columns,
    Kind,
    column_types,
    parse,
)

_ABSENT: Final = {"abs_active": -1}  # what an absent integer reads as, where it is not 0
_LIKELIHOOD: Final = "log_likelihood"


class Head(NamedTuple):
    """What a batch says of itself, beside its records."""

    kind: Kind
    vehicle: str
    boot: int
    region: int
    seq: int
    first_held: int
    estimator: str


class Heads(NamedTuple):
    """The same of k batches, by column."""

    kind: Kind
    vehicle: list[str]
    boot: IntArray
    region: IntArray
    seq: IntArray
    first_held: IntArray
    estimator: list[str]

    def at(self, place: int) -> Head:
        """The head of one."""
        return Head(
            self.kind, self.vehicle[place], int(self.boot[place]), int(self.region[place]), int(self.seq[place]),
            int(self.first_held[place]), self.estimator[place],
        )  # fmt: skip

    def take(self, kept: BoolArray) -> Heads:
        """Some of them."""
        return Heads(
            self.kind, list(compress(self.vehicle, kept)), self.boot[kept], self.region[kept], self.seq[kept],
            self.first_held[kept], list(compress(self.estimator, kept)),
        )  # fmt: skip


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
    heads: Heads
    sizes: IntArray
    columns: Columns
    told: BoolArray
    errors: list[tuple[int, WireError]]


def decode_many(kind: Kind, payloads: Sequence[tuple[bytes, str]]) -> Decoded:
    """Read batches of one kind from payloads and their encodings."""
    errors: list[tuple[int, WireError]] = []
    usual = {ENCODING[kind], *PLAIN}
    plain = [payload if encoding in usual and len(payload) <= MAX_BYTES else b"" for payload, encoding in payloads]
    data, walked = _walked(kind, plain, True)
    places = list(range(len(plain)))
    if not walked.understood.all():
        for place in np.flatnonzero(~walked.understood).tolist():
            try:
                plain[place] = _plainly(kind, *payloads[place])
            except WireError as error:
                errors.append((place, error))
        wrong = {place for place, _ in errors}
        places = [place for place in places if place not in wrong]
        data, walked = _walked(kind, [plain[place] for place in places], False)
        assert walked.understood.all(), "the protobuf library writes what we do not read"
    fields = _Fields(kind, data, walked)
    return _without_misfits(Decoded(places, fields.heads(), *fields.columns(), errors), fields)


def _walked(kind: Kind, messages: list[bytes], strict: bool) -> tuple[NDArray[np.uint8], Walked]:
    data = np.frombuffer(b"".join(messages), np.uint8)
    return data, walk(kind, data, np.cumsum(np.fromiter(map(len, messages), np.int64, len(messages))), strict)


def _plainly(kind: Kind, payload: bytes, encoding: str) -> bytes:
    """A message as our own encoder writes it.

    Raises:
        WireError: it is none.
    """
    message = parse(payload, encoding, MESSAGES[kind], ENCODING[kind])
    _check(message, kind)
    message.DiscardUnknownFields()
    data: bytes = message.SerializeToString()
    return data


def decode(payload: bytes, encoding: str, kind: Kind) -> Batch:
    """Read one batch; the inverse of `wire.encode` for every column that was sent.

    Raises:
        WireError: too large, not the message, no needed column, or columns of unequal length.
    """
    found = decode_many(kind, [(payload, encoding)])
    for _, error in found.errors:
        raise error
    head = found.heads.at(0)
    if kind is Kind.OBSERVATION and not found.told.all():
        found.columns[_LIKELIHOOD] = found.columns[_LIKELIHOOD][:, :0]
    return Batch(kind, *head[1:-1], found.columns, head.estimator)


def _check(message: Any, kind: Kind) -> None:  # noqa: ANN401
    """Whether a message's columns have the lengths that they should.

    Raises:
        WireError: they have not.
    """
    first = NEEDED[kind][0]
    n = len(getattr(message, first))
    if not 1 <= n <= MAX_ROWS:
        raise WireError(first, f"{n} records", f"send 1 to {MAX_ROWS}")
    for name in column_types(kind):
        given = len(getattr(message, name))
        if name == _LIKELIHOOD:
            if given not in (0, n * mugrid.BINS):
                raise WireError(name, f"{given} bytes for {n} records", f"send {mugrid.BINS} a record, or none")
        elif given != n and (given or name in NEEDED[kind]):
            raise WireError(name, f"has {given} records, {first} has {n}", "give every column the same length")


class _Fields(NamedTuple):
    """The fields of k messages, where they lie."""

    kind: Kind
    data: NDArray[np.uint8]
    walked: Walked

    @property
    def sizes(self) -> IntArray:
        """Records of each message."""
        return self.walked.sizes

    def sent(self, name: str) -> BoolArray:
        """Which messages come with a column, (k,)."""
        return np.asarray(self.walked.counts[:, list(column_types(self.kind)).index(name)] > 0)

    def given(self, name: str) -> BoolArray:
        """Which records come with a column, (n,)."""
        return np.repeat(self.sent(name), self.sizes)

    def heads(self) -> Heads:
        """Heads, with the first of all sequence numbers held where the sender does not say which."""
        data = self.data.tobytes()
        texts = {
            name: [
                str(data[begin:end], "utf-8") for begin, end in zip(*self.walked.texts[:, at].T.tolist(), strict=True)
            ]
            for at, name in enumerate(TEXTS)
        }
        boot, region, seq, first_held = (self.walked.numbers[:, at].copy() for at in range(len(NUMBERS)))
        first_held[first_held == 0] = 1
        return Heads(self.kind, texts["vehicle"], boot, region, seq, first_held, texts["estimator"])

    def columns(self) -> tuple[IntArray, Columns, BoolArray]:
        """Sizes, columns as they were sent (integers wide) or filled, and `told`."""
        out: Columns = {}
        n = int(self.sizes.sum())
        told = np.zeros(n, bool)
        for at, (name, dtype) in enumerate(column_types(self.kind).items()):
            column: NDArray[Any]
            if name == _LIKELIHOOD:
                told, column = self.given(name), np.zeros((n, mugrid.BINS), np.uint8)
            elif dtype.kind == "f":
                column = np.full(n, np.nan, dtype)
            else:
                column = np.full(n, _ABSENT.get(name, 0), np.int64)
            gather(self.data, self.walked, at, self.kind, column)
            out[name] = column
        return self.sizes, out, told


def _without_misfits(found: Decoded, fields: _Fields) -> Decoded:
    """Derive what follows from the pose; drop messages of which a number does not fit, or that have no place."""
    kind, columns = fields.kind, found.columns
    bad: dict[int, WireError] = {}
    owner = np.repeat(np.arange(len(found.sizes)), found.sizes)

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
    homeless = np.repeat(found.heads.region == 0, found.sizes)
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
    kept = np.array([at not in bad for at in range(len(found.sizes))])
    rows = kept[owner]
    return Decoded(
        list(compress(found.places, kept)), heads.take(kept), found.sizes[kept],
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
    unsaid = ~fields.sent("sector")
    if unsaid.any():
        starts = np.cumsum(fields.sizes) - fields.sizes
        headed = np.logical_and.reduceat(np.isfinite(columns["yaw"]), starts)
        rows = np.repeat(unsaid & headed, fields.sizes)
        columns["sector"][rows] = grid.sector_of(columns["yaw"][rows])


def _with_regions(found: Decoded, columns: Columns) -> Heads:
    """Heads, with the region of the first record where the sender did not name it."""
    heads, homeless = found.heads, found.heads.region == 0
    if not homeless.any():
        return heads
    rows = (np.cumsum(found.sizes) - found.sizes)[homeless]
    if "cell" in columns:
        cell = columns["cell"][rows]
    else:
        cell = grid.cell_of(*(np.nan_to_num(columns[name][rows]) for name in ("latitude", "longitude")))
    region = heads.region.copy()
    region[homeless] = grid.region_of(cell)
    return heads._replace(region=region)
