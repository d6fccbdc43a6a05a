"""Tests of a damaged outbox file (the agent's store of unacknowledged messages). The agent must
rename and count it, recover its readable batches, and continue.
"""

from __future__ import annotations

import random
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import pytest

from edge_agent.publish import spool_file
from edge_agent.publish.batching import Draft
from edge_agent.publish.outbox import Outbox, StoredBatch
from schemas.errors import InputError
from schemas.wire import Kind
from tests.outboxes import read_batches

PAGE = 4096
BATCHES = 120


def store_batches(path: Path) -> dict[int, bytes]:
    """Store some hundred batches in an outbox (store of unacknowledged messages) on disk, and
    return their payloads by sequence number.
    """
    random_ = random.Random(7)
    payloads = [random_.randbytes(random_.choice((60, 190, 900))) for _ in range(BATCHES)]
    outbox = Outbox(path, boot=5)
    outbox.store(
        [
            Draft("car-a", Kind.OBSERVATION, 77, 2, lambda s, f, p=p: p)  # type: ignore[misc]
            for p in payloads
        ],
        0.0,
    )
    outbox.close()
    return dict(enumerate(payloads, 1))


def payloads_by_seq(batches: list[StoredBatch]) -> dict[int, bytes]:
    return {batch.seq: batch.payload for batch in batches}


def test_outbox_with_any_page_lost_recovers_most_of_its_batches(tmp_path: Path) -> None:
    whole = store_batches(tmp_path / "whole.sqlite")
    image = (tmp_path / "whole.sqlite").read_bytes()
    noticed = 0
    least = BATCHES
    pages = len(image) // PAGE
    for page in [*range(8), *range(8, pages, 3)]:
        folder = tmp_path / str(page)
        folder.mkdir()
        path = folder / "spool.sqlite"
        path.write_bytes(image[: page * PAGE] + bytes(PAGE) + image[(page + 1) * PAGE :])
        outbox = Outbox(path, boot=6)
        noticed += outbox.counts.damages
        held = payloads_by_seq(read_batches(outbox))
        assert held.items() <= whole.items(), "a batch is not what was stored"
        least = min(least, len(held))
        assert (
            outbox.store([Draft("car-a", Kind.STATE, 77, 1, lambda s, f: b"goes on")], 0.0)[0].seq
            == 1
        )
        outbox.close()
        assert len(list(folder.glob("spool.sqlite.damaged-*"))) == outbox.counts.damages
    assert noticed > pages // 5
    assert least > BATCHES // 2


def test_a_bit_that_flips_within_a_batch_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "spool.sqlite"
    random_ = random.Random(3)
    whole = store_batches(path)
    image = bytearray(path.read_bytes())
    places = [image.find(whole[seq]) + random_.randrange(60) for seq in (20, 70, 110)]
    for place in places:
        image[place] ^= 1 << random_.randrange(8)
    path.write_bytes(image)
    outbox = Outbox(path, boot=6)
    held = payloads_by_seq(read_batches(outbox))
    assert held == {seq: payload for seq, payload in whole.items() if seq not in (20, 70, 110)}
    assert outbox.counts.damaged == 6
    outbox.close()


def test_a_batch_whose_number_of_records_is_damaged_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "spool.sqlite"
    whole = store_batches(path)
    with sqlite3.connect(path) as database:
        database.execute("UPDATE batch SET records = 0 WHERE seq = 20")
    database.close()
    outbox = Outbox(path, boot=6)
    assert payloads_by_seq(read_batches(outbox)).keys() == whole.keys() - {20}
    assert outbox.counts.damaged == 1
    outbox.close()


def test_file_damaged_in_use_is_recovered_and_sequences_continue(tmp_path: Path) -> None:
    path = tmp_path / "spool.sqlite"
    store_batches(path)
    outbox = Outbox(path, boot=6)
    draft = Draft("car-a", Kind.OBSERVATION, 77, 2, lambda s, f: b"mine")
    first = outbox.store([draft, draft], 0.0)
    outbox.settle_ranges(first[0].stream, [(1, 2)])
    outbox.delete_settled()
    outbox.recover_file()
    assert outbox.counts.damages == 1
    assert outbox.store([draft], 1.0)[0].seq == 3
    assert len(outbox.held) == BATCHES + 1
    outbox.close()


def damaged_file(folder: Path) -> Path:
    path = folder / "spool.sqlite"
    store_batches(path)
    image = path.read_bytes()
    path.write_bytes(image[: 5 * PAGE] + bytes(PAGE) + image[6 * PAGE :])
    return path


def raise_full_disk(_: Path) -> NoReturn:
    raise OSError(28, "No space left on device")


def test_a_start_after_a_failed_recovery_finds_the_batches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = damaged_file(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(spool_file, "_readable_batches", raise_full_disk)
        with pytest.raises(InputError, match="No space left"):
            Outbox(path, boot=6)
    outbox = Outbox(path, boot=7)
    assert outbox.counts.damages == 1
    assert len(outbox.held) > BATCHES // 2
    outbox.close()


def test_a_recovery_interrupted_between_its_renames_is_completed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = damaged_file(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", stop_after_one_rename(Path.rename))
        with pytest.raises(InputError, match="crash"):
            Outbox(path, boot=6)
    assert not path.exists()
    (tmp_path / "spool.sqlite-wal").write_bytes(b"log of the damaged file" * 1000)
    outbox = Outbox(path, boot=7)
    assert len(outbox.held) > BATCHES // 2
    outbox.close()


def stop_after_one_rename(rename: Callable[[Path, Path], Path]) -> Callable[[Path, Path], Path]:
    """Return a function that renames the first file, and raises at the next one that exists."""
    done: list[Path] = []

    def rename_once(path: Path, target: Path) -> Path:
        if done and path.exists():
            raise OSError("crash")
        done.append(path)
        return rename(path, target)

    return rename_once


def test_recovery_during_use_is_repeated_until_the_disk_accepts_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "spool.sqlite"
    store_batches(path)
    outbox = Outbox(path, boot=6)
    with monkeypatch.context() as patch:
        patch.setattr(spool_file, "_readable_batches", raise_full_disk)
        with pytest.raises(OSError, match="No space left"):
            outbox.recover_file()
    with pytest.raises(sqlite3.Error) as raised:
        outbox.due_batches(0.0, 1)
    assert spool_file.is_damage(raised.value), "the publisher would not try again"
    outbox.recover_file()
    assert len(outbox.held) == BATCHES
    assert outbox.counts.damaged == 0
    outbox.close()


def test_an_outbox_of_a_former_version_has_no_checksums_and_is_read(tmp_path: Path) -> None:
    path = tmp_path / "spool.sqlite"
    whole = store_batches(path)
    with sqlite3.connect(path) as database:
        database.execute("ALTER TABLE batch DROP COLUMN checksum")
    database.close()
    outbox = Outbox(path, boot=6)
    assert payloads_by_seq(read_batches(outbox)) == whole
    assert outbox.counts.damages == 0
    outbox.close()


def test_file_that_is_no_database_is_refused_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "spool.sqlite"
    path.write_bytes(b"SQLite is what my shopping list is about" * 100)
    with pytest.raises(InputError, match="cannot be opened"):
        Outbox(path)
    assert [p.name for p in tmp_path.iterdir()] == ["spool.sqlite"]
