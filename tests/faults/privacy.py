"""Campaign on privacy: a reader of the map tries to follow a lone car at night, with the shipped
secure settings.

Five side streets, each with as many households as STREETS states, join a main road. Each
household's car leaves twice by day. One car leaves alone at night, and its agent does not publish
the beginning of the trip.

The reader stores the map tiles of every publication and compares them with the previous ones. It
assumes that the car is in the cell that changed most: a new cell, or else the cell whose interval,
times or counts changed most. The reader then guesses the side street that is nearest to the first
such cells. If no cell has changed, the reader guesses at random. For a random guess, the campaign
records its probability of being right.

As a control, the same is done with a map that shows every visit (pass through a cell) at once.
There the reader must find the car.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple
from unittest.mock import patch

import numpy as np
import pyarrow as pa

from fleet_service.app.engine import Engine
from fleet_service.ingest.inbox import Message
from fleet_service.serve.tile_cache import TileCache
from fleet_service.serve.visitors import PART_NS
from schemas import grid, keys, wire
from schemas.config import ServiceConfig
from schemas.numeric import FloatArray, IntArray
from schemas.runtime.figures import Figure
from schemas.wire import Batch
from tests.changed_tiles import changed_tiles
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.fleet_service.examples import CELL, LATITUDE, LONGITUDE, SECOND, batch

PUBLIC: Final = 3  # vehicles needed for a public cell in the secure configuration
CUT: Final = 16  # cells (200 m) at the beginning of a trip that the agent does not publish
STREETS: Final = (4, 3, 3, 2, 1)  # households in each side street
LENGTH: Final = 30  # cells of a side street
PART: Final = 40  # visits in a batch
MAIN: Final = 60  # cells of the main road
NEAR_M: Final = 25.0
EAST: Final = 0
SOUTH: Final = 3
YAW: Final = (0.0, np.pi / 2, np.pi, -np.pi / 2)
HOUR: Final = 3600 * SECOND
MU: Final = 0.8
ICE: Final = 0.12


class Trip(NamedTuple):
    """Cells and heading sectors of a car's trip, one per second, in the order in which the car's
    agent publishes them.
    """

    cell: IntArray
    sector: IntArray


class Pursuit(NamedTuple):
    """Result of one attempt of a reader to follow a car.

    Attributes:
        hits: for each publication of the map, the probability that the reader guesses the car's
            place.
        chance: the same probability if the reader guesses at random.
        street: probability that the reader guesses the car's street.
    """

    hits: list[float]
    chance: list[float]
    street: float


def _trip(street: int, house: int) -> Trip:
    """Return the trip of a car from house number `house` of side street number `street`, along this
    street and then the main road, to the end of the main road.
    """
    column, row = (int(v) for v in grid.deinterleave(np.int64(CELL)))
    junction = 10 * street + 5
    down = np.arange(LENGTH - house, 0, -1)
    x = np.concatenate([np.full(len(down), junction), np.arange(junction, MAIN)])
    y = np.concatenate([down, np.zeros(MAIN - junction, int)])
    sector = np.where(y > 0, SOUTH, EAST)
    cell = np.asarray(grid.interleave(column + x, row - y), np.int64)
    return Trip(cell[CUT:], sector[CUT:])


def _visit(name: str, seq: int, when: int, trip: Trip, at: slice, mu: float) -> list[Message]:
    """Return the messages in which the car `name` reports the cells numbered `at` of a trip, one
    message per region. The car leaves the last of these cells at the time `when` [ns].
    """
    cell = trip.cell[at]
    latitude, longitude = grid.centre(cell)
    regions = grid.region_of(cell)
    out = []
    for region in np.unique(regions).tolist():
        mine = regions == region
        columns = {
            "latitude": latitude[mine],
            "longitude": longitude[mine],
            "cell": cell[mine],
            "sector": trip.sector[at][mine].astype(np.int8),
            "yaw": np.array(YAW, np.float32)[trip.sector[at][mine]],
        }
        one: Batch = batch(name, seq, when, [mu] * int(mine.sum()), **columns)
        one = replace(one, region=int(region))
        out.append(
            Message(
                one.kind,
                keys.observation_key(one.region, name),
                wire.encode(one),
                wire.ENCODING[one.kind],
            )
        )
    return out


class Town:
    """Simulated town with a fleet service, which makes its map. The constructor simulates one day:
    each household's car makes two trips, and the service publishes the map in the evening.

    Args:
        folder: folder of the service's archive.
        seed: seed of the random order of the trips and of the noise of the reports.
        public: number of vehicles that must visit a cell before it is shown.

    Attributes:
        engine: the service without its network.
        day: beginning of the simulated day [ns].
        held: newest published table of each map tile, which the reader has stored.
    """

    def __init__(self, folder: Path, seed: int, public: int = PUBLIC) -> None:
        self._random = np.random.default_rng(seed)
        self.engine = Engine(ServiceConfig(public_vehicles=public), folder)
        # The day begins so that the evening and the night are in the same part of the window.
        self.day = (time.time_ns() // (2 * PART_NS) - 2) * 2 * PART_NS
        self.held: dict[int, pa.Table] = {}
        self._sent = 0
        for hour in (7, 17):
            cars = [(street, house) for street, n in enumerate(STREETS) for house in range(n)]
            for turn, k in enumerate(self._random.permutation(len(cars)).tolist()):
                street, house = cars[k]
                when = self.day + hour * HOUR + turn * 400 * SECOND
                trip = _trip(street, house)
                for first in range(0, len(trip.cell), PART):
                    part = slice(first, min(first + PART, len(trip.cell)))
                    self.drive(f"car-{street}{house}", when + part.stop * SECOND, trip, part)
        self.put(self.day + 21 * HOUR)

    def drive(
        self, name: str, when: int, trip: Trip, at: slice, mu: float = MU
    ) -> list[wire.Alert]:
        """Let the service process a car's reports from the cells numbered `at` of a trip, and
        return the alerts that they raise.
        """
        self._sent += 1
        # The interval of a report begins .1 below its value, and must not be negative.
        seen = float(np.clip(mu + self._random.normal(0.0, 0.02), 0.11, 1.0))
        alerts = self.engine.intake.ingest(
            _visit(name, self._sent, when, trip, at, seen), when + SECOND // 2
        )
        self.engine.settlement.flush()
        return alerts

    def put(self, now: int) -> dict[int, tuple[pa.Table | None, pa.Table]]:
        """Let the service publish the map tiles that have changed. Return, for each of these tiles,
        its table before the publication (None if there was none) and after it.
        """
        out = {}
        for tile, payload in changed_tiles(self.engine.queries, now):
            table = pa.ipc.open_stream(payload).read_all()
            out[tile] = (self.held.get(tile), table)
            self.held[tile] = table
        return out


def _suspects(before: pa.Table | None, after: pa.Table) -> Iterator[tuple[float, int]]:
    """Yield (size of the change, cell) for each cell whose published values changed by more than
    their normal ageing explains. Such a change shows that a vehicle passed.
    """
    known = {}
    if before is not None:
        known = {(row["cell"], row["sector"]): row for row in before.to_pylist()}
    for row in after.to_pylist():
        old = known.pop((row["cell"], row["sector"]), None)
        if old is None:
            yield 10.0, row["cell"]
            continue
        narrowed = (old["mu_upper"] - old["mu_lower"]) - (row["mu_upper"] - row["mu_lower"])
        names = ("vehicles", "observations", "first_time", "last_time")
        changed = any(old[name] != row[name] for name in names)
        if narrowed > 1e-4 or changed:
            yield narrowed + changed, row["cell"]


def _places(cells: IntArray) -> FloatArray:
    """Return the positions of map cells as an array of complex numbers (n,), east + i·north [m]."""
    latitude, longitude = grid.centre(cells)
    north = (latitude - LATITUDE) * 111_195.0
    east = (longitude - LONGITUDE) * 111_195.0 * np.cos(np.radians(LATITUDE))
    return np.asarray(east + 1j * north)


def pursue(town: Town, street: int) -> Pursuit:
    """Simulate one attempt of a map reader to follow a car that drives away alone at night from
    side street number `street`. After each publication the reader takes the map cell that changed
    most as the car's place. Return how often the guesses were right.
    """
    trip = _trip(street, 0)
    begin = town.day + 22 * HOUR
    hits: list[float] = []
    chance: list[float] = []
    found: list[int] = []
    for k in range(len(trip.cell)):
        when = begin + k * SECOND
        town.drive(f"car-{street}0", when, trip, slice(k, k + 1))
        put = town.put(when + SECOND)
        car = _places(trip.cell[k : k + 1])[0]
        seen = np.concatenate([t["cell"].to_numpy() for _, t in put.values()] or [trip.cell[:0]])
        random = float((np.abs(_places(seen) - car) <= NEAR_M).mean()) if len(seen) else 0.0
        suspects = sorted(s for both in put.values() for s in _suspects(*both))
        if suspects:
            found.append(suspects[-1][1])
            place = _places(np.array(found[-1:]))[0]
            hits.append(float(abs(place - car) <= NEAR_M))
        else:
            hits.append(random)
        chance.append(random)
    town.put(begin + HOUR)
    return Pursuit(hits, chance, _name_street(found, street))


def _name_street(found: list[int], street: int) -> float:
    """Return the probability that a reader of the map guesses the car's side street, which has the
    number `street`.

    `found` contains the cells in which the reader assumed the car, one per publication of the map.
    The reader guesses the street that is nearest to the first three of these cells. If several
    streets are equally near, or if `found` is empty, the reader chooses one of them at random.
    """
    if not found:
        return 1.0 / len(STREETS)
    first = _places(np.array(found[:3]))
    nearest = []
    for number in range(len(STREETS)):
        way = _places(_trip(number, 0).cell[: LENGTH - CUT])
        nearest.append(np.abs(first[:, None] - way[None, :]).min(axis=1).mean())
    best = np.flatnonzero(np.array(nearest) <= min(nearest) + 1.0)
    return float(street in best) / len(best)


def _slippery_delay(folder: Path, public: int) -> float:
    """Return the time [s] until both the map and an alert show ice that two cars have measured.
    `public` is the number of vehicles that must visit a cell before it is shown.
    """
    town = Town(folder, 0, public)
    with closing(town.engine):
        trip = _trip(0, 0)
        at = slice(len(trip.cell) - 20, len(trip.cell) - 17)
        cells = set(trip.cell[at].tolist())
        begin = town.day + 22 * HOUR
        alerts = town.drive("car-10", begin, trip, at, ICE)
        alerts += town.drive("car-20", begin + SECOND, trip, at, ICE)
        for delay in range(60):
            town.put(begin + (1 + delay) * SECOND)
            rows = [row for table in town.held.values() for row in table.to_pylist()]
            shown = any(row["cell"] in cells and row["p_slippery"] > 0.5 for row in rows)
            if shown and alerts:
                return float(delay)
    return float("inf")


def run(site: Site) -> list[Figure]:
    """Let a reader of the map try to follow a car from each side street. As a control, repeat this
    with a map that shows every report at once. Return the figures.
    """
    over: list[float] = []
    puts = 0
    streets: list[float] = []
    for seed in range(site.choose_amount(3, 1)):
        for street in range(len(STREETS)):
            town = Town(site.folder / f"{seed}-{street}", site.seed + seed)
            with closing(town.engine):
                found = pursue(town, street)
            puts += len(found.hits)
            streets.append(found.street)
            over.append(float(np.mean(found.hits) - np.mean(found.chance)))
            site.say(
                f"street {street}: {np.mean(found.hits):.3f} of the puts, by chance "
                f"{np.mean(found.chance):.3f}; street named {found.street:.2f}"
            )
    named = float(np.mean(streets))
    control = _control(site.folder / "control")
    delay = _slippery_delay(site.folder / "ice", PUBLIC) - _slippery_delay(site.folder / "open", 1)
    return [
        make_figure("faults.privacy.position_over_chance", float(np.mean(over))),
        make_figure("faults.privacy.street_over_chance", round(named - 1.0 / len(STREETS), 9)),
        make_figure("faults.privacy.slippery_delay_s", delay),
        make_figure("faults.privacy.puts", puts),
        make_figure("faults.privacy.control_position", control),
    ]


def _control(folder: Path) -> float:
    """Return the result of the control run, in which the map shows every report at once and the
    reader must therefore be able to follow the car.

    The result is the share of publications after which the reader guesses the car's place
    correctly, minus the same share for random guesses. A positive result shows that the reader's
    method works.
    """
    with patch.object(TileCache, "source", property(lambda tiles: tiles.state.fusion)):
        town = Town(folder, 0)
        with closing(town.engine):
            found = pursue(town, 0)
    return float(np.mean(found.hits) - np.mean(found.chance))
