"""Tests of values that unvisited cells borrow from their neighbours. The influence of a neighbour
must fall with its distance. A borrowed value must be marked as borrowed, and must never be more
certain than the neighbours' own values.
"""

from __future__ import annotations

import numpy as np

from fleet_service.fusion import Fusion
from fleet_service.lab.drive import CELL
from fleet_service.serve.neighbour_fill import PRIOR_SHARE, REACH, impute_cells
from fleet_service.serve.view import CellView
from schemas import grid, mugrid
from schemas.numeric import IntArray
from tests.fleet_service.examples import observations, value

EAST: IntArray = grid.interleave(
    grid.deinterleave(CELL[:1])[0] + np.arange(30), np.repeat(grid.deinterleave(CELL[:1])[1], 30)
)
ROUTE = EAST * grid.SECTORS


def borrow_beliefs(visited: dict[int, float], route: IntArray | None = ROUTE) -> CellView:
    """Let three vehicles measure friction in some cells of a row of thirty. Return the beliefs that
    unvisited cells borrow, that is, that are estimated from these neighbours.

    Args:
        visited: measured friction by index of the cell in the row.
        route: keys of the cells to estimate; None for the cells next to visited ones.
    """
    fusion = Fusion(120.0)
    for place, mu in visited.items():
        o = observations(
            np.arange(3) * 2.0, np.arange(3), value(np.full(3, mu)), cell=int(EAST[place])
        )
        fusion.update(o)
    now = int(fusion.live.time[: fusion.size].max())
    slots = np.arange(fusion.size)
    tile = int(grid.tile_of(EAST[0]))
    assert (grid.tile_of(EAST) == tile).all()
    return impute_cells(fusion, tile, slots, route, now)


def widths(cells: CellView) -> dict[int, float]:
    """Return the width of the friction interval of each cell in `cells`, by index of the cell in
    the row of thirty cells.
    """
    lower, upper = (mugrid.quantiles(cells.belief, q) for q in (0.05, 0.95))
    return {
        int(np.flatnonzero(c == EAST)[0]): w for c, w in zip(cells.cell, upper - lower, strict=True)
    }


def test_along_a_route_a_cell_borrows_the_less_the_further_it_is() -> None:
    cells = borrow_beliefs({5: 0.3})
    assert cells.imputed.all()
    near = cells.belief[np.argsort(cells.cell)] @ (mugrid.CENTRES < 0.4)
    place = np.sort([np.flatnonzero(c == EAST)[0] for c in cells.cell])
    assert place.tolist() == [*range(5), *range(6, 6 + REACH)]
    behind = near[place > 5]
    assert (np.diff(behind) < 0.0).all()
    assert behind[0] < PRIOR_SHARE * 0.31 + (1.0 - PRIOR_SHARE)
    assert behind[-1] > mugrid.PRIOR @ (mugrid.CENTRES < 0.4)


def test_belief_between_two_surfaces_excludes_a_third() -> None:
    cells = borrow_beliefs({5: 0.2, 12: 0.9})
    found = {
        int(np.flatnonzero(c == EAST)[0]): b for c, b in zip(cells.cell, cells.belief, strict=True)
    }
    between = found[8]
    third = np.abs(mugrid.CENTRES - 0.55) < 0.1
    assert between[third].max() <= mugrid.PRIOR[0]
    assert between[np.abs(mugrid.CENTRES - 0.2) < 0.05].max() > mugrid.PRIOR[0]
    assert between[np.abs(mugrid.CENTRES - 0.9) < 0.05].max() > mugrid.PRIOR[0]


def test_only_adjoining_cells_are_borrowed_without_a_route() -> None:
    cells = borrow_beliefs({5: 0.3}, route=None)
    assert len(cells.cell) == 8
    assert set(widths(borrow_beliefs({5: 0.3}))) >= {4, 6}
