"""Assignment of map cells to road links, separately for each heading sector of a cell. It is
computed once per network. Observations can then be looked up by cell and sector, so no trip must be
matched to roads.

A cell and sector belong to the link that is nearest in distance and heading. A cell in which one
link ends and the next begins belongs to both links, because its observations cannot be separated.
`make roads-bench` measures how often the assignment is correct.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial import cKDTree

from fleet_service.analytics.roads.network import DirectedLink, RoadNetwork
from schemas import grid
from schemas.errors import InputError
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.thresholds import METRES_PER_DEGREE

# [m] Largest distance from a cell's centre to a road: half a cell, lanes beyond the drawn line, and
# the position error.
REACH_M: Final = 25.0
# [m/rad] Cost of the angle between a road and the sector's axis. An angle of 45° costs as much as
# 6 m, so a parallel road one lane away is preferred.
TURN_M: Final = 8.0
# [rad] Largest heading difference: 45° to a sector's edge, and 15° beyond it, within which a
# vehicle reports to both sectors.
MOST_TURN: Final = np.radians(60.0)
# [m] Additional cost of service roads, because they have far less traffic than the street next to
# them.
SERVICE_M: Final = 6.0
STEP_M: Final = 2.0
PIECE: Final = 4096  # number of cells that are processed at once
_TYPES: Final[dict[str, pa.DataType]] = {
    "cell": pa.int64(),
    "sector": pa.int8(),
    "link": pa.string(),
    "direction": pa.string(),
    "from_m": pa.float64(),
    "to_m": pa.float64(),
    "length_m": pa.float64(),
    "name": pa.string(),
    "kind": pa.string(),
    "distance_m": pa.float64(),
    "ambiguous_m": pa.float64(),
    "shared": pa.bool_(),
}
SCHEMA: Final = pa.schema(_TYPES)


class _Marks(NamedTuple):
    """Points ("marks") every STEP_M metres along all road links; each attribute is a column (n,).

    Attributes:
        link: number of the link.
        run: distance from the start of the link [m].
        latitude, longitude: position [deg].
        yaw: driving direction [rad].
    """

    link: IntArray
    run: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    yaw: FloatArray


class _Joined(NamedTuple):
    """Assignment of map cells and heading sectors to road links, in columns (n,).

    Attributes:
        cell, sector: map cell and heading sector.
        mark: index of the nearest mark (point on a road link), which also gives the link.
        distance: distance from the cell's centre to this mark [m].
        ambiguous: by how much another link fits worse than the best one, as additional distance
            [m]; NaN if there is no other link.
        second: True if the cell and sector also have a better row: an adjoining link that fits the
            cell better than the link of this row.
    """

    cell: IntArray
    sector: IntArray
    mark: IntArray
    distance: FloatArray
    ambiguous: FloatArray
    second: BoolArray


def join_roads(network: RoadNetwork) -> pa.Table:
    """Return a table with one row for each cell and heading sector on a road link. Among the
    columns are the link, the part of its length in the cell [m], and the distance from the cell to
    the link [m]. The documentation page "Columns of the questions" lists all columns.
    """
    lengths, marks = _link_marks(network.links)
    scale = np.cos(np.radians(marks.latitude))
    side = scale.mean() * METRES_PER_DEGREE * 360.0 / 2**grid.CELL_ZOOM
    joined = _join_cells(network, marks, scale, side)
    link = marks.link[joined.mark]
    middle = marks.run[joined.mark]
    length = lengths[link]
    begin, total = _link_begins(network.links, lengths)
    texts = {
        name: pa.array([getattr(network.links[k], field) for k in link.tolist()], pa.string())
        for name, field in (
            ("link", "id"),
            ("direction", "direction"),
            ("name", "name"),
            ("kind", "kind"),
        )
    }
    numbers = {
        "cell": joined.cell,
        "sector": joined.sector.astype(np.int8),
        "from_m": begin[link] + np.maximum(middle - side / 2.0, 0.0),
        "to_m": begin[link] + np.minimum(middle + side / 2.0, length),
        "length_m": total[link],
        "distance_m": joined.distance,
        "shared": joined.second,
    }
    arrays: dict[str, Any] = {name: pa.array(column) for name, column in numbers.items()} | texts
    arrays["ambiguous_m"] = pa.array(joined.ambiguous, from_pandas=True)
    found = pa.table([arrays[name] for name in SCHEMA.names], schema=SCHEMA)
    found = found.sort_by([("cell", "ascending"), ("sector", "ascending"), ("shared", "ascending")])
    return found.replace_schema_metadata(
        {f"roads.{key}": value for key, value in network.source.items()}
    )


def _link_begins(
    links: Sequence[DirectedLink], lengths: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return, for each link with its length in `lengths` (n,) [m], the position of its begin and
    the total length. Lines with the same id and direction are parts of one link, one after another.
    """
    total: dict[tuple[str, str], float] = {}
    begin = np.zeros(len(links))
    for k, link in enumerate(links):
        begin[k] = total.get((link.id, link.direction), 0.0)
        total[link.id, link.direction] = begin[k] + lengths[k]
    return begin, np.array([total[link.id, link.direction] for link in links])


