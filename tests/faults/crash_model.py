"""Campaign of histories on a disk with power loss: power lost at any operation, partly written
data, a full disk.

This module has thousands of histories of the segment log (writer of new rows) and its compaction
(sorting). `crash_spool` has histories of the agent's outbox (store of unacknowledged messages).
`crash_service` has histories of a whole service with its keys, checkpoints, weather, retention and
erasure.

A history of the log is a few lives of one archive. In each life (run of the program) batches are
admitted, and segments (files of new rows) are written and compacted. Then the power fails at a
random operation, and the next life starts from the surviving files. Every acknowledged row must be
present exactly once, and a batch may count as received only if it is present. In the last life
every unacknowledged batch is sent again.
"""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa

from fleet_service.archive.format import layout, load, reading, segments
from fleet_service.archive.format.segments import Rows
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.archive.segment_log import SegmentLog
from fleet_service.ingest.dedup import SequenceTrackers
from fleet_service.replay import restart
from fleet_service.replay.streams import restore_streams
from schemas import grid
from schemas.runtime.figures import Figure
from schemas.wire import Kind
from tests.faults.bars import make_figure
from tests.faults.crash_lives import Lives
from tests.faults.crash_service import ServiceHistory
from tests.faults.crash_spool import spool_history
from tests.faults.frame import Site

VEHICLE: Final = 7
STEPS: Final = 7
ROWS: Final = 2  # rows of a batch. They lie in two zones, so that compaction writes two partitions.
START: Final = 1_728_000_000_000_000_000
CELLS: Final = grid.cell_of(np.array([57.7, 57.7]), np.array([11.97, 15.97]))


class Batch(NamedTuple):
    """Batch that is written in a history, identified by its kind (observations or states) and
    sequence number.
    """

    kind: Kind
    seq: int


def rows_of(batches: list[Batch]) -> Rows:
    """Return the rows of the given batches, all of one kind, as columns. The segment log (writer of
    new rows) takes rows in this form.
    """
    kind = batches[0].kind
    n = ROWS * len(batches)
    rows: Rows = {
        "with_likelihood": np.ones(n, bool),
        "log_likelihood": np.zeros((n, 32), np.uint8),
    }
    for f in segments.SCHEMAS[kind]:
        if f.name not in rows:
            rows[f.name] = np.full(n, "") if f.type == pa.string() else np.zeros(n, np.int64)
    seq = np.repeat([batch.seq for batch in batches], ROWS)
    row = np.tile(np.arange(ROWS), len(batches))
    rows |= {
        "seq": seq,
        "row": row,
        "boot": seq * 0 + 1,
        "region": seq * 0 + 1,
        "first_held": seq * 0 + 1,
    }
    rows["vehicle"] = np.full(n, VEHICLE.to_bytes(8).hex())
    rows["late"] = np.zeros(n, bool)
    rows["cell"] = CELLS[row]
    rows[layout.TIME[kind]] = START + seq
    return rows


class History(Lives[Batch]):
    """Simulated history (sequence of operations and power losses) of an archive's log."""

    lives = 3
    operations = 80
    full_after = 60

    def __init__(self, number: int, folder: Path) -> None:
        super().__init__(number, folder)
        self.sent: list[Batch] = []

    def _run_life(self, root: Path, last: bool) -> None:
        with suppress(OSError):  # a service that starts on a full disk reports this and ends
            log: SegmentLog[Batch] = SegmentLog(root, "shard")
            streams = SequenceTrackers()
            restore_streams(root, streams)
            for _ in range(STEPS):
                self._run_step(root, log, streams)
            if last:
                self._let_in(log, streams, self.sent)
                self.acknowledged.update(log.flush())

    def _run_step(self, root: Path, log: SegmentLog[Batch], streams: SequenceTrackers) -> None:
        chance = self.random.random()
        if chance < 0.45:
            new = [self._make_batch() for _ in range(self.random.randint(1, 3))]
            again = self.random.sample(self.sent, min(2, len(self.sent)))
            self._let_in(log, streams, new + again)
        elif chance < 0.8:
            with suppress(OSError):
                self.acknowledged.update(log.flush())
        else:
            with suppress(OSError):
                compact(root, round_rows=self.random.choice((1, 5, 1000)))

    def _make_batch(self) -> Batch:
        kind = Kind.STATE if self.random.random() < 0.2 else Kind.OBSERVATION
        self.sent.append(Batch(kind, 1 + sum(batch.kind is kind for batch in self.sent)))
        return self.sent[-1]

    def _let_in(
        self, log: SegmentLog[Batch], streams: SequenceTrackers, batches: list[Batch]
    ) -> None:
        for kind in Kind:
            stream = streams[VEHICLE, 1, kind, 1]
            new = [
                b
                for b in dict.fromkeys(batches)
                if b.kind is kind and not stream.has_accepted(b.seq)
            ]
            if new:
                for batch in new:
                    stream.accept(batch.seq)
                log.add(kind, rows_of(new), new)

    def _find_problems(self, root: Path, last: bool) -> list[str]:
        streams = SequenceTrackers()
        with suppress(FileNotFoundError):
            restore_streams(root, streams)
        found: list[str] = []
        for kind in Kind:
            tables = list(reading.read_tables(root, kind, ["seq", "row"]))
            rows = Counter(
                pair
                for t in tables
                for pair in zip(t["seq"].to_pylist(), t["row"].to_pylist(), strict=True)
            )
            found += [
                f"{kind} {pair} is there {count} times" for pair, count in rows.items() if count > 1
            ]
            owed = {b.seq for b in (self.sent if last else self.acknowledged) if b.kind is kind}
            held = {seq for seq, _ in rows}
            found += [
                f"{kind} {seq} is lost"
                for seq in sorted(owed)
                for row in range(ROWS)
                if not rows[seq, row]
            ]
            stream = streams[VEHICLE, 1, kind, 1]
            found += [
                f"{kind} {b.seq} only counts as held"
                for b in self.sent
                if b.kind is kind and stream.has_accepted(b.seq) and b.seq not in held
            ]
        return found


