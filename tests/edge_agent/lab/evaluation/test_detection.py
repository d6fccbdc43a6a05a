"""Tests of the figures that evaluate the detection of ice. On made-up drives each figure must
follow its definition. One small simulated town must pass through the whole evaluation.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_agent.app.estimator_factory import bank_of
from edge_agent.lab.evaluation.detection import (
    DetectionResults,
    DetectionTally,
    bridge_gaps,
    judge_drive,
    runs_of,
    slides_of,
)
from edge_agent.lab.evaluation.detection_bars import DETECTION, detection_figures
from edge_agent.lab.evaluation.detection_campaign import (
    DetectionTown,
    judge_towns,
    simulate_towns,
    town_named,
)
from edge_agent.lab.evaluation.detection_drives import (
    DetectionDrive,
    DetectionVisits,
    slippery_favoured,
    stood_where_it_appeared,
)
from edge_agent.lab.evaluation.report import detection_table
from edge_agent.lab.evaluation.slide_oracle import visit_evidence
from edge_agent.lab.evaluation.slip_flag import friction_flagged
from edge_agent.lab.seeds import FIGURES
from edge_agent.lab.simulation import simulate_manoeuvre
from edge_agent.lab.simulation.manoeuvres import jump
from schemas.errors import InputError
from schemas.mugrid import BINS, CENTRES
from schemas.signals import CHANNELS, Health
from schemas.thresholds import SLIPPERY_MU

SAMPLES = 1200  # 2 s dry, 4 s of ice with a slide of 1 s, then 6 s dry


def drive_saying(lower: float, upper: float) -> DetectionDrive:
    """Return a simulated drive of one car over ice, with made-up estimates: the friction interval
    is always `lower` to `upper`.
    """
    ones = np.ones((SAMPLES, 1), np.float32)
    mu = 0.9 * ones
    theta = np.zeros((SAMPLES, 1, 4), np.float32)
    mu[200:600] = 0.15
    theta[300:400, :, :2] = 5.0
    wheels = np.repeat(mu[:, :, None], 4, axis=2)
    likelihood = np.zeros((2, BINS))
    likelihood[0, CENTRES > 0.3] = -5.0
    visits = DetectionVisits(
        np.array([0, 0]), np.array([250, 700]), np.array([550, 900]), likelihood
    )
    return DetectionDrive(
        speed=10.0 * ones,
        ax=-1.0 * ones,
        ay=0.0 * ones,
        mu=mu,
        mu_wheel=wheels,
        theta=theta,
        used=np.where(theta > 0.0, 0.95, 0.1).astype(np.float32),
        lower=lower * ones,
        median=lower * ones,
        upper=upper * ones,
        slippery=float(upper < SLIPPERY_MU) * ones,
        health=np.zeros((SAMPLES, 1), np.int32),
        favoured=0.0 * ones,
        flagged=np.where(theta[..., 0] > 0.0, 0.1, np.inf).astype(np.float32),
        controlled=theta[..., 0] > 0.0,
        stood=np.zeros((SAMPLES, 1), np.bool_),
        visits=visits,
    )


def test_always_reporting_ice_misses_none_and_is_false_on_every_road() -> None:
    found = judge_drive(drive_saying(0.05, 0.3))
    assert (
        found.mean("passes.ice")
        == found.mean("slide.told.some_wheels")
        == found.mean("coverage90.ice")
        == 1.0
    )
    assert found.mean("false_ice") == found.mean("false_ice.settled") == 1.0
    assert found.mean("coverage90.dry") == found.mean("false_grip") == 0.0
    assert found.total["false_events"] == 2.0
    assert found.seconds["seconds.ice.braking"] == [0.0]


def test_a_front_axle_that_reaches_ice_first_is_false_by_the_mean_alone() -> None:
    drive = drive_saying(0.05, 0.3)
    drive.slippery[:] = 0.0
    drive.slippery[150:400] = 1.0
    drive.mu_wheel[150:200, :, :2] = 0.15
    drive.mu[150:200] = 0.525
    found = judge_drive(drive)
    assert found.mean("false_ice") > 0.0
    assert found.mean("false_ice.off_ice") == found.total["false_events.off_ice"] == 0.0
    assert found.total["false_events"] == 1.0


def test_always_reporting_grip_finds_nothing_and_is_false_grip_on_ice() -> None:
    found = judge_drive(drive_saying(0.7, 1.1))
    assert (
        found.mean("passes.ice")
        == found.mean("slide.told.some_wheels")
        == found.mean("warned")
        == 0.0
    )
    assert found.mean("false_ice") == found.total["false_events"] == 0.0
    assert found.mean("false_grip") == found.mean("false_grip.sure") == 1.0
    assert found.mean("score.ice") == pytest.approx(0.4 + 20.0 * 0.55, rel=1e-5)


def test_visits_on_ice_with_a_slide_are_judged_by_their_likelihood() -> None:
    found = judge_drive(drive_saying(0.05, 1.2))
    assert found.mean("ice.yield.slide") == found.mean("ice.favoured.slide") == 1.0
    assert found.count["ice.yield"] == 1
    assert "ice.yield.calm" not in found.count
    assert found.mean("false_visits") == 0.0


def test_slip_flag_and_contradictions_are_counted_in_the_slide() -> None:
    drive = drive_saying(0.05, 1.2)
    drive.health[350:500] = Health.CONTRADICTION
    drive.health[900:] = Health.CONTRADICTION
    found = judge_drive(drive)
    assert found.mean("flag.passes.ice") == found.mean("controller.passes.ice") == 1.0
    assert found.seconds["flag.seconds.ice.braking"] == [0.0]
    assert found.total["contradictions.slide"] == found.total["contradictions.elsewhere"] == 1.0
    assert found.total["s.slide"] == pytest.approx(0.5), (
        "what is contradicted already cannot be so again"
    )


def test_cars_that_stood_where_ice_appeared_are_judged_apart() -> None:
    mu = np.full((500, 2), 0.9)
    speed = np.array([[0.0, 5.0]]).repeat(500, axis=0)
    mu[300:400] = 0.15
    stood = stood_where_it_appeared(mu, speed, [3.0])
    assert stood[300:400, 0].all()
    assert stood.sum() == 100
    drive = drive_saying(0.7, 1.1)
    found = judge_drive(replace(drive, stood=drive.mu < 0.2))
    assert found.mean("passes.ice.stood") == 0.0
    assert not {"passes.ice", "ice.yield"} & set(found.count)


def test_slides_are_bridged_and_have_a_least_length() -> None:
    theta = np.zeros((400, 4))
    theta[100:108, 1] = 3.0
    theta[112:130, 2] = 3.0
    theta[300:305, 0] = 3.0
    assert slides_of(theta) == [(100, 130)]
    assert runs_of(bridge_gaps(np.asarray(theta.any(axis=1)), 1.0)) == [(100, 130), (300, 305)]


def test_the_slip_flag_sees_a_slide_on_ice_and_nothing_on_dry_road() -> None:
    found = []
    for mu in (jump(0.9, 0.15, at=30.0), 0.9):
        log, vehicle = simulate_manoeuvre("braking", mu=mu, speed=20.0, seed=3)
        signals = np.stack(
            [log[name].to_numpy(zero_copy_only=False) for name in CHANNELS], axis=-1
        )[:, None]
        found.append(friction_flagged(log["t"].to_numpy()[:, None], signals, [vehicle]).min())
    assert found[0] < 0.25
    assert found[1] > 0.35, "no road is called slippery while the car stops"


def test_the_oracle_finds_the_friction_of_a_slide_and_not_of_rolling() -> None:
    slip = np.full((50, 4), 0.6)
    speed = np.full(50, 10.0)
    rng = np.random.default_rng(0)
    slid = visit_evidence(np.full((50, 4), 0.15), slip, speed, rng)
    calm = visit_evidence(np.full((50, 4), 0.05), np.full((50, 4), 0.05), speed, rng)
    assert slippery_favoured(slid) > 3.0
    assert abs(CENTRES[int(np.argmax(slid))] - 0.16) < 0.04
    assert slippery_favoured(calm) < 1.0


def test_simulated_town_fills_the_table_of_results() -> None:
    lines: list[str] = []
    chosen = [
        DetectionTown(FIGURES, "rough", 45.0, 3),
        DetectionTown(FIGURES, "rough", 45.0, 3, winter=True),
    ]
    results = judge_towns(chosen, lambda vehicles: bank_of("aco-fckf", vehicles), lines.append)
    found = {figure.name: figure.value for figure in detection_figures(results)}
    assert len(lines) == 2
    assert found["coverage90.dry.short.rough.winter"] != found["coverage90.dry.short.rough.other"]
    assert 0.0 <= found["false_ice.short.rough"] < 0.05
    assert 0.5 < found["coverage90.dry.short.rough"] <= 1.0
    assert results.pool_towns(["short"], "rough").count["false_visits"] > 20
    table = detection_table(detection_figures(results))
    assert "| `coverage90.ice.short` |" in table


def test_names_of_detection_figures_are_unique_and_towns_are_named() -> None:
    names = [bar.name for bar in DETECTION]
    assert len(names) == len(set(names))
    assert town_named("50001:plain:900") == DetectionTown(50001, "plain", 900.0)
    assert town_named("50001") == DetectionTown(50001, "rough", 120.0)
    with pytest.raises(InputError, match="town"):
        town_named("50001:wet")
    assert town_named("50003:rough:120:winter").winter
    campaign = simulate_towns(range(20), quick=False)
    assert {town.length for town in campaign} == {"short", "long"}
    assert sum(town.winter for town in campaign) == len(campaign) / 2
    assert not detection_figures(DetectionResults())
    assert np.isnan(DetectionTally().mean("nothing"))
