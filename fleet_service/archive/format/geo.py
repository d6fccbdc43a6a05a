"""GeoParquet 1.1 written with pyarrow alone: geometries as well-known binary (WKB), a bounding box
per row, and the `geo` key of the footer.

Source: GeoParquet specification 1.1.0 (OGC), and the OGC simple features' well-known binary. Axis
order is longitude, latitude; a file without `crs` is OGC:CRS84 by the specification.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa

from schemas import grid
from schemas.numeric import FloatArray, IntArray

GEO: Final = b"geo"
GEOMETRY = "geometry"
BBOX = "bbox"
SIDES: Final = ("xmin", "ymin", "xmax", "ymax")
_POINT: Final = np.dtype([("order", "u1"), ("type", "<u4"), ("xy", "<f8", 2)])
_RING: Final = np.dtype([("order", "u1"), ("type", "<u4"), ("rings", "<u4"), ("points", "<u4")])
_LITTLE_ENDIAN = 1
_TYPE_POINT = 1
_TYPE_POLYGON = 3
_TYPE_MULTIPOLYGON = 6
Pieces = Sequence[Sequence[int]]


def with_cells(table: pa.Table) -> pa.Table:
    """Return a table with a column `cell` as a GeoParquet table with the polygons of the cells.

    If the table also has a column `sector`, a row's polygon is the quarter of the cell that belongs
    to this heading sector (`grid.outline`), so that polygons do not overlap.
    """
    x, y = _cell_outlines(table, table["cell"].to_numpy())
    return _add_geo_metadata(
        table, _binary_array(_wkb_polygons(x, y)), "Polygon", _bounding_sides(x, y)
    )


def with_stretches(table: pa.Table, cells: Pieces) -> pa.Table:
    """Return a GeoParquet table with one multi-polygon per row, for rows that consist of several
    cells.

    `cells` contains the cells of each row. If the table has a column `sector`, each polygon is the
    quarter of the cell that belongs to this heading sector.
    """
    count = np.array([len(own) for own in cells], np.int64)
    first = np.concatenate([[0], np.cumsum(count)])
    x, y = _cell_outlines(table, np.array([cell for own in cells for cell in own], np.int64), count)
    boxes = _wkb_polygons(x, y)
    sides = _bounding_sides(x, y)
    head = struct.Struct("<BII")
    wkb = [
        head.pack(_LITTLE_ENDIAN, _TYPE_MULTIPOLYGON, n) + boxes[begin : begin + n].tobytes()
        for n, begin in zip(count.tolist(), first.tolist(), strict=False)
    ]
    extreme = (np.minimum, np.minimum, np.maximum, np.maximum)
    whole = tuple(
        f.reduceat(side, first[:-1]) if len(count) else side
        for f, side in zip(extreme, sides, strict=True)
    )
    return _add_geo_metadata(table, pa.array(wkb, pa.binary()), "MultiPolygon", whole)


def with_points(table: pa.Table, longitude: FloatArray, latitude: FloatArray) -> pa.Table:
    """Return a table with one point per row as a GeoParquet table; longitude and latitude are (n,)
    [deg].
    """
    wkb = np.zeros(len(longitude), _POINT)
    wkb["order"] = _LITTLE_ENDIAN
    wkb["type"] = _TYPE_POINT
    wkb["xy"] = np.stack([longitude, latitude], axis=1)
    return _add_geo_metadata(
        table, _binary_array(wkb), "Point", (longitude, latitude, longitude, latitude)
    )


def geojson_shapes(table: pa.Table) -> Iterator[dict[str, Any]]:
    """Yield the geometry of each row of a GeoParquet table as GeoJSON."""
    written: list[Any] = table[GEOMETRY].to_pylist()
    for wkb in written:
        kind, count = (
            struct.unpack_from("<II", wkb, 1) if len(wkb) > _POINT.itemsize else (_TYPE_POINT, 0)
        )
        if kind == _TYPE_POINT:
            yield {"type": "Point", "coordinates": np.frombuffer(wkb, "<f8", 2, 5).tolist()}
        elif kind == _TYPE_POLYGON:
            yield {"type": "Polygon", "coordinates": _read_rings(wkb, 1, 0)[0]}
        else:
            yield {"type": "MultiPolygon", "coordinates": _read_rings(wkb, count, 9)}


def _read_rings(wkb: bytes, count: int, begin: int) -> list[Any]:
    """Return the rings of `count` polygons from bytes of well-known binary (WKB), starting at byte
    `begin`. Each polygon must have one ring, and all rings the same number of corners. A polygon
    is returned as [ring], and a ring is a list of corners [x, y].
    """
    corners = struct.unpack_from("<I", wkb, begin + _RING.itemsize - 4)[0] if count else 0
    rings: list[Any] = np.frombuffer(wkb, _ring_dtype(corners), count, begin)["xy"][
        :, None
    ].tolist()
    return rings


def _ring_dtype(corners: int) -> np.dtype[Any]:
    return np.dtype([*_RING.descr, ("xy", "<f8", (corners, 2))])


def _cell_outlines(
    table: pa.Table, cells: IntArray, count: IntArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return longitudes and latitudes [deg] of the corners of cells, (n, 4) each. If the table has
    a column `sector`, return instead the corners of triangles, (n, 3) each: the quarter of each
    cell that belongs to the heading sector of the cell's row.

    Args:
        table: table whose rows consist of the cells.
        cells: cells (n,) of all rows, in the order of the rows.
        count: number of cells of each row; None if each row has one cell.
    """
    if "sector" not in table.schema.names:
        return grid.outline(cells)
    sector = table["sector"].to_numpy()
    return grid.outline(cells, sector if count is None else np.repeat(sector, count))


