"""Tests of privacy. Readers must not notice a lone vehicle in any value that they see, with one
exception: it may make a cell look more slippery.
"""

from __future__ import annotations

import numpy as np
import pytest

from fleet_service.fusion import Fusion
from fleet_service.serve.public_cells import PERIOD_NS, PublicCells
from fleet_service.serve.visitors import PART_NS, Visitors
from schemas import mugrid
from schemas.numeric import IntArray
from tests.fleet_service.examples import CELL, SECOND, START, observations, value

K = 3
LATER_S = 2 * PERIOD_NS / SECOND


class Map:
    """Beliefs about some cells (a `Fusion`), together with the public copy of these cells that
    readers see.
    """

    def __init__(self) -> None:
        self.fusion = Fusion(120.0)
        self.public = PublicCells(self.fusion, Visitors(self.fusion), K)

    def visit(self, second: float, *vehicles: int, mu: float = 0.8, cell: int = CELL) -> None:
        o = observations(
            np.full(len(vehicles), second), vehicles, value([mu] * len(vehicles)), cell
        )
        with self.public.follow(o):
            self.fusion.update(o)

    def seen(self, second: float, cell: int = CELL) -> list[float]:
        """Return three values of a cell as readers see them at the time `second`: lower end and
        upper end of its friction (in bins of the friction grid), and P(slippery). Return an empty
        list if the cell is not public.
        """
        now = START + int(second * SECOND)
        slot = self.public.select(self.slots(cell), now)
        if not len(slot):
            return []
        found = self.public.beliefs(slot, now)
        share = found.cumsum(axis=1)[0]
        return [*np.interp((0.05, 0.95), share, np.arange(32)), *(found @ mugrid.SLIPPERY_SHARE)]

    def slots(self, cell: int = CELL) -> IntArray:
        return self.fusion.slots_of(np.array([cell]), np.array([0]))


@pytest.fixture
def busy() -> Map:
    """Return a map with one public cell (a cell that readers see), which five vehicles visited
    before it was published.
    """
    made = Map()
    made.visit(0.0, 1, 2, 3, 4, 5)
    assert made.seen(1.0) == []
    assert made.seen(LATER_S)
    return made


def test_lone_vehicles_do_not_show_and_the_belief_ages(busy: Map) -> None:
    at = (LATER_S + 10.0, LATER_S + 5000.0)
    other = Map()
    other.visit(0.0, 1, 2, 3, 4, 5)
    expected = [other.seen(LATER_S)] + [other.seen(second) for second in at]
    for turn in range(20):
        busy.visit(LATER_S + turn, 6)
    busy.visit(LATER_S + 30, 7)
    assert [busy.seen(second) for second in at] == expected[1:]


def test_enough_vehicles_show_at_the_next_moment(busy: Map) -> None:
    before = busy.seen(LATER_S + 40)
    busy.visit(LATER_S + 20, 6, 7, 8)
    assert busy.seen(LATER_S + 40) == before
    after = busy.seen(2 * LATER_S)
    assert after[1] - after[0] < before[1] - before[0]


def test_third_vehicle_alone_in_its_tile_does_not_trigger_publication(busy: Map) -> None:
    busy.visit(LATER_S + 20, 6, 7, cell=CELL)
    busy.visit(LATER_S + 21, 11, 12, 13, cell=CELL + 1)
    assert busy.seen(2 * LATER_S, CELL + 1)
    busy.visit(2 * LATER_S + 1, 8)
    before = busy.seen(2 * LATER_S + 2)
    assert busy.seen(3 * LATER_S)[1] >= before[1], "three visited the cell, one of them lately"


@pytest.mark.parametrize("mu", [0.12, 0.45])
def test_less_grip_shows_at_once(busy: Map, mu: float) -> None:
    before = busy.seen(LATER_S + 9)
    busy.visit(LATER_S + 10, 6, mu=mu)
    after = busy.seen(LATER_S + 10)
    assert after[2] > before[2]
    assert after[0] < before[0]


def test_cell_forgotten_by_day_does_not_return_with_one_vehicle(busy: Map) -> None:
    night = 2 * PART_NS / SECOND
    assert busy.seen(night) == []
    busy.visit(night, 1)
    busy.visit(night + 1, 2)
    busy.visit(night + 2, 3)
    assert busy.seen(night + 3) == []
    assert busy.seen(night + LATER_S)


def test_dropped_slots_release_their_memory(busy: Map) -> None:
    busy.visit(LATER_S + 1, 6)
    busy.visit(LATER_S + 1, 6, cell=CELL + 1)
    before = busy.seen(LATER_S + 5)
    dropped = np.zeros(busy.fusion.size, bool)
    dropped[busy.slots(CELL + 1)] = True
    busy.public.renumber(busy.fusion.drop(dropped))
    assert busy.seen(LATER_S + 5) == before
