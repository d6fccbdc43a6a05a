"""Tests of the papers' estimators on short drives. They must find the car's motion, use no future
samples and give no NaN. Each of their settings must have an effect.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators import (
    Estimates,
    adaptive_federated_ckf,
    compensated_wckf,
    create,
    paper_aco_fckf,
)
from edge_agent.estimators.estimates import COLUMNS
from edge_agent.estimators.paper_aco_fckf import Setting
from edge_agent.observe.cell_tracker import locate_vehicles, new_tracks
from edge_agent.observe.observation_builder import OpenVisits, build_records
from schemas.config import AgentConfig
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.signals import Health, S
from schemas.vehicle import Vehicle
from tests.edge_agent.estimators.drives import drive
from tests.edge_agent.estimators.test_bank import FAULTS

PAPERS = ("paper-aco-fckf", "federated-ckf", "adaptive-federated-ckf", "compensated-wckf", "sr-ukf")
SET_BY_HAND = ("adaptive-federated-ckf", "compensated-wckf")
BY_WHEEL = ("federated-ckf", "sr-ukf")
PRIOR_WIDTH = 0.9 * 1.15


def run(name: str, t: FloatArray, signals: FloatArray, vehicle: Vehicle) -> Estimates:
    return bank_of(name, [vehicle]).advance(t[:, None], signals[:, None])


@pytest.mark.campaign
@pytest.mark.parametrize("name", PAPERS)
def test_on_a_slalom_the_motion_is_found(name: str) -> None:
    t, signals, vehicle = drive("slalom", 0.8, seconds=6.0)
    reported = run(name, t, signals, vehicle)
    assert abs(reported.vx[-1, 0] - 30 / 3.6) < 0.15
    assert np.corrcoef(reported.yaw_rate[:, 0], signals[:, S.YAW_RATE])[0, 1] > 0.99
    assert (reported.mu_lower <= reported.mu).all()
    assert (reported.mu <= reported.mu_upper).all()
    assert reported.evidence is None


@pytest.mark.parametrize("name", PAPERS)
def test_a_vehicle_has_the_same_numbers_alone_and_among_many(name: str) -> None:
    t, signals, vehicle = drive("slalom", 0.8, seconds=1.5)
    bank = bank_of(name, [vehicle] * 3)
    crowd = np.repeat(signals[:, None], 3, axis=1)
    crowd[:, :2] += 0.01 * np.random.default_rng(0).normal(size=(1, 2, crowd.shape[2]))
    together = bank.advance(np.repeat(t[:, None], 3, axis=1), crowd)
    alone = run(name, t, signals, vehicle)
    for array in COLUMNS:
        assert np.array_equal(getattr(together, array)[:, 2], getattr(alone, array)[:, 0]), array


@pytest.mark.parametrize("name", PAPERS)
def test_however_the_samples_are_cut_the_numbers_are_the_same_and_causal(name: str) -> None:
    t, signals, vehicle = drive("slalom", 0.8, seconds=1.5)
    whole = run(name, t, signals, vehicle)
    bank = bank_of(name, [vehicle])
    parts = [
        bank.advance(t[a:b, None], signals[a:b, None])
        for a, b in pairwise([0, 1, 2, 37, 90, len(t)])
    ]
    for array in COLUMNS:
        assert np.array_equal(
            np.concatenate([getattr(p, array) for p in parts]), getattr(whole, array)
        ), array
    if whole.mu_wheel is not None:
        wheels = [p.mu_wheel for p in parts if p.mu_wheel is not None]
        assert np.array_equal(np.concatenate(wheels), whole.mu_wheel)


@pytest.mark.parametrize("name", PAPERS)
@pytest.mark.parametrize("fault", FAULTS)
def test_faults_cause_no_nan_and_are_shown_in_health(name: str, fault: str) -> None:
    t, signals, vehicle = drive("slalom", 0.3, seconds=6.0)
    t = t.copy()
    signals = signals.copy()
    harm, flag = FAULTS[fault]
    harm(t, signals)
    reported = run(name, t, signals, vehicle)
    for array in COLUMNS:
        assert np.isfinite(getattr(reported, array)).all(), array
    assert reported.mu_wheel is None or np.isfinite(reported.mu_wheel).all()
    assert (reported.health & int(flag)).any()


@pytest.mark.parametrize("name", PAPERS)
@pytest.mark.parametrize("rate", [10, 1])
def test_slow_sampling_and_standing_still_are_survived(name: str, rate: int) -> None:
    t, signals, vehicle = drive("braking", 0.8, seconds=8.0)
    reported = run(name, t[:: 100 // rate], signals[:: 100 // rate], vehicle)
    assert all(np.isfinite(getattr(reported, array)).all() for array in COLUMNS)
    assert np.abs(reported.vx).max() < 40.0


@pytest.mark.campaign
@pytest.mark.parametrize("name", PAPERS)
def test_observer_without_evidence_reports_friction_and_interval(name: str) -> None:
    t, signals, vehicle = drive("slalom", 0.8, seconds=6.0)
    t = t[:, None]
    signals = signals[:, None]
    _, located = locate_vehicles(new_tracks(1), t, signals)
    reported = bank_of(name, [vehicle]).advance(t, signals, located.closes)
    _, output, _ = build_records(
        OpenVisits.before_any(1), (t * 1e9).astype(np.int64), located, reported, AgentConfig()
    )
    assert len(output.vehicle) > 0
    assert output.columns["log_likelihood"].shape == (len(output.vehicle), 0)
    assert (output.columns["mu_lower"] < output.columns["mu_upper"]).all()


@pytest.mark.parametrize("name", SET_BY_HAND)
def test_friction_that_is_not_estimated_is_reported_as_the_prior(name: str) -> None:
    t, signals, vehicle = drive("slalom", 0.3, seconds=2.0)
    reported = run(name, t, signals, vehicle)
    assert np.ptp(reported.mu) == 0.0
    assert (reported.mu_upper - reported.mu_lower)[-1, 0] == pytest.approx(PRIOR_WIDTH)


@pytest.mark.parametrize("name", SET_BY_HAND)
def test_the_friction_that_is_set_matters_where_tyres_bend(name: str) -> None:
    t, signals, vehicle = drive("slalom", 0.3, seconds=6.0)
    module = adaptive_federated_ckf if name == "adaptive-federated-ckf" else compensated_wckf
    right, wrong = (
        module.make_bank([vehicle], mu).advance(t[:, None], signals[:, None]) for mu in (0.3, 0.9)
    )
    assert right.innovation_nis.mean() < wrong.innovation_nis.mean()


@pytest.mark.parametrize("name", BY_WHEEL)
def test_straight_on_at_constant_speed_every_wheel_is_as_unknown_as_before(name: str) -> None:
    t, signals, vehicle = drive("straight", 0.85, seconds=10.0)
    reported = run(name, t, signals, vehicle)
    assert reported.mu_wheel is not None
    assert (
        reported.mu_wheel[-1, 0, :, 2] - reported.mu_wheel[-1, 0, :, 1] >= 0.8 * PRIOR_WIDTH
    ).all()


def test_unscented_filter_with_torque_finds_friction_of_snow_in_a_slalom() -> None:
    t, signals, vehicle = drive("slalom", 0.3)
    reported = run("sr-ukf", t, signals, vehicle)
    assert reported.mu_lower[-1, 0] < 0.3 < reported.mu_upper[-1, 0]
    assert abs(reported.mu[-1, 0] - 0.3) < 0.1
    broken = signals.copy()
    broken[:, S.TORQUE : S.TORQUE + 4] = np.nan
    less = run("sr-ukf", t, broken, vehicle)
    assert (less.health & int(Health.NO_TORQUE)).all()
    assert (less.mu_upper - less.mu_lower)[300:].mean() > (reported.mu_upper - reported.mu_lower)[
        300:
    ].mean()


@pytest.mark.parametrize(
    "change",
    [
        {"process": (1e-6, 1e-6, 1e-3, 1e-3, 1e-6, 1e-4)},
        {"start": (1.0, 0.09, 0.2, 0.2, 0.01, 0.1)},
        {"noise": (0.05, 0.05, 0.05)},
        {"mu": 0.3},
        {"straight": True},
    ],
    ids=lambda change: next(iter(change)),
)
def test_every_setting_of_the_papers_filter_matters(change: dict[str, object]) -> None:
    t, signals, vehicle = drive("slalom", 0.3, seconds=1.5)
    usual, other = (
        paper_aco_fckf.make_bank([vehicle], Memberships(), setting).advance(
            t[:, None], signals[:, None]
        )
        for setting in (Setting(), Setting()._replace(**change))  # type: ignore[arg-type]
    )
    assert not np.array_equal(usual.mu, other.mu)


def test_fuzzy_sets_change_the_papers_filter_and_are_refused_elsewhere() -> None:
    t, signals, vehicle = drive("slalom", 0.3, seconds=1.5)
    still = Memberships(outputs=(0.0, 0.0, 0.0, 0.0, 0.0))
    reported = create("paper-aco-fckf", [vehicle], memberships=still).advance(
        t[:, None], signals[:, None]
    )
    assert (reported.adaptation == 1.0).all()
    assert (run("paper-aco-fckf", t, signals, vehicle).adaptation != 1.0).any()
    with pytest.raises(InputError, match="memberships"):
        create("sr-ukf", [vehicle], memberships=still)


@pytest.mark.parametrize(("shape", "field"), [((3, 2, 18), "signals"), ((3, 1, 17), "signals")])
def test_misuse_is_refused_by_name(shape: tuple[int, ...], field: str) -> None:
    vehicle = drive("slalom", 0.3, seconds=1.5)[2]
    with pytest.raises(InputError, match=field):
        bank_of("paper-aco-fckf", [vehicle]).advance(np.zeros((3, 1)), np.zeros(shape))
    with pytest.raises(InputError, match="closes"):
        create("sr-ukf", [vehicle]).advance(
            np.zeros((3, 1)), np.zeros((3, 1, 18)), np.zeros((2, 1), bool)
        )
