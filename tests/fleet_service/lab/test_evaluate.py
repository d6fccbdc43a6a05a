"""Tests of the evaluation campaign of the fleet service in short runs: every figure is present, and
the parts work as documented.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from fleet_service.cli import evaluate, main
from fleet_service.lab import (
    agent,
    attacks,
    bars,
    campaign,
    changes,
    exact,
    fleets,
    rules,
    third_party,
    town,
)
from fleet_service.lab.drive import draw_arrivals, novel_deliveries, rows_of
from fleet_service.lab.score import coverage, of_beliefs, safe_share
from schemas import mugrid


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shrink the evaluation of the map to a few minutes and vehicles, so that it runs in seconds.
    The figures of such a run are not meaningful.
    """
    brief = tuple(fleet._replace(begin=0, minutes=6) for fleet in fleets.FLEETS)
    for module, name, value in (
        (fleets, "FLEETS", brief),
        (fleets, "AT", (6,)),
        (changes, "MINUTES", 5),
        (changes, "CHANGE", 3),
        (attacks, "BEGIN", 4),
        (attacks, "MINUTES", 6),
        (exact, "MINUTES", 5),
        (exact, "UNEXCITED", (3,)),
        (attacks, "ENOUGH", 0),
        (third_party, "MINUTES", 5),
        (third_party, "CHANGE_VISITS", 30),
        (third_party, "COLD_SEEDS", 2),
        (third_party, "VISITS", 5),
    ):
        monkeypatch.setattr(module, name, value)


@pytest.mark.campaign
@pytest.mark.usefixtures("small")
def test_quick_campaign_writes_figures_with_bars_table_and_plots(
    tmp_path: Path,
) -> None:
    assert main(["evaluate", "--out", str(tmp_path), "--quick", "--skip-whole-way"]) == 0
    header, *rows = json.loads((tmp_path / "figures.json").read_text())
    assert header["campaign"] == "fusion --quick"
    found = {row["name"]: row for row in rows}
    assert set(bars.BARS) <= set(found)
    missing = {name for name in bars.BARS if found[name]["value"] is None}
    assert missing >= {
        "fusion.whole_way.crps",
        "fusion.whole_way.rmse.after6",
        "fusion.whole_way.level.rmse",
    }
    assert all(
        name.startswith(
            (
                "fusion.whole_way",
                "fusion.resampled",
                "fusion.false",
                "fusion.missed",
                "fusion.clean",
            )
        )
        for name in missing
    )
    assert not any(found[name]["holds"] for name in missing)
    assert found["fusion.replay.max_difference"]["holds"]
    assert "DOES NOT HOLD" in (tmp_path / "figures.md").read_text()
    assert {path.name for path in tmp_path.glob("*.png")} == {
        "reliability.png",
        "rmse.png",
        "delay.png",
        "misbehaving.png",
    }


def test_end_to_end_alone_lists_its_figures_and_no_others(tmp_path: Path) -> None:
    found = campaign.run(tmp_path, True, {}, lambda _line: None, only="end-to-end")
    names = {figure.name for figure in found}
    assert names == {name for name in bars.BARS if name.startswith(campaign.END_TO_END)}
    assert "fusion.whole_way.hills.coverage90" in names
    assert not any(figure.holds for figure in found)
    assert [world.rough for world in campaign.drives_end_to_end(quick=True)] == [
        0.0,
        0.5,
        *[0.5] * 10,
    ]


def test_one_part_lists_the_figures_that_it_measures_and_no_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert set(evaluate.PARTS) == {*campaign.parts_of(range(1), print), "end-to-end"}
    parts = {"ice": lambda: {"fusion.clean.rmse": 0.03}, "value": lambda: {"other": 1.0}}
    monkeypatch.setattr(campaign, "parts_of", lambda _seeds, _log_line: parts)
    found = campaign.run(tmp_path, True, {}, lambda _line: None, only="ice")
    assert [figure.name for figure in found] == ["fusion.clean.rmse"]
    header, *rows = json.loads((tmp_path / "figures.json").read_text())
    assert header["campaign"] == "fusion --quick"
    assert [row["name"] for row in rows] == ["fusion.clean.rmse"]


