"""Areas with data: groups of neighbouring tiles, with the number of their cells and alerts, and the
nearest place name.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from fleet_service.client.stretches import link_cells
from fleet_service.page.map_mirror import MapMirror
from schemas import grid
from schemas.thresholds import METRES_PER_DEGREE

NEAR_M: Final = 30_000.0  # [m] an area gets the name of the nearest place within this distance
MOST: Final = 100


def found_in(world: MapMirror, places: Sequence[tuple[str, float, float]]) -> list[dict[str, Any]]:
    """Return the areas of the map that have data, one dictionary each; an area is a group of
    neighbouring tiles. The keys are: `name` of the nearest place (empty if no named place is near),
    `box` of the area [deg], `latitude` and `longitude` of the centre [deg], and the numbers of
    `cells` and `alerts` in the area.

    Args:
        world: the mirrored map.
        places: names of places with longitude and latitude [deg].
    """
    cell, _ = world.places()
    cell = np.unique(cell)
    tile = np.asarray(grid.tile_of(cell))
    tiles, of_tile = np.unique(tile, return_inverse=True)
    label = link_cells(tiles)[of_tile]
    standing = world.alerts.as_json()
    found: list[dict[str, Any]] = []
    for number in range(int(label.max(initial=-1)) + 1):
        own = cell[label == number]
        west, south, east, north = grid.bounds(own)
        box = [float(west.min()), float(south.min()), float(east.max()), float(north.max())]
        latitude = (box[1] + box[3]) / 2
        longitude = (box[0] + box[2]) / 2
        alerts = sum(_is_inside(box, one["longitude"], one["latitude"]) for one in standing)
        found.append(
            {
                "name": _nearest_name(latitude, longitude, places),
                "box": box,
                "latitude": latitude,
                "longitude": longitude,
                "cells": len(own),
                "alerts": alerts,
            }
        )
    return sorted(found, key=lambda one: (-one["alerts"], -one["cells"]))[:MOST]


def _is_inside(box: Sequence[float], longitude: float, latitude: float) -> bool:
    return box[0] <= longitude <= box[2] and box[1] <= latitude <= box[3]


def _nearest_name(
    latitude: float, longitude: float, places: Sequence[tuple[str, float, float]]
) -> str:
    scale = METRES_PER_DEGREE * math.cos(math.radians(latitude))
    far = [
        (math.hypot((x - longitude) * scale, (y - latitude) * METRES_PER_DEGREE), name)
        for name, x, y in places
    ]
    distance, name = min(far, default=(math.inf, ""))
    return name if distance <= NEAR_M else ""
