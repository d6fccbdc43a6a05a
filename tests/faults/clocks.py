"""Campaign on a service's clock that is years ahead or behind for a minute, while the service runs
or at its start. Meanwhile vehicles drive on, some of them on ice.

The machine's clocks are simulated; everything else is the code of a real service: its own clock
(which reads those of the machine), engine, archive, checkpoint (saved state), retention and
restart. In each case vehicles report ice, the machine's clock jumps, the vehicles go on and send
some batches again, and the service is restarted.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import pyarrow as pa

from fleet_service.app.clock import SteadyClock
from fleet_service.app.engine import Engine
from fleet_service.app.jobs import archive_jobs
from fleet_service.app.service import ingest_messages
from fleet_service.archive.format import reading
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.ingest.inbox import Message
from schemas import wire
from schemas.config import ServiceConfig
from schemas.runtime.figures import Figure
from schemas.thresholds import NS
from schemas.wire import Kind
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.fleet_service.examples import batch, key
from tests.fleet_service.replay.test_checkpoints import keep

YEAR: Final = 365 * 86_400 * NS
VEHICLES: Final = 6
CONFIG: Final = ServiceConfig(raw_days=31)


class Case(NamedTuple):
    """Case of a clock error: its size, and whether it occurs at the start or while the service
    runs.
    """

    jump: int
    at_start: bool


@dataclass
class Machine:
    """Simulated clocks of a machine [ns]: the true time, and the error of the wall clock."""

    true: int
    off: int = 0

    def clock(self, seen: int) -> SteadyClock:
        """Return a new service clock (`SteadyClock`) that reads these simulated clocks of the
        machine. `seen` is the latest time [ns] of a report before the service's start, or 0.
        """
        return SteadyClock(seen, lambda: self.true + self.off, lambda: self.true)

    def has_jumped(self, clock: SteadyClock) -> bool:
        """Return True if the service's clock `clock` differs by more than half a year from the true
        time or from the machine's wall clock (`SteadyClock.lag`).
        """
        return max(abs(clock.now() - self.true), abs(clock.lag())) > YEAR // 2


@dataclass
class Found:
    """Numbers of failures by kind (refused batches, lost alerts …), summed over the cases of wrong
    clocks.
    """

    sent: int = 0
    rejected: int = 0
    doubled: int = 0
    retired: int = 0
    lost: int = 0
    alerts_lost: int = 0
    jumps: int = 0


def run(site: Site) -> list[Figure]:
    """Run a service with a wrong clock, and return the figures. The clock is a year ahead, a year
    behind, or thirty years behind (as after an empty battery). Each of these errors occurs once
    while the service runs and once at its start.
    """
    cases = [
        Case(jump, at_start) for jump in (YEAR, -YEAR, -30 * YEAR) for at_start in (False, True)
    ]
    found = Found()
    for number, case in enumerate(cases):
        _run_case(site.folder / str(number), case, found, site.choose_amount(60, 20))
        site.say(f"{case}: {found}")
    return [
        make_figure("faults.clocks.rejected", found.rejected),
        make_figure("faults.clocks.doubled", found.doubled),
        make_figure("faults.clocks.retired", found.retired + found.lost),
        make_figure("faults.clocks.alerts_lost", found.alerts_lost),
        make_figure("faults.clocks.sent", found.sent),
        make_figure("faults.clocks.jumps", found.jumps),
    ]


def _run_case(root: Path, case: Case, found: Found, seconds: int) -> None:
    machine = Machine(time.time_ns())
    seq = 0

    def drive(engine: Engine, clock: SteadyClock, steps: int) -> None:
        """Simulate `steps` seconds. In each second let all vehicles send a new batch and an earlier
        one again, and then run the service's jobs.
        """
        nonlocal seq
        for _ in range(steps):
            machine.true += NS
            seq += 1
            found.sent += VEHICLES
            for again in (max(seq - 5, 1), seq):
                ingest_messages(
                    engine,
                    clock,
                    [
                        _make_message(v, again, machine.true - (seq - again) * NS)
                        for v in range(VEHICLES)
                    ],
                )
            engine.settlement.flush()
            if clock.moment().sure:
                engine.alerts.expire(clock.now())

    def run_service(off: int, steps: int, check: Callable[[Engine], None] | None = None) -> None:
        machine.off = off
        with closing(Engine(CONFIG, root)) as engine:
            clock = machine.clock(engine.seen)
            if check is not None:
                check(engine)
            drive(engine, clock, steps)
            if not case.at_start:
                machine.off = case.jump
                drive(engine, clock, seconds)
                found.jumps += machine.has_jumped(clock)
                _apply_retention(root, engine, clock)
                machine.off = 0
                drive(engine, clock, seconds)
            if case.at_start and off:
                found.jumps += machine.has_jumped(clock)
                _apply_retention(root, engine, clock)
                machine.off = 0
                drive(engine, clock, seconds)
            keep(engine, root)
            compact(root)
            drive(engine, clock, 3)
            found.rejected += engine.counts.refused.total()
            found.alerts_lost += engine.alerts.count == 0

    def check_alert(engine: Engine) -> None:
        found.alerts_lost += engine.alerts.count == 0

    run_service(0, seconds)
    run_service(case.jump if case.at_start else 0, seconds, check_alert)
    run_service(0, 3, check_alert)
    rows = _count_rows(root)
    found.doubled += sum(n - 1 for n in rows.values())
    found.lost += VEHICLES * seq - len(rows)


def _apply_retention(root: Path, engine: Engine, clock: SteadyClock) -> None:
    """Run the job that removes old rows (retention) as the service does. The time of `clock`
    decides which rows are old.
    """
    jobs = archive_jobs(engine, CONFIG, root, clock.moment)
    next(job for job in jobs if job.name == "retention").work(threading.Event())


def _make_message(vehicle: int, seq: int, at: int) -> Message:
    one = batch(f"sim-{vehicle:03}", seq, at, [0.15])
    return Message(
        Kind.OBSERVATION, key(one.vehicle), wire.encode(one), wire.ENCODING[Kind.OBSERVATION]
    )


def _count_rows(root: Path) -> Counter[tuple[int, int]]:
    """Return the number of archived rows per boot (start of the vehicle's agent) and seq (number of
    the batch). The rows are not counted per vehicle, because a vehicle has another pseudonym each
    month.
    """
    tables = list(reading.read_tables(root, Kind.OBSERVATION, ["boot", "seq"]))
    table = pa.concat_tables(tables)
    return Counter(
        zip(table["boot"].to_numpy().tolist(), table["seq"].to_numpy().tolist(), strict=True)
    )
