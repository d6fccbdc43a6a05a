"""Campaign on one enrolled car that uses everything a valid car may do, for a simulated hour, with
ten honest cars on the same road.

The insider (the car that attacks) sends as much as its rate limit allows. It reports visits to
cells all over a region and over the world, and ice on a road that only it drives. It uses a new
boot (identifier of an agent's start) for each batch, JSON, and batches whose rows lie in two
months. It also sends its own batches again, unchanged and under other sequence numbers. Engine,
limits and archive are real; only time is simulated. The insider's messages are counted, because too
few of them would be no attack.
"""

from __future__ import annotations

import json
import time
from collections import deque
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from fleet_service.app.engine import Engine
from fleet_service.counts import ServiceCounts
from fleet_service.ingest.inbox import Message
from fleet_service.ingest.rate_limit import RateLimiter
from schemas import grid, keys, wire
from schemas.config import ServiceConfig
from schemas.runtime.figures import Figure
from schemas.thresholds import NS
from schemas.wire import Batch
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.fleet_service.examples import LATITUDE, LONGITUDE, batch

CAR: Final = "car-666"
HONEST: Final = tuple(f"car-{k:03}" for k in range(10))
ICE: Final = (LATITUDE + 0.01, LONGITUDE + 0.01)  # a road that no other vehicle drives on
MONTH_NS: Final = 29 * 86_400 * NS
WARM_S: Final = 60  # after this time the sizes of pools and windows are constant


def _make_growth_figure(grown: float, seconds: int, *, quick: bool) -> Figure:
    """Return a figure of the growth of the service's memory: `grown` [MB] in `seconds` [s],
    converted to MB per hour. A quick run returns `grown` itself, because it is too short for a rate
    per hour.
    """
    if quick:
        return replace(make_figure("faults.insider.mb_per_hour", grown), unit="MB in all")
    return make_figure("faults.insider.mb_per_hour", grown / seconds * 3600)


def run(site: Site) -> list[Figure]:
    """Simulate an hour of the insider's messages (in a quick run, four minutes), and return the
    figures.
    """
    seconds = site.choose_amount(3600, 240)
    counts = ServiceCounts()
    random_ = np.random.default_rng(site.seed)
    start = time.time_ns() - 4000 * NS
    longest = 0.0
    sent = 0
    at = 0.0
    replayed = 0
    earlier = deque[Message](maxlen=100)
    config = ServiceConfig()
    limits = RateLimiter(
        config.vehicle_kb_s * 1e3, config.vehicle_burst_kb * 1e3, None, counts, lambda: at
    )
    with closing(Engine(config, site.folder / "archive")) as engine:
        _warm_up(engine, start - NS, random_)
        warm = 0.0
        for second in range(seconds):
            at = float(second)
            now = start + second * NS
            honest = [_make_message(_make_visit(name, second + 1, now, second)) for name in HONEST]
            attack: list[Message] = []
            while True:
                is_repeated = sent % 7 == 6 and bool(earlier)
                if is_repeated:
                    one = earlier[int(random_.integers(len(earlier)))]
                else:
                    one = _make_attack(sent, second, now, random_)
                if not limits.allows(one.key, len(one.payload), one.encoding):
                    break
                attack.append(one)
                earlier.append(one)
                sent += 1
                replayed += is_repeated
            began = time.perf_counter()
            engine.intake.ingest(attack + honest, now)
            engine.settlement.flush()
            longest = max(longest, time.perf_counter() - began)
            if second == WARM_S:
                warm = _memory_mb()
        grown = _memory_mb() - warm
        alone = sum(
            _is_insider_only(alert.latitude, alert.longitude)
            for alert in engine.alerts.next_to_repeat(10**6)
        )
        settled = engine.counts.observations
        ours = {name: n for name, n in engine.counts.as_dict().items() if n}
    site.say(f"{sent} messages of the insider, {settled} observations; {ours}")
    return [
        make_figure("faults.insider.alerts_alone", alone),
        _make_growth_figure(grown, seconds - WARM_S, quick=site.quick),
        make_figure("faults.insider.honest_delay_s", longest),
        make_figure("faults.insider.messages", sent / seconds),
        make_figure("faults.insider.replayed", replayed),
        make_figure("faults.insider.honest_lost", int(settled < len(HONEST) * seconds)),
    ]


