"""Tests that reports of ice in neighbouring cells make a cell more probably slippery, within the
documented limits.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_service.fusion import Fusion, neighbours
from fleet_service.fusion.adjacent import next_cell
from fleet_service.fusion.constants import NEIGHBOURS, UNSURE
from fleet_service.fusion.weather import Reports
from schemas import grid, mugrid
from schemas.numeric import FloatArray
from schemas.thresholds import NS
from tests.fleet_service.examples import (
    CELL,
    REGION,
    START,
    at_least,
    belief,
    interval,
    observations,
    slippery,
    value,
)

X, Y = (int(part[0]) for part in grid.deinterleave(np.array([CELL])))
DIRECTIONS = ((1, 0), (0, -1), (-1, 0), (0, 1))  # direction of each sector in columns and rows
UNTESTED = at_least([0.3])  # lower bound from one gentle driver


def east(steps: int, north: int = 0) -> int:
    """Return the number of the cell that lies `steps` cells to the east and `north` cells to the
    north of the cell CELL.
    """
    return int(grid.interleave(np.array([X + steps]), np.array([Y - north]))[0])


def road(found: dict[int, FloatArray], sector: int = 0) -> Fusion:
    """Return a fusion (beliefs about all cells) after vehicles visited cells east of CELL.

    Args:
        found: log-likelihoods (n, 32) of the visits to a cell, by the number of steps east of CELL;
            new vehicles visit each cell.
        sector: heading sector of the visits.
    """
    fusion = Fusion(120.0)
    for steps, likelihoods in found.items():
        tell(fusion, east(steps), likelihoods, sector)
    return fusion


def cell_at(along: int, left: int, sector: int) -> int:
    """Return the number of the cell that lies `along` cells ahead and `left` cells to the left of
    the cell CELL, seen in the direction of a heading sector.
    """
    dx, dy = DIRECTIONS[sector]
    return east(along * dx + left * dy, north=left * dx - along * dy)


def tell(fusion: Fusion, cell: int, likelihoods: FloatArray, sector: int = 0) -> None:
    vehicles = cell % 1000 * 100 + np.arange(len(likelihoods))
    o = observations(5.0 * np.arange(len(likelihoods)), vehicles, likelihoods, cell)
    o.sector[:] = sector
    fusion.update(o)


def snow(vehicles: int = 4) -> FloatArray:
    return value([0.3] * vehicles)


def dry(vehicles: int = 4) -> FloatArray:
    return value([0.85] * vehicles)


@given(st.integers(0, (1 << 21) - 1), st.integers(1, (1 << 21) - 2), st.integers(0, 3))
def test_the_next_cell_lies_in_the_sectors_direction(x: int, y: int, sector: int) -> None:
    dx, dy = DIRECTIONS[sector]
    expected = grid.interleave(np.array([(x + dx) % (1 << 21)]), np.array([y + dy]))[0]
    assert next_cell(int(grid.interleave(np.array([x]), np.array([y]))[0]), sector) == expected


def test_an_untested_cell_between_snow_is_probably_slippery() -> None:
    alone, one, both = (
        slippery(belief(road({0: UNTESTED} | {k: snow() for k in sides})))
        for sides in ((), (1,), (-1, 1))
    )
    assert alone < 0.21
    assert alone + 0.3 < one < both
    assert both > 0.9


def test_many_visits_without_a_value_weaken_a_message_to_unsure() -> None:
    p_slippery = [
        slippery(belief(road({0: at_least([0.05] * visits), 1: snow(9)}))) for visits in (1, 4, 9)
    ]
    assert np.all(np.diff(p_slippery) < 0.0)
    assert p_slippery[0] > 0.6
    assert p_slippery[-1] == pytest.approx(UNSURE, abs=0.05)


def test_influence_of_a_neighbour_falls_with_distance() -> None:
    p_slippery = [
        slippery(belief(road({0: UNTESTED, steps: snow()}))) for steps in range(1, NEIGHBOURS + 2)
    ]
    assert np.all(np.diff(p_slippery) < 0.0)
    assert p_slippery[-1] == slippery(belief(road({0: UNTESTED})))


def test_snow_in_the_opposite_direction_lowers_the_belief() -> None:
    fusion = road({0: UNTESTED})
    tell(fusion, east(0, north=1), snow(), sector=2)
    assert slippery(belief(fusion)) > 0.4
    across = road({0: UNTESTED})
    tell(across, east(0, north=1), snow(), sector=1)
    assert slippery(belief(across)) < 0.21


@pytest.mark.parametrize("sector", range(4))
@pytest.mark.parametrize("slope", [-1, 1])
def test_messages_follow_a_road_that_runs_diagonally_to_the_grid(slope: int, sector: int) -> None:
    fusion = Fusion(120.0)
    for k in (-2, -1, 1, 2):
        tell(fusion, cell_at(k, slope * k, sector), snow(), sector)
    tell(fusion, CELL, UNTESTED, sector)
    assert slippery(belief(fusion, sector=sector)) > 0.9


def test_straight_road_ignores_cells_at_its_side() -> None:
    fusion = road({0: UNTESTED, 1: dry(), -1: dry()})
    for along in (-1, 1):
        tell(fusion, cell_at(along, 1, 0), snow())
    assert slippery(belief(fusion)) == slippery(belief(road({0: UNTESTED})))


@pytest.mark.parametrize("others", [dry(), UNTESTED, at_least([0.02] * 9), np.zeros((3, 32))])
def test_neighbours_without_slippery_road_change_no_belief(others: FloatArray) -> None:
    alone = belief(road({0: UNTESTED}))
    among = belief(road({0: UNTESTED} | dict.fromkeys((-2, -1, 1, 2), others)))
    assert among == pytest.approx(alone, abs=2e-3)
    assert interval(among)[1] == pytest.approx(interval(alone)[1], abs=2e-3)


def test_a_cell_whose_own_visitors_found_grip_keeps_it() -> None:
    between = belief(road({0: dry(), -1: snow(9), 1: snow(9)}))
    assert slippery(between) < 0.02
    assert interval(between)[0] > 0.6


def one_report_of_ice(grip_s: float, ice_s: float) -> float:
    """Return P(slippery) of a cell next to ice after one vehicle reported ice in this cell too.
    Before this, four vehicles reported grip there from `grip_s` [s] on, and four vehicles reported
    ice in the next cell from `ice_s` [s] on.
    """
    fusion = Fusion(120.0)
    four = 20.0 * np.arange(4)
    likelihoods = value([0.85] * 4 + [0.15] * 5, 0.03)
    seconds = np.concatenate([grip_s + four, ice_s + four, [900.0]])
    cells = np.array([CELL] * 4 + [east(1)] * 4 + [CELL])
    order = np.argsort(seconds)
    o = observations(seconds[order], np.arange(9)[order], likelihoods[order])
    o.cell[:] = cells[order]
    fusion.update(o)
    return slippery(belief(fusion))


@pytest.mark.parametrize(("grip_s", "is_known"), [(500.0, True), (0.0, False)])
def test_no_message_crosses_a_known_border(grip_s: float, *, is_known: bool) -> None:
    seconds = np.append(500.0 - grip_s + 20.0 * np.arange(4), grip_s + 20.0 * np.arange(4))
    o = observations(seconds, np.arange(8), value([0.15] * 4 + [0.75] * 4, 0.05))
    o.cell[:4] = east(1)
    order = np.argsort(seconds)
    among = Fusion(120.0)
    alone = Fusion(120.0)
    among.update(o.take(order))
    alone.update(o.take(order[order >= 4]))
    assert np.array_equal(belief(among), belief(alone)) == is_known


def test_ice_beyond_a_known_border_does_not_confirm_a_report() -> None:
    assert one_report_of_ice(grip_s=500.0, ice_s=0.0) < 0.3


def test_ice_that_is_newer_than_the_grip_confirms_a_report() -> None:
    assert one_report_of_ice(grip_s=0.0, ice_s=500.0) > 0.8


def test_grip_ends_a_stretch() -> None:
    past = slippery(belief(road({0: UNTESTED, 1: dry(), 2: snow()})))
    assert past == slippery(belief(road({0: UNTESTED})))


def test_a_message_is_of_a_neighbours_own_reports() -> None:
    far = road(
        {0: UNTESTED}
        | dict.fromkeys(range(1, NEIGHBOURS + 1), UNTESTED)
        | {NEIGHBOURS + 1: snow(9)}
    )
    near = [slippery(belief(far, east(k))) for k in range(NEIGHBOURS, -1, -1)]
    assert near[0] > 0.4
    assert near[-1] == slippery(belief(road({0: UNTESTED})))


def test_reading_a_belief_does_not_change_the_stored_one() -> None:
    fusion = road({0: UNTESTED, 1: snow()})
    before = fusion.live.belief.copy()
    alone = road({0: UNTESTED})
    assert slippery(belief(fusion)) > 0.4
    np.testing.assert_array_equal(fusion.live.belief, before)
    np.testing.assert_array_equal(fusion.live.belief[0], alone.live.belief[0])
    assert fusion.slippery(np.array([0]))[0] == alone.slippery(np.array([0]))[0]


def test_weather_prior_is_not_counted_again_from_neighbours() -> None:
    prior = np.where(mugrid.CENTRES < 0.4, 1.0, 0.1)
    one = np.ones(1, np.int64)
    nan = np.full(1, np.nan)
    alone = road({})
    among = road({})
    for fusion, cells in ((alone, [0]), (among, [-1, 0, 1])):
        fusion.update_weather(Reports(one * REGION, one * START, nan, nan, nan, prior[None]))
        for steps in cells:
            tell(fusion, east(steps), at_least([0.1]))
    assert slippery(belief(alone)) > 0.5
    assert slippery(belief(among)) == pytest.approx(slippery(belief(alone)), abs=0.02)


def interval_width(p: FloatArray) -> float:
    """Return the width of the 90 % interval of a belief (32,)."""
    lower, upper = interval(p)
    return upper - lower


def test_a_measured_neighbour_narrows_the_interval_of_a_measured_cell() -> None:
    one = value([0.6, 0.6], 0.1)
    alone = belief(road({0: one}))
    between = belief(road({-1: one, 0: one, 1: one}))
    assert interval_width(between) < 0.95 * interval_width(alone)
    assert interval(between)[0] < 0.6 < interval(between)[1]


def test_a_measured_dry_neighbour_does_not_make_a_bound_dry() -> None:
    dry = value(np.full(5, 0.9), 0.05)
    alone = interval(belief(road({0: UNTESTED})))
    assert interval(belief(road({-1: dry, 0: UNTESTED, 1: dry})))[0] <= alone[0] + 1e-9


@pytest.mark.parametrize("own", [0.15, 0.3, 0.38, 0.42, 0.6, 0.9])
@pytest.mark.parametrize("next_to", [0.15, 0.42, 0.9])
@pytest.mark.parametrize("count", [1, 6])
def test_measured_neighbours_do_not_change_p_slippery(
    own: float, next_to: float, count: int
) -> None:
    others = value(np.full(count, next_to), 0.05)
    fusion = road({-1: others, 1: others, 0: value([own, own], 0.05)})
    slot = fusion.slots_of(np.array([CELL]), np.array([0]))
    without = slippery(fusion.beliefs_at_last_report(slot)[0])
    now = int(fusion.live.time[slot[0]])
    assert slippery(fusion.beliefs(slot, now)[0]) == pytest.approx(without, abs=1e-9)


def test_values_that_faded_are_not_refreshed_by_a_neighbour() -> None:
    fusion = road({0: value([0.3, 0.3], 0.05)})
    week = 7 * 24 * 3600.0
    fusion.update(observations([week], [9], value([0.7], 0.05), east(1)))
    now = START + int(week * 1e9)
    slot = fusion.slots_of(np.array([CELL]), np.array([0]))
    assert np.allclose(fusion.beliefs(slot, now)[0], mugrid.PRIOR, atol=1e-4)


def test_a_reading_of_many_cells_equals_readings_of_single_cells(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fusion = road({k: (snow() if k % 7 < 3 else dry()) for k in range(12)} | {12: UNTESTED})
    slots = np.arange(fusion.size)
    now = START + 3600 * NS
    single = np.concatenate([fusion.beliefs(slots[k : k + 1], now) for k in slots])
    assert np.array_equal(fusion.beliefs(slots, now), single)
    # The result does not depend on how many aged beliefs are kept.
    monkeypatch.setattr(neighbours, "_TILE_CELLS", 3)
    assert np.array_equal(fusion.beliefs(slots, now), single)