def run_log_history(number: int) -> list[str]:
    """Return the violations (broken promises) found in one simulated history of the log (sequence
    of operations and power losses).
    """
    return _run_log(number)[0]


def _run_log(number: int) -> tuple[list[str], int]:
    """Return the violations (broken promises) in one simulated history of the log, and the number
    of batches acknowledged before a power loss.
    """
    folder = Path(tempfile.mkdtemp(prefix="crash-", dir=_find_memory_folder()))
    one = History(number, folder)
    try:
        return one.find_violations(), one.at_stake
    finally:
        shutil.rmtree(folder)


def _run_outbox(number: int) -> tuple[list[str], int]:
    """Return the violations (broken promises) found in one simulated history of the outbox (store
    of unacknowledged messages), and 0.

    The other histories return as second value the number of batches acknowledged before a power
    loss. Here it is always 0, because this history has no service that acknowledges batches.
    """
    return spool_history(number), 0


def _run_service(number: int) -> tuple[list[str], int]:
    """Return the violations (broken promises) found in one simulated history of a whole service,
    and the number of batches acknowledged before a power loss.
    """
    with tempfile.TemporaryDirectory(prefix="crash-", dir=_find_memory_folder()) as folder:
        one = ServiceHistory(number, Path(folder))
        return one.find_violations(), one.at_stake


def _find_memory_folder() -> str | None:
    """Return a temporary folder in memory if the system has one, otherwise None. A real disk is not
    needed, because the simulated disk decides which data survives a power loss.
    """
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def run(site: Site) -> list[Figure]:
    """Run 5 000 simulated histories of the log (writer of new rows), 500 of the outbox (store of
    unacknowledged messages) and 600 of a service (in a quick run, 120 in total), and return the
    figures.
    """
    logs = site.choose_amount(5000, 100)
    outboxes = site.choose_amount(500, 10)
    services = site.choose_amount(600, 10)
    first = site.seed * 1_000_000
    bad = 0
    acknowledged = Counter[str]()
    kinds = (
        ("log", _run_log, logs),
        ("spool", _run_outbox, outboxes),
        ("service", _run_service, services),
    )
    with ProcessPoolExecutor(mp_context=get_context("spawn"), initializer=_silence_logs) as pool:
        for kind, one, count in kinds:
            for number, (found, safe) in enumerate(
                pool.map(one, range(first, first + count), chunksize=10)
            ):
                bad += bool(found)
                acknowledged[kind] += safe
                for problem in found[:3]:
                    site.say(f"{kind} history {first + number}: {problem}")
                if (number + 1) % 200 == 0:
                    site.say(f"{number + 1} histories of the {kind}, {bad} with a violation so far")
    return [
        make_figure("faults.crash_model.violations", bad),
        make_figure("faults.crash_model.acknowledged", acknowledged.total()),
        make_figure("faults.crash_model.service_acknowledged", acknowledged["service"]),
        Figure("faults.crash_model.histories", logs + outboxes + services, "histories"),
    ]


def _silence_logs() -> None:
    # These modules log damaged files and unusable checkpoints, which occur in every history.
    for module in (
        load,
        restart,
    ):
        logging.getLogger(module.__name__).setLevel(logging.ERROR)