def _warm_up(engine: Engine, now: int, random_: np.random.Generator) -> None:
    """Ingest one message of each kind, because compilation at first use is not damage by the
    attacker.
    """
    for number in range(6):
        engine.intake.ingest([_make_attack(number, 0, now, random_)], now)


def _make_attack(number: int, second: int, now: int, random_: np.random.Generator) -> Message:
    """Return the next message of the insider; its six kinds of messages follow each other in
    turn.
    """
    seq = number + 1
    what = number % 6
    if what == 0:  # places all over the region
        return _make_message(_make_scattered(seq, now, random_, 0.05))
    if what == 1:  # places all over the world
        return _make_message(_make_scattered(seq, now, random_, 60.0))
    if what == 2:  # a new stream for each batch
        return _make_message(
            replace(_make_visit(CAR, 1, now, second), boot=int(random_.integers(1, 1 << 62)))
        )
    if what == 3:  # JSON text, which is expensive to parse
        one = _make_scattered(seq, now, random_, 0.001)
        return _make_text_message(one)
    if what == 4:  # one row in an earlier month and one now, on the ice that it reports alone
        old = now - MONTH_NS
        one = _make_ice(seq, now, 2)
        leave = np.array([old, now])
        return _make_message(
            replace(one, columns=one.columns | {"leave_time": leave, "enter_time": leave - NS})
        )
    return _make_message(_make_ice(seq, now, 1))  # the same report of ice again and again


def _make_ice(seq: int, now: int, rows: int) -> Batch:
    cell = int(grid.cell_of(*ICE))
    where = {
        "latitude": np.full(rows, ICE[0]),
        "longitude": np.full(rows, ICE[1]),
        "cell": np.full(rows, cell),
    }
    one = batch(CAR, seq, now, [0.15] * rows)
    return replace(one, region=int(grid.region_of(cell)), columns=one.columns | where)


def _make_visit(name: str, seq: int, now: int, second: int) -> Batch:
    """Return a batch of an honest car with one visit (pass through a cell). The car drives along a
    road of twenty cells at 12 m/s; `second` determines its place.
    """
    longitude = LONGITUDE + 2e-4 * ((second + sum(name.encode())) % 20)
    one = batch(name, seq, now, [0.8])
    cell = grid.cell_of(LATITUDE, longitude)
    return replace(
        one, columns=one.columns | {"longitude": np.array([longitude]), "cell": np.array([cell])}
    )


def _make_scattered(seq: int, now: int, random_: np.random.Generator, degrees: float) -> Batch:
    """Draw fifty random places within `degrees` [deg] of the road. Return a batch in which the
    insider reports those that lie in the same region as the first.
    """
    spread = random_.uniform(-degrees, degrees, (2, 50))
    latitude = np.clip(LATITUDE + spread[0], -80.0, 80.0)
    longitude = LONGITUDE + spread[1]
    cell = grid.cell_of(latitude, longitude)
    region = grid.region_of(cell)
    mine = region == region[0]
    one = batch(CAR, seq, now, [0.5] * int(mine.sum()))
    where = {"latitude": latitude[mine], "longitude": longitude[mine], "cell": cell[mine]}
    same = np.full(int(mine.sum()), now)
    where |= {"leave_time": same, "enter_time": same - NS}
    return replace(one, region=int(region[0]), columns=one.columns | where)


def _make_message(one: Batch) -> Message:
    place = keys.observation_key(one.region, one.vehicle)
    return Message(one.kind, place, wire.encode(one), wire.ENCODING[one.kind])


def _make_text_message(one: Batch) -> Message:
    """Return a message that contains the batch `one` as JSON, written as a person would write it by
    hand.
    """
    text = {
        "vehicle": one.vehicle,
        "boot": str(one.boot),
        "seq": str(one.seq),
        "region": str(one.region),
        "enter_time": [str(t) for t in one.columns["enter_time"].tolist()],
        **{
            name: one.columns[name].tolist()
            for name in ("latitude", "longitude", "yaw", "mu", "mu_utilised")
        },
    }
    place = keys.observation_key(one.region, one.vehicle)
    return Message(one.kind, place, json.dumps(text).encode(), "application/json")


def _is_insider_only(latitude: float, longitude: float) -> bool:
    """Return True if a place does not lie on the road of the honest cars; then only the insider
    reports it.
    """
    return abs(latitude - LATITUDE) > 1e-3 or not -1e-3 <= longitude - LONGITUDE <= 5e-3


def _memory_mb() -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 1024