def _join_cells(network: RoadNetwork, marks: _Marks, scale: FloatArray, side: float) -> _Joined:
    """Assign the cells near road links to the links with a matching heading.

    `scale` (marks,) is the cosine of the latitude of each mark (point on a link), and `side` the
    width of a cell [m].
    """
    tree = cKDTree(_to_mercator(marks.latitude, marks.longitude))
    reach = REACH_M / scale.min()
    cells = _nearby_cells(marks, float(side))
    service = np.array([SERVICE_M if link.kind == "service" else 0.0 for link in network.links])
    start, end = (
        np.unique(_end_points(network.links), axis=0, return_inverse=True)[1].reshape(-1, 2)
    ).T
    parts = []
    for first in range(0, len(cells), PIECE):
        piece = cells[first : first + PIECE]
        pairs = cKDTree(_to_mercator(*grid.centre(piece))).sparse_distance_matrix(
            tree, reach, output_type="ndarray"
        )
        metres = pairs["v"] * scale[pairs["j"]]
        for axis in range(grid.SECTORS):
            turn = _angle_between(marks.yaw[pairs["j"]], axis * np.pi / 2.0)
            fits = (turn <= MOST_TURN) & (metres <= REACH_M)
            row = pairs["i"][fits]
            mark = pairs["j"][fits]
            metre = metres[fits]
            link = marks.link[mark]
            cost = metre + TURN_M * turn[fits] + service[link]
            # the best mark of each cell and link
            each = _first_of(np.lexsort((cost, link, row)), row, link)
            row, link, mark, metre, cost = (
                column[each] for column in (row, link, mark, metre, cost)
            )
            best = _first_of(np.lexsort((cost, row)), row)[
                np.cumsum(np.append(0, row[1:] != row[:-1]))[: len(row)]
            ]
            goes_on = (end[link] == start[link[best]]) | (end[link[best]] == start[link])
            is_best = link == link[best]
            more = cost - cost[best]
            # Also keep a link that continues the best one, if it begins within the cell.
            is_kept = is_best | (goes_on & (more <= side / 2.0))
            other = np.full(len(piece), np.inf)
            np.minimum.at(other, row, np.where(is_kept, np.inf, more))
            other[np.isinf(other)] = np.nan
            columns = (piece[row], np.full(len(row), axis), mark, metre, other[row], ~is_best)
            parts.append([column[is_kept] for column in columns])
    return _Joined(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def read_roads(path: Path) -> pa.Table:
    """Return the table in a file made by `join_roads`.

    Raises:
        InputError: the file is not such a table.
    """
    try:
        table = pq.read_table(path)
        return table.select(SCHEMA.names).cast(SCHEMA)
    except (OSError, pa.ArrowInvalid, pa.ArrowTypeError, KeyError) as error:
        reason = str(error).splitlines()[0][:100]
        raise InputError(
            "roads",
            f"{path} is not a table of roads ({reason})",
            "create it with fleet-service roads",
        ) from error


def _link_marks(links: list[DirectedLink]) -> tuple[FloatArray, _Marks]:
    """Return the lengths (n,) [m] of the road links, and the marks (points every STEP_M) along
    them.
    """
    lengths = np.empty(len(links))
    parts = []
    for k, link in enumerate(links):
        east = METRES_PER_DEGREE * np.cos(np.radians(float(np.mean(link.latitude))))
        dx = np.diff(link.longitude) * east
        dy = np.diff(link.latitude) * METRES_PER_DEGREE
        run = np.concatenate([[0.0], np.cumsum(np.hypot(dx, dy))])
        lengths[k] = run[-1]
        count = max(int(run[-1] / STEP_M), 1)
        at = (np.arange(count) + 0.5) * run[-1] / count
        piece = np.minimum(np.searchsorted(run, at, side="right") - 1, len(dx) - 1)
        parts.append(
            (
                np.full(len(at), k),
                at,
                np.interp(at, run, link.latitude),
                np.interp(at, run, link.longitude),
                np.arctan2(dy, dx)[piece],
            )
        )
    return lengths, _Marks._make(np.concatenate(column) for column in zip(*parts, strict=True))


def _nearby_cells(marks: _Marks, side: float) -> IntArray:
    """Return the numbers (n,) of the cells that may lie on a road link: all cells within REACH_M
    metres of a mark, and some others.
    """
    x, y = grid.deinterleave(np.unique(grid.cell_of(marks.latitude, marks.longitude)))
    wide = int(np.ceil(REACH_M / side))
    offsets = np.arange(-wide, wide + 1)
    found = [grid.interleave(x + i, y + j) for i in offsets for j in offsets]
    return np.unique(np.concatenate(found))


def _first_of(order: IntArray, *groups: IntArray) -> IntArray:
    """Return, for each group of elements, the index of the element that comes first in `order`.
    Elements belong to the same group if their numbers are equal in all arrays `groups`. `order`
    contains the indices of all elements, sorted by group.
    """
    new = np.zeros(len(order), np.bool_)
    new[:1] = True
    for group in groups:
        new[1:] |= group[order][1:] != group[order][:-1]
    return order[new]


def _end_points(links: list[DirectedLink]) -> FloatArray:
    """Return the first and the last point of each road link in turn, (2 n, 2) [deg], rounded to a
    tenth of a metre.
    """
    ends = [(at.latitude[k], at.longitude[k]) for at in links for k in (0, -1)]
    return np.asarray(np.round(np.array(ends), 6), np.float64)


def _to_mercator(latitude: FloatArray, longitude: FloatArray) -> FloatArray:
    """Return positions [deg] as points in the plane of the Mercator projection, (n, 2) [m]. A true
    metre is 1 / cos(latitude) long in this plane.
    """
    radius = np.degrees(METRES_PER_DEGREE)
    y = np.arcsinh(np.tan(np.radians(latitude)))
    return np.asarray(radius * np.column_stack([np.radians(longitude), y]))


def _angle_between(yaw: FloatArray, axis: float) -> FloatArray:
    return np.asarray(np.abs((yaw - axis + np.pi) % (2.0 * np.pi) - np.pi))


def add_road_names(found: pa.Table, roads: pa.Table) -> pa.Table:
    """Return an answer with a column `road`: the name of the road at each cell, null if no named
    road is near. `roads` is a table that `read_roads` has returned.
    """
    network = roads.sort_by("distance_m")
    nearest: dict[Any, str] = {}
    columns = (network[name].to_pylist() for name in ("cell", "sector", "name"))
    for cell, sector, name in zip(*columns, strict=True):
        if name:
            nearest.setdefault((cell, sector), name)
    places = zip(found["cell"].to_pylist(), found["sector"].to_pylist(), strict=True)
    names = pa.array([nearest.get(place) for place in places], pa.string())
    return found.append_column("road", names)
