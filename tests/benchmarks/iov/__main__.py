"""`python -m tests.benchmarks.iov [--only PART …] [--out DIR] [--quick]`: benchmarks of the
interfaces by which other vehicles and programs use GripMap.

The parts are: own and foreign hazard messages (DENM), routes around ice, the speed limit for a
motion planner, the Kuksa provider, MCAP files, and clients in other programming languages.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any, Final

import numpy as np

from fleet_service.client import routing
from schemas.numeric import FloatArray
from schemas.runtime import figures
from schemas.runtime.figures import Figure
from schemas.thresholds import METRES_PER_DEGREE
from tests.benchmarks.iov import interfaces, routes
from tests.benchmarks.iov.clients import measure_clients
from tests.benchmarks.iov.denm import measure_denm
from tests.benchmarks.iov.planner import measure_planner

SEED: Final = 4201
SLOWER: Final = 1.2  # longest time of an accepted detour, relative to the quickest route


def measure_routes(folder: Path, quick: bool) -> list[Figure]:
    """Compute routes through a town with icy streets, with and without costs from the friction map,
    and count those that avoid the ice.
    """
    draw = np.random.default_rng(SEED)
    engine = routes.Valhalla(folder)
    town = routes.make_town(draw)
    network = folder / "town.osm"
    routes.write_town(town, network)
    engine.build(network)
    chosen = draw.choice(
        len(town.streets), round(routes.ICY_SHARE * len(town.streets)), replace=False
    )
    icy = [town.streets[k] for k in chosen.tolist()]
    middles = np.array([town.crossings[list(street)].mean(axis=0) for street in icy])
    table = routes.icy_map(town, icy)
    costs = routing.valhalla_request(
        routing.cost_lines(
            table,
            [
                road
                for street in town.streets
                for line in [town.line(street)]
                for road in (line, routing.RoadLine(line.latitude[::-1], line.longitude[::-1]))
            ],
        )
    )
    trips = 20 if quick else 60
    cases, avoided, error_s, longer = _drive_trips(engine, town, middles, costs, draw, trips)
    return [
        Figure(
            "route.avoids_ice",
            avoided / max(cases, 1),
            "of trips with a way round of at most 20 % more",
            0.95,
            "more",
        ),
        Figure(
            "route.time_error",
            round(error_s, 1),
            "s between the time of a route and of its shape asked again, to .1 s",
            0.0,
        ),
        Figure("route.cases", float(cases), "trips with such a way round", 5.0, "more"),
        Figure(
            "route.more_time",
            float(np.mean(longer)) - 1.0 if longer else float("nan"),
            "of the quickest route",
        ),
    ]


def _drive_trips(
    engine: routes.Valhalla,
    town: routes.StreetTown,
    middles: FloatArray,
    costs: dict[str, Any],
    draw: np.random.Generator,
    trips: int,
) -> tuple[int, int, float, list[float]]:
    """Compute the routes of random trips. Return the number of trips whose quickest route meets ice
    and that have a way round; how many of them avoid the ice with `costs`; the largest error of a
    route's time [s]; and the time with `costs` relative to the quickest route, for each trip.

    `middles` (n, 2) are the positions [deg] of the ice.
    """
    closed = [{"lat": a, "lon": b} for a, b in middles.tolist()]
    cases = 0
    avoided = 0
    error_s = 0.0
    longer = list[float]()
    for _ in range(trips):
        # The ends lie in the middle of streets. A trip that ends at a crossing would have a last
        # turn without length.
        ends = draw.choice(len(town.streets), 2, replace=False).tolist()
        trip = np.array([town.crossings[list(town.streets[k])].mean(axis=0) for k in ends])
        request = {"locations": [{"lat": a, "lon": b} for a, b in trip.tolist()], "costing": "auto"}
        plain = _route(engine, request)
        if plain is None or not _meets(plain["shape"], middles):
            continue
        free = _route(engine, request | {"exclude_locations": closed})
        if free is None or _meets(free["shape"], middles) or free["time"] > SLOWER * plain["time"]:
            continue
        cases += 1
        found = _route(engine, request | costs)
        assert found is not None
        spent = _time(engine, found["shape"])
        error_s = max(error_s, abs(_time(engine, plain["shape"]) - plain["time"]))
        longer.append(spent / plain["time"])
        avoided += not _meets(found["shape"], middles) and spent <= SLOWER * plain["time"]
    return cases, avoided, error_s, longer


def _route(engine: routes.Valhalla, request: dict[str, Any]) -> dict[str, Any] | None:
    answer = engine.ask("route", request)
    if "trip" not in answer:
        return None
    (leg,) = answer["trip"]["legs"]
    return {"shape": _decode(leg["shape"]), "time": leg["summary"]["time"]}


def _time(engine: routes.Valhalla, shape: np.ndarray[Any, Any]) -> float:
    """Return the travel time [s] of the route along the points `shape` [deg]. The route planner
    Valhalla computes it without costs of low friction.
    """
    points = [{"lat": a, "lon": b} for a, b in shape.tolist()]
    answer = engine.ask(
        "trace_route", {"shape": points, "costing": "auto", "shape_match": routes.EDGE}
    )
    return float(answer["trip"]["summary"]["time"])


def _meets(shape: np.ndarray[Any, Any], middles: np.ndarray[Any, Any]) -> bool:
    """Return True if the route with the points `shape` [deg] passes the midpoint of an icy street;
    `middles` are the midpoints of all icy streets [deg].
    """
    scale = np.array([1.0, np.cos(np.radians(routes.ORIGIN[0]))])
    first = shape[:-1] * scale
    last = shape[1:] * scale
    along = last - first
    length = np.maximum((along**2).sum(axis=1), 1e-18)
    for middle in middles * scale:
        share = np.clip(((middle - first) * along).sum(axis=1) / length, 0.0, 1.0)
        gap = np.hypot(*(first + share[:, None] * along - middle).T).min()
        if gap * METRES_PER_DEGREE < 5.0:
            return True
    return False


def _decode(text: str) -> np.ndarray[Any, Any]:
    """Return the points [deg] of a route from an encoded polyline with six decimals."""
    numbers = list[int]()
    value = 0
    shift = 0
    for letter in text:
        bits = ord(letter) - 63
        value |= (bits & 31) << shift
        shift += 5
        if bits < 32:
            numbers.append(~(value >> 1) if value & 1 else value >> 1)
            value = 0
            shift = 0
    return np.cumsum(np.array(numbers).reshape(-1, 2), axis=0) / 1e6


PARTS: Final = {
    "denm": measure_denm,
    "foreign": interfaces.measure_foreign,
    "routes": measure_routes,
    "planner": measure_planner,
    "kuksa": interfaces.measure_kuksa,
    "mcap": interfaces.measure_mcap,
    "clients": measure_clients,
}


def main() -> int:
    """Run the chosen parts of the benchmark, and write and print their figures. Return 0 if every
    figure meets its target, otherwise 1.
    """
    parser = argparse.ArgumentParser(prog="tests.benchmarks.iov", description=__doc__)
    parser.add_argument("--only", nargs="+", choices=PARTS, help="these parts alone")
    parser.add_argument(
        "--out", type=Path, default=Path(".iov"), help="figures and files (default .iov)"
    )
    parser.add_argument("--quick", action="store_true", help="smaller numbers")
    arguments = parser.parse_args()
    found: list[Figure] = []
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.only or PARTS:
        began = time.monotonic()
        found += PARTS[name](arguments.out, arguments.quick)
        print(f"{name}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
        figures.write_figures(arguments.out / "figures.json", "iov", [SEED], found)
    print(figures.format_table(found))
    return 0 if all(one.holds for one in found) else 1


if __name__ == "__main__":
    sys.exit(main())
