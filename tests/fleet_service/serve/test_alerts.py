"""Tests of alerts. An alert must begin when enough independent vehicles report ice. It must end
only when grip is certain or no vehicle confirms the ice any more.
"""

from __future__ import annotations

import numpy as np
import pytest

from fleet_service.fusion import Fusion
from fleet_service.fusion.store.records import Side
from fleet_service.serve.alerts import LIKELY, RAISE_ABOVE, Alerts
from schemas import grid, mugrid
from tests.fleet_service.examples import (
    CELL,
    SECOND,
    START,
    at_least,
    belief,
    observations,
    slippery,
    value,
)

HOUR = 3600 * SECOND
COLUMN, ROW = (int(part[0]) for part in grid.deinterleave(np.array([CELL])))


def icy(vehicles: list[int]) -> tuple[Fusion, Alerts, list[bool]]:
    """Let the vehicles with the given numbers report ice in a cell, one after the other. Return the
    fusion (beliefs about all cells), its alerts, and one value per vehicle: True if its report
    raised an alert.
    """
    fusion = Fusion(120.0)
    alerts = Alerts(fusion)
    raised = []
    for k, vehicle in enumerate(vehicles):
        updated = fusion.update(observations([10.0 * k], [vehicle], value([0.2])))
        raised.append(any(alert.raised for alert in alerts.update(updated.slots)))
    return fusion, alerts, raised


def test_the_second_vehicle_raises_the_alert_and_it_is_raised_once() -> None:
    _, alerts, raised = icy([1, 2, 3, 4])
    assert raised == [False, True, False, False]
    assert alerts.slots == {0}


def test_alert_is_judged_by_the_belief_about_the_road() -> None:
    # These cells are too far apart to influence each other.
    fusion = Fusion(120.0)
    cells = 64 * np.arange(40)
    for vehicle in range(3):
        fusion.update(
            observations(
                20.0 * vehicle + cells / 256,
                cells * 9 + vehicle,
                value(cells / 2560 + 0.1),
                CELL + cells,
            )
        )
    alerts = Alerts(fusion)
    slots = np.arange(fusion.size)
    believed = fusion.beliefs_at_last_report(slots) @ mugrid.SLIPPERY_SHARE
    assert fusion.slippery(slots) == pytest.approx(believed, abs=1e-9)
    shares = {alert.cell: float(alert.reason.split()[4]) for alert in alerts.update(slots)}
    known = {
        int(c): round(float(p), 2)
        for c, p in zip(fusion.cell, believed, strict=True)
        if p > RAISE_ABOVE
    }
    assert shares.items() <= known.items()
    # Evidence below 1 nat supports no alert.
    assert {cell for cell, p in known.items() if p > 0.95} <= set(shares)
    assert 0 < len(shares) < fusion.size


def test_one_vehicle_with_many_unexcited_others_raises_nothing() -> None:
    fusion, alerts, raised = icy([1] * 20)
    updated = fusion.update(
        observations(300.0 + np.arange(20), np.arange(2, 22), at_least(np.full(20, 0.1)))
    )
    assert not alerts.update(updated.slots)
    assert not any(raised)
    assert fusion.live.vehicles[0] == 21


