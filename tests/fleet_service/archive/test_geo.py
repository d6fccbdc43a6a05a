"""Tests that an independent validator and GeoPandas accept the GeoParquet files."""

from __future__ import annotations

from pathlib import Path

import geopandas
import geoparquet_validator
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from shapely.geometry import box

from fleet_service.archive.export import extract
from fleet_service.archive.format import geo, snapshots
from fleet_service.archive.format.files import MAP, write_table
from fleet_service.fusion import Fusion
from fleet_service.serve.encode import cell_table
from schemas import grid, tables
from tests.fleet_service.examples import CELL, START, observations, value


def a_map(cells: int = 300) -> pa.Table:
    """Return a map table with `cells` neighbouring cells."""
    rng = np.random.default_rng(2)
    cell = CELL + rng.permutation(cells)
    fusion = Fusion(120.0)
    fusion.update(
        observations(
            np.arange(cells),
            np.arange(cells) % 7,
            value(rng.uniform(0.2, 0.9, cells)),
            cell.tolist(),
        )
    )
    return cell_table(fusion, np.arange(fusion.size), START + 10**12)


def failures(path: Path) -> list[str]:
    """Return the names of the tests of the GeoParquet validator that a file fails. Assert that the
    validator applied all required tests.
    """
    report = geoparquet_validator.check(str(path))
    passed = [outcome["id"] for outcome in report["outcomes"] if outcome["status"] == "pass"]
    assert len([name for name in passed if "/core/" in name]) > 8
    return list(geoparquet_validator.failed(report))


def test_a_snapshot_is_geoparquet_that_an_independent_validator_accepts(tmp_path: Path) -> None:
    table = a_map()
    path = snapshots.write_snapshot(tmp_path, table, START)
    assert path == tmp_path / "map/date=2023-11-14/20231114T221320Z.parquet"
    assert failures(path) == []
    assert snapshots.newest_snapshot(tmp_path, START) == path
    assert snapshots.newest_snapshot(tmp_path, START - 10**9) is None
    assert snapshots.time_of(path) == START
    kept = pq.read_table(path, partitioning=None)
    assert kept.schema.names == [*tables.MAP_ARCHIVE.names, "geometry", "bbox"]
    assert kept["cell"].to_pylist() == np.sort(table["cell"].to_numpy()).tolist()
    assert kept.schema.field("mu").metadata == tables.MAP_SCHEMA.field("mu").metadata


def test_geopandas_reads_the_polygons_of_the_cells_and_a_box_of_them(tmp_path: Path) -> None:
    path = snapshots.write_snapshot(tmp_path, a_map(), START)
    frame = geopandas.read_parquet(path)
    assert frame.crs == "OGC:CRS84"
    assert frame.geometry.is_valid.all()
    x, y = grid.outline(frame["cell"].to_numpy(), frame["sector"].to_numpy())
    extremes = np.stack([x.min(axis=1), y.min(axis=1), x.max(axis=1), y.max(axis=1)], axis=1)
    np.testing.assert_array_equal(frame.geometry.bounds.to_numpy(), extremes)
    assert frame.geometry.exterior.is_ccw.all()
    middle = frame.geometry.iloc[7].centroid
    near = (middle.x - 1e-7, middle.y - 1e-7, middle.x + 1e-7, middle.y + 1e-7)
    assert geopandas.read_parquet(path, bbox=near)["cell"].tolist() == [frame["cell"].iloc[7]]


def test_the_sectors_of_a_cell_lie_side_by_side_and_fill_it(tmp_path: Path) -> None:
    table = geo.with_cells(pa.table({"cell": [CELL] * 4, "sector": pa.array(range(4), pa.int8())}))
    extract.write_extract(table, tmp_path / "a.geojson")
    quarters = geopandas.read_file(tmp_path / "a.geojson").geometry.set_crs(
        None, allow_override=True
    )
    west, south, east, north = (float(side) for side in grid.bounds(CELL))
    whole = box(west, south, east, north)
    assert quarters.union_all().symmetric_difference(whole).area < 1e-9 * whole.area
    assert quarters.area.sum() == pytest.approx(whole.area)
    # Direction of each sector from the cell's centre: east, north, west, south.
    for sector, (x, y) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
        off = quarters.iloc[sector].centroid
        assert (off.x - whole.centroid.x) * x + (off.y - whole.centroid.y) * y > 0.0
    (square,) = geo.geojson_shapes(geo.with_cells(pa.table({"cell": [CELL]})))
    assert square["coordinates"][0][:3:2] == [[west, south], [east, north]]


@pytest.mark.parametrize("rows", [0, 1, 5])
def test_points_and_empty_exports_are_geoparquet(tmp_path: Path, rows: int) -> None:
    x = np.linspace(11.0, 12.0, rows)
    y = np.linspace(57.0, 58.0, rows)
    write_table(
        geo.with_points(pa.table({"n": np.arange(rows)}), x, y), tmp_path / "points.parquet", MAP
    )
    report = geoparquet_validator.check(str(tmp_path / "points.parquet"))
    assert geoparquet_validator.failed(report, "core") == []
    frame = geopandas.read_parquet(tmp_path / "points.parquet")
    np.testing.assert_array_equal(frame.geometry.x, x)
    np.testing.assert_array_equal(frame.geometry.y, y)


def test_the_validator_refuses_a_file_whose_geometry_is_broken(tmp_path: Path) -> None:
    table = geo.with_cells(a_map(3))
    broken = table.set_column(
        table.schema.get_field_index("geometry"),
        "geometry",
        pa.array([b"\x01\x03"] * 3, pa.binary()),
    )
    write_table(broken, tmp_path / "broken.parquet", MAP)
    assert geoparquet_validator.failed(
        geoparquet_validator.check(str(tmp_path / "broken.parquet")), "core"
    )


def test_geojson_and_csv_equal_the_map(tmp_path: Path) -> None:
    table = geo.with_cells(a_map(3))
    for ending in (".geojson", ".csv"):
        extract.write_extract(table, tmp_path / f"map{ending}")
    frame = geopandas.read_file(tmp_path / "map.geojson")
    assert frame["cell"].tolist() == table["cell"].to_pylist()
    np.testing.assert_allclose(frame["mu"], table["mu"].to_numpy(), atol=1e-6)
    np.testing.assert_allclose(
        frame.geometry.bounds["maxx"], grid.bounds(table["cell"].to_numpy())[2]
    )
    header, *lines = (tmp_path / "map.csv").read_text().splitlines()
    assert header.startswith('"cell","sector","mu"')
    assert len(lines) == 3
