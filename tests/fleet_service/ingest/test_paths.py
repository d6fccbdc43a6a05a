"""Tests of the check for impossible positions. The check follows the path of a vehicle over rows,
batches, boots (starts of its agent) and regions, whatever the order of arrival.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from fleet_service.ingest import paths
from fleet_service.ingest.paths import FASTEST, LEAP_M, VehiclePaths
from tests.fleet_service.examples import SECOND, START

METRE = 1.0 / 111_195.0  # [deg] longitude per metre on the equator
CAR = 7


def find(
    known: VehiclePaths, seconds: Iterable[float], east_m: Iterable[float], vehicle: int = CAR
) -> list[bool]:
    """Return, for each position that a vehicle on the equator reports, True if the check finds it
    implausible.

    Args: known: paths of the vehicles so far, which the check extends. seconds: times of the
    reports, after START [s]. east_m: positions along the equator [m]. vehicle: the vehicle's
    number.
    """
    time = START + (np.array(list(seconds)) * SECOND).astype(np.int64)
    east = np.array(list(east_m), float) * METRE
    found = known.find_implausible(np.full(len(time), vehicle), time, np.zeros(len(time)), east)
    return [bool(one) for one in found]


def test_a_vehicle_is_not_in_two_towns_at_once() -> None:
    known = VehiclePaths()
    assert find(known, [0, 10, 20, 30], [0, 400, 8e6, 1200]) == [False, False, True, False]
    assert find(known, [-3600], [-200_000]) == [False], (
        "a backlog: there was time to come from there"
    )
    assert find(known, [31], [5_000 + FASTEST * 31]) == [True]


def test_leaps_of_all_rows_share_one_budget() -> None:
    step = LEAP_M - 100.0
    walk = find(VehiclePaths(), np.arange(210) * 1e-3, np.arange(210) * step)
    assert walk == [False] + [False] + [True] * 208
    in_batches = []
    known = VehiclePaths()
    for k in range(210):
        in_batches += find(known, [k * 1e-3], [k * step])
    assert in_batches == walk


def test_leap_budget_fills_again() -> None:
    known = VehiclePaths()
    assert find(known, [0, 0.1], [0, 1900]) == [False, False]
    assert find(known, [0.2], [3800]) == [True]
    hours = 7200
    assert find(known, [hours, hours + 0.1], [1900, 3800]) == [False, False]


def test_order_of_time_does_not_hide_a_second_place() -> None:
    known = VehiclePaths()
    assert find(known, [0, -3600, 0.5], [0, -200_000, -250_000]) == [False, False, True], (
        "back and forth in time"
    )
    assert find(known, [-1800, -1799], [-100_000, -40_000]) == [False, True]


def test_backlogs_in_any_order_are_plausible() -> None:
    random = np.random.default_rng(3)
    seconds = np.arange(0, 3600, 20.0)
    east = np.cumsum(random.uniform(0, 30, len(seconds)) * 20)
    live = find(VehiclePaths(), seconds, east)
    newest_first = find(VehiclePaths(), seconds[::-1], east[::-1])
    known = VehiclePaths()
    between = []
    late = (seconds > 1200) & (seconds < 2400)
    between += find(known, seconds[~late], east[~late])
    between += find(known, seconds[late], east[late])
    assert not any(live + newest_first + between)


def test_a_gap_of_dropped_anchors_allows_no_far_place() -> None:
    known = VehiclePaths()
    seconds = np.arange(0, 3600, 10.0)
    assert not any(find(known, seconds, seconds * 15))
    for at in np.arange(5, 3590, 97.0):
        assert find(known, [at, at], [at * 15 + 20_000, at * 15]) == [True, False]


@pytest.mark.parametrize("start", [179.9999, -179.9999])
def test_the_date_line_is_no_leap(start: float) -> None:
    known = VehiclePaths()
    time = START + np.arange(2) * SECOND
    found = known.find_implausible(np.full(2, CAR), time, np.zeros(2), np.array([start, -start]))
    assert found.tolist() == [False, False]


def test_each_vehicle_is_compared_with_itself() -> None:
    known = VehiclePaths()
    cars = np.arange(1000, 0, -1)
    far = 10.0
    longitude = cars / 1000.0
    for step in range(3):
        time = np.full(1000, START + (step + 1) * SECOND)
        moved = longitude + far * ((cars == 500 + step) & (step > 0))
        wrong = known.find_implausible(cars, time, np.zeros(1000), moved)
        assert cars[wrong].tolist() == ([500 + step] if step else [])


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paths, "VEHICLES", 100)
    known = VehiclePaths()
    for first in range(0, 1000, 50):
        cars = np.arange(first, first + 50)
        known.find_implausible(cars, np.full(50, START), np.zeros(50), np.zeros(50))
    assert len(known._rows) <= 100
    assert len(known._paths) == 128
