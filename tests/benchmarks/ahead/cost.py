"""Cost of the look ahead (queries for the map and the alerts of the road ahead) for one car and
day: megabytes received in a busy city, and processor time.

The city is a grid of streets 100 m apart. Every map place is measured in both directions, and each
map tile has STANDING active alerts. The car drives DAY_KM through it at city speed. The received
bytes are counted as the service's answers with their keys, plus FRAME bytes of transport overhead
per answer.
"""

from __future__ import annotations

import math
import time
from typing import Final

import numpy as np

from edge_agent.ahead.cell_decoder import decode_cells
from edge_agent.ahead.horizon import horizon_length, look_ahead
from edge_agent.ahead.local_map import LocalMap
from edge_agent.ahead.path import GivenRoute, Path, Pose, straight_path, to_degrees
from edge_agent.ahead.request_log import FURTHER_M, RequestLog, Tiles, keys_of
from edge_agent.ahead.roads import ways_on
from edge_agent.ahead.warnings import Active, update_warnings
from schemas import grid, keys
from schemas.numeric import FloatArray, IntArray
from schemas.runtime.figures import Figure
from schemas.thresholds import NS
from tests.benchmarks.ahead.made_up_service import tile_payload

DAY_KM: Final = 40.0  # daily distance of a car in Europe: 13 000 km a year on 325 days
SPEED: Final = 9.0  # [m/s] speed of the simulated car
BLOCK_M: Final = 100.0
BLOCKS: Final = 40  # blocks along a side of the city
STANDING: Final = 3  # alerts in each tile of 1.3 km; the service repeats them every two seconds
ALERT_BYTES: Final = 190  # size of an alert with its key
FRAME: Final = 40
CENTRE: Final = Pose(57.70, 11.97, 0.0, SPEED, 1_800_000_000 * NS)


def street_places() -> IntArray:
    """Return the sorted keys (cell·4 + heading sector), (n,), of all map places on the city's
    streets.
    """
    side = np.arange(0.0, BLOCK_M * BLOCKS, 4.0)
    line = np.arange(0.0, BLOCK_M * (BLOCKS + 1), BLOCK_M)
    found = []
    for offset, sectors in ((2.0, (0, 1)), (-2.0, (2, 3))):
        for along_x, sector in zip((True, False), sectors, strict=True):
            a, b = (
                grid_.ravel()
                for grid_ in np.meshgrid(side, line + (-offset if along_x else offset))
            )
            cell = grid.cell_of(*to_degrees(*((a, b) if along_x else (b, a)), CENTRE))
            found.append(np.unique(cell) * grid.SECTORS + sector)
    return np.unique(np.concatenate(found))


def draw_way(rng: np.random.Generator, metres: float) -> FloatArray:
    """Draw a random route through the city; return its corners (n, 2) [m].

    At each crossing the route goes straight on, left or right, and never leaves the city.
    """
    place = np.array([BLOCKS // 2, BLOCKS // 2])
    heading = 0
    corners = [place]
    for _ in range(math.ceil(metres / BLOCK_M)):
        turns = [heading, heading, heading, (heading + 1) % 4, (heading + 3) % 4]
        rng.shuffle(turns)
        for turn in turns:
            next_place = place + np.array([[1, 0], [0, 1], [-1, 0], [0, -1]][turn])
            if ((next_place >= 0) & (next_place <= BLOCKS)).all():
                place = next_place
                heading = turn
                break
        corners.append(place)
    return np.array(corners) * BLOCK_M


def cost_figures(seed: int, metres: float) -> list[Figure]:
    """Return the megabytes received per day and the share of a processor core that is used, for a
    car that knows its route and for one that does not.
    """
    known = street_places()
    out = []
    for routed, ending in ((True, ""), (False, ".unrouted")):
        megabytes, share = drive_way(np.random.default_rng(seed), known, metres, routed=routed)
        out += [
            Figure(
                f"ahead.mb_per_day{ending}",
                megabytes * 1e3 * DAY_KM / metres,
                "MB",
                5 if routed else None,
            ),
            Figure(f"ahead.core_share{ending}", share, "of a core", 0.01 if routed else None),
        ]
    return out


def drive_way(
    rng: np.random.Generator, known: IntArray, metres: float, *, routed: bool
) -> tuple[float, float]:
    """Drive a random route of `metres` through the city; return (megabytes received, processor time
    divided by driving time).

    `known` are the keys of all map places (cell·4 + heading sector) that the service knows. If
    `routed` is True, the car knows its route.
    """
    corners = draw_way(rng, metres)
    run = BLOCK_M * np.arange(len(corners))
    route = GivenRoute(*to_degrees(corners[:, 0], corners[:, 1], CENTRE))
    local_map = LocalMap()
    asked = RequestLog()
    tiles = Tiles()
    active: tuple[Active, ...] = ()
    total = 0
    spent = 0.0
    for second in range(int(metres / SPEED)):
        s = second * SPEED
        x = np.interp(s, run, corners[:, 0])
        y = np.interp(s, run, corners[:, 1])
        step = corners[min(int(s / BLOCK_M) + 1, len(corners) - 1)] - corners[int(s / BLOCK_M)]
        latitude, longitude = to_degrees(np.asarray(x), np.asarray(y), CENTRE)
        now = CENTRE.time + second * NS
        pose = Pose(float(latitude), float(longitude), math.atan2(step[1], step[0]), SPEED, now)
        began = time.process_time()
        length = horizon_length(SPEED)
        paths: list[Path] = []
        if routed and (given := route.ahead(pose, length + FURTHER_M)) is not None:
            paths = [given]
        paths = (
            paths
            or ways_on(pose, local_map.keys(), length + FURTHER_M)
            or [straight_path(pose, length)]
        )
        active, _ = update_warnings(
            active,
            [look_ahead(path.first_metres(length), local_map, now) for path in paths],
            pose,
            local_map,
        )
        tiles.update_subscriptions([path.first_metres(length) for path in paths], pose)
        boxes = [box for path in paths for box in asked.missing_boxes(path, pose, length)]
        spent += time.process_time() - began
        for box in boxes:
            inside = known[grid.touches(box, grid.bounds(known // grid.SECTORS))]
            tile = grid.tile_of(inside // grid.SECTORS)
            for one in np.unique(tile).tolist():
                payload = tile_payload(inside[tile == one], 0.7, now)
                key = keys.map_key(one)
                total += len(payload) + len(key) + FRAME
                began = time.process_time()
                local_map.store_cells(*decode_cells(key, payload, now), now)
                spent += time.process_time() - began
            total += FRAME * len(keys_of(box))
        if second % 2 == 0:
            total += len(tiles.subscribed_tiles) * STANDING * (ALERT_BYTES + FRAME)
    return total / 1e6, spent / int(metres / SPEED)