def test_unconfirmed_alert_ends_by_itself_with_the_reason() -> None:
    _, alerts, _ = icy([1, 2, 3])
    assert not alerts.expire(START + HOUR // 4)
    (ended,) = alerts.expire(START + 6 * HOUR)
    assert (ended.cell, ended.raised, ended.reason) == (
        CELL,
        False,
        "no recent visit has confirmed the alert",
    )
    assert not alerts.expire(START + 7 * HOUR)


def test_between_the_two_limits_an_alert_stays() -> None:
    fusion, alerts, _ = icy([1, 2, 3])
    updated = fusion.update(observations([100.0], [4], value([0.85])))
    assert not alerts.update(updated.slots)
    assert alerts.slots == {0}


def test_old_ice_does_not_corroborate_new_ice() -> None:
    fusion, alerts, _ = icy([1, 2])
    alerts.expire(START + 6 * HOUR)
    updated = fusion.update(
        observations([6 * 3600.0 + k for k in range(3)], [3, 3, 3], value([0.2, 0.2, 0.2]))
    )
    assert not alerts.update(updated.slots)


def report_in_turn(
    mu: float, vehicles: range, then: float, others: range, wait: float = 400.0
) -> tuple[Fusion, list[bool]]:
    """Let each of `vehicles` report the friction `mu` in a cell. After `wait` seconds, let each of
    `others` report the friction `then` there. Return the fusion (beliefs about all cells), and one
    value for each of `others`: True if the cell had an alert after its report.
    """
    fusion = Fusion(120.0)
    alerts = Alerts(fusion)
    under = []
    for k, vehicle in enumerate([*vehicles, *others]):
        later = k >= len(vehicles)  # by then the first vehicles are known
        updated = fusion.update(
            observations([20.0 * k + wait * later], [vehicle], value([then if later else mu]))
        )
        alerts.update(updated.slots)
        under.append(bool(alerts.slots))
    return fusion, under[len(vehicles) :]


def test_two_witnesses_of_new_ice_raise_an_alert_on_a_dry_road() -> None:
    _, under = report_in_turn(0.85, range(20), 0.2, range(5, 11), wait=700.0)
    assert under == [False, True, True, True, True, True]


def test_dry_witnesses_of_the_last_minutes_ask_for_four_witnesses_of_ice() -> None:
    fusion, under = report_in_turn(0.85, range(20), 0.2, range(5, 11), wait=200.0)
    assert slippery(belief(fusion)) > 0.9
    assert under == [False, False, False, True, True, True]


@pytest.mark.parametrize(
    ("drivers", "found", "raised"), [(3, 0, False), (3, 1, False), (3, 2, True), (6, 2, False)]
)
def test_neighbours_confirm_two_reports_of_ice_that_outweigh_the_past(
    drivers: int, found: int, raised: bool
) -> None:
    fusion = Fusion(120.0)
    (before, here, behind) = grid.interleave(COLUMN + np.arange(-1, 2), np.full(3, ROW)).tolist()
    for cell in (before, here, behind):  # on this road vehicles used more grip than ice has
        seconds = 20.0 * np.arange(drivers)
        fusion.update(
            observations(seconds, np.arange(drivers), at_least(np.full(drivers, 0.5)), cell)
        )
    for cell, vehicles in ((before, 4), (behind, 4), (here, found)):
        seconds = 150.0 + 20.0 * np.arange(vehicles)
        fusion.update(
            observations(seconds, 50 + np.arange(vehicles), value([0.2] * vehicles), cell)
        )
    slots = fusion.slots_of(np.array([here]), np.array([0]))
    own = float(fusion.slippery(slots)[0])
    believed = float(fusion.beliefs_at_last_report(slots)[0] @ mugrid.SLIPPERY_SHARE)
    assert own < 0.5
    assert believed > RAISE_ABOVE or not found
    assert bool(Alerts(fusion).update(slots)) is raised is (own > LIKELY and found == 2)


def test_bounds_clear_an_alert_when_only_a_dry_road_gives_so_much_grip() -> None:
    for used, stands in ((0.7, False), (0.5, True)):
        fusion, alerts, _ = icy([1, 2, 3])
        # These reports change the belief to a dry road.
        updated = fusion.update(observations([100.0, 101.0], [4, 5], value([0.85, 0.85])))
        later = fusion.update(
            observations(200.0 + np.arange(8), np.arange(6, 14), at_least(np.full(8, used)))
        )
        alerts.update(updated.slots)
        alerts.update(later.slots)
        assert bool(alerts.slots) is stands


@pytest.mark.parametrize(("icy", "needed"), [(2, 4), (20, 5)])
def test_an_alert_ends_with_two_more_sources_of_grip_than_of_ice(icy: int, needed: int) -> None:
    fusion, under = report_in_turn(0.2, range(icy), 0.85, range(5, 11), 700.0)
    assert slippery(belief(fusion)) < 0.05
    assert under == [True] * (needed - 1) + [False] * (7 - needed)


@pytest.mark.parametrize("slope", [0, 1])
@pytest.mark.parametrize(
    ("beside", "grip_used", "alerted"),
    [(0.2, False, [True, True]), (0.85, False, [False, False]), (0.2, True, [False, False])],
)
def test_one_source_of_ice_in_each_of_two_near_cells_suffices(
    beside: float, grip_used: bool, alerted: list[bool], slope: int
) -> None:
    fusion = Fusion(120.0)
    alerts = Alerts(fusion)
    cells = grid.interleave(COLUMN + np.array([0, 2]), ROW + slope * np.array([0, 1]))
    if grip_used:
        for cell in cells.tolist():
            fusion.update(observations([0.0], [9], at_least(np.array([0.8])), cell))
    for vehicle, cell, mu in ((1, int(cells[0]), 0.2), (2, int(cells[1]), beside)):
        updated = fusion.update(observations([10.0 * vehicle], [vehicle], value([mu]), cell))
        alerts.update(updated.slots)
    slots = fusion.slots_of(cells, np.zeros(2, np.int64))
    assert [slot in alerts.slots for slot in slots.tolist()] == alerted


@pytest.mark.parametrize(
    ("sector", "mu", "alerted"),
    [(2, 0.2, [True, True]), (1, 0.2, [False, False]), (2, 0.85, [False, False])],
)
def test_one_source_of_ice_in_each_direction_of_a_road_suffices(
    sector: int, mu: float, alerted: list[bool]
) -> None:
    fusion = Fusion(120.0)
    alerts = Alerts(fusion)
    cells = grid.interleave(np.full(2, COLUMN), ROW + np.arange(2))
    sectors = np.array([0, sector])
    for vehicle, reported in ((0, 0.2), (1, mu)):
        o = observations([10.0 * vehicle], [vehicle], value([reported]), int(cells[vehicle]))
        o.sector[:] = sectors[vehicle]
        alerts.update(fusion.update(o).slots)
    slots = fusion.slots_of(cells, sectors)
    assert [slot in alerts.slots for slot in slots.tolist()] == alerted


def test_a_cell_between_two_sources_needs_none_of_its_own() -> None:
    fusion = Fusion(120.0)
    alerts = Alerts(fusion)
    cells = grid.interleave(COLUMN + np.arange(4), np.full(4, ROW))
    bounds = at_least(np.array([0.1]))
    for step in (1, 3):
        fusion.update(observations([float(step)], [9], bounds, int(cells[step])))
    for vehicle, step in ((1, 0), (2, 2), (3, 0), (4, 2)):
        seconds = [10.0 * vehicle]
        updated = fusion.update(observations(seconds, [vehicle], value([0.2]), int(cells[step])))
        alerts.update(updated.slots)
    slots = fusion.slots_of(cells, np.zeros(4, np.int64))
    assert [slot in alerts.slots for slot in slots.tolist()] == [True, True, True, False]


def test_one_vehicle_along_a_stretch_raises_no_alert() -> None:
    fusion = Fusion(120.0)
    alerts = Alerts(fusion)
    for step, cell in enumerate(grid.interleave(COLUMN + np.arange(4), np.full(4, ROW)).tolist()):
        alerts.update(fusion.update(observations([float(step)], [1], value([0.2]), cell)).slots)
    assert not alerts.slots


def test_a_vehicle_without_trust_no_longer_corroborates() -> None:
    fusion, _ = report_in_turn(0.2, range(4), 0.2, range(0))
    slot = np.zeros(1, np.int64)
    assert (fusion.sources(slot, Side.ICE, 0) > 0).sum() == 4
    rng = np.random.default_rng(3)
    for cell in range(40):  # elsewhere the first two vehicles report ice as dry
        who = rng.permutation(12)
        mu = np.where(who < 2, 0.9, 0.2 + 0.02 * rng.normal(size=12))
        fusion.update(observations(200.0 + 20.0 * cell + np.arange(12), who, value(mu), cell=cell))
    assert fusion.trust(0) < 0.5 < fusion.trust(2)
    assert (fusion.sources(slot, Side.ICE, 0) > 0).sum() == 2


def test_an_alert_ends_only_when_grip_is_sure() -> None:
    fusion, alerts, _ = icy([1, 2, 3])
    ended = []
    for vehicle in range(10, 18):
        updated = fusion.update(observations([200.0 + 10.0 * vehicle], [vehicle], value([0.85])))
        ended += alerts.update(updated.slots)
    (only,) = ended
    assert (only.raised, only.reason) == (False, "later visits measured good grip")
    assert only.p_slippery < 0.05
