"""Tests of map cells, tiles and heading sectors. A position must lie in its cell, a parent must be
the cell of the coarser zoom, and conversions between forms of cell numbers must be reversible.
Places on the grid's borders must get the right cell.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas import grid

latitudes = st.floats(-85.0, 85.0)
longitudes = st.floats(-180.0, 180.0, exclude_max=True)


@given(latitudes, longitudes)
def test_cell_of_a_position_contains_it(latitude: float, longitude: float) -> None:
    west, south, east, north = (float(v) for v in grid.bounds(grid.cell_of(latitude, longitude)))
    # A longitude just below 180° is rounded to -180°.
    assert (longitude - west + 1e-9) % 360.0 <= east - west + 2e-9
    assert south - 1e-9 <= latitude <= north + 1e-9


@given(latitudes, longitudes)
def test_centre_of_a_cell_is_inside_it(latitude: float, longitude: float) -> None:
    cell = grid.cell_of(latitude, longitude)
    assert grid.cell_of(*grid.centre(cell)) == cell


@given(latitudes, longitudes, st.sampled_from([7, 10, 14]))
def test_a_parent_is_the_cell_of_the_coarser_zoom(
    latitude: float, longitude: float, zoom: int
) -> None:
    cell = grid.cell_of(latitude, longitude)
    assert grid.parent(cell, zoom) == grid.cell_of(latitude, longitude, zoom)
    assert grid.quadkey(int(cell), 21).startswith(grid.quadkey(int(grid.parent(cell, zoom)), zoom))


@given(st.integers(0, 4**21 - 1))
def test_a_quadkey_is_the_quadint_in_base_four(cell: int) -> None:
    assert grid.from_quadkey(grid.quadkey(cell, 21)) == cell


def test_interleaving_is_undone() -> None:
    x, y = np.random.default_rng(0).integers(0, 1 << 21, (2, 10_000))
    columns, rows = grid.deinterleave(grid.interleave(x, y))
    np.testing.assert_array_equal(columns, x)
    np.testing.assert_array_equal(rows, y)


def test_quadkeys_are_those_of_the_published_example() -> None:
    # Example of Bing Maps Tile System: tile (3, 5) at zoom 3 is "213".
    assert grid.quadkey(int(grid.interleave(np.array(3), np.array(5))), 3) == "213"


def test_cell_length_is_that_of_the_design() -> None:
    for latitude, side in ((0.0, 19.1), (57.7, 10.2), (60.0, 9.6)):
        west, _, east, _ = (float(v) for v in grid.bounds(grid.cell_of(latitude, 10.0)))
        assert np.radians(east - west) * 6_378_137 * np.cos(np.radians(latitude)) == pytest.approx(
            side, abs=0.1
        )


def test_neighbours_touch_and_wrap_at_the_date_line() -> None:
    for longitude in (11.97, 179.9999999, -180.0):
        cell = grid.cell_of(57.7, longitude)
        around = grid.neighbours(cell)
        assert len(set(around.tolist()) | {int(cell)}) == 9
        assert cell in grid.neighbours(around[0])


def test_beyond_the_poles_there_is_no_neighbour() -> None:
    assert (grid.neighbours(grid.cell_of(90.0, 0.0)) == -1).sum() == 3


@pytest.mark.parametrize(
    ("degrees", "sector"),
    [(0, 0), (44, 0), (46, 1), (90, 1), (180, 2), (-90, 3), (359, 0), (-180, 2)],
)
def test_sectors_are_quarters_of_the_compass(degrees: float, sector: int) -> None:
    assert grid.sector_of(np.radians(degrees)) == sector


@pytest.mark.parametrize(
    ("degrees", "second"),
    [(0, -1), (29, -1), (31, 1), (59, 0), (61, -1), (-40, 3), (179, -1), (134, 2)],
)
def test_a_heading_near_an_edge_belongs_to_both_sectors(degrees: float, second: int) -> None:
    assert grid.sectors_touched(np.radians(degrees))[1] == second