def test_a_missing_figure_fails_the_campaign() -> None:
    found = dict.fromkeys(bars.BARS, 0.0)
    assert len(bars.judge_figures(found)) == len(bars.BARS)
    (one,) = (figure for figure in bars.judge_figures({}) if figure.name == "fusion.clean.rmse")
    assert math.isnan(one.value)
    assert not campaign.all_hold(bars.judge_figures({}))


def test_a_single_visit_without_bias_is_calibrated() -> None:
    rng = np.random.default_rng(1)
    n = 4000
    mu = rng.uniform(0.2, 1.0, n)
    who = np.zeros(n, np.int64)
    exactly = agent.Errors(np.zeros(1), np.zeros(1), np.zeros(1))
    along = np.tile(np.arange(4), n // 4)
    sure = np.ones(n, bool)
    passes = agent.Passes(
        who,
        mu,
        np.zeros(n),
        agent.used_shares(rng, sure),
        agent.reading_noise(rng, along),
        who,
        sure,
    )
    reports = agent.draw_reports(rng, exactly, passes)
    belief = np.exp(reports.log_likelihood - reports.log_likelihood.max(axis=1, keepdims=True))
    belief /= belief.sum(axis=1, keepdims=True)
    assert coverage(of_beliefs(belief, mu, who + 1)) == pytest.approx(0.9, abs=0.015)
    assert safe_share(of_beliefs(belief, mu, who + 1)) == pytest.approx(0.95, abs=0.015)


def test_error_shared_in_one_place_is_not_averaged_out() -> None:
    rng = np.random.default_rng(4)
    common = np.concatenate([town.draw_town(rng, 1, 0.0).common for _ in range(40)])
    assert np.std(common) == pytest.approx(agent.COMMON, rel=0.15)
    n = 4000
    mu = 0.6
    errors = agent.Errors(np.zeros(n), np.zeros(n), np.zeros(n))
    who = np.arange(n)
    sure = np.ones(n, bool)
    passes = agent.Passes(
        who, np.full(n, mu), np.full(n, 0.05), np.ones(n), rng.normal(size=n), 0 * who, sure
    )
    readings = agent.draw_reports(rng, errors, passes).reading
    assert readings.mean() - mu == pytest.approx(0.05 * mu, abs=0.005)


def test_an_unexcited_visit_is_flat_above_the_grip_used_within_half_a_nat() -> None:
    rng = np.random.default_rng(2)
    n = 500
    who = np.arange(500)
    passes = agent.Passes(
        who, np.full(n, 0.8), np.zeros(n), np.full(n, 0.2), np.zeros(n), 0 * who, who < 0
    )
    reports = agent.draw_reports(rng, agent.Errors.draw(rng, n), passes)
    above = reports.log_likelihood[:, mugrid.CENTRES > 0.35]
    assert np.ptp(above, axis=1).max() <= agent.SLOPE_NATS


def test_duplicate_delivery_is_admitted_once() -> None:
    rng = np.random.default_rng(3)
    visits = town.drive_fleet(rng, town.draw_town(rng, 5, 0.0), agent.Errors.draw(rng, 10), 5)
    _, which = draw_arrivals(rng, visits)
    kept = which[novel_deliveries(rows_of(visits), visits.vehicle, which)]
    assert len(which) > len(visits)
    np.testing.assert_array_equal(np.sort(kept), np.arange(len(visits)))


@pytest.mark.campaign
def test_federated_reset_is_inverse_variance_and_newest_is_the_last() -> None:
    seconds = np.arange(3.0)
    place = np.zeros(3, np.int64)
    reading = np.array([0.5, 0.7, np.nan])
    std = np.array([0.1, 0.1, np.nan])
    sent = np.array([[0.5, 0.01], [0.7, 0.01], [0.6, 0.05]])
    found = rules.fuse_by_rules(place, seconds, sent, (reading, std), np.array([10.0]), 1)[0, :, 0]
    federated, newest = (
        found[rules.RULES.index(name)] for name in ("federated reset", "newest report")
    )
    information = 1 / rules.PRIOR_VAR + 2 / 0.01
    expected = (rules.PRIOR_MEAN / rules.PRIOR_VAR + (0.5 + 0.7) / 0.01) / information
    assert federated == pytest.approx([expected, 1 / information], rel=1e-3)
    assert newest == pytest.approx([0.6, 0.05], rel=1e-3)
