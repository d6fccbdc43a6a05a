"""Places on earth: cells, tiles, regions and zones of the Web-Mercator grid, and heading sectors.
All functions are vectorised.

A *quadint* is the number of a grid square. At zoom z it interleaves the bits of the Web-Mercator
tile column x and row y (x in the even bits), so that its base-4 digits are the quadkey. The square
at zoom z that contains a cell is found by a shift: `parent = cell >> 2·(21 - z)`.

    cell     zoom 21   10 m (60° north) to 19 m (equator)   the canonical cell, int64
    tile     zoom 14   area of one map message
    region   zoom 10   area of one key of observations
    zone     zoom 7    area of one folder of the archive
    sector   0 east, 1 north, 2 west, 3 south   quarter of the compass that the vehicle heads for

The two carriageways of a road lie in different sectors.

Latitudes are limited to ±85.0511° (Web Mercator). Longitudes wrap at ±180°. Source: the slippy-map
tile scheme (OpenStreetMap wiki, "Slippy map tilenames") and Bing's quadkeys.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from schemas.numeric import FloatArray, IntArray

CELL_ZOOM: Final = 21
TILE_ZOOM: Final = 14
REGION_ZOOM: Final = 10
ZONE_ZOOM: Final = 7
MAX_LATITUDE: Final = 85.05112877980659
SECTORS: Final = 4
HEADINGS: Final = ("east", "north", "west", "south")  # name of each heading sector, by its number
# [rad] A heading within this angle of a sector's edge belongs to both sectors.
SECTOR_MARGIN: Final = np.radians(15.0)

# Shifts and masks that move the bits of a 32-bit number to the even positions of a 64-bit number.
_SPREAD: Final = (
    (16, 0x0000FFFF0000FFFF),
    (8, 0x00FF00FF00FF00FF),
    (4, 0x0F0F0F0F0F0F0F0F),
    (2, 0x3333333333333333),
    (1, 0x5555555555555555),
)

# The two base-4 digits of each hexadecimal digit.
_BASE_4: Final = {ord(f"{digit:x}"): f"{digit >> 2}{digit & 3}" for digit in range(16)}


def _spread_bits(v: IntArray) -> IntArray:
    for shift, mask in _SPREAD:
        v = (v | (v << shift)) & mask
    return v


def _gather_bits(v: IntArray) -> IntArray:
    v = v & 0x5555555555555555
    for (shift, _), mask in zip(
        reversed(_SPREAD), (*(m for _, m in reversed(_SPREAD[:-1])), 0xFFFFFFFF), strict=True
    ):
        v = (v | (v >> shift)) & mask
    return v


def interleave(x: IntArray, y: IntArray) -> IntArray:
    """Return the quadint (number of a grid square) from the square's column x and row y at its
    zoom; arrays of any equal shape.
    """
    return _spread_bits(x) | (_spread_bits(y) << 1)


def deinterleave(cell: ArrayLike) -> tuple[IntArray, IntArray]:
    """Return column x and row y of a grid square, given by its quadint (number of the square);
    arrays of the same shape.
    """
    c = np.asarray(cell, dtype=np.int64)
    return _gather_bits(c), _gather_bits(c >> 1)


def cell_of(latitude: ArrayLike, longitude: ArrayLike, zoom: int = CELL_ZOOM) -> IntArray:
    """Return the grid square at `zoom` (by default a map cell) that contains each position [deg],
    as int64 of the same shape. Positions must be finite.
    """
    n = 1 << zoom
    phi = np.radians(np.clip(np.asarray(latitude, dtype=np.float64), -MAX_LATITUDE, MAX_LATITUDE))
    x = np.floor((np.asarray(longitude, dtype=np.float64) + 180.0) / 360.0 * n).astype(np.int64) % n
    y = np.floor((1.0 - np.arcsinh(np.tan(phi)) / np.pi) / 2.0 * n).astype(np.int64)
    return interleave(x, np.clip(y, 0, n - 1))


def parent(cell: ArrayLike, zoom: int, of: int = CELL_ZOOM) -> IntArray:
    """Return the quadint (number) of the larger grid square at `zoom` that contains each square in
    `cell`. The squares in `cell` have the zoom `of`. Arrays may have any shape.
    """
    return np.asarray(cell, dtype=np.int64) >> (2 * (of - zoom))


def tile_of(cell: ArrayLike) -> IntArray:
    """Return the quadint (number) of the tile (zoom 14) that contains a cell; arrays of any
    shape.
    """
    return parent(cell, TILE_ZOOM)


def region_of(cell: ArrayLike) -> IntArray:
    """Return the quadint (number) of the region (zoom 10) that contains a cell; arrays of any
    shape.
    """
    return parent(cell, REGION_ZOOM)


def zone_of(cell: ArrayLike) -> IntArray:
    """Return the quadint (number) of the zone (zoom 7) that contains a cell; arrays of any
    shape.
    """
    return parent(cell, ZONE_ZOOM)


def _latitude(row: NDArray[Any], zoom: int) -> FloatArray:
    return np.degrees(np.arctan(np.sinh(np.pi * (1.0 - 2.0 * row / (1 << zoom)))))


def _longitude(column: NDArray[Any], zoom: int) -> FloatArray:
    return column / (1 << zoom) * 360.0 - 180.0


def centre(cell: ArrayLike, zoom: int = CELL_ZOOM) -> tuple[FloatArray, FloatArray]:
    """Return latitude and longitude [deg] of the centres of grid squares. `cell` contains the
    squares' numbers at `zoom`; the results have its shape.
    """
    x, y = deinterleave(cell)
    return _latitude(y + 0.5, zoom), _longitude(x + 0.5, zoom)


def bounds(
    cell: ArrayLike, zoom: int = CELL_ZOOM
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the west, south, east and north edges [deg] of grid squares. `cell` contains the
    squares' numbers at `zoom`; each result has its shape.
    """
    x, y = deinterleave(cell)
    return _longitude(x, zoom), _latitude(y + 1, zoom), _longitude(x + 1, zoom), _latitude(y, zoom)


