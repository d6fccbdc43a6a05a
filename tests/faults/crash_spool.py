"""Histories of the agent's outbox (store of unacknowledged messages): power lost at any byte that
SQLite had not yet synced.

SQLite writes its files itself, so the files are read before and after each commit. When a commit
has returned, its bytes are synced. Power loss during the next commit leaves the old files and a
part of the new write-ahead log. If SQLite was copying this log into the database, power loss leaves
any mixture of old and new database pages, with the old log.
"""

from __future__ import annotations

import random
import shutil
import tempfile
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

from edge_agent.publish.batching import Draft
from edge_agent.publish.held_batches import Stream
from edge_agent.publish.outbox import Outbox
from schemas.wire import Kind
from tests.outboxes import read_batches

PAGE: Final = 4096
COMMITS: Final = 6
CAPACITY: Final = 10**9


class Files(NamedTuple):
    """Bytes of the SQLite file of the outbox (store of unacknowledged messages) and of its
    write-ahead log.
    """

    database: bytes
    log: bytes

    @staticmethod
    def read_files(path: Path) -> Files:
        log = Path(f"{path}-wal")
        return Files(path.read_bytes(), log.read_bytes() if log.exists() else b"")


def _return_payload(payload: bytes, sequence: int, first: int) -> bytes:
    return payload


def spool_history(number: int) -> list[str]:
    """Return the violations (broken promises) found in one simulated history of an agent's outbox
    (batches stored on disk).
    """
    random_ = random.Random(number)
    folder = Path(tempfile.mkdtemp(prefix="spool-"))
    try:
        return _run_history(random_, folder)
    finally:
        shutil.rmtree(folder)


def _run_history(random_: random.Random, folder: Path) -> list[str]:
    path = folder / "spool.sqlite"
    boot = 5
    outbox = Outbox(path, boot=boot, capacity_bytes=CAPACITY)
    stream = Stream("car-a", boot, Kind.OBSERVATION, 1)
    held = {0: b""}
    found = []
    held.clear()
    for _ in range(COMMITS):
        before = Files.read_files(path)
        sure = set(held)
        settled = {seq for seq in held if random_.random() < 0.3}
        outbox.settle_ranges(stream, [(seq, seq) for seq in settled])
        payload = random_.randbytes(random_.choice((50, 3000, 400_000)))
        batches = outbox.store(
            [Draft("car-a", Kind.OBSERVATION, 1, 1, partial(_return_payload, payload))] * 2,
            0.0,
        )
        held.update({batch.seq: batch.payload for batch in batches})
        after = Files.read_files(path)
        for image in (after, _tear_write(random_, before, after)):
            owed = sure - settled if image is not after else set(held) - settled
            found += _find_problems(folder / "image.sqlite", image, owed, held)
        for seq in settled:
            del held[seq]
    outbox.close()
    return found


def _tear_write(random_: random.Random, before: Files, after: Files) -> Files:
    """Return a random possible content of SQLite's files after power loss during a commit that
    changes them from `before` to `after`.
    """
    if before.database != after.database and random_.random() < 0.5:
        pages = range(0, max(len(before.database), len(after.database)), PAGE)
        chosen = (
            random_.choice((before, after)).database[at : at + PAGE].ljust(PAGE, b"\0")
            for at in pages
        )
        return Files(b"".join(chosen), before.log)
    cut = random_.randint(0, len(after.log))
    database = before.database if before.database == after.database else after.database
    rubbish = random_.randbytes(random_.choice((0, 7, PAGE)))
    rest = before.log[cut:] if cut < len(before.log) else rubbish
    return Files(database, after.log[:cut] + rest)


def _find_problems(path: Path, image: Files, owed: set[int], known: dict[int, bytes]) -> list[str]:
    path.write_bytes(image.database)
    Path(f"{path}-wal").write_bytes(image.log)
    Path(f"{path}-shm").unlink(missing_ok=True)
    again = Outbox(path, boot=6, capacity_bytes=CAPACITY)
    kept = {batch.seq: batch.payload for batch in read_batches(again)}
    again.close()
    found = [f"batch {seq} is lost" for seq in owed - kept.keys()]
    return found + [
        f"batch {seq} is not what was stored"
        for seq, payload in kept.items()
        if known.get(seq) != payload
    ]