def _bounding_sides(
    x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    return x.min(axis=1), y.min(axis=1), x.max(axis=1), y.max(axis=1)


def _wkb_polygons(x: FloatArray, y: FloatArray) -> np.ndarray[Any, Any]:
    """Return polygons as well-known binary (WKB), each a closed ring with the corners x, y (n,
    k).
    """
    wkb = np.zeros(len(x), _ring_dtype(x.shape[1] + 1))
    wkb["order"] = _LITTLE_ENDIAN
    wkb["type"] = _TYPE_POLYGON
    wkb["rings"] = 1
    wkb["points"] = x.shape[1] + 1
    corners = np.stack([x, y], axis=2)
    wkb["xy"] = np.concatenate([corners, corners[:, :1]], axis=1)
    return wkb


def _binary_array(wkb: np.ndarray[Any, Any]) -> pa.Array[Any]:
    offsets: IntArray = np.arange(len(wkb) + 1, dtype=np.int64) * wkb.dtype.itemsize
    buffers = [None, pa.py_buffer(offsets.astype(np.int32).tobytes()), pa.py_buffer(wkb.tobytes())]
    return pa.Array.from_buffers(pa.binary(), len(wkb), buffers)


def _add_geo_metadata(
    table: pa.Table, geometry: pa.Array[Any], kind: str, sides: tuple[FloatArray, ...]
) -> pa.Table:
    box = pa.StructArray.from_arrays([pa.array(side) for side in sides], names=list(SIDES))
    column: dict[str, Any] = {
        "encoding": "WKB",
        "geometry_types": [kind] if len(geometry) else [],
        "covering": {"bbox": {side: [BBOX, side] for side in SIDES}},
    }
    if kind != "Point":
        column["orientation"] = "counterclockwise"
    if len(geometry):
        least = [float(side.min()) for side in sides[:2]]
        most = [float(side.max()) for side in sides[2:]]
        column["bbox"] = [*least, *most]
    geo = {"version": "1.1.0", "primary_column": GEOMETRY, "columns": {GEOMETRY: column}}
    marked = table.append_column(
        _degree_field(GEOMETRY, geometry, "WKB, longitude and latitude (OGC:CRS84)"), geometry
    )
    marked = marked.append_column(_degree_field(BBOX, box, "of the geometry, deg"), box)
    metadata: dict[Any, Any] = {**(table.schema.metadata or {}), GEO: json.dumps(geo).encode()}
    return marked.replace_schema_metadata(metadata)


def _degree_field(name: str, column: pa.Array[Any], meaning: str) -> pa.Field[Any]:
    return pa.field(name, column.type, nullable=False, metadata={"unit": "deg", "meaning": meaning})
