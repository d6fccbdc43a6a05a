"""Tests that every setting of the service has an effect: a test changes the setting, and requires
another behaviour.
"""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fleet_service.app import jobs, service
from fleet_service.app.clock import SteadyClock
from fleet_service.app.engine import Engine
from fleet_service.app.service import Service
from fleet_service.ingest.inbox import Message
from schemas import grid, keys, wire
from schemas.config import ServiceConfig
from schemas.wire import Kind
from tests.changed_tiles import changed_tiles
from tests.event_lines import logger_into
from tests.fleet_service.archive.reference_archive import DATA
from tests.fleet_service.examples import REGION, SECOND, batch, key
from tests.secured import make_enrolment

# Settings of the configuration: another value, and a function whose result must differ.
Show = Callable[[ServiceConfig, Path], object]


def open_engine(config: ServiceConfig, root: Path) -> Iterator[Engine]:
    """Yield an engine (service without network) with the setting under test, after it has received
    four reports in this order:

    - from car sim-001, one second old
    - from car sim-002, ten minutes old
    - from car sim-003, dated one minute in the future
    - from car sim-001 again, five minutes old, so older than this car's first report
    """
    with closing(Engine(config, root)) as engine:
        now = time.time_ns()
        for name, age in (("sim-001", 1), ("sim-002", 600), ("sim-003", -60), ("sim-001", 300)):
            sent = batch(name, 1 + (age == 300), now - age * SECOND, [0.5])
            engine.intake.ingest(
                [Message(sent.kind, key(name), wire.encode(sent), wire.ENCODING[sent.kind])], now
            )
        engine.settlement.flush()
        yield engine


def of_engine(look: Callable[[Engine], object]) -> Show:
    return lambda config, root: next(look(engine) for engine in open_engine(config, root))


def of_jobs(config: ServiceConfig, root: Path) -> object:
    with closing(Engine(config, root)) as engine:
        return {
            job.name: job.every_s
            for job in jobs.archive_jobs(engine, config, root, SteadyClock().moment)
        }


def of_compaction(config: ServiceConfig, root: Path) -> object:
    shutil.copytree(DATA / "v1.0" / "archive", root)
    with closing(Engine(config, root)) as engine:
        (compaction,) = (
            job
            for job in jobs.archive_jobs(engine, config, root, SteadyClock().moment)
            if job.name == "compaction"
        )
        assert compaction.work(threading.Event())
    return sorted(path.name for path in root.parent.joinpath("there").rglob("*.parquet"))


def of_service(look: Callable[[Service], object]) -> Show:
    def show(config: ServiceConfig, root: Path) -> object:
        made = Service(config, root, logger_into([]))
        with closing(made.engine):
            return look(made)

    return show


def let_in(made: Service) -> list[bool]:
    """Let two vehicles each send 60 messages of 40 kB to a service with the setting under test.
    Return, for each message, True if the rate limit admits it.
    """
    return [
        made.inbox._limits.allows(key(name), 40_000)
        for name in ("car-1", "car-2")
        for _ in range(60)
    ]


def let_publisher_in(config: ServiceConfig, root: Path) -> object:
    """Return what `let_in` returns if the first sender is a publisher."""
    return of_service(let_in)(config.model_copy(update={"publishers": ["car-1"]}), root)


def count_queued(made: Service) -> int:
    for _ in range(5):
        made.inbox.put(Message(Kind.STATE, "", b"", ""))
    return len(made.inbox)


def turns(made: Service) -> tuple[int, int]:
    """Simulate ten passes of the service's main loop, 0.3 s each. Return the number of segments
    (files of new rows) that the service writes, and the number of rounds in which it publishes
    tiles.
    """
    clock = [time.monotonic()]
    calls = {"begin_flush": 0, "take_dirty": 0}

    def make_counter(name: str) -> Callable[..., list[Any]]:
        def call(*_: object) -> list[Any]:
            calls[name] += 1
            return []

        return call

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service, "time", SimpleNamespace(monotonic=lambda: clock[0]))
        patch.setattr(service, "IDLE_S", 0.0)
        patch.setattr(made._rounds, "_clock", lambda: clock[0])
        owners = ((made.engine.settlement, "begin_flush"), (made.engine.state.map, "take_dirty"))
        for owner, name in owners:
            patch.setattr(owner, name, make_counter(name))
        for _ in range(10):
            clock[0] += 0.3
            made._step(None, threading.Event())  # type: ignore[arg-type]
    return calls["begin_flush"], calls["take_dirty"]


