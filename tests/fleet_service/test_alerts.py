"""When an alert begins and ends."""

from __future__ import annotations

import numpy as np

from fleet_service.alerts import Alerts
from fleet_service.fusion import Fusion
from tests.fleet_service.examples import CELL, SECOND, START, at_least, observations, value

HOUR = 3600 * SECOND


def icy(vehicles: list[int]) -> tuple[Fusion, Alerts, list[bool]]:
    """A cell that these vehicles called icy, one after the other; and whether each of them raised an alert."""
    fusion = Fusion(120.0)
    alerts = Alerts(fusion)
    raised = []
    for k, vehicle in enumerate(vehicles):
        folded = fusion.fold(observations([10.0 * k], [vehicle], value([0.2])))
        raised.append(any(alert.raised for alert in alerts.folded(folded.slots)))
    return fusion, alerts, raised


def test_the_second_vehicle_raises_the_alert_and_it_is_raised_once() -> None:
    _, alerts, raised = icy([1, 2, 3, 4])
    assert raised == [False, True, False, False]
    assert alerts.raised == {0}


def test_one_vehicle_with_many_unexcited_witnesses_raises_nothing() -> None:
    fusion, alerts, raised = icy([1] * 20)
    folded = fusion.fold(observations(300.0 + np.arange(20), np.arange(2, 22), at_least(np.full(20, 0.1))))
    assert not alerts.folded(folded.slots)
    assert not any(raised)
    assert fusion.live.vehicles[0] == 21


def test_an_alert_that_nobody_confirms_ends_by_itself_with_the_reason() -> None:
    _, alerts, _ = icy([1, 2, 3])
    assert not alerts.faded(START + HOUR // 4)
    (ended,) = alerts.faded(START + 6 * HOUR)
    assert (ended.cell, ended.raised, ended.reason) == (CELL, False, "no visit has confirmed it for too long")
    assert not alerts.faded(START + 7 * HOUR)


def test_between_the_two_limits_an_alert_stays() -> None:
    fusion, alerts, _ = icy([1, 2, 3])
    folded = fusion.fold(observations([100.0], [4], value([0.85])))
    assert not alerts.folded(folded.slots)
    assert alerts.raised == {0}


def test_old_ice_is_no_witness_for_new_ice() -> None:
    fusion, alerts, _ = icy([1, 2])
    alerts.faded(START + 6 * HOUR)
    folded = fusion.fold(observations([6 * 3600.0 + k for k in range(3)], [3, 3, 3], value([0.2, 0.2, 0.2])))
    assert not alerts.folded(folded.slots)


def test_what_many_called_dry_takes_three_witnesses() -> None:
    fusion = Fusion(120.0)
    alerts = Alerts(fusion)
    fusion.fold(observations(np.arange(20) * 30.0, np.arange(20), value(np.full(20, 0.85))))
    raised = []
    for vehicle in range(8):
        folded = fusion.fold(observations([900.0 + 10.0 * vehicle], [vehicle], value([0.2])))
        raised.append(any(alert.raised for alert in alerts.folded(folded.slots)))
    assert True in raised
    assert raised.index(True) >= 2


def test_an_alert_ends_only_when_grip_is_sure() -> None:
    fusion, alerts, _ = icy([1, 2, 3])
    ended = []
    for vehicle in range(10, 18):
        folded = fusion.fold(observations([200.0 + 10.0 * vehicle], [vehicle], value([0.85])))
        ended += alerts.folded(folded.slots)
    (only,) = ended
    assert (only.raised, only.reason) == (False, "later visits found grip")
    assert only.p_slippery < 0.05
