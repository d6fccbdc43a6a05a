"""Where visits begin and end: satellite fixes and yaw -> the cell and sector that a vehicle is in, sample by sample.

A visit begins with a fix in a new cell or heading sector. Fixes jitter, and a road may run along a border, so a visit
is left only when a fix lies clearly outside: CELL_MARGIN beyond the cell, SECTOR_KEEP beyond the sector.
Without a fix for FIX_HELD_S the vehicle is nowhere (cell -1). Without yaw the course over ground serves.
Pure; what must be carried between blocks is a `Track`, and any split of the samples gives the same result.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from schemas import grid
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.runtime.jit import compiled
from schemas.signals import S
from schemas.thresholds import METRES_PER_DEGREE

FIX_HELD_S: Final = 1.0  # a 10 Hz receiver that misses ten fixes is lost; at 15 m/s the next cell has been reached
CELL_MARGIN: Final = 0.1  # of a cell's side, 1 to 2 m: three standard deviations of a receiver's white noise
SECTOR_KEEP: Final = np.radians(5.0)  # beyond the sector's edge
COURSE_BASE_M: Final = 3.0  # a course is taken between fixes this far apart: some 8 degrees of noise
NOWHERE: Final = -1  # cell of a vehicle without position

# columns of a Track's float state
_FIX_TIME, _LATITUDE, _LONGITUDE, _YAW_TIME, _YAW, _FROM_LAT, _FROM_LON, _COURSE = range(8)
_WEST, _SOUTH, _EAST, _NORTH = range(8, 12)
_FLOATS: Final = 12
_CELL, _SECTOR = 0, 1


@dataclass(frozen=True)
class Track:
    """State of N vehicles between blocks: last fix, yaw, borders of the visited cell (N, 12); cell, sector (N, 2)."""

    floats: FloatArray
    integers: IntArray

    @staticmethod
    def start(vehicles: int) -> Track:
        """Nothing seen yet."""
        return Track(np.full((vehicles, _FLOATS), np.nan), np.full((vehicles, 2), NOWHERE, dtype=np.int64))


@dataclass(frozen=True)
class Located:
    """Per sample, shape (T, N).

    closes: True at the first sample of a new visit, or of being nowhere.
    inside: True where a fix of this very sample lies in the visited cell.
    cell, sector: quadint z21 and heading sector, -1 when nowhere.
    latitude, longitude [deg], yaw [rad]: as last received, NaN when too old.
    """

    closes: BoolArray
    inside: BoolArray
    cell: IntArray
    sector: IntArray
    latitude: FloatArray
    longitude: FloatArray
    yaw: FloatArray


def locate(track: Track, t: FloatArray, signals: FloatArray, *, lost: bool = False) -> tuple[Track, Located]:
    """Follow N vehicles through a block: t (T, N) [s], signals (T, N, channels) -> what is carried, what was found.

    `lost` gives the held fixes up, which ends every visit.
    """
    latitude, longitude, yaw = (np.ascontiguousarray(signals[..., c]) for c in (S.LATITUDE, S.LONGITUDE, S.YAW))
    fix = (np.abs(latitude) <= grid.MAX_LATITUDE) & (np.abs(longitude) <= 180.0)
    cells = np.full(t.shape, NOWHERE, dtype=np.int64)
    cells[fix] = grid.cell_of(latitude[fix], longitude[fix])
    borders = np.full((*t.shape, 4), np.nan)
    borders[fix] = np.stack(grid.bounds(cells[fix]), axis=-1)
    place = np.full((*t.shape, 2), NOWHERE, dtype=np.int64)
    flags = np.zeros((*t.shape, 2), dtype=np.bool_)
    pose = np.full((*t.shape, 3), np.nan)
    after = Track(track.floats.copy(), track.integers.copy())
    if lost:
        after.floats[:, _FIX_TIME] = np.nan
    _follow(t, latitude, longitude, yaw, cells, borders, after.floats, after.integers, place, flags, pose)
    found = (flags[..., i] for i in range(2)), (place[..., i] for i in range(2)), (pose[..., i] for i in range(3))
    # one memory layout for all shapes, or numba compiles the kernels again for blocks of one sample
    return after, Located(*(np.ascontiguousarray(column) for group in found for column in group))


@compiled
def _course(state: FloatArray, latitude: float, longitude: float) -> None:
    """Update the course over ground [rad from east] when the vehicle has moved far enough."""
    north = (latitude - state[_FROM_LAT]) * METRES_PER_DEGREE
    east = (longitude - state[_FROM_LON]) * METRES_PER_DEGREE * np.cos(np.radians(latitude))
    distance = np.hypot(north, east)
    if distance >= COURSE_BASE_M:
        state[_COURSE] = np.arctan2(north, east)
    if not distance < COURSE_BASE_M:
        state[_FROM_LAT], state[_FROM_LON] = latitude, longitude


@compiled
def _stays(state: FloatArray, sector: int, latitude: float, longitude: float, yaw: float) -> bool:
    """Whether a fix still belongs to the visit, margins included."""
    wide = CELL_MARGIN * (state[_EAST] - state[_WEST])
    high = CELL_MARGIN * (state[_NORTH] - state[_SOUTH])
    off = np.mod(yaw - sector * (np.pi / 2) + np.pi, 2 * np.pi) - np.pi
    return bool(
        state[_WEST] - wide <= longitude <= state[_EAST] + wide
        and state[_SOUTH] - high <= latitude <= state[_NORTH] + high
        and abs(off) <= np.pi / 4 + SECTOR_KEEP
    )


@compiled
def _follow(
    t: FloatArray,
    latitude: FloatArray,
    longitude: FloatArray,
    yaw: FloatArray,
    cells: IntArray,
    borders: FloatArray,
    floats: FloatArray,
    integers: IntArray,
    place: IntArray,
    flags: BoolArray,
    pose: FloatArray,
) -> None:
    """Sequential core of `locate`; writes floats, integers (carried), place, flags and pose (results)."""
    for k in range(t.shape[0]):
        for n in range(t.shape[1]):
            state, now = floats[n], t[k, n]
            if np.isfinite(yaw[k, n]):
                state[_YAW_TIME], state[_YAW] = now, yaw[k, n]
            if cells[k, n] != NOWHERE:
                state[_FIX_TIME], state[_LATITUDE], state[_LONGITUDE] = now, latitude[k, n], longitude[k, n]
                _course(state, latitude[k, n], longitude[k, n])
            heading = state[_YAW] if now - state[_YAW_TIME] <= FIX_HELD_S else state[_COURSE]
            held = now - state[_FIX_TIME] <= FIX_HELD_S
            if held:
                pose[k, n, 0], pose[k, n, 1], pose[k, n, 2] = state[_LATITUDE], state[_LONGITUDE], heading
            if not held and integers[n, _CELL] != NOWHERE:
                integers[n, _CELL], integers[n, _SECTOR] = NOWHERE, NOWHERE
                flags[k, n, 0] = True
            elif cells[k, n] != NOWHERE and np.isfinite(heading):
                here = integers[n, _CELL] != NOWHERE and _stays(
                    state, integers[n, _SECTOR], latitude[k, n], longitude[k, n], heading
                )
                if not here:
                    integers[n, _CELL] = cells[k, n]
                    integers[n, _SECTOR] = np.int64(np.floor((heading + np.pi / 4) / (np.pi / 2))) % grid.SECTORS
                    state[_WEST : _NORTH + 1] = borders[k, n]
                    flags[k, n, 0] = True
            flags[k, n, 1] = cells[k, n] != NOWHERE and cells[k, n] == integers[n, _CELL]
            place[k, n, 0], place[k, n, 1] = integers[n, _CELL], integers[n, _SECTOR]
