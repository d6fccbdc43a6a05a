"""Decoder of one batch (message with records), and functions that all decoders share. These
functions read heads (fields of a batch other than its records), check batches, and fill columns
that a sender may leave out.

Missing columns are filled: floats with NaN, cell and sector from the pose (position and yaw), the
leaving time with the entering time. The fleet service has its own decoder, which decodes many
batches at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import compress
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas import grid, mugrid
from schemas.errors import WireError
from schemas.numeric import BoolArray, IntArray
from schemas.signals import FLAGS
from schemas.wire.codec import (
    ENCODING,
    MAX_ROWS,
    MESSAGES,
    NEEDED,
    Batch,
    Columns,
    Kind,
    column_types,
    parse,
)

ABSENT: Final = dict.fromkeys(FLAGS, -1)  # value of an absent integer column where it is not 0
LIKELIHOOD: Final = "log_likelihood"


class Head(NamedTuple):
    """Head of a batch: all fields of the message except its records, such as the vehicle's name and
    the sequence number.
    """

    kind: Kind
    vehicle: str
    boot: int
    region: int
    seq: int
    first_held: int
    estimator: str


class Heads(NamedTuple):
    """Heads (fields other than records) of k batches, one column per field."""

    kind: Kind
    vehicle: list[str]
    boot: IntArray
    region: IntArray
    seq: IntArray
    first_held: IntArray
    estimator: list[str]

    def at(self, index: int) -> Head:
        """Return the head of the batch at position `index`."""
        return Head(
            self.kind,
            self.vehicle[index],
            int(self.boot[index]),
            int(self.region[index]),
            int(self.seq[index]),
            int(self.first_held[index]),
            self.estimator[index],
        )

    def take(self, kept: BoolArray) -> Heads:
        """Return the heads of the batches that the mask `kept` (k,) selects."""
        return Heads(
            self.kind,
            list(compress(self.vehicle, kept)),
            self.boot[kept],
            self.region[kept],
            self.seq[kept],
            self.first_held[kept],
            list(compress(self.estimator, kept)),
        )


class Decoded(NamedTuple):
    """The k valid batches that were decoded from several messages, with the errors of the other
    messages.

    Attributes:
        indices: for each batch, the index of the message from which it was decoded, (k,).
        heads: head of each batch.
        sizes: number of records of each batch, (k,).
        columns: every column of the table for this kind of records, by name, (n,); the n records of
            all batches follow each other. `log_likelihood` is (n, 32).
        with_likelihood: mask (n,), True if the record came with a log-likelihood of friction.
        errors: index and error of each message that is not a valid batch.
    """

    indices: list[int]
    heads: Heads
    sizes: IntArray
    columns: Columns
    with_likelihood: BoolArray
    errors: list[tuple[int, WireError]]


class PresentColumns(NamedTuple):
    """Table that states which columns each of k batches contained when it was received.

    Attributes:
        kind: kind of the records in all batches, observations or states.
        sizes: number of records of each batch, (k,).
        columns: name of every column → mask (k,), True for each batch that contains it.
    """

    kind: Kind
    sizes: IntArray
    columns: dict[str, BoolArray]

    def records(self, name: str) -> BoolArray:
        """Return a mask of records (n,): True if the record's batch contains the column `name`."""
        return np.repeat(self.columns[name], self.sizes)


# protobuf messages have no types.
def message_of(kind: Kind, payload: bytes, encoding: str) -> Any:  # noqa: ANN401
    """Parse the bytes of a batch with the protobuf library and check that its columns have equal
    lengths.

    Raises:
        WireError: the payload is too large or not the expected message, or a required column is
            missing, or columns have unequal lengths.
    """
    message = parse(payload, encoding, MESSAGES[kind], ENCODING[kind])
    _check_columns(message, kind)
    return message


def head_of(kind: Kind, payload: bytes, encoding: str) -> Head | None:
    """Return the head of a batch whose records are invalid, so that the sender can be informed.
    Return None if the head cannot be read either.
    """
    try:
        found = parse(payload, encoding, MESSAGES[kind], ENCODING[kind])
    except WireError:
        return None
    held = found.first_held or 1
    return Head(kind, found.vehicle, found.boot, found.region, found.seq, held, found.estimator)