def outline(cell: ArrayLike, sector: ArrayLike | None = None) -> tuple[FloatArray, FloatArray]:
    """Return longitudes and latitudes [deg] of the corners of cells (n,), each (n, 4),
    counter-clockwise from the south-west.

    If heading sectors (n,) are given, return triangles (n, 3) instead. Each triangle is the quarter
    of the cell on the side to which the vehicle heads; its first corner is the cell's centre.
    """
    west, south, east, north = bounds(cell)
    x = np.stack([west, east, east, west], axis=-1)
    y = np.stack([south, south, north, north], axis=-1)
    if sector is None:
        return x, y
    latitude, longitude = centre(cell)
    # First corner of each sector. East, for example, reaches from the south-east to the north-east
    # corner.
    first = np.mod(np.asarray(sector, dtype=np.int64) + 1, SECTORS)
    row = np.arange(len(first))
    sides = [(side[row, first], side[row, (first + 1) % SECTORS]) for side in (x, y)]
    return np.stack([longitude, *sides[0]], axis=-1), np.stack([latitude, *sides[1]], axis=-1)


def touches(
    box: tuple[float, float, float, float], area: tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike]
) -> NDArray[np.bool_]:
    """Return a mask of the areas in `area`: True if an area and the rectangle `box` overlap in more
    than a border. Both are given by their west, south, east and north edges [deg].
    """
    west, south, east, north = (np.asarray(side) for side in area)
    return np.asarray((east > box[0]) & (north > box[1]) & (west < box[2]) & (south < box[3]))


def neighbours(cell: ArrayLike, zoom: int = CELL_ZOOM) -> IntArray:
    """Return the numbers of the eight grid squares around each square in `cell` at `zoom`, (…, 8),
    row by row from the north-west. Columns wrap around the earth; a neighbour beyond the map's
    northern or southern edge is -1.
    """
    n = 1 << zoom
    x, y = deinterleave(cell)
    dx = np.array([-1, 0, 1, -1, 1, -1, 0, 1])
    dy = np.array([-1, -1, -1, 0, 0, 1, 1, 1])
    columns = (x[..., None] + dx) % n
    rows = y[..., None] + dy
    return np.where((rows >= 0) & (rows < n), interleave(columns, np.clip(rows, 0, n - 1)), -1)


def quadkey(cell: int, zoom: int) -> str:
    """Return the quadkey (digits of a quadtree path) of a grid square, given by its quadint
    (number): a string of `zoom` digits 0–3.
    """
    digits = f"{cell:x}".translate(_BASE_4).zfill(zoom)
    return digits[len(digits) - zoom :]


def from_quadkey(digits: str) -> int:
    """Return the quadint (number of a grid square) of a quadkey (digits of a quadtree path). Its
    zoom is the number of digits.
    """
    return int(digits, 4)


def sector_of(yaw: ArrayLike) -> NDArray[np.int8]:
    """Return the heading sector of a yaw [rad, counter-clockwise from east], in the same shape."""
    quarter = np.floor((np.asarray(yaw, dtype=np.float64) + np.pi / 4) / (np.pi / 2))
    return np.mod(quarter, SECTORS).astype(np.int8)


def sectors_touched(yaw: ArrayLike) -> tuple[NDArray[np.int8], NDArray[np.int8]]:
    """Return two arrays in the shape of `yaw`. The first is the heading sector of each yaw [rad].
    The second is the neighbouring sector if the yaw lies within 15° of the border between the two
    sectors, else -1.
    """
    angle = np.asarray(yaw, dtype=np.float64)
    first = sector_of(angle)
    left = sector_of(angle + SECTOR_MARGIN)
    right = sector_of(angle - SECTOR_MARGIN)
    second = np.where(left != first, left, np.where(right != first, right, -1))
    return first, second.astype(np.int8)
