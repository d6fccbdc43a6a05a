"""Campaign on impossible positions: vehicles that report places where they cannot be, and two
vehicles that report ice on roads where nobody else drives.

Teleports: each car drives honestly, but also reports one false place that is too far from its path.
The false report is sent in different ways (KINDS). It is in the batch of the true reports or in
another batch. Its time is before, between or after theirs. It can have another boot number (start
of the agent) or another region. Or the car reports a chain of false places, 3.8 km and a
millisecond apart.

Two cars: both report ice at 210 places along 400 km, in three ways. "leaps": the next place follows
after a millisecond, which no car can drive. "live": the cars drive at a plausible 65 m/s, and each
report is sent at once. "backlog": the same drive, but all reports are sent after its end.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fleet_service.app.engine import Engine
from fleet_service.ingest.inbox import Message
from schemas import grid, keys, wire
from schemas.config import ServiceConfig
from schemas.numeric import FloatArray, IntArray
from schemas.runtime.figures import Figure
from schemas.wire import Batch
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.fleet_service.examples import LATITUDE, LONGITUDE, SECOND, batch

Numbers = NDArray[np.floating[Any]]
KINDS: Final = ("row", "batch", "boot", "region", "before", "between", "walk")
# Least distance of a false place from the car's path. A car at speed FASTEST moves 3.4 km in 20 s,
# LEAP_M included.
FAR_M: Final = 6_000.0
# Distance between two places [m] and speed [m/s] of two cars with plausible paths.
STEP_M = 1_900.0
SPEED = 65.0
PLACES: Final = 210
ICY_PLACES: Final = 20  # icy places that three honest cars report
METRES_PER_DEGREE: Final = 111_195.0


def run(site: Site) -> list[Figure]:
    """Send a thousand teleports (reports of impossible places; in a quick run, a few hundred) and
    three drives of two cars, and return the figures.
    """
    teleports = site.choose_amount(1_000, 140)
    accepted, honest_lost = _drive_teleports(site, teleports)
    alerts = {way: _two_cars(site, way) for way in ("leaps", "backlog", "live")}
    site.say(f"alerts of two cars at {PLACES} places: {alerts}")
    return [
        make_figure("faults.path.implausible_accepted", accepted),
        make_figure("faults.path.honest_excluded", honest_lost),
        make_figure("faults.path.teleports", teleports),
        make_figure("faults.path.two_car_alerts", max(alerts.values())),
        make_figure("faults.path.pair_alerts", _count_honest_alerts(site, 2)),
        make_figure("faults.path.honest_alerts", _count_honest_alerts(site, 3)),
    ]


def _offset_position(north_m: Numbers, east_m: Numbers) -> tuple[FloatArray, FloatArray]:
    latitude = np.asarray(LATITUDE + north_m / METRES_PER_DEGREE, np.float64)
    longitude = LONGITUDE + east_m / METRES_PER_DEGREE / np.cos(np.radians(latitude))
    return latitude, np.asarray(longitude, np.float64)


def _make_visits(
    name: str, seq: int, when: IntArray, place: tuple[FloatArray, FloatArray], mu: float
) -> list[Batch]:
    """Return batches, one per map region, in which the vehicle `name` reports the friction `mu` at
    the places `place` (latitude, longitude). The vehicle leaves these places at the times `when`
    [ns].
    """
    cell = grid.cell_of(*place)
    regions = grid.region_of(cell)
    out = []
    for region in np.unique(regions).tolist():
        mine = regions == region
        columns = {
            "latitude": place[0][mine],
            "longitude": place[1][mine],
            "cell": cell[mine],
            "leave_time": when[mine],
            "enter_time": when[mine] - SECOND,
        }
        one = batch(name, seq, int(when[-1]), [mu] * int(mine.sum()))
        out.append(replace(one, region=int(region), columns=one.columns | columns))
    return out


def _make_messages(batches: Sequence[Batch]) -> list[Message]:
    return [
        Message(
            b.kind, keys.observation_key(b.region, b.vehicle), wire.encode(b), wire.ENCODING[b.kind]
        )
        for b in batches
    ]


def _drive_teleports(site: Site, count: int) -> tuple[int, int]:
    """Let `count` cars drive honestly and each report one distant place too (a teleport). Return
    the number of teleports that reached the map, and the number of honest rows that did not.
    """
    rng = np.random.default_rng(site.seed)
    start = time.time_ns() - 7200 * SECOND
    fused = 0
    excluded = 0
    with closing(Engine(ServiceConfig(), site.folder / "teleports")) as engine:
        for number in range(count):
            name = f"car-{number:04}"
            kind = KINDS[number % len(KINDS)]
            north = np.arange(30) * 15.0
            when = start + np.arange(30) * SECOND
            way = _make_visits(name, 1, when, _offset_position(north, np.zeros(30)), 0.8)
            wrong = _far_away(kind, name, start, rng)
            before = engine.counts.implausible_moves
            if kind == "row":
                one = way[0]
                (other,) = wrong
                columns = {k: np.concatenate([v, other.columns[k]]) for k, v in one.columns.items()}
                engine.intake.ingest(
                    _make_messages([replace(one, columns=columns)]), start + 100 * SECOND
                )
            elif kind == "between":
                # Order of arrival: first half of the path, false place, second half.
                half = _make_visits(
                    name, 1, when[:15], _offset_position(north[:15], np.zeros(15)), 0.8
                )
                rest = _make_visits(
                    name, 2, when[15:], _offset_position(north[15:], np.zeros(15)), 0.8
                )
                later = [replace(one, seq=3) for one in wrong]
                engine.intake.ingest(_make_messages([*half, *rest, *later]), start + 100 * SECOND)
            else:
                engine.intake.ingest(_make_messages([*way, *wrong]), start + 100 * SECOND)
            found = engine.counts.implausible_moves - before
            most = sum(len(b.columns["mu"]) for b in wrong)
            if found < most:
                site.say(f"{kind}: {most - found} of {most} accepted")
            fused += max(most - found, 0)
            excluded += max(found - most, 0)
            excluded += engine.counts.refused.total()
    return fused, excluded


def _far_away(kind: str, name: str, start: int, rng: np.random.Generator) -> list[Batch]:
    """Return batches of the car `name` that report a place far from its path, at about the time of
    its true reports. `kind` is the way of sending this false report, for example "boot" (under
    another boot number) or "walk" (a chain of false places, 3.8 km and a millisecond apart).
    """
    far = rng.uniform(FAR_M, 4e5) * np.exp(1j * rng.uniform(0, 2 * np.pi))
    second = {"before": -5, "between": 14.5}.get(kind, 31.0)
    # The car approaches the false place in steps that are each possible after the previous row. The
    # first two steps may be possible within the leap budget.
    if kind == "walk":
        steps = np.arange(2, 50)
        when = start + 31 * SECOND + steps * (SECOND // 1000)
        return _make_visits(
            name, 2, when, _offset_position(450.0 + np.zeros(len(steps)), steps * 2 * STEP_M), 0.2
        )
    if kind == "row":  # a batch covers one region, so the false place must lie in it
        home = grid.region_of(grid.cell_of(LATITUDE, LONGITUDE))
        sides = [FAR_M * 1j**turn for turn in range(4)]
        far = next(
            s
            for s in sides
            if grid.region_of(grid.cell_of(*_offset_position(np.array(s.real), np.array(s.imag))))
            == home
        )
    place = _offset_position(np.array([float(np.real(far))]), np.array([float(np.imag(far))]))
    found = _make_visits(
        name, 1 if kind == "boot" else 2, start + np.array([int(second * SECOND)]), place, 0.2
    )
    return [replace(one, boot=one.boot + 1) for one in found] if kind == "boot" else found


def _two_cars(site: Site, way: str) -> int:
    """Let two cars report ice on a road where nobody else drives, and return the number of places
    at which they raise an alert. `way` is the way of reporting:

    - "leaps": the next place follows after a millisecond, which no car can drive
    - "live": the cars drive at a plausible speed, and each report is sent at once
    - "backlog": the same drive, but all reports are sent after its end
    """
    start = time.time_ns() - 9000 * SECOND
    raised = set[int]()
    apart = SECOND // 1000 if way == "leaps" else int(STEP_M / SPEED * SECOND)
    end = start + PLACES * apart
    with closing(Engine(ServiceConfig(), site.folder / way)) as engine:
        for place in range(PLACES):
            when = np.array([start + place * apart])
            for car in range(2):
                visits = _make_visits(
                    f"insider-{car}",
                    place + 1,
                    when + car,
                    _offset_position(np.zeros(1), np.array([place * STEP_M])),
                    0.15,
                )
                alerts = engine.intake.ingest(
                    _make_messages(visits), int(when[0]) + 2 * SECOND if way == "live" else end
                )
                raised |= {alert.cell for alert in alerts if alert.raised}
    return len(raised)


def _count_honest_alerts(site: Site, cars: int) -> int:
    """Return the number of icy places at which `cars` honest cars raise an alert, on a road without
    other traffic.
    """
    start = time.time_ns() - 3600 * SECOND
    raised = set[int]()
    with closing(Engine(ServiceConfig(), site.folder / f"honest-{cars}")) as engine:
        for place in range(ICY_PLACES):
            for car in range(cars):
                when = np.array([start + (place * 90 + car * 60) * SECOND])
                visits = _make_visits(
                    f"car-{car}",
                    place + 1,
                    when,
                    _offset_position(np.zeros(1), np.array([place * 1_500.0])),
                    0.15,
                )
                raised |= {
                    a.cell
                    for a in engine.intake.ingest(_make_messages(visits), int(when[0]) + SECOND)
                    if a.raised
                }
    return len(raised)