def decode(payload: bytes, encoding: str, kind: Kind) -> Batch:
    """Decode the bytes of one batch. For the columns that were sent, this is the inverse of
    `codec.encode`. Other columns are filled with defaults.

    Raises:
        WireError: the payload is too large or not the expected message, a required column is
            missing, columns have unequal lengths, or a number does not fit its column.
    """
    message = message_of(kind, payload, encoding)
    n = len(getattr(message, NEEDED[kind][0]))
    given = {name: np.array([len(getattr(message, name)) > 0]) for name in column_types(kind)}
    sent = PresentColumns(kind, np.array([n]), given)
    columns = {
        name: _read_column(message, name, dtype, n) for name, dtype in column_types(kind).items()
    }
    numbers = (
        np.array([getattr(message, name)], np.int64)
        for name in ("boot", "region", "seq", "first_held")
    )
    boot, region, seq, first_held = numbers
    heads = Heads(
        kind,
        [message.vehicle],
        boot,
        region,
        seq,
        np.where(first_held == 0, 1, first_held),
        [message.estimator],
    )
    likelihood = sent.records(LIKELIHOOD) if kind is Kind.OBSERVATION else np.zeros(n, bool)
    found = complete_batches(Decoded([0], heads, sent.sizes, columns, likelihood, []), sent)
    for _, error in found.errors:
        raise error
    if kind is Kind.OBSERVATION and not likelihood.all():
        found.columns[LIKELIHOOD] = found.columns[LIKELIHOOD][:, :0]
    return Batch(kind, *found.heads.at(0)[1:-1], found.columns, message.estimator)


def _read_column(
    message: Any,  # noqa: ANN401
    name: str,
    dtype: np.dtype[Any],
    n: int,
) -> NDArray[Any]:
    """Return a column of a message (n,), integers as int64. A column that was not sent is filled
    with its default value.
    """
    values = getattr(message, name)
    if name == LIKELIHOOD:
        return np.frombuffer(values or bytes(n * mugrid.BINS), np.uint8).reshape(n, mugrid.BINS)
    if dtype.kind == "f":
        return np.array(values, dtype) if values else np.full(n, np.nan, dtype)
    return np.array(values, np.int64) if values else np.full(n, ABSENT.get(name, 0), np.int64)


def _check_columns(message: Any, kind: Kind) -> None:  # noqa: ANN401
    """Check that a message's columns have equal lengths.

    Raises:
        WireError: the lengths differ, or the number of records is out of range.
    """
    first = NEEDED[kind][0]
    n = len(getattr(message, first))
    if not 1 <= n <= MAX_ROWS:
        raise WireError(first, f"{n} records", f"send 1 to {MAX_ROWS}")
    for name in column_types(kind):
        given = len(getattr(message, name))
        if name == LIKELIHOOD:
            if given not in (0, n * mugrid.BINS):
                raise WireError(
                    name,
                    f"{given} bytes for {n} records",
                    f"send {mugrid.BINS} per record, or none",
                )
        elif given != n and (given or name in NEEDED[kind]):
            raise WireError(
                name, f"has {given} records, {first} has {n}", "give every column the same length"
            )


