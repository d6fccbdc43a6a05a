"""Neighbours of a cell: before and behind it on the road, and in the other direction. Compiled."""

from __future__ import annotations

from typing import Final

from schemas import grid
from schemas.runtime.jit import refcount_free_inlined

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


@refcount_free_inlined
def heading_on(side: int, sector: int) -> int:
    """Return the heading sector of the neighbours on one side of a cell; `sector` is its own."""
    return (sector + 2) % grid.SECTORS if side == ACROSS else sector


@refcount_free_inlined
def step_to(cell: int, previous: int, sector: int, side: int, step: int) -> int:
    """Return the cell of a neighbour of `cell` on one side. `step` is the number of the neighbour,
    counted from 1, and `sector` is the heading sector.

    Before and behind the cell, neighbour k is k cells away. It is found from `previous`, the cell
    of neighbour `step` - 1 (at first `cell` itself). For the opposite direction of the road,
    neighbour 1 is in `cell` itself, because both directions may share a cell. Neighbours 2 and 3
    are in the cells to its left and right.
    """
    if side != ACROSS:
        return next_cell(previous, (sector + 2 * side) % grid.SECTORS)
    if step == 1:
        return cell
    return next_cell(cell, (sector + _SIDEWAYS[step - 2]) % grid.SECTORS)
