"""Base map and named roads of the demo's simulated town, so that the live page looks like a town
and needs no network.

`write_files` makes an MBTiles file of vector tiles (streets, buildings, parks, water, names) and a
GeoJSON file of the roads. The streets have the geometry of the simulation. Houses, parks and the
lake around them are generated with fixed seeds.
"""

from __future__ import annotations

import gzip
import itertools
import json
import math
import sqlite3
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from edge_agent.lab.simulation.roads import Road, round_corners
from edge_agent.lab.simulation.scenarios import Scenario
from fleet_service.page.vector_tiles import EXTENT, LINE, POINT, POLYGON, TileShape, encode_tile
from schemas.numeric import FloatArray

NAME: Final = "Frostberg"
ATTRIBUTION: Final = "Frostberg, a simulated town"
ZOOMS: Final = range(11, 17)
AROUND_M: Final = 900.0  # [m] distance from the town's centre that the map covers
# Tile units that lines continue beyond a tile's edge, so that none ends at the edge.
BUFFER: Final = 256
STREETS: Final = (
    "Kyrkogatan",
    "Brogatan",
    "Kvarngatan",
    "Sjögatan",
    "Norra Ringvägen",
    "Östra Ringvägen",
    "Södra Ringvägen",
    "Västra Ringvägen",
)
CLEAR_M: Final = 9.0  # [m] distance from the centre of a street to a house
HOUSES: Final = 420
LAKE: Final = (-330.0, -330.0, 150.0, 105.0)  # x, y and two radii [m]
PARKS: Final = ((-95.0, 70.0, 62.0, 36.0), (88.0, -72.0, 48.0, 40.0), (300.0, 190.0, 120.0, 80.0))
_PER_TILE: Final = EXTENT


@dataclass
class StreetPlan:
    """Shapes of the simulated town, with coordinates in metres: lines of streets with names,
    polygons with their map layer, and names of places with their positions.
    """

    streets: list[tuple[str, FloatArray, str]] = field(default_factory=list)
    areas: list[tuple[str, FloatArray]] = field(default_factory=list)
    names: list[tuple[str, str, float, float]] = field(default_factory=list)


def town_of(scenario: Scenario) -> StreetPlan:
    """Return the shapes of the demo's town (streets, houses, parks, names) for a scenario of the
    simulator.
    """
    found = StreetPlan()
    for number, road in enumerate(scenario.roads):
        name = STREETS[number % len(STREETS)]
        kind = "secondary" if "Ring" in name else "tertiary"
        found.streets.append((name, _centre_line(scenario, road), kind))
    centres = np.concatenate([line for _, line, _ in found.streets])
    found.areas.append(("water", _blob_outline(LAKE, 3)))
    found.areas += [("park", _blob_outline(park, 7 + k)) for k, park in enumerate(PARKS)]
    found.areas += [("building", house) for house in _place_houses(centres)]
    found.streets += _lanes_around(centres)
    found.names += [("place", NAME, 0.0, 46.0), ("water", "Frostsjön", LAKE[0], LAKE[1])]
    return found


def _centre_line(scenario: Scenario, road: Road) -> FloatArray:
    corners = [scenario.junctions[road.start], *road.bends, scenario.junctions[road.end]]
    return round_corners(corners, road.radius)[::16]


def _blob_outline(shape: tuple[float, float, float, float], seed: int) -> FloatArray:
    """Return a smooth closed outline, points (48, 2) [m]. `shape` is x and y of its centre and its
    two radii [m].
    """
    x, y, a, b = shape
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2.0 * math.pi, 48, endpoint=False)
    waves = sum(rng.uniform(0.03, 0.09) * np.sin(k * angle + rng.uniform(0, 6)) for k in (2, 3, 5))
    radius = 1.0 + np.asarray(waves)
    return np.stack([x + a * radius * np.cos(angle), y + b * radius * np.sin(angle)], 1)


