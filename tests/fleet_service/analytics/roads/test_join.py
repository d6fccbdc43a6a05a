"""Tests of the assignment of map cells to road links. A cell (counted once per heading sector) must
belong to the nearest link with the same direction. Where one link ends and the next begins, it must
belong to both.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from fleet_service.analytics.roads.join import REACH_M, join_roads, read_roads
from fleet_service.analytics.roads.network import DirectedLink, RoadNetwork
from fleet_service.cli import main
from schemas import grid
from schemas.errors import InputError
from schemas.thresholds import METRES_PER_DEGREE
from tests.fleet_service.analytics.roads.test_network import extract

LATITUDE = 57.7
LONGITUDE = 11.97
EAST = METRES_PER_DEGREE * np.cos(np.radians(LATITUDE))


def place(x: float, y: float) -> tuple[float, float]:
    """Return latitude and longitude [deg] of a point given in metres east and north of a fixed
    place.
    """
    return LATITUDE + y / METRES_PER_DEGREE, LONGITUDE + x / EAST


def road(
    name: str, *points: tuple[float, float], both: bool = True, kind: str = "primary"
) -> list[DirectedLink]:
    latitude, longitude = np.array([place(*point) for point in points]).T
    forward = DirectedLink(name, "forward", name, kind, latitude, longitude)
    back = DirectedLink(name, "backward", name, kind, latitude[::-1], longitude[::-1])
    return [forward, back] if both else [forward]


def on(frame: pd.DataFrame, x: float, y: float, sector: int) -> list[tuple[str, str]]:
    cell = int(grid.cell_of(*place(x, y)))
    rows = frame[(frame.cell == cell) & (frame.sector == sector)]
    return list(zip(rows.link, rows.direction, strict=True))


def cells_near(y: float) -> list[int]:
    """Return the cells within 20 m north and south of the line y [m] from x = 0 to 200 m."""
    return [
        int(grid.cell_of(*place(x, y + off))) for x in range(0, 201, 5) for off in range(-20, 21, 5)
    ]


def frame_of(*roads: list[DirectedLink]) -> pd.DataFrame:
    found: pd.DataFrame = join_roads(
        RoadNetwork([link for own in roads for link in own], {"extract": "test"})
    ).to_pandas()
    return found


def test_sector_distinguishes_the_two_directions_of_a_road() -> None:
    frame = frame_of(road("a", (0, 0), (500, 0)))
    assert on(frame, 250, -3, 0) == [("a", "forward")]
    assert on(frame, 250, 3, 2) == [("a", "backward")]
    assert not on(frame, 250, 0, 1), "nobody crosses there"
    assert not on(frame, 250, REACH_M + 15, 0)


def test_heading_decides_at_a_crossing_and_distance_elsewhere() -> None:
    frame = frame_of(road("east", (-300, 0), (300, 0)), road("north", (0, -300), (0, 300)))
    assert on(frame, 0, 0, 0) == [("east", "forward")]
    assert on(frame, 0, 0, 1) == [("north", "forward")]
    assert on(frame, 0, 0, 3) == [("north", "backward")]
    apart = frame_of(
        road("a", (0, 0), (500, 0), both=False), road("b", (0, 24), (500, 24), both=False)
    )
    assert on(apart, 250, 0, 0) == [("a", "forward")]
    assert on(apart, 250, 24, 0) == [("b", "forward")]
    assert apart.ambiguous_m.min() < 10.0, "a cell between them is little nearer to one"


def test_a_slanting_road_is_found_from_either_sector_it_touches() -> None:
    frame = frame_of(road("a", (0, 0), (300, 300)))
    assert on(frame, 150, 150, 0) == on(frame, 150, 150, 1) == [("a", "forward")]


def test_a_cell_in_which_a_link_ends_and_the_next_begins_is_of_both() -> None:
    centre = grid.centre(grid.cell_of(*place(250, 0)))
    x = float((centre[1] - LONGITUDE) * EAST)
    frame = frame_of(road("a", (0, 0), (x, 0)), road("b", (x, 0), (500, 0)))
    cell = int(grid.cell_of(*place(x, 0)))
    rows = frame[(frame.cell == cell) & (frame.sector == 0)]
    assert set(rows.link) == {"a", "b"}
    assert sorted(rows.shared) == [False, True]
    assert on(frame, x - 40, 0, 0) == [("a", "forward")]
    assert on(frame, x + 40, 0, 0) == [("b", "forward")]


def test_the_cells_of_a_link_cover_its_length() -> None:
    frame = frame_of(road("a", (0, 0), (331, 47)))
    own = frame[(frame.direction == "forward") & (frame.sector == 0)].sort_values("from_m")
    assert own.from_m.min() == 0.0
    assert own.to_m.max() == pytest.approx(np.hypot(331, 47), rel=2e-3)
    assert (own.from_m.to_numpy()[1:] <= own.to_m.cummax().to_numpy()[:-1] + 1e-6).all(), "no gap"


def test_lines_with_one_id_are_parts_of_one_link() -> None:
    frame = frame_of(
        road("a", (0, 0), (200, 0), both=False), road("a", (0, 300), (100, 300), both=False)
    )
    assert frame.length_m.to_numpy() == pytest.approx(300.0, rel=1e-3)
    first, second = (frame[frame.cell.isin(cells_near(y))] for y in (0, 300))
    assert first.to_m.max() <= second.from_m.min() + 1.0
    assert second.to_m.max() == pytest.approx(300.0, rel=1e-3)


def test_road_join_is_right_at_any_latitude() -> None:
    def at(latitude: float) -> list[DirectedLink]:
        east = METRES_PER_DEGREE * np.cos(np.radians(latitude))
        lines: Any = (np.full(2, latitude), np.array([10.0, 10.0 + 400 / east]))
        return [DirectedLink(f"{latitude}", "forward", "", "", *lines)]

    frame = frame_of(at(5.0), at(69.0))
    for latitude in (5.0, 69.0):
        own = frame[frame.link == f"{latitude}"]
        assert own.distance_m.max() <= REACH_M
        assert own.length_m.iloc[0] == pytest.approx(400, rel=1e-3)


def test_roads_command_writes_the_file_that_analyses_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "roads.parquet"
    assert main(["roads", str(extract(tmp_path / "town.osm")), "--out", str(out)]) == 0
    assert "on 5 directed links" in capsys.readouterr().out
    assert read_roads(out).num_rows > 100
    about = pq.read_schema(out).metadata
    assert b"OpenStreetMap" in about[b"roads.licence"]
    assert len(about[b"roads.sha256"]) == 64
    (tmp_path / "other.parquet").write_bytes(b"x")
    with pytest.raises(InputError, match="roads"):
        read_roads(tmp_path / "other.parquet")


def test_id_and_name_of_lines_are_those_of_the_columns_that_are_given(tmp_path: Path) -> None:
    (south, west) = place(0, 0)
    (north, east) = place(200, 0)
    line = {"type": "LineString", "coordinates": [[west, south], [east, north]]}
    columns = {"id": "1", "name": "First", "nr": "E6", "street": "Avenue"}
    feature = {"type": "Feature", "properties": columns, "geometry": line}
    lines = tmp_path / "lines.geojson"
    out = tmp_path / "roads.parquet"
    lines.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    for more, link, name in (
        ([], "1", "First"),
        (["--id", "nr", "--name", "street"], "E6", "Avenue"),
    ):
        assert main(["roads", str(lines), "--out", str(out), *more]) == 0
        found = pq.read_table(out)
        assert (set(found["link"].to_pylist()), set(found["name"].to_pylist())) == ({link}, {name})