def count_far_moves(config: ServiceConfig, root: Path) -> int:
    """Let one sender report two distant places at the same time, and return the number of reports
    that the service counts as implausible moves.
    """
    now = time.time_ns()
    with closing(Engine(config, root)) as engine:
        for seq, latitude in enumerate((57.7, 58.7), 1):
            report: dict[str, Any] = {
                "vehicle": "sim-001",
                "boot": "1",
                "seq": str(seq),
                "enter_time": [str(now)],
                "yaw": [0.1],
            }
            report |= {"latitude": [latitude], "longitude": [11.97], "mu_utilised": [0.2]}
            region = int(grid.region_of(int(grid.cell_of(latitude, 11.97))))
            where = keys.observation_key(region, "sim-001")
            body = json.dumps(report).encode()
            engine.intake.ingest([Message(Kind.OBSERVATION, where, body, wire.JSON)], now)
        assert engine.counts.observations == 2
        return engine.counts.implausible_moves


def count_refused(engine: Engine) -> object:
    return engine.counts.refused["time"], engine.counts.late


SETTINGS: Final[dict[str, tuple[object, Show]]] = {
    "name": (
        "shard-9",
        lambda c, r: (
            of_engine(count_refused)(c, r),
            [p.name[:7] for p in (r / "inbox").glob("*.parquet")],
        ),
    ),
    "lateness_s": (1000.0, of_engine(count_refused)),
    "clock_ahead_s": (120.0, of_engine(count_refused)),
    "oldest_s": (400.0, of_engine(count_refused)),
    "public_vehicles": (
        9,
        of_engine(lambda engine: len(changed_tiles(engine.queries, time.time_ns()))),
    ),
    "weather": ("{rain}", of_engine(lambda engine: engine.counts.weather)),
    "compact_s": (10.0, of_jobs),
    "checkpoint_s": (10.0, of_jobs),
    "snapshot_s": (10.0, of_jobs),
    "raw_days": (50, of_jobs),
    "put_to": ("file://{there}", of_compaction),
    "queue_batches": (3, of_service(count_queued)),
    "vehicle_kb_s": (1e9, of_service(let_in)),
    "vehicle_burst_kb": (100.0, of_service(let_in)),
    "fleet": ("{fleet}", of_service(let_in)),
    "publishers": (["sim-001"], count_far_moves),
    "publisher_kb_s": (20.0, let_publisher_in),
    "segment_s": (1.0, of_service(turns)),
    "put_s": (0.1, of_service(turns)),
}
# Settings whose effect other tests show. `zenoh` and `regions` are covered by app/test_service.py,
# the archive and its copy by app/test_copy.py. The lease and the standby are covered by
# shards/test_successor.py. tests/schemas/runtime and app/test_metrics.py cover the rest.
SEEN_OUTSIDE: Final = {
    "zenoh",
    "regions",
    "archive",
    "standby",
    "lease_s",
    "metrics_port",
    "metrics_host",
    "log",
}


def test_every_setting_of_the_service_is_in_a_table() -> None:
    assert set(ServiceConfig.model_fields) == set(SETTINGS) | SEEN_OUTSIDE


@pytest.mark.parametrize("name", SETTINGS)
def test_every_setting_of_the_service_changes_what_it_does(name: str, tmp_path: Path) -> None:
    value, show = SETTINGS[name]
    if isinstance(value, str):
        (tmp_path / "fleet").write_text(make_enrolment(vehicles=["car-1"]).model_dump_json())
        pq.write_table(
            pa.table({"region": [REGION], "time": [time.time_ns()], "precipitation": [2.0]}),
            tmp_path / "rain",
        )
        value = value.format(
            **{
                file: tmp_path / "2" / file if file == "there" else tmp_path / file
                for file in ("fleet", "rain", "there")
            }
        )
    assert getattr(ServiceConfig(), name) != value
    usual, again, other = (
        show(ServiceConfig.model_validate(given), tmp_path / str(k) / "archive")
        for k, given in enumerate(({}, {}, {name: value}))
    )
    assert usual == again
    assert other != usual
