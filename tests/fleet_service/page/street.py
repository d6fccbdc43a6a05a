"""Crossing of two streets on which six cars drive. The parts of the streets have dry road, snow,
ice or wet road; in one part no car uses much grip.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import zenoh

from schemas import grid, mugrid, wire
from schemas.numeric import FloatArray, IntArray
from tests.fleet_service.examples import CELL, at_least, batch, send, value

VISIT_NS: Final = 600_000_000  # [ns] time for 10 m at 17 m/s
ROLLED: Final = 0.25  # grip used where a vehicle only rolls through
# Longitudinal and lateral share of the used grip: braking, accelerating, turning. Visits with the
# same manoeuvre share an error.
WAYS: Final = (
    (-1.0, 0.0),
    (1.0, 0.0),
    (0.0, 1.0),
)
EAST, NORTH, WEST, SOUTH = range(4)
CARS: Final = tuple(f"car-{name}" for name in ("one", "two", "three", "four", "five", "six"))
MIDDLE: Final = tuple(int(v) for v in grid.deinterleave(CELL))


class Part(NamedTuple):
    """Part of a street: its cells, the headings in which it is driven, and the friction measured
    there (None if cars use little grip).
    """

    dx: range
    dy: range
    headings: tuple[int, ...]
    mu: float | None


PARTS: Final = {
    "dry": Part(range(-20, -8), range(1), (EAST, WEST), 0.85),
    "snow": Part(range(-8, 0), range(1), (EAST, WEST), 0.32),
    "ice": Part(range(5), range(1), (EAST, WEST), 0.16),
    "wet": Part(range(5, 14), range(1), (EAST, WEST), 0.52),
    "passed": Part(range(14, 21), range(1), (EAST, WEST), None),
    "avenue": Part(range(1), range(-20, 0), (NORTH, SOUTH), 0.8),
}


def cells(part: Part) -> IntArray:
    """Return the cells (n,) of one part (stretch with one surface) of the street."""
    places = [(x, y) for x in part.dx for y in part.dy]
    x, y = (np.array(one, np.int64) for one in zip(*places, strict=True))
    return grid.interleave(MIDDLE[0] + x, MIDDLE[1] + y)


def put(
    session: zenoh.Session,
    parts: Sequence[str],
    now: int,
    first_seq: int = 1,
    cars: Sequence[str] = CARS,
) -> int:
    """Publish the observations of cars that drive over the named parts of the street, there and
    back. The last observation is at `now` [ns]. Return the next free sequence number of each car.
    """
    place, heading, mu = _drive([PARTS[name] for name in parts])
    time = now - (len(place) - 1 - np.arange(len(place))) * VISIT_NS
    for car in cars:
        seq = first_seq
        for k in range(0, len(place), wire.MAX_ROWS):
            part = slice(k, k + wire.MAX_ROWS)
            _report(session, car, seq, (place[part], heading[part], mu[part], time[part]))
            seq += 1
    return seq


def _report(
    session: zenoh.Session,
    car: str,
    seq: int,
    visits: tuple[IntArray, IntArray, FloatArray, IntArray],
) -> None:
    place, heading, mu, time = visits
    latitude, longitude = grid.centre(place)
    bound = np.isnan(mu)
    found = np.where(bound[:, None], at_least(np.full(len(mu), ROLLED)), value(np.nan_to_num(mu)))
    used = np.where(bound, ROLLED, np.nan_to_num(mu))
    message = batch(
        car,
        seq,
        int(time[-1]),
        np.where(bound, 0.7, mu).tolist(),
        latitude=latitude,
        longitude=longitude,
        cell=place,
        sector=heading,
        yaw=np.array([0.0, np.pi / 2, np.pi, -np.pi / 2])[heading],
        leave_time=time,
        enter_time=time - VISIT_NS,
        log_likelihood=mugrid.encode_log_likelihood(found),
        mu_utilised=used,
        used_longitudinal=used * WAYS[CARS.index(car) % 3][0],
        used_lateral=used * WAYS[CARS.index(car) % 3][1],
    )
    send(session, message)


def _drive(parts: Sequence[Part]) -> tuple[IntArray, IntArray, FloatArray]:
    """Return cell, heading sector and friction (NaN if not measured) of each visit as arrays (n,).
    The visits are in the order of one drive over the parts: east, west, north, south.
    """
    found = []
    for heading in (EAST, WEST, NORTH, SOUTH):
        way = [
            (cell, heading, np.nan if part.mu is None else part.mu)
            for part in parts
            if heading in part.headings
            for cell in cells(part).tolist()
        ]
        found += way if heading in (EAST, SOUTH) else way[::-1]
    cell, sector, mu = zip(*found, strict=True)
    return np.array(cell, np.int64), np.array(sector, np.int64), np.array(mu)


def count_known(*parts: str) -> int:
    """Return the number of (cell, heading) pairs that the map has after cars drove over the named
    parts of the crossing.
    """
    return sum(len(cells(PARTS[name])) * len(PARTS[name].headings) for name in parts or PARTS)
