"""Campaign on a damaged newest segment (file of new rows): it is cut at every byte, and its bytes
are changed one at a time. The service must not count rows that are missing.

The newest segment models one that was written but not yet acknowledged when the power failed: its
rows may be lost, but rows of older segments may not. A batch whose rows are lost must be accepted
as new when its vehicle sends it again.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Final

import numpy as np

from fleet_service.app.engine import Engine
from fleet_service.archive.format import load, reading, segments
from fleet_service.archive.identity.pseudonyms import Pseudonyms, pseudonym_number
from fleet_service.ingest.dedup import SequenceTrackers
from fleet_service.ingest.inbox import Message
from fleet_service.replay.streams import restore_streams
from schemas import wire
from schemas.config import ServiceConfig
from schemas.runtime.figures import Figure
from schemas.wire import Batch, Kind
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.fleet_service.examples import SECOND, batch, key

SEGMENTS: Final = 2
BATCHES: Final = 2  # batches in a segment
# After each WHOLE_WAY damages a service starts on the archive, and all batches are sent again.
WHOLE_WAY: Final = 200


def run(site: Site) -> list[Figure]:
    """Cut the newest segment (file of new rows) at every byte, and change every fifth byte (in a
    quick run, some hundred bytes). Return as figures how many rows were lost or wrongly counted as
    received.
    """
    # Thousands of files are set aside, each with a log line.
    logging.getLogger(load.__name__).setLevel(logging.ERROR)
    batches, newest = _write_archive(site.folder)
    whole = newest.read_bytes()
    rng = np.random.default_rng(site.seed)
    lost = 0
    tried = 0
    for damaged in _make_damages(whole, rng, site.choose_amount(1, 97)):
        newest.write_bytes(damaged)
        lost += _count_lost(site.folder, batches)
        if tried % WHOLE_WAY == 0:
            lost += _after_all_is_sent_again(site.folder, batches)
        for left in newest.parent.glob("*.parquet*"):
            if left.name.removesuffix(load.BAD) >= newest.name:
                left.unlink()
        tried += 1
        if tried % 2000 == 0:
            site.say(f"{tried} damages, {lost} rows lost or doubled")
    return [
        make_figure("faults.truncation.lost_rows", lost),
        make_figure("faults.truncation.damages", tried),
    ]


def _write_archive(root: Path) -> tuple[list[Batch], Path]:
    """Write an archive. Return its batches in the order of their segments (files of new rows), and
    the path of the newest segment.
    """
    now = time.time_ns() - SECOND
    batches = [batch("sim-001", seq, now, [0.8, 0.7]) for seq in range(1, SEGMENTS * BATCHES + 1)]
    with closing(Engine(ServiceConfig(), root)) as engine:
        for first in range(0, len(batches), BATCHES):
            engine.intake.ingest(_make_messages(batches[first : first + BATCHES]), time.time_ns())
            engine.settlement.flush()
    return batches, segments.list_segments(root, Kind.OBSERVATION)[-1]


def _make_damages(whole: bytes, rng: np.random.Generator, stride: int) -> Iterator[bytes]:
    for place in range(0, len(whole), stride):
        yield whole[:place]
    for place in range(0, len(whole), 5 * stride):
        changed = bytearray(whole)
        changed[place] ^= int(rng.integers(1, 256))
        yield bytes(changed)


def _make_messages(batches: Sequence[Batch]) -> list[Message]:
    return [Message(b.kind, key(b.vehicle), wire.encode(b), wire.ENCODING[b.kind]) for b in batches]


def _read_rows(root: Path) -> list[tuple[int, int, float]]:
    tables = reading.read_tables(root, Kind.OBSERVATION, ["seq", "row", "mu"])
    return [
        row
        for table in tables
        for row in zip(*(table[n].to_pylist() for n in ("seq", "row", "mu")), strict=True)
    ]


def _list_expected(batches: Sequence[Batch]) -> set[tuple[int, int, float]]:
    return {
        (b.seq, row, round(float(mu), 3)) for b in batches for row, mu in enumerate(b.columns["mu"])
    }


def _count_lost(root: Path, batches: Sequence[Batch]) -> int:
    """Return the number of wrong or missing rows in the archive, as a restarted service reads it.
    The number includes:

    - missing rows of older segments (files of new rows)
    - missing rows of the newest segment, if the service counts their batch as received
    - rows that no vehicle has sent
    """
    held = {(seq, row, round(mu, 3)) for seq, row, mu in _read_rows(root)}
    streams = SequenceTrackers()
    restore_streams(root, streams)
    pseudonyms = Pseudonyms(root / "keys")
    first = batches[0]
    at = int(batches[0].columns["enter_time"][0])
    vehicle = pseudonym_number(pseudonyms.of("sim-001", at))
    boot = pseudonyms.boot("sim-001", first.boot, at)
    assert (vehicle, boot, Kind.OBSERVATION, first.region) in streams
    stream = streams[vehicle, boot, Kind.OBSERVATION, first.region]
    owed = [
        b
        for place, b in enumerate(batches)
        if place < len(batches) - BATCHES or stream.has_accepted(b.seq)
    ]
    return len(_list_expected(owed) - held) + len(held - _list_expected(batches))


def _after_all_is_sent_again(root: Path, batches: Sequence[Batch]) -> int:
    """Send every batch again and check its acknowledgement. Return the number of rows that are then
    missing or doubled.
    """
    with closing(Engine(ServiceConfig(), root)) as engine:
        engine.intake.ingest(_make_messages(batches), time.time_ns())
        ((_, ack),) = engine.settlement.flush()
    (stream,) = wire.decode_ack(ack)[1]
    assert stream.durable == ((1, len(batches)),)
    rows = [(seq, row, round(mu, 3)) for seq, row, mu in _read_rows(root)]
    return len(set(rows) ^ _list_expected(batches)) + len(rows) - len(set(rows))