def _place_houses(centres: FloatArray) -> Iterable[FloatArray]:
    """Yield the outline of each house as points (n, 2) [m]. The houses stand along the streets and
    parallel to them, and do not touch streets, parks or each other. `centres` are points (n, 2) [m]
    on the streets' centre lines.
    """
    rng = np.random.default_rng(5)
    placed: list[tuple[float, float, float]] = []
    for _ in range(HOUSES * 6):
        k = int(rng.integers(4, len(centres) - 5))
        along = centres[k + 1] - centres[k]
        length = float(np.hypot(*along))
        if not 0.5 < length < 20.0:
            continue
        angle = math.atan2(along[1], along[0])
        wide = rng.uniform(9, 20)
        deep = rng.uniform(8, 13)
        side = rng.choice((-1.0, 1.0))
        distance = CLEAR_M + deep / 2 + rng.choice((1.0, 3.0, 24.0))
        x = float(centres[k, 0] - side * distance * math.sin(angle))
        y = float(centres[k, 1] + side * distance * math.cos(angle))
        reach = math.hypot(wide, deep) / 2
        near = float(np.min(np.hypot(*(centres - (x, y)).T)))
        parked = any(
            ((x - px) / a) ** 2 + ((y - py) / b) ** 2 < 1.3 for px, py, a, b in (*PARKS, LAKE)
        )
        is_crowded = any(
            math.hypot(x - px, y - py) < 0.92 * (reach + far) for px, py, far in placed
        )
        if near < CLEAR_M + deep / 2 - 1.0 or parked or is_crowded:
            continue
        placed.append((x, y, reach))
        corners = np.array([(-wide, -deep), (wide, -deep), (wide, deep), (-wide, deep)]) / 2
        turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        yield corners @ turn + (x, y)
        if len(placed) >= HOUSES:
            return


def _lanes_around(centres: FloatArray) -> list[tuple[str, FloatArray, str]]:
    """Return roads, with points (n, 2) [m], that lead from the simulated streets out of the town.
    These roads are only drawn; no simulated car uses them.
    """
    out = []
    for name, angle in (("E20", 0.55), ("E20", math.pi + 0.35), ("Skogsvägen", 2.2)):
        direction = np.array([math.cos(angle), math.sin(angle)])
        start = centres[int(np.argmax(centres @ direction))]
        run = np.linspace(0.0, 1.0, 40)[:, None]
        bend = np.array([-direction[1], direction[0]]) * 60.0
        line = start + run * direction * 700.0 + np.sin(run * 3.0) * bend
        out.append((name, line, "primary" if name == "E20" else "minor"))
    return out


def write_files(scenario: Scenario, folder: Path) -> tuple[Path, Path]:
    """Write the town's base map (MBTiles) and its roads (GeoJSON) as two files into `folder`;
    return the two paths.
    """
    found = town_of(scenario)
    tiles = folder / "town.mbtiles"
    roads = folder / "roads.geojson"
    roads.write_text(json.dumps(_roads_geojson(scenario, found)), encoding="utf-8")
    _write_tiles(scenario, found, tiles)
    return tiles, roads


def _roads_geojson(scenario: Scenario, found: StreetPlan) -> dict[str, object]:
    def make_feature(shape: str, coordinates: object, **about: str) -> dict[str, object]:
        return {
            "type": "Feature",
            "geometry": {"type": shape, "coordinates": coordinates},
            "properties": about,
        }

    def to_degrees(line: FloatArray) -> list[list[float]]:
        latitude, longitude = scenario.to_latlon(line[:, 0], line[:, 1])
        points: list[list[float]] = np.stack([longitude, latitude], 1).round(7).tolist()
        return points

    lines = [
        make_feature("LineString", to_degrees(line), id=str(number), name=name)
        for number, (name, line, _) in enumerate(found.streets)
        if name in STREETS
    ]
    latitude, longitude = scenario.to_latlon(np.zeros(1), np.zeros(1))
    place = make_feature(
        "Point", [float(longitude[0]), float(latitude[0])], name=NAME, kind="place"
    )
    return {"type": "FeatureCollection", "features": [*lines, place]}


