"""Tests of the figures for simulated drives with realistic sensor errors on hills. Trivial
estimators must get the expected scores, and the tuning must not use the seeds of these drives.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.estimators import Estimates
from edge_agent.estimators.estimates import ONE_FRICTION, Column
from edge_agent.lab.evaluation import oracle, real_world
from edge_agent.lab.evaluation.batch import DriveSet, simulate_realistic
from edge_agent.lab.evaluation.real_world import PRIOR, Tally
from edge_agent.lab.evaluation.scenarios import PAPERS
from edge_agent.lab.seeds import FIGURES
from edge_agent.lab.tuning import objectives, study
from schemas.numeric import FloatArray
from schemas.signals import Health, S
from schemas.thresholds import GRAVITY, SLIPPERY_MU, SURFACES


@pytest.fixture(scope="module")
def driven() -> tuple[DriveSet, FloatArray]:
    """Return simulated drives of six cars, forty seconds in a town, with realistic sensor errors.
    Return also an array (T, 6): for each sample and car the largest share of the available grip
    that any wheel used.
    """
    return real_world.simulate_town(FIGURES, 6, 40.0)


def saying(batch: DriveSet, lower: float, upper: float) -> Estimates:
    """Return made-up estimates of a drive: the true motion, and a constant friction interval from
    `lower` to `upper`.
    """
    output = np.zeros((*batch.t.shape, ONE_FRICTION))
    for column, name in ((Column.VX, "vx"), (Column.VY, "vy"), (Column.YAW_RATE, "yaw_rate")):
        output[..., column] = batch.truth[f"true_{name}"]
    output[..., Column.MU] = (lower + upper) / 2
    output[..., Column.MU_LOWER] = lower
    output[..., Column.MU_UPPER] = upper
    output[..., Column.VX_STD : Column.MU] = 1.0
    output[..., Column.P_SLIPPERY] = upper < SLIPPERY_MU
    return Estimates(output)


def figures(driven: tuple[DriveSet, FloatArray], reported: Estimates) -> dict[str, float]:
    tally = Tally()
    real_world.tally_town(tally, driven[0], reported, driven[1])
    return tally.means()


def test_prior_always_covers_and_never_finds_ice(
    driven: tuple[DriveSet, FloatArray],
) -> None:
    found = figures(driven, saying(driven[0], *PRIOR))
    baseline = Tally()
    real_world.tally_baseline(baseline, driven[0])
    assert found["coverage90"] == 1.0
    assert found["width"] == found["width.all"] == pytest.approx(1.0)
    assert found["false_ice"] == found["below"] == found["rmse_vx"] == found["lost"] == 0.0
    assert found["score"] == pytest.approx(1.035) == baseline.means()["score"]
    assert 0.0 < baseline.means()["rmse_vx"] < 0.5


def test_contradiction_is_counted_by_surface_and_by_whether_grip_is_used(
    driven: tuple[DriveSet, FloatArray],
) -> None:
    reported = saying(driven[0], *PRIOR)
    excited = real_world.recent_maximum(driven[1]) >= 0.6
    assert figures(driven, reported)["contradiction_share"] == 0.0
    reported.values[..., Column.HEALTH] = np.where(
        excited & (driven[0].mu > 0.75), Health.CONTRADICTION, Health.OK
    )
    found = figures(driven, reported)
    assert 0.0 < found["contradiction_share"] < found["contradiction_share.dry.excited"] == 1.0
    assert found["contradiction_share.dry.calm"] == found["contradiction_share.snow.excited"] == 0.0


def test_estimator_that_always_reports_ice_is_right_only_on_ice(
    driven: tuple[DriveSet, FloatArray],
) -> None:
    found = figures(driven, saying(driven[0], 0.05, 0.2))
    assert [found[f"coverage90.{name}"] for name in ("snow", "wet", "dry")] == [0.0, 0.0, 0.0]
    assert found["false_ice"] == found["false_ice.settled"] == 1.0
    assert found["false_ice.off_ice"] == 1.0
    assert found["false_ice.of_all"] == pytest.approx((driven[0].mu > 0.6).mean())
    assert 0.05 < found["below"] < 1.0
    assert found["score"] > 3.0


def test_ice_below_one_wheel_is_false_ice_but_not_off_ice(
    driven: tuple[DriveSet, FloatArray],
) -> None:
    reported = saying(driven[0], *PRIOR)
    reported.values[..., Column.P_SLIPPERY] = driven[0].mu_wheel.min(axis=-1) <= 0.45
    found = figures(driven, reported)
    assert found["missed_ice"] == found["false_ice.off_ice"] == 0.0
    assert found["false_ice"] > 0.0


def test_the_prior_misses_ice_and_always_reporting_grip_is_false_grip(
    driven: tuple[DriveSet, FloatArray],
) -> None:
    prior, ice, grip = (
        figures(driven, saying(driven[0], *ends)) for ends in (PRIOR, (0.05, 0.3), (0.7, 1.1))
    )
    assert (prior["missed_ice"], prior["false_grip"]) == (1.0, 0.0)
    assert (ice["missed_ice"], ice["false_grip"]) == (0.0, 0.0)
    assert (grip["missed_ice"], grip["false_grip"]) == (1.0, 1.0)


def test_every_second_town_is_in_winter() -> None:
    assert [real_world.in_winter(seed) for seed in range(FIGURES, FIGURES + 4)] == [
        False,
        True,
        False,
        True,
    ]
    batch, _ = real_world.simulate_town(FIGURES + 1, 2, 2.0)
    assert np.isfinite(batch.mu).all()


def test_each_surface_and_cars_without_torque_are_met_in_a_town(
    driven: tuple[DriveSet, FloatArray],
) -> None:
    batch, used = driven
    for above, most in SURFACES.values():
        assert ((batch.mu > above) & (batch.mu <= most)).any()
    silent = np.isnan(batch.signals[:, :, S.TORQUE]).all(axis=0)
    assert silent.any()
    assert not silent.all()
    assert np.abs(batch.truth["true_slope"]).max() > 0.03
    assert (batch.truth["true_vx"] == 0.0).any()
    assert (real_world.recent_maximum(used) >= used).all()
    assert 0.0 < (real_world.recent_maximum(used) >= 0.6).mean() < 1.0


def test_the_grip_in_use_never_exceeds_the_friction_where_it_is_one(
    driven: tuple[DriveSet, FloatArray],
) -> None:
    batch, _ = driven
    one = np.ptp(batch.mu_wheel, axis=-1) == 0.0
    steady = one & (np.abs(np.gradient(batch.mu, axis=0)) == 0.0)
    # `in_use` has a memory of 0.2 s, so a few samples may exceed the friction.
    assert (real_world.in_use(batch) <= batch.mu)[steady].mean() > 0.999
    assert real_world.in_use(batch).max() > 0.3


def test_cars_stand_still_on_a_slope() -> None:
    batches = real_world.simulate_standing(0.05, range(FIGURES, FIGURES + 3), 2.0)
    assert len(batches) == 6
    for batch in batches:
        assert not batch.truth["true_vx"].any()
        assert (np.abs(batch.signals[..., S.OMEGA : S.OMEGA + 4]) < 0.2).all()
    mean_ax = np.array([batch.signals[..., S.AX].mean() for batch in batches])
    assert np.abs(mean_ax[:3] / GRAVITY - 0.05).max() < 0.015
    assert np.isnan(batches[-1].signals[..., S.TORQUE]).all()


def test_oracle_error_comes_only_from_unknown_parameters() -> None:
    """The oracle is an estimator that knows all true values, except those that the vehicle file and
    the sensors' data sheet leave open. Unknown are for example the errors of wheel radius, tyre
    stiffness and sensor offsets.

    Its speed error must be similar to the error that the wheel radius in the vehicle file causes.
    Its friction error must be below 0.1.
    """
    seeds = range(FIGURES, FIGURES + 4)
    speeds = oracle.speed_rmse(seeds)
    (frictions, expected) = oracle.friction_errors(seeds)
    batch = simulate_realistic(PAPERS["002.sine"], seeds)
    true = PAPERS["002.sine"].vehicle.vehicle.wheel_radius
    by_wheels = [
        abs(vehicle.wheel_radius / true - 1.0) * batch.truth["true_vx"].mean()
        for vehicle in batch.vehicles
    ]
    assert 0.2 < speeds.mean() / np.mean(by_wheels) < 1.1
    assert (frictions < 0.1).all()
    assert 0.2 < frictions.mean() / expected.mean() < 2.0


def test_tuning_seeds_differ_from_those_of_the_figures() -> None:
    for drives in (objectives.TRAIN, objectives.HELD_OUT, study.TRAIN, study.HELD_OUT):
        assert all(drive.seed < FIGURES for drive in drives)
