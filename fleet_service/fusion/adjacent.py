"""Neighbours of a cell: before and behind it on the road, and in the other direction. Compiled."""

from __future__ import annotations

from typing import Final, NamedTuple

from fleet_service.fusion import constants
from fleet_service.fusion.store.records import NONE
from fleet_service.fusion.store.table import find_row
from schemas import grid
from schemas.numeric import IntArray
from schemas.runtime.jit import refcount_free_inlined
from schemas.runtime.records import RecordArray
from schemas.thresholds import NS

_WHOLE: Final = (1 << 2 * grid.CELL_ZOOM) - 1  # all bits of a cell number
_X: Final = 0x5555555555555555 & _WHOLE  # bits of the column number; `_Y`: of the row number
_Y: Final = _WHOLE - _X
_EAST, _NORTH, _WEST, _SOUTH = range(grid.SECTORS)
# sides of a cell; across: the opposite direction of the road
BEFORE, BEHIND, ACROSS = range(3)
# [quarter turns] from the heading of a sector to its left and right
_SIDEWAYS: Final = (1, 3)
# Number of cells in which the other direction of the road may lie: the same cell, left and right.
ACROSS_CELLS: Final = 1 + len(_SIDEWAYS)
# [ns] time for which a visit shows that a road leads through a cell
_ROAD_NS: Final = int(constants.FORGOTTEN_S) * NS


@refcount_free_inlined
def next_cell(cell: int, heading: int) -> int:
    """Return the next cell in the direction of a sector `heading`, also across the date line."""
    x = cell & _X
    y = cell & _Y
    if heading == _EAST:
        x = ((x | _Y) + 1) & _X
    elif heading == _WEST:
        x = (x - 1) & _X
    elif heading == _SOUTH:
        y = ((y | _X) + 2) & _Y
    else:
        y = (y - 2) & _Y
    return x | y


class SearchSide(NamedTuple):
    """One side of a slot (cell and heading sector) on which neighbours are searched for.

    Attributes:
        key: number of the slot, cell · 4 + sector.
        side: BEFORE, BEHIND or ACROSS.
        now: time of the search [ns]; a visit in the last _ROAD_NS shows that a road leads through a
            cell.
    """

    key: int
    side: int
    now: int


@refcount_free_inlined
def find_neighbour(
    table: IntArray, cells: RecordArray, search: SearchSide, previous: int, step: int
) -> tuple[int, int]:
    """Return the cell and the row of a neighbour of a slot; the row is NONE if no vehicle visited
    the neighbour.

    Before and behind, neighbour k is k cells away along the road. It is the cell straight ahead of
    neighbour k - 1, or, if that one was not visited lately, a cell to its left or right that was.
    So a road is also followed where it runs diagonally to the grid.

    For the opposite direction of the road, neighbour 1 is in the slot's own cell, because both
    directions may share a cell. Neighbours 2 and 3 are in the cells to its left and right.

    Args:
        table: hash table that finds the rows of `cells`.
        cells: records of the slots.
        search: the slot and its side.
        previous: cell of neighbour `step` - 1; at first the slot's own cell.
        step: number of the neighbour, counted from 1.
    """
    cell = search.key // grid.SECTORS
    sector = search.key % grid.SECTORS
    opposite = (sector + 2) % grid.SECTORS
    if search.side == ACROSS:
        if step > 1:
            cell = next_cell(cell, (sector + _SIDEWAYS[step - 2]) % grid.SECTORS)
        return cell, _visited_row(table, cells, cell, opposite)
    heading = sector if search.side == BEFORE else opposite
    ahead = next_cell(previous, heading)
    row = _visited_row(table, cells, ahead, sector)
    since = search.now - _ROAD_NS
    if row == NONE or cells[row].time < since:
        for turn in _SIDEWAYS:
            beside = next_cell(ahead, (heading + turn) % grid.SECTORS)
            beside_row = _visited_row(table, cells, beside, sector)
            if beside_row != NONE and cells[beside_row].time >= since:
                return beside, beside_row
    return ahead, row


@refcount_free_inlined
def _visited_row(table: IntArray, cells: RecordArray, cell: int, sector: int) -> int:
    row = find_row(table, cells, cell * grid.SECTORS + sector)
    return NONE if row == NONE or cells[row].vehicles == 0 else row
