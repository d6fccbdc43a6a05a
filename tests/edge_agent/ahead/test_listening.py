"""Tests of the demo's town with cars that receive the map: such a car must not publish the
received map as its own measurement, and the figures about these cars must be correct.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_agent.lab.simulation.listeners import WarnedDrivers
from tests.benchmarks.ahead import listening
from tests.benchmarks.ahead.listening import Drive, ListeningTown, measure


@pytest.mark.campaign
def test_town_warned_by_its_own_map_makes_the_same_map_bit_for_bit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A town whose cars receive the map must make the same map as one whose cars receive none. The
    drivers do not react to warnings, because a driver who reacts produces other measurements.
    """
    monkeypatch.setattr(listening, "ASKED_S", 4.0)
    hearing, deaf = (
        ListeningTown("test", 12, 3, listening=hears, rough=0.0) for hears in (True, False)
    )
    hearing.drivers = WarnedDrivers(hearing.fleet, 0.0)
    with_ = hearing.run(40.0)
    without = deaf.run(40.0)
    assert hearing.received_map.alerts
    assert len(with_.known_error) > 50, "cells that the map knew, and that it told"
    assert not deaf.received_map.cells
    assert with_.visits == without.visits > 500
    slots = np.arange(hearing.fusion.size)
    one, other = (town.fusion.beliefs(slots, town._now()) for town in (hearing, deaf))
    assert np.array_equal(one, other)
    assert with_.inside == without.inside
    assert with_.passed == without.passed != set()


def test_the_figures_count_vehicles_that_slid_and_cells_that_are_covered() -> None:
    with_ = [
        Drive(
            {(1, 1)},
            {(1, 1), (2, 1), (3, 1)},
            3.0,
            [True] * 90 + [False] * 10,
            900,
            2,
            4,
            [(0.1, 0.2)],
        )
    ]
    without = [
        Drive(
            {(1, 1), (1, 2), (2, 1)}, {(1, 1), (1, 2), (2, 1)}, 4.0, [True] * 95 + [False] * 5, 800
        )
    ]
    found = {figure.name: figure for figure in measure(with_, without)}
    assert found["ahead.lost_grip_ratio"].value == 0.5, "one vehicle of two, however often"
    assert found["ahead.lost_grip.without"].value == 3
    assert found["ahead.alert_passes"].value == 4.0
    assert found["prior.map_loop"].value == pytest.approx(0.05)
    assert not found["prior.map_loop"].holds
    assert found["prior.entry_error_ratio.town"].value == 0.5


def test_no_target_is_met_without_events() -> None:
    found = {figure.name: figure for figure in measure([Drive()], [Drive()])}
    for name in ("ahead.lost_grip_ratio", "prior.map_loop"):
        assert math.isnan(found[name].value)
        assert not found[name].holds
