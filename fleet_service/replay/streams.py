"""Record of accepted batches (messages with records), restored from an archive, so that a service
detects duplicates after a restart.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa

from fleet_service.archive.format import layout, reading, segments
from fleet_service.archive.format.load import Damaged, skip_damaged
from fleet_service.archive.identity.pseudonyms import pseudonym_number
from fleet_service.ingest.dedup import ArchivedRows, SequenceTrackers
from schemas.numeric import IntArray
from schemas.wire import Kind

IDENTITY: Final = ["vehicle", "boot", "region", "seq"]


class Begin(NamedTuple):
    """Start of a replay.

    Attributes:
        day: first day of measurement that is read; None for all days.
        after: only segments (files of new rows) after this position are read; None to read from the
            first.
        until: only segments up to this position are read; None to read to the last.
    """

    day: int | None = None
    after: layout.Cut | None = None
    until: layout.Cut | None = None


def restore_streams(
    root: Path,
    streams: SequenceTrackers,
    begin: Begin = Begin(),  # noqa: B008 immutable
    damaged: Damaged = skip_damaged,
) -> None:
    """Record every archived batch as accepted, so that duplicates are detected after a restart.

    Args:
        root: folder of the archive.
        streams: record of accepted batches; updated.
        begin: start of the replay.
        damaged: called with each damaged file.
    """
    for kind, rows in read_streams(root, begin, damaged):
        streams.restore(kind, rows)


def read_streams(root: Path, begin: Begin, damaged: Damaged) -> Iterator[tuple[Kind, ArchivedRows]]:
    """Yield the identity and times of the rows of every archived batch, for
    `SequenceTrackers.restore`. See `restore_streams` for the arguments.
    """
    for kind, first in layout.FIRST_TIME.items():
        columns = (*IDENTITY, "first_held", first)
        selection = reading.RowSelection(
            columns, days=(begin.day, None), after=begin.after, until=begin.until
        )
        for table in reading.read_selected(root, kind, selection, damaged):
            boot, region, seq, first_held = (
                table[name].to_numpy() for name in (*IDENTITY[1:], "first_held")
            )
            time = segments.to_nanoseconds(table[first])
            vehicle = pseudonym_numbers(table["vehicle"])
            yield kind, ArchivedRows(vehicle, boot, region, seq, first_held, time)


def pseudonym_numbers(pseudonyms: pa.ChunkedArray[Any] | pa.Array[Any]) -> IntArray:
    """Convert pseudonyms (vehicles' names in the archive), (n,), from text to 64-bit numbers."""
    chunked = (
        pseudonyms if isinstance(pseudonyms, pa.ChunkedArray) else pa.chunked_array([pseudonyms])
    )
    coded = chunked.combine_chunks().dictionary_encode()
    if not len(coded):
        return np.zeros(0, np.int64)
    each = np.array(
        [pseudonym_number(pseudonym) for pseudonym in coded.dictionary.to_pylist()], np.int64
    )
    return np.asarray(each[coded.indices.to_numpy()])
