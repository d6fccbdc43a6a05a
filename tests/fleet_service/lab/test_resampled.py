"""Tests of simulated reports in a town. They are drawn from the estimator's reports on other
simulated drives, so that they have realistic errors. Each town vehicle must get the reports of one
vehicle of these drives, from roads of similar friction. The values must be scaled to the friction
of the town's roads.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fleet_service.lab import models, resampled, town
from fleet_service.lab.agent import Errors, SimulatedReports
from fleet_service.lab.resampled import DrivenVisits, TrueVisits
from schemas import mugrid
from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import NS

VEHICLES = 4
MINUTES = 6


def visits_on(mu: FloatArray, vehicle: IntArray, low: FloatArray) -> DrivenVisits:
    """Return made-up visits (passages of cells) on roads with friction `mu`, by the vehicles
    `vehicle`. Vehicle k reports `low[k]` times the true friction. Every second visit uses enough
    grip to measure friction; the others use little.
    """
    excited = np.arange(len(mu)) % 2 == 1
    reading = mu * low[vehicle]
    reports = SimulatedReports(
        reading,
        0.05 * mu,
        0.5 * mu,
        np.zeros(len(mu), np.int64),
        -0.5 * np.square((mugrid.CENTRES - reading[:, None]) / 0.05),
    )
    return DrivenVisits(vehicle, mu, excited, reports)


def a_town(seed: int) -> tuple[town.Visits, np.random.Generator]:
    rng = np.random.default_rng(seed)
    return town.drive_fleet(
        rng, town.draw_town(rng, MINUTES, 0.0), Errors.draw(rng, VEHICLES), MINUTES
    ), rng


def test_vehicle_of_a_town_is_one_of_the_ways_on_the_towns_road() -> None:
    visits, rng = a_town(1)
    low = np.array([0.7, 0.8, 0.9, 1.0, 1.1])
    mu = np.tile(np.geomspace(0.05, 1.2, 80), len(low))
    ways = visits_on(mu, np.repeat(np.arange(len(low)), 80), low)
    found = resampled.resample_visits(rng, visits, ways, VEHICLES)
    ratio = found.reports.reading / found.mu
    kept = [np.unique(np.round(ratio[found.vehicle == vehicle], 6)) for vehicle in range(VEHICLES)]
    # A vehicle's persistent error is the same in the whole town.
    assert all(len(of) == 1 for of in kept)
    assert len({float(of[0]) for of in kept}) == VEHICLES
    assert found.reports.used == pytest.approx(0.5 * visits.mu)
    inside = (found.reports.reading > 0.2) & (found.reports.reading < 1.1)
    most = mugrid.CENTRES[found.reports.log_likelihood.argmax(axis=1)]
    assert (
        np.abs(most - found.reports.reading)[inside].max() < mugrid.CENTRES[1] - mugrid.CENTRES[0]
    )


def test_where_a_vehicle_never_was_on_such_a_road_another_s_visit_is_drawn() -> None:
    visits, rng = a_town(2)
    visits = replace(visits, mu=np.full(len(visits), 0.15))
    mu = np.repeat([0.15, 0.9], 40)
    ways = visits_on(mu, (mu > 0.5).astype(np.int64), np.array([1.0, 0.5]))
    found = resampled.resample_visits(rng, visits, ways, VEHICLES)
    assert found.reports.reading == pytest.approx(np.full(len(visits), 0.15))


def test_visits_to_one_friction_are_all_drawn_and_borders_rarely() -> None:
    visits, rng = a_town(3)
    visits = replace(visits, mu=np.full(len(visits), 0.32))
    visit = np.arange(200)
    mu = np.where(visit < 190, 0.3, 0.32)  # the last ten are at the border to another surface
    ways = visits_on(mu, np.zeros(len(mu), np.int64), np.array([1.0]))
    ways = ways._replace(reports=replace(ways.reports, manoeuvre=visit))
    found = resampled.resample_visits(rng, visits, ways, VEHICLES).reports.manoeuvre
    assert len(np.unique(found)) > 100
    assert np.mean(found >= 190) == pytest.approx(0.05, abs=0.03)


def test_the_truth_of_a_visit_is_where_its_vehicle_was_then() -> None:
    truth = TrueVisits(
        np.array([0, 0, 1]),
        np.array([0, 10, 0]) * NS,
        np.array([0.9, 0.2, 0.5]),
        np.array([0.1, 0.9, 0.7]),
    )
    nan = np.full(4, np.nan, np.float32)
    found = resampled.attach_truth(
        {
            "vehicle": np.array([1, 0, 0, 0]),
            "enter_time": np.array([5, 0, 8, 11]) * NS,
            "leave_time": np.array([6, 4, 16, 12]) * NS,
            "mu": np.array([np.nan, 0.8, 0.3, 0.2], np.float32),
            "mu_lower": nan,
            "mu_upper": nan,
            "mu_utilised": nan,
            "used_longitudinal": nan,
            "used_lateral": nan,
            "log_likelihood": np.zeros((4, mugrid.BINS), np.uint8),
        },
        truth,
    )
    assert found.mu.tolist() == [0.5, 0.9, 0.2, 0.2]
    assert found.excited.tolist() == [True, False, True, True]


def test_vehicles_of_two_ways_are_different_ones() -> None:
    way = visits_on(np.full(4, 0.5), np.array([0, 0, 2, 2]), np.ones(3))
    assert resampled.join_ways([way, way]).vehicle.tolist() == [0, 0, 2, 2, 3, 3, 5, 5]


def test_fleet_without_grip_demand_has_no_figures() -> None:
    way = visits_on(np.full(4, 0.5), np.zeros(4, np.int64), np.ones(1))
    assert models.measure_real(way._replace(excited=np.zeros(4, bool)), range(1)) == {}
