"""Tests of the road lines on the page, which are read from a file or derived from cells. Streets
that cross must stay separate, and a few scattered cells must make no road.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fleet_service.page.recent import MOST, STEP_S, RecentMoments
from fleet_service.page.roads import learned_lines, read_roads
from schemas import grid
from schemas.errors import InputError
from tests.fleet_service.examples import CELL

EAST, NORTH, WEST, _SOUTH = range(4)
COLUMN, ROW = (int(v) for v in grid.deinterleave(CELL))


def cells(*places: tuple[int, int]) -> np.ndarray:
    x, y = (np.array(one) for one in zip(*places, strict=True))
    return np.asarray(grid.interleave(COLUMN + x, ROW + y))


def test_a_learned_line_follows_its_cells_in_the_direction_of_travel() -> None:
    street = cells(*((k, 0) for k in range(20)))
    for heading, sign in ((EAST, 1), (WEST, -1)):
        (line,) = learned_lines(street, np.full(20, heading))
        longitude = np.array(line.points)[:, 0]
        assert (sign * np.diff(longitude) > 0).all()
        assert len(line.points) == 20
        assert line.directions == 1


def test_a_gap_of_two_cells_is_bridged_and_one_of_four_is_not() -> None:
    near = cells(*((k, 0) for k in range(20) if k not in (8, 9)))
    assert len(learned_lines(near, np.full(len(near), EAST))) == 1
    far = cells(*((k, 0) for k in range(20) if k not in (8, 9, 10, 11)))
    assert len(learned_lines(far, np.full(len(far), EAST))) == 2


def test_streets_that_cross_stay_two_lines() -> None:
    east = [(k, 0) for k in range(-10, 11)]
    north = [(0, k) for k in range(-10, 11)]
    cell = np.concatenate([cells(*east), cells(*north)])
    sector = np.repeat([EAST, NORTH], 21)
    assert len(learned_lines(cell, sector)) == 2


def test_a_few_scattered_cells_make_no_road() -> None:
    assert learned_lines(cells((0, 0), (1, 0), (30, 5)), np.full(3, EAST)) == []


def test_lines_of_a_file_have_names_and_directions(tmp_path: Path) -> None:
    path = tmp_path / "roads.geojson"

    def feature(shape: str, coordinates: object, **about: str) -> dict[str, object]:
        return {
            "type": "Feature",
            "geometry": {"type": shape, "coordinates": coordinates},
            "properties": about,
        }

    line = [[11.0, 57.0], [11.1, 57.0]]
    features = [
        feature("LineString", line, name="One"),
        feature("MultiLineString", [line, line], oneway="yes"),
        feature("Point", [11.0, 57.0], name="Town"),
        feature("Point", [11.0, 57.0]),
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    found = read_roads(path)
    assert [(one.name, one.directions) for one in found.lines] == [("One", 3), ("", 1), ("", 1)]
    assert found.places == [("Town", 11.0, 57.0)]
    metres = json.dumps(
        {"features": [feature("LineString", [[319000, 6400000], [319100, 6400000]])]}
    )
    for text, problem in (
        ("no", "cannot be read"),
        ("{}", "is no GeoJSON FeatureCollection"),
        ("[]", "is no GeoJSON FeatureCollection"),
        ('{"features": []}', "contains 0 lines"),
        ('{"features": [{"geometry": null}]}', "feature 0 has no usable geometry"),
        (metres, "feature 0 has no usable geometry; .* in degrees"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=problem):
            read_roads(path)


def test_recent_moments_are_kept_in_steps_and_thinned_with_age() -> None:
    recent = RecentMoments()
    for second in range(0, 3 * 3600, 5):
        recent.keep(1000.0 + second, {7: np.zeros(second % 3, np.void)})
    times = recent.times()
    assert len(times) <= MOST
    assert times == sorted(times)
    assert times[-1] >= 1000 + 3 * 3600 - 2 * STEP_S
    assert times[-1] - times[0] > 3600, "the first hour is there, coarser"
    assert min(np.diff(times)) >= STEP_S


def test_unchanged_moment_is_stored_once() -> None:
    recent = RecentMoments()
    tile = np.zeros(3, np.void)
    for second in range(0, 100, 10):
        recent.keep(float(second), {7: tile})
    assert recent.times() == [0]
    assert recent.at(0) == {7: tile}
    assert recent.at(5) is None


def test_cells_side_by_side_are_one_learned_line() -> None:
    """Position errors may divide the reports from one lane among two or three parallel rows of
    cells. These rows must become one road line.
    """
    scattered = cells(
        *((k, (0, 2, 0, 1)[k % 4]) for k in range(24)), *((k, 2) for k in range(3, 9))
    )
    (line,) = learned_lines(scattered, np.full(len(scattered), EAST))
    assert len(line.points) == 24
