"""Campaign on single-bit errors in every kind of file of service and agent: each error is detected
or has no effect.

For each error, one bit in a copy of an archive is changed, and a service starts from the copy. Its
map and its rows are compared with those of the undamaged archive. Every difference must have been
counted as damage. The outbox files of agents (their stores of unacknowledged messages) are tested
in the same way: an agent must send exactly the stored bytes.
"""

from __future__ import annotations

import logging
import random
import shutil
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge_agent.publish.batching import Draft
from edge_agent.publish.outbox import Outbox
from fleet_service.app.engine import Engine
from fleet_service.archive.format import reading
from schemas.config import ServiceConfig
from schemas.errors import InputError
from schemas.runtime.figures import Figure
from schemas.wire import Kind
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.fleet_service.archive.reference_archive import (
    ROUNDS,
    make_messages,
    now_of,
    read_map,
    write_reference_archive,
)
from tests.outboxes import read_batches

KINDS: Final = {
    "inbox": "inbox/*.parquet",
    "states in the inbox": "inbox/states/*.parquet",
    "observations": "observations/*/*/*.parquet",
    "states": "states/*/*/*.parquet",
    "weather": "weather/*.parquet",
    "key": "keys/*",
    "checkpoint": "checkpoints/*/*",
    "roll-up": "rollup/*/*/*/*.parquet",
    "map": "map/*/*.parquet",
}
BATCHES: Final = 40  # batches in the agent's stored backlog


def run(site: Site) -> list[Figure]:
    """Change random bits in each kind of file, count errors that were not detected, and return the
    figures.
    """
    # Each damaged file causes a log line.
    logging.getLogger("fleet_service").setLevel(logging.ERROR)
    logging.getLogger("edge_agent").setLevel(logging.ERROR)
    random_ = random.Random(site.seed)
    each = site.choose_amount(40, 1)
    whole = site.folder / "whole"
    write_reference_archive(whole)
    right = _reload_service(whole, whole)
    unnoticed = []
    loops = []
    tried = 0
    for kind, pattern in KINDS.items():
        for _ in range(each):
            copy = site.folder / "copy"
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(whole, copy)
            path = random_.choice(sorted(copy.glob(pattern)))
            bit = _flip_bit(path, random_)
            tried += 1
            try:
                found = _reload_service(copy, whole)
            except InputError:
                # Without its key an archive looks like another archive, and only an operator can
                # decide.
                if kind != "key":
                    loops.append(f"{kind}: {path.name} bit {bit}")
            # Any exception at a start repeats at each start, so it counts as a restart loop.
            except Exception as error:  # noqa: BLE001
                loops.append(f"{kind}: {path.name} bit {bit}: {error!r}")
            else:
                if not found["counted"] and not _is_same(found, right):
                    unnoticed.append(f"{kind}: {path.name} bit {bit}")
    spools, wrong = _damage_spool(site, random_, site.choose_amount(200, 15))
    for line in (*unnoticed, *loops, *wrong):
        site.say(line)
    return [
        make_figure("faults.bitrot.unnoticed", len(unnoticed) + len(wrong)),
        make_figure("faults.bitrot.crash_loops", len(loops)),
        make_figure("faults.bitrot.tried", tried + spools),
    ]


def _flip_bit(path: Path, random_: random.Random) -> int:
    data = bytearray(path.read_bytes())
    bit = random_.randrange(8 * len(data))
    data[bit // 8] ^= 1 << bit % 8
    path.write_bytes(data)
    return bit


def _reload_service(root: Path, whole: Path) -> dict[str, Any]:
    """Start a service from the archive in the folder `root`. Return a dictionary with the service's
    map (`map`), its rows (`rows`), and the number of detected damages (`counted`).

    `whole` is the folder of the undamaged archive. If `root` is another folder, it is a damaged
    copy, in which rows may be missing. The function then sends every batch again.
    """
    with closing(Engine(ServiceConfig(), root)) as engine:
        for turn in range(ROUNDS):
            if root != whole:
                engine.intake.ingest(list(make_messages(turn)), now_of(ROUNDS))
        engine.settlement.flush()
        counts = engine.counts
        damaged: list[Path] = []
        rows = {kind: _read_rows(root, kind, damaged) for kind in Kind}
        counted = counts.files_set_aside + counts.checkpoints_refused + counts.key_failures
        counted += counts.witnesses_damaged + len(damaged)
        return {"map": read_map(engine, now_of(ROUNDS)), "rows": rows, "counted": counted}


def _read_rows(root: Path, kind: Kind, damaged: list[Path]) -> list[tuple[str, int, int]]:
    columns = ("vehicle", "seq", "row")
    return sorted(
        row
        for table in reading.read_tables(
            root, kind, columns, damaged=lambda path, _: damaged.append(path)
        )
        for row in zip(*(table[name].to_pylist() for name in columns), strict=True)
    )


def _is_same(found: dict[str, Any], right: dict[str, Any]) -> bool:
    now, then = (np.asarray(one["map"]["beliefs"]) for one in (found, right))
    return bool(
        found["rows"] == right["rows"]
        and now.shape == then.shape
        and np.allclose(now, then, 0.0, 1e-6)
    )


def _damage_spool(site: Site, random_: random.Random, times: int) -> tuple[int, list[str]]:
    """Change bits of an outbox file (store of unacknowledged messages). Return the number of
    changes, and the errors that were not detected.
    """
    path = site.folder / "whole.sqlite"
    wrong = []
    outbox = Outbox(path, boot=5)
    payloads = {seq: random_.randbytes(random_.choice((80, 400))) for seq in range(1, BATCHES + 1)}
    outbox.store(
        [Draft("car-a", Kind.OBSERVATION, 1, 2, lambda s, f: payloads[s]) for _ in payloads], 0.0
    )
    outbox.close()
    for number in range(times):
        copy = site.folder / f"spool-{number}.sqlite"
        shutil.copyfile(path, copy)
        bit = _flip_bit(copy, random_)
        outbox = Outbox(copy, boot=6)
        held = {
            batch.seq: batch.payload
            for batch in read_batches(outbox)
            if batch.stream.vehicle == "car-a"
        }
        lost = payloads.keys() - held.keys()
        counted = outbox.counts.damages + outbox.counts.damaged
        if any(payloads.get(seq) != payload for seq, payload in held.items()) or (
            lost and not counted
        ):
            wrong.append(f"spool: bit {bit}")
        outbox.close()
    return times, wrong
