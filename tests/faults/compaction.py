"""Campaign of kill -9 during compaction (sorting of the archive's new rows), repeated while one
thread writes to the log and another reads the archive.

`python -m tests.faults.compaction ARCHIVE` compacts in an endless loop of small rounds; the
campaign kills this process at random moments.
"""

from __future__ import annotations

import random
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Final

import pyarrow as pa
import pyarrow.parquet as pq

from fleet_service.archive.format import layout, reading
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.archive.segment_log import SegmentLog
from schemas.runtime.figures import Figure
from schemas.wire import Kind
from tests.faults.bars import make_figure
from tests.faults.crash_model import ROWS, Batch, rows_of
from tests.faults.frame import Site
from tests.faults.processes import Part

BATCHES: Final = 50  # batches in a segment
PAUSE_S: Final = 0.05  # pause between two segments
ROUND_ROWS: Final = 1000
# Range of the time until the kill; one round of compaction takes 0.1 s.
UNTIL_KILL_S: Final = (0.0, 0.6)


class Writing:
    """Thread that writes numbered batches to the segment log (files of new rows) until it is
    closed. Every batch with a number up to `acknowledged` is durable.
    """

    def __init__(self, root: Path) -> None:
        self.acknowledged = 0
        self._log: SegmentLog[Batch] = SegmentLog(root, "shard")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._write_batches)
        self._thread.start()

    def _write_batches(self) -> None:
        while not self._stop.wait(PAUSE_S):
            first = self.acknowledged + 1
            batches = [Batch(Kind.OBSERVATION, seq) for seq in range(first, first + BATCHES)]
            self._log.add(Kind.OBSERVATION, rows_of(batches), batches)
            self.acknowledged += len(self._log.flush())

    def close(self) -> None:
        """Stop the thread that writes batches to the log."""
        self._stop.set()
        self._thread.join()


class Reading:
    """Thread that reads the archive until it is closed. It counts its reads, and the reads in which
    a row was missing or doubled.
    """

    def __init__(self, root: Path, writing: Writing) -> None:
        self.reads = 0
        self.incomplete = 0
        self._root = root
        self._writing = writing
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read_rows)
        self._thread.start()

    def _read_rows(self) -> None:
        while not self._stop.is_set():
            owed = self._writing.acknowledged
            whole = reading.read_tables(self._root, Kind.OBSERVATION, ["seq", "row"])
            self.incomplete += not is_complete(whole, owed)
            self.incomplete += not is_complete(read_compacted(self._root), 0)
            self.reads += 2

    def close(self) -> None:
        """Stop the thread that reads the archive."""
        self._stop.set()
        self._thread.join()


def read_compacted(root: Path) -> Iterable[pa.Table]:
    """Return the rows that another program would read: only the compacted (sorted) files, as listed
    at one moment.
    """
    for path in list(layout.compacted_files(root, Kind.OBSERVATION)):
        yield pq.read_table(path, columns=["seq", "row"], partitioning=None)


def is_complete(tables: Iterable[pa.Table], owed: int) -> bool:
    """Return True if the rows in `tables` are complete and unique: each row of the batches 1 to
    `owed`, which were acknowledged, is present, and no row occurs twice.
    """
    rows = Counter(
        p for t in tables for p in zip(t["seq"].to_pylist(), t["row"].to_pylist(), strict=True)
    )
    has_rows = all((seq, row) in rows for seq in range(1, owed + 1) for row in range(ROWS))
    return has_rows and (not rows or max(rows.values()) == 1)


def run(site: Site) -> list[Figure]:
    """Kill a compaction of the archive (its sorting of new rows) 50 times (in a quick run, five
    times), and return the numbers of lost and doubled rows as figures.
    """
    root = site.folder / "archive"
    random_ = random.Random(site.seed)
    part = Part(
        "compaction", [sys.executable, "-m", "tests.faults.compaction", str(root)], site.folder
    )
    with closing(Writing(root)) as writing, closing(Reading(root, writing)) as reader:
        for _ in range(site.choose_amount(50, 5)):
            part.start()
            part.line_with("compacting")
            time.sleep(random_.uniform(*UNTIL_KILL_S))
            part.kill()
    compact(root)
    incomplete = reader.incomplete + (not is_complete(read_compacted(root), writing.acknowledged))
    site.say(f"{part.starts} kills, {reader.reads} reads, {writing.acknowledged} batches")
    return [
        make_figure("faults.compaction.incomplete_reads", incomplete),
        make_figure("faults.compaction.kills", part.starts),
        make_figure("faults.compaction.reads", reader.reads),
        make_figure("faults.compaction.batches", writing.acknowledged),
    ]


def main() -> None:
    """Compact the archive again and again in small rounds, until the process is killed."""
    print("compacting", flush=True)
    while True:
        compact(Path(sys.argv[1]), ROUND_ROWS)


if __name__ == "__main__":
    main()
