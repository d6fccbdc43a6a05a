"""Tests of the evaluation of the map's value to users. It compares the map's warnings with simple
rules in towns with known friction, by precision, recall and minutes of unnoticed ice.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fleet_service.lab import town, value
from fleet_service.lab.value import TownTraffic
from schemas.numeric import FloatArray


def town_that_freezes(minute: float) -> town.Town:
    """Return a dry town in which the first road turns to ice after `minute` minutes."""
    mu: FloatArray = np.full((value.MINUTES + 1, town.CELLS), 0.8)
    mu[int(minute) :, : town.LENGTH] = 0.15
    changed = np.full(town.CELLS, np.inf)
    changed[: town.LENGTH] = minute
    built = town.draw_town(np.random.default_rng(1), value.MINUTES, 0.0)
    return dataclasses.replace(built, mu=mu, changed=changed)


def traffic(cars: float, demand: float = 1.0) -> tuple[town.Town, TownTraffic]:
    place = town_that_freezes(120.0)
    return place, value.drive_cars(np.random.default_rng(2), place, cars, demand)


def test_ice_excites_everybody_and_makes_controllers_work() -> None:
    _, drive = traffic(10.0)
    icy = drive.visits.mu < 0.4
    assert drive.visits.excited[icy].mean() > 0.6
    assert drive.limited[icy].mean() > 0.2 > 10.0 * drive.limited[~icy].mean()


def test_gentle_drivers_excite_less() -> None:
    assert (
        traffic(10.0, value.GENTLE)[1].visits.excited.mean()
        < traffic(10.0)[1].visits.excited.mean()
    )


def test_two_events_find_the_ice_and_nothing_before_it() -> None:
    _, drive = traffic(20.0)
    assert not value.two_events(drive, 119.0 * 60.0).any()
    found = value.two_events(drive, 170.0 * 60.0)
    assert found[: town.LENGTH].mean() > 0.5
    assert not found[town.LENGTH :].any()


def test_median_of_values_finds_the_ice() -> None:
    _, drive = traffic(20.0)
    found = value.slippery_median(drive, 179.0 * 60.0)
    assert found[: town.LENGTH].mean() > 0.5
    assert found[town.LENGTH :].mean() < 0.05


def test_minutes_are_counted_from_the_change_and_never_counts_most() -> None:
    place = town_that_freezes(120.0)
    moments = np.arange(value.BEGIN, value.MINUTES + 1, value.STEP)
    warned = np.zeros((len(moments), town.CELLS), bool)
    warned[moments >= 130, 0] = True
    minutes = value.count_unnoticed(place, warned)
    assert minutes.tolist() == [10.0, *[value.UNNOTICED_MOST] * (town.LENGTH - 1)]
    frozen = place.mu[-1, 0]
    assert len(value.count_unnoticed(place, warned, frozen)) == 0


@pytest.mark.parametrize(
    ("warned", "precision", "recall"),
    [([True, True], 0.5, 1.0), ([True, False], 1.0, 1.0), ([False, True], 0.0, 0.0)],
)
def test_precision_and_recall_count_both_directions(
    warned: list[bool], precision: float, recall: float
) -> None:
    truth: FloatArray = np.array([0.2, 0.8])
    assert value.precision(truth, np.array(warned)) == precision
    assert value.recall(truth, np.array(warned)) == recall


def test_recall_of_ice_leaves_snow_out() -> None:
    truth: FloatArray = np.array([0.15, 0.35, 0.35])
    warned = np.array([True, False, False])
    assert value.recall(truth, warned) == pytest.approx(1.0 / 3.0)
    assert value.recall(truth, warned, value.ICE_MOST) == 1.0