def _write_tiles(scenario: Scenario, found: StreetPlan, path: Path) -> None:
    path.unlink(missing_ok=True)
    corners = np.array([[-AROUND_M, -AROUND_M], [AROUND_M, AROUND_M]])
    with sqlite3.connect(path) as table:
        table.execute("create table metadata (name text, value text)")
        table.execute(
            "create table tiles (zoom_level int, tile_column int, tile_row int, tile_data blob)"
        )
        about = {
            "name": NAME,
            "format": "pbf",
            "attribution": ATTRIBUTION,
            "minzoom": str(ZOOMS[0]),
            "maxzoom": str(ZOOMS[-1]),
            "type": "baselayer",
        }
        table.executemany("insert into metadata values (?, ?)", about.items())
        for zoom in ZOOMS:
            box = _to_mercator(scenario, corners) * 2**zoom
            for x in range(int(box[0, 0]), int(box[1, 0]) + 1):
                for y in range(int(box[1, 1]), int(box[0, 1]) + 1):
                    tile = _make_tile(scenario, found, zoom, x, y)
                    row = (zoom, x, (1 << zoom) - 1 - y, gzip.compress(tile, mtime=0))
                    table.execute("insert into tiles values (?, ?, ?, ?)", row)
    table.close()


def _make_tile(scenario: Scenario, found: StreetPlan, zoom: int, x: int, y: int) -> bytes:
    def to_tile_units(line: FloatArray) -> list[tuple[int, int]]:
        at = (_to_mercator(scenario, line) * 2**zoom - (x, y)) * _PER_TILE
        return [(int(px), int(py)) for px, py in np.rint(at)]

    layers: dict[str, list[TileShape]] = {
        "park": [],
        "water": [],
        "building": [],
        "transportation": [],
        "place": [],
    }
    for layer, outline in found.areas:
        ring = to_tile_units(outline)
        if _touches_tile(ring) and (layer != "building" or zoom >= 14):
            layers[layer].append(TileShape(POLYGON, [ring], {"class": layer}))
    for name, line, kind in found.streets:
        for part in _clip_line(to_tile_units(line)):
            layers["transportation"].append(TileShape(LINE, [part], {"class": kind, "name": name}))
    for layer, name, px, py in found.names:
        (point,) = to_tile_units(np.array([[px, py]]))
        if min(point) >= 0 and max(point) < EXTENT:
            kind = "town" if layer == "place" else "lake"
            layers.setdefault("place" if layer == "place" else "water_name", []).append(
                TileShape(POINT, [[point]], {"class": kind, "name": name})
            )
    return encode_tile(layers)


def _touches_tile(points: Sequence[tuple[int, int]]) -> bool:
    xs = [p[0] for p in points]
    ys = [p[1] for p in points]
    return (
        max(xs) > -BUFFER
        and min(xs) < EXTENT + BUFFER
        and max(ys) > -BUFFER
        and min(ys) < EXTENT + BUFFER
    )


def _clip_line(points: list[tuple[int, int]]) -> Iterable[list[tuple[int, int]]]:
    """Yield those parts of a line (street of the town) that lie within a map tile or the margin
    around it.
    """
    part: list[tuple[int, int]] = []
    for first, second in itertools.pairwise(points):
        if _touches_tile((first, second)):
            part = part or [first]
            part.append(second)
        elif part:
            yield part
            part = []
    if part:
        yield part


def _to_mercator(scenario: Scenario, line: FloatArray) -> FloatArray:
    """Return points (n, 2) [m] as fractions (n, 2) of the Web Mercator square, x to the east and y
    to the south.
    """
    latitude, longitude = (np.asarray(one) for one in scenario.to_latlon(line[:, 0], line[:, 1]))
    y = (1.0 - np.arcsinh(np.tan(np.radians(latitude))) / math.pi) / 2.0
    return np.stack([(longitude + 180.0) / 360.0, y], 1)
