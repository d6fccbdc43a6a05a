"""Comparison of the load generators' journals (lists of stored and acknowledged batches) with the
archive.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from fleet_service.archive.format import layout, reading
from fleet_service.archive.identity.pseudonyms import Pseudonyms
from schemas.wire import Kind

HOUR_NS = 3_600_000_000_000
ROW = ["vehicle", "boot", "region", "seq", "row"]
Name = tuple[str, int, int, int]  # vehicle, boot, region, seq


@dataclass(frozen=True)
class Census:
    """Counts of batches and rows after all load has ended.

    Attributes:
        stored: number of batches that were committed to an outbox (store of unacknowledged
            messages).
        settled: number of these batches that an acknowledgement settled (made final).
        acknowledged_lost: settled batches of which a row is missing in the archive.
        lost: stored batches of which a row is missing, settled or not.
        doubled: rows that the archive contains more than once.
        rows: rows in the archive.
        observations: observations in the stored batches.
    """

    stored: int
    settled: int
    acknowledged_lost: int
    lost: int
    doubled: int
    rows: int
    observations: int


class Told(NamedTuple):
    """Content of the load generators' journals.

    Attributes:
        stored: number of records, and time [s], of every batch that was stored in an outbox.
        settled: time [s] at which an acknowledgement settled a batch (made it final).
    """

    stored: dict[Name, tuple[int, float]]
    settled: dict[Name, float]

    def longest_wait(self, since: float) -> float:
        """Return the time [s] from `since` until the service had acknowledged or refused all
        batches that were in an outbox at `since`. The result is infinite if it never did so for one
        of them.
        """
        waits = [
            self.settled.get(name, float("inf")) - since
            for name, (_, at) in self.stored.items()
            if at <= since
        ]
        return max(waits, default=0.0)

    def stored_between(self, begin: float, end: float) -> int:
        """Return the number of batches that the vehicles' outboxes stored between the times `begin`
        and `end` [s].
        """
        return sum(begin <= at <= end for _, at in self.stored.values())


def read_journals(journals: Iterable[Path]) -> Told:
    """Return the content of the journals (lists of stored and acknowledged batches) of all load
    generators.
    """
    out = Told({}, {})
    for journal in journals:
        for line in journal.read_text().splitlines():
            if line[:2] not in ("+ ", "- "):
                continue  # other output of the load generator
            sign, vehicle, boot, _, region, seq, records, at = line.split()
            name = (vehicle, int(boot), int(region), int(seq))
            if sign == "+":
                out.stored[name] = (int(records), float(at))
            else:
                out.settled.setdefault(name, float(at))
    return out


def compare_with_archive(journals: Iterable[Path], archive: Path) -> Census:
    """Compare the load generators' journals (lists of stored and acknowledged batches) with all
    rows of the archive, and return the counts.
    """
    stored, settled = read_journals(journals)
    held, doubled, rows = _count_archived(archive, {name[:2] for name in stored})
    doubled = max(doubled, _doubled_outside(archive))
    missing = {name for name, (records, _) in stored.items() if held.get(name, 0) < records}
    return Census(
        len(stored),
        len(settled.keys() & stored.keys()),
        len(missing & settled.keys()),
        len(missing),
        doubled,
        rows,
        sum(records for records, _ in stored.values()),
    )


def _doubled_outside(archive: Path) -> int:
    """Return the number of rows that an outside program would read twice. Such a program reads all
    compacted (sorted) files of an archive, and does not apply the rules of the archive format.
    """
    paths = list(layout.compacted_files(archive, Kind.OBSERVATION))
    whole = [pq.read_table(path, columns=ROW, partitioning=None) for path in paths]
    return sum(t.num_rows for t in whole) - (
        pa.concat_tables(whole).group_by(ROW).aggregate([]).num_rows if whole else 0
    )


def _count_archived(
    archive: Path, starts: set[tuple[str, int]]
) -> tuple[dict[Name, int], int, int]:
    """Return the number of distinct rows per archived batch, the number of repeated rows, and the
    number of all rows.

    Args:
        archive: folder of the archive.
        starts: (vehicle, boot) of the batches to count; the boot identifies a start of the
            vehicle's agent.
    """
    tables = list(reading.read_tables(archive, Kind.OBSERVATION, ROW))
    if not tables:
        return {}, 0, 0
    whole = pa.concat_tables(tables)
    found = whole.group_by(ROW[:-1]).aggregate([("row", "count_distinct")]).to_pydict()
    pseudonyms = Pseudonyms(archive / "keys")
    now = time.time_ns()
    start_of = {
        (pseudonyms.of(vehicle, now - ago), pseudonyms.boot(vehicle, boot, now - ago)): (
            vehicle,
            boot,
        )
        for vehicle, boot in starts
        for ago in (0, HOUR_NS)
    }
    kept = zip(found["vehicle"], found["boot"], strict=True)
    names = (
        (*start_of.get(start, start), region, seq)
        for start, region, seq in zip(kept, found["region"], found["seq"], strict=True)
    )
    held = dict(zip(names, found["row_count_distinct"], strict=True))
    return held, whole.num_rows - sum(held.values()), whole.num_rows
