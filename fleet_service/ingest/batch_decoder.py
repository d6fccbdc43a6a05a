"""Decoder that turns many messages into one set of columns. Python code runs per message and per
column, never per record.

A compiled scanner (`protobuf_scan`) finds the fields in the bytes of all messages. Then the values
of all messages are read column by column. A message that the scanner does not understand, for
example JSON, is decoded by the protobuf library and encoded again in the plain form. So there is
one path from bytes to columns. An error in one message is reported for that message and does not
affect the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_service.ingest.protobuf_scan import (
    NUMBERS,
    TEXTS,
    ScannedFields,
    gather_values,
    walk_fields,
)
from schemas import mugrid
from schemas.errors import WireError
from schemas.numeric import BoolArray, IntArray
from schemas.wire import ENCODING, MAX_BYTES, PLAIN, Columns, Kind, column_types
from schemas.wire.batches import (
    ABSENT,
    LIKELIHOOD,
    Decoded,
    Heads,
    PresentColumns,
    complete_batches,
    message_of,
)


def decode_many(kind: Kind, payloads: Sequence[tuple[bytes, str]]) -> Decoded:
    """Return the columns of all messages with batches of one kind (observations or states), decoded
    together, and the errors of undecodable messages. Each message is given as a pair of payload and
    encoding.
    """
    errors: list[tuple[int, WireError]] = []
    usual = {ENCODING[kind], *PLAIN}
    plain = [
        payload if encoding in usual and len(payload) <= MAX_BYTES else b""
        for payload, encoding in payloads
    ]
    data, walked = _scan_messages(kind, plain, strict=True)
    indices = list(range(len(plain)))
    if not walked.understood.all():
        for index in np.flatnonzero(~walked.understood).tolist():
            try:
                plain[index] = _reencode_message(kind, *payloads[index])
            except WireError as error:
                errors.append((index, error))
        wrong = {index for index, _ in errors}
        indices = [index for index in indices if index not in wrong]
        data, walked = _scan_messages(kind, [plain[index] for index in indices], strict=False)
        assert walked.understood.all(), "the protobuf library writes what we do not read"
    fields = _Fields(kind, data, walked)
    return complete_batches(
        Decoded(indices, fields.heads(), *fields.columns(), errors), fields.present_columns()
    )


def _scan_messages(
    kind: Kind, messages: list[bytes], *, strict: bool
) -> tuple[NDArray[np.uint8], ScannedFields]:
    data = np.frombuffer(b"".join(messages), np.uint8)
    sizes = np.fromiter(map(len, messages), np.int64, len(messages))
    return data, walk_fields(kind, data, np.cumsum(sizes), strict=strict)


def _reencode_message(kind: Kind, payload: bytes, encoding: str) -> bytes:
    """Return a message as protobuf bytes in the form that our own encoder writes, which
    `protobuf_scan` understands.

    Raises:
        WireError: the payload is not a message of this kind.
    """
    message = message_of(kind, payload, encoding)
    message.DiscardUnknownFields()
    data: bytes = message.SerializeToString()
    return data


class _Fields(NamedTuple):
    """Positions of the fields of k protobuf messages (batches of records) in their bytes."""

    kind: Kind
    data: NDArray[np.uint8]
    walked: ScannedFields

    @property
    def sizes(self) -> IntArray:
        """Return the number of records in each of the k messages, (k,)."""
        return self.walked.sizes

    def present_columns(self) -> PresentColumns:
        """Return which columns each of the k messages contains: for each column a mask (k,), True
        for a message that contains it.
        """
        given = self.walked.counts > 0
        return PresentColumns(
            self.kind,
            self.sizes,
            {name: given[:, at] for at, name in enumerate(column_types(self.kind))},
        )

    def heads(self) -> Heads:
        """Return the heads (fields other than records) of all k messages. A missing field
        `first_held` is replaced with 1, the lowest sequence number.
        """
        data = self.data.tobytes()
        texts = {
            name: [
                str(data[begin:end], "utf-8")
                for begin, end in zip(*self.walked.texts[:, at].T.tolist(), strict=True)
            ]
            for at, name in enumerate(TEXTS)
        }
        boot, region, seq, first_held = (
            self.walked.numbers[:, at].copy() for at in range(len(NUMBERS))
        )
        first_held[first_held == 0] = 1
        return Heads(self.kind, texts["vehicle"], boot, region, seq, first_held, texts["estimator"])

    def columns(self) -> tuple[IntArray, Columns, BoolArray]:
        """Return three items: the number of records of each message (k,), the columns (missing
        values filled, integers widened to 64 bits), and a mask of the records that have a
        likelihood (n,).
        """
        out: Columns = {}
        n = int(self.sizes.sum())
        likelihood = np.zeros(n, bool)
        for at, (name, dtype) in enumerate(column_types(self.kind).items()):
            column: NDArray[Any]
            if name == LIKELIHOOD:
                likelihood = np.repeat(self.walked.counts[:, at] > 0, self.sizes)
                column = np.zeros((n, mugrid.BINS), np.uint8)
            elif dtype.kind == "f":
                column = np.full(n, np.nan, dtype)
            else:
                column = np.full(n, ABSENT.get(name, 0), np.int64)
            gather_values(self.data, self.walked, at, self.kind, column)
            out[name] = column
        return self.sizes, out, likelihood