def complete_batches(found: Decoded, sent: PresentColumns) -> Decoded:
    """Fill missing columns of decoded batches: leaving time, cell and heading sector, and the
    region in the head of a batch. Return the batches.

    Some batches are refused: they are removed from the result, and an error is added to its
    `errors`. A batch is refused if it needs a position or a heading but has none, or if a number
    does not fit its column.

    Args:
        found: decoded batches; columns that were not sent contain default values.
        sent: table that states which columns each batch contained when it was received.
    """
    kind = sent.kind
    columns = found.columns
    bad: dict[int, WireError] = {}
    owner = np.repeat(np.arange(len(found.sizes)), found.sizes)

    def refuse(rows: NDArray[np.bool_], error: WireError) -> None:
        if rows.any():
            for at in np.unique(owner[rows]).tolist():
                bad.setdefault(at, error)

    for name, dtype in column_types(kind).items():
        if dtype.kind == "i" and dtype.itemsize < 8:
            limits = np.iinfo(dtype)
            outside = (columns[name] < limits.min) | (columns[name] > limits.max)
            refuse(
                outside,
                WireError(
                    name, f"does not fit {dtype}", "use the values defined in the .proto file"
                ),
            )
            columns[name] = np.where(outside, 0, columns[name]).astype(dtype)
    placed = sent.records("cell") if kind is Kind.OBSERVATION else np.zeros(len(owner), bool)
    region_missing = np.repeat(found.heads.region == 0, found.sizes)
    needs_place = ~placed & (region_missing | (kind is Kind.OBSERVATION))
    for name in ("latitude", "longitude"):
        nowhere = ~(np.abs(columns[name]) <= 180.0) & needs_place
        refuse(nowhere, WireError(name, "has values that are not positions", "send finite degrees"))
        needs_place &= ~nowhere
    if kind is Kind.OBSERVATION:
        for rows, error in _heading_errors(columns["yaw"], sent.records("sector")):
            refuse(rows, error)
        _derive_columns(columns, sent, needs_place)
    heads = _with_regions(found, columns)
    if not bad:
        return found._replace(heads=heads)
    kept = np.array([at not in bad for at in range(len(found.sizes))])
    rows = kept[owner]
    return Decoded(
        list(compress(found.indices, kept)),
        heads.take(kept),
        found.sizes[kept],
        {name: column[rows] for name, column in columns.items()},
        found.with_likelihood[rows],
        found.errors + [(found.indices[at], error) for at, error in bad.items()],
    )


def _heading_errors(
    yaw: NDArray[np.floating[Any]], with_sector: BoolArray
) -> Iterator[tuple[BoolArray, WireError]]:
    """Yield each error of the yaw angles (n,) [rad] of visits, with a mask of the visits that have
    it. `with_sector` is True for visits whose heading sector was sent.

    A visit without a heading, or with degrees taken for radians, would count for an arbitrary
    direction. A sender that gives the sector may count turns, or leave out the yaw.
    """
    fix = "send radians from east, or give the sector"
    yield ~with_sector & ~np.isfinite(yaw), WireError("yaw", "is missing", fix)
    is_turned = np.abs(yaw) > 2.0 * np.pi
    yield ~with_sector & is_turned, WireError("yaw", "is more than a turn", fix)


def _derive_columns(columns: Columns, sent: PresentColumns, unplaced: BoolArray) -> None:
    """Fill, in place, the columns that a sender of observations may leave out: leaving time, cell
    and heading sector.

    `unplaced` is a mask of rows, True where a row has a finite position but no cell; these rows get
    a cell.
    """
    without = ~sent.records("leave_time")
    columns["leave_time"] = np.where(without, columns["enter_time"], columns["leave_time"])
    if unplaced.any():
        at = np.flatnonzero(unplaced)
        columns["cell"] = columns["cell"].copy()
        columns["cell"][at] = grid.cell_of(columns["latitude"][at], columns["longitude"][at])
    sector_missing = ~sent.columns["sector"]
    if sector_missing.any():
        rows = np.repeat(sector_missing, sent.sizes) & np.isfinite(columns["yaw"])
        columns["sector"][rows] = grid.sector_of(columns["yaw"][rows])


def _with_regions(found: Decoded, columns: Columns) -> Heads:
    """Return the heads of the batches. If a head has no region, the region of the batch's first
    record is used.
    """
    heads = found.heads
    region_missing = found.heads.region == 0
    if not region_missing.any():
        return heads
    rows = (np.cumsum(found.sizes) - found.sizes)[region_missing]
    if "cell" in columns:
        cell = columns["cell"][rows]
    else:
        cell = grid.cell_of(
            *(np.nan_to_num(columns[name][rows]) for name in ("latitude", "longitude"))
        )
    region = heads.region.copy()
    region[region_missing] = grid.region_of(cell)
    return heads._replace(region=region)
