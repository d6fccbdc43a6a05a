"""Tests that a late report is not dropped, but counts with its true age."""

from __future__ import annotations

import numpy as np

from fleet_service.fusion import Fusion, Updated, constants
from fleet_service.fusion.fuse import RecordedResult
from fleet_service.serve.alerts import Alerts
from tests.fleet_service.examples import CELL, START, belief, observations, slippery, value
from tests.fleet_service.fusion.test_order import difference, drive

# A report that sets the current time.
LIVE = observations([3600.0], [50], value([0.8]), cell=CELL + 9)


def late(order: np.ndarray, parts: int) -> tuple[Fusion, list[tuple[np.ndarray, Updated]]]:
    """Process a live report, and after it a backlog (old reports) of one hour, in the order `order`
    and divided into `parts` parts. Return the `Fusion` (beliefs about all cells). Return also, for
    each part, the row numbers of its observations and the outcome of their update.
    """
    fusion = Fusion(120.0)
    fusion.update(LIVE)
    o = drive(7, 400, 3000.0)
    return fusion, [(rows, fusion.update(o.take(rows))) for rows in np.array_split(order, parts)]


def test_backlog_of_an_hour_is_fused_in_any_order_of_arrival() -> None:
    straight, updates = late(np.arange(400), 4)
    mixed, _ = late(np.random.default_rng(1).permutation(400), 37)
    assert all(updated.late.all() for _, updated in updates)
    fused = np.concatenate([updated.late_by > 0 for _, updated in updates])
    assert fused.mean() > 0.95
    assert difference(straight, mixed) <= 1e-6


def test_late_visit_to_an_unvisited_cell_counts_as_if_in_time() -> None:
    o = observations([600.0], [1], value([0.2]))
    found = []
    for parts in ((o, LIVE), (LIVE, o)):
        fusion = Fusion(120.0)
        for part in parts:
            fusion.update(part)
        found.append(belief(fusion, now=START + 3600 * 10**9))
    assert 0.5 < slippery(found[0]) < 0.95
    np.testing.assert_allclose(found[0], found[1], atol=0.02)


def judge_after_backlog(present: float, past: float) -> tuple[float, bool]:
    """Let two vehicles report the friction `present` of a cell, and then let the reports of twelve
    other vehicles arrive that measured `past` there 20 to 55 minutes earlier. Return P(slippery) of
    the cell, and True if it has an alert.
    """
    fusion = Fusion(120.0, enrolled=True)
    alerts = Alerts(fusion)
    new = observations([3300.0, 3320.0], [1, 2], value([present, present]))
    who = 10 + np.arange(12)
    old = observations(180.0 * np.arange(12), who, value(np.full(12, past)))
    for part in (new, LIVE, old):
        updated = fusion.update(part)
        alerts.update(updated.slots)
    assert updated.late.all()
    found = belief(fusion, now=START + 3600 * 10**9)
    return slippery(found), bool(alerts.standing_alerts)


def test_backlog_of_dry_road_does_not_hide_the_ice_of_now() -> None:
    probability, has_alert = judge_after_backlog(present=0.15, past=0.8)
    assert probability > 0.8
    assert has_alert


def test_backlog_of_ice_does_not_hide_the_grip_of_now() -> None:
    probability, has_alert = judge_after_backlog(present=0.8, past=0.15)
    assert probability < 0.2
    assert not has_alert


def test_late_reports_of_ice_raise_an_alert_at_the_time_of_the_visits() -> None:
    for mu in (0.15, 0.8):
        fusion = Fusion(120.0, enrolled=True)
        fusion.update(LIVE)
        updated = fusion.update(observations([3000.0, 3060.0], [1, 2], value([mu, mu])))
        assert updated.late.all()
        raised = Alerts(fusion).update(updated.slots)
        assert len(raised) == (mu < 0.4)
        assert all(START + 2990 * 10**9 < alert.time <= START + 3060 * 10**9 for alert in raised)


def test_report_older_than_the_forgetting_time_is_not_fused() -> None:
    fusion = Fusion(120.0)
    fusion.update(observations([constants.CHANGE_S + 1000.0], [50], value([0.8]), cell=CELL + 9))
    updated = fusion.update(observations([100.0], [1], value([0.2])))
    assert updated.late.all()
    assert not updated.late_by.any()
    assert not len(updated.slots)


def test_replay_fuses_late_reports_at_the_same_point() -> None:
    fusion, updates = late(np.random.default_rng(2).permutation(400), 5)
    o = drive(7, 400, 3000.0)
    n = 400
    found = RecordedResult(np.zeros(n, bool), np.zeros(n, np.int64), np.zeros(n, np.float32))
    for rows, updated in updates:
        found.late[rows] = updated.late
        found.late_by[rows] = updated.late_by
        found.weight[rows] = updated.weight
    again = Fusion(120.0)
    first = again.update(LIVE)
    assert not first.late.any()
    again.update(o, found)
    assert difference(fusion, again) <= 1e-6
