"""Campaign of malformed messages and queries among honest ones, through the whole engine (service
without network): admission, fusion, archive, answers.

The check is independent of the service's own rules. It reads the archive: every value must be
finite or absent and within the physical limits of its unit, and every honest row must be present
exactly once.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds

from fleet_service.app.engine import Engine
from fleet_service.ingest.inbox import Message
from schemas import grid, query, wire
from schemas.config import ServiceConfig
from schemas.errors import InputError, WireError
from schemas.runtime.figures import Figure
from schemas.wire import Kind
from schemas.wire.tile import decode_tile
from tests.changed_tiles import changed_tiles
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.faults.mutants import Mutants
from tests.fleet_service.examples import SECOND, batch, key

TURN: Final = 500  # malformed messages per pass of the service's main loop
HONEST: Final = ("honest-0", "honest-1", "honest-2")
ASKED_EVERY: Final = 10  # one query for each so many messages
# Possible values by column of the archive: limits that hold for every car on every road.
POSSIBLE: Final = {
    "latitude": (-85.06, 85.06),
    "longitude": (-180.0, 180.0),
    "mu": (0.0, 2.0),
    "mu_lower": (0.0, 2.0),
    "mu_upper": (0.0, 2.0),
    "mu_utilised": (0.0, 2.0),
    "speed": (0.0, 100.0),
    "sector": (0, 3),
    "tyre_season": (0, 3),
    "abs_active": (-1, 1),
    "esc_active": (-1, 1),
    "tcs_active": (-1, 1),
    "wiper": (0.0, 1.0),
    "used_longitudinal": (-2.0, 2.0),
    "used_lateral": (-2.0, 2.0),
    "air_temperature": (-90.0, 80.0),
    "position_std": (0.0, 100.0),
    "vx": (-100.0, 100.0),
    "vy": (-100.0, 100.0),
    "yaw_rate": (-20.0, 20.0),
    "sideslip": (-4.0, 4.0),
    "yaw": (-1000.0, 1000.0),
    "yaw_std": (0.0, 10.0),
    "health": (0, 2**31 - 1),
    "boot": (0, 2**63 - 1),
    "seq": (1, 2**63 - 1),
    "row": (0, 49),
    "first_held": (1, 2**63 - 1),
    "weight": (0.0, 1.2),
    "bias": (-0.2, 0.2),
    "bias_std": (0.0, 0.1),
    "spread": (0.0, 4.0),
    "slope": (0.0, 1.0),
}
METRES_PER_DEGREE: Final = 111_195.0
DAY: Final = 86_400 * SECOND
TWO_CELLS_M: Final = 45.0
NEEDED: Final = {"latitude", "longitude"}


def run(site: Site) -> list[Figure]:
    """Let the engine (service without network) process a million malformed messages (in a quick
    run, some thousands), and return the figures.
    """
    count = site.choose_amount(1_000_000, 10_000)
    began = time.time_ns()
    crashes = 0
    answers = 0
    mutants = Mutants(site.seed, began)
    engine = Engine(ServiceConfig(), site.folder / "archive")
    honest = 0
    # Number of historical maps to compute. Each takes a process and a second.
    pasts = site.choose_amount(50, 3)
    for turn in range(count // TURN):
        messages = []
        queries = []
        now = began + turn * SECOND
        mutants.now = now
        for place in range(TURN):
            if place % ASKED_EVERY:
                messages.append(mutants.make_message())
            else:
                queries.append(mutants.make_query())
        honest += 1
        messages[len(messages) // 2 : len(messages) // 2] = list(_make_honest(honest, now))
        crashes += _run_turn(site, engine, messages, now)
        for asked in queries:
            failed, answered, past = _ask_query(site, engine, asked, now, pasts > 0)
            crashes = crashes + failed
            answers = answers + answered
            pasts = pasts - past
        if not turn % 200:
            site.say(
                f"{turn * TURN} malformed, {crashes} crashes, {engine.counts.observations} rows "
                "admitted"
            )
    refused = engine.counts.refused.total()
    engine.close()
    tiles, broken = _decode_damaged_tiles(site, engine, now)
    rows, impossible, found = _count_archived(site.folder / "archive", began, now)
    return [
        make_figure("faults.fuzz.crashes", crashes + broken),
        make_figure("faults.fuzz.admitted_out_of_range", impossible),
        make_figure("faults.fuzz.honest_lost", abs(honest * len(HONEST) - found)),
        Figure("faults.fuzz.malformed", count + tiles, "messages, queries and tiles"),
        make_figure("faults.fuzz.refused", refused),
        Figure("faults.fuzz.admitted", rows, "rows"),
        make_figure("faults.fuzz.answered", answers),
        make_figure("faults.fuzz.pasts", site.choose_amount(50, 3) - pasts),
    ]


def _make_honest(seq: int, now: int) -> Iterator[Message]:
    for name in HONEST:
        sent = batch(name, seq, now, [0.8])
        yield Message(
            Kind.OBSERVATION, key(name), wire.encode(sent), wire.ENCODING[Kind.OBSERVATION]
        )


def _run_turn(site: Site, engine: Engine, messages: list[Message], now: int) -> int:
    """Let the service process `messages` in one pass of its main loop. Return 1 if a message caused
    an exception instead of a refusal, otherwise 0.
    """
    try:
        engine.intake.ingest(messages, now)
        for _, ack in engine.settlement.flush():
            wire.decode_ack(ack)
        changed_tiles(engine.queries, now)
        engine.alerts.expire(now)
    except Exception:  # noqa: BLE001 any exception counts as a crash
        site.say(traceback.format_exc())
        return 1
    return 0


def _ask_query(
    site: Site, engine: Engine, asked: dict[str, str], now: int, past: bool
) -> tuple[int, int, int]:
    """Let the service answer the query `asked`. Return three counts, each 0 or 1: crashes, answers,
    and rebuilt past maps. If `past` is False, queries about a past map are not sent.
    """
    rebuilt = 0
    try:
        wanted = query.parse(asked)
        if wanted.at is not None and not past:
            return 0, 0, 0
        rebuilt = int(wanted.at is not None)
        list(engine.queries.answer(wanted, lambda _: True, now))
    except InputError:
        return 0, 0, 0
    except Exception:  # noqa: BLE001
        site.say(f"{asked}\n{traceback.format_exc()}")
        return 1, 0, rebuilt
    return 0, 1, rebuilt


def _decode_damaged_tiles(site: Site, engine: Engine, now: int) -> tuple[int, int]:
    """Decode damaged map tiles as a client does. Return the number of tiles, and the number of
    those at which the decoder crashed.
    """
    r = np.random.default_rng(site.seed)
    crashes = 0
    count = site.choose_amount(50_000, 1_000)
    (_, good), *_ = engine.queries.answer(
        query.parse({"bbox": "11.9,57.6,12.0,57.8"}), lambda _: True, now
    )
    for _ in range(count):
        damaged = bytearray(good)
        for place in r.integers(0, len(damaged), r.integers(1, 9)).tolist():
            damaged[place] = int(r.integers(256))
        try:
            decode_tile(
                bytes(damaged[: int(r.integers(len(damaged)))] if r.random() < 0.2 else damaged)
            )
        except WireError:
            continue
        except Exception:  # noqa: BLE001
            site.say(traceback.format_exc())
            crashes += 1
    return count, crashes


def _count_archived(root: Path, began: int, now: int) -> tuple[int, int, int]:
    """Return the numbers of rows, of impossible rows, and of rows of the honest vehicles in all
    files of the archive.
    """
    rows = 0
    impossible = 0
    found = 0
    honest = _list_pseudonyms(root, began) | _list_pseudonyms(root, now)
    for file in sorted(root.rglob("*.parquet")):
        table = ds.dataset(file, partitioning=None).to_table()
        bad = np.zeros(table.num_rows, bool)
        columns = {name: table[name] for name in table.schema.names}
        for name, (least, most) in POSSIBLE.items():
            if name in columns:
                values = columns[name].to_numpy()
                absent = (
                    np.isnan(values)
                    if values.dtype.kind == "f" and name not in NEEDED
                    else np.zeros(len(values), bool)
                )
                bad |= ~(((values >= least) & (values <= most)) | absent)
        for name in columns.keys() & {"enter_time", "leave_time", "time"}:
            times = columns[name].cast(pa.timestamp("ns", tz="UTC")).cast(pa.int64()).to_numpy()
            bad |= (times < began - 31 * DAY) | (times > now + 30 * SECOND)
        cell = columns["cell"].to_numpy()
        latitude = columns["latitude"].to_numpy()
        middle, across = grid.centre(cell)
        north = (middle - latitude) * METRES_PER_DEGREE
        east = (
            (across - columns["longitude"].to_numpy())
            * METRES_PER_DEGREE
            * np.cos(np.radians(latitude))
        )
        bad |= (grid.region_of(cell) != columns["region"].to_numpy()) | (
            np.hypot(north, east) > TWO_CELLS_M
        )
        rows = rows + table.num_rows
        impossible = impossible + int(bad.sum())
        found += sum(vehicle in honest for vehicle in columns["vehicle"].to_pylist())
    return rows, impossible, found


def _list_pseudonyms(root: Path, now: int) -> set[str]:
    from fleet_service.archive.identity.pseudonyms import Pseudonyms

    known = Pseudonyms(root / "keys")
    return {known.of(name, now) for name in HONEST}
