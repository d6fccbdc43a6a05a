"""Tests of the tuning objective. It must be a proper and finite score, its drives must differ from
the held-out drives, and the command must work from end to end.
"""

import argparse
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app.tuned_memberships import WAYS, Score, SplitScores, load_tuned
from edge_agent.cli import main, tune
from edge_agent.lab.tuning.objectives import (
    HELD_OUT,
    OBJECTIVES,
    TOWNS,
    TRAIN,
    TuningScores,
    TuningSet,
    candidate_values,
    detection_cost,
    detection_scores,
    interval_score,
    objective_on,
    record_all,
    record_drives,
    scores_of,
)
from edge_agent.lab.tuning.search import Iteration
from schemas.errors import InputError
from schemas.signals import CHANNELS

ESTIMATOR = tune.ESTIMATOR


@pytest.fixture(scope="module")
def drives() -> TuningSet:
    """Return three short simulated drives of the training set."""
    return record_drives(TRAIN[:3], 4.0)


def test_recorded_drives_stand_side_by_side(drives: TuningSet) -> None:
    assert drives.signals.shape == (400, 3, len(CHANNELS))
    assert drives.t.shape == drives.mu.shape == (400, 3)
    assert len(drives.vehicles) == 3
    assert np.isfinite(drives.signals[:, :, 2]).mean() > 0.9


def test_judging_drives_share_no_seed_or_setting_with_search_drives() -> None:
    assert not {drive.seed for drive in TRAIN} & {drive.seed for drive in HELD_OUT}
    assert len({drive.seed for drive in TRAIN + HELD_OUT}) == len(TRAIN + HELD_OUT)
    searched, judged = (
        {(drive.manoeuvre, drive.vehicle) for drive in drives} for drives in (TRAIN, HELD_OUT)
    )
    assert not searched & judged


def test_worth_is_finite_and_the_same_every_time(drives: TuningSet) -> None:
    first, second = (scores_of(Memberships(), drives, ESTIMATOR) for _ in range(2))
    assert first == second
    assert np.isfinite(astuple(first)).all()
    assert 0.0 <= first.coverage <= 1.0


def test_worth_of_several_drives_is_the_mean_of_each(drives: TuningSet) -> None:
    single = [
        scores_of(
            Memberships(),
            TuningSet(
                (vehicle,),
                drives.t[:, [n]],
                drives.signals[:, [n]],
                drives.mu[:, [n]],
                drives.used[:, [n]],
            ),
            ESTIMATOR,
        )
        for n, vehicle in enumerate(drives.vehicles)
    ]
    both = scores_of(Memberships(), drives, ESTIMATOR)
    for name in ("interval_score", "coverage", "log_likelihood", "nis_ratio"):
        mean = np.mean([getattr(one, name) for one in single])
        np.testing.assert_allclose(getattr(both, name), mean, rtol=1e-12)


def test_interval_score_pays_for_width_and_twenty_times_for_a_miss() -> None:
    lower = np.array([0.2, 0.2, 0.2])
    upper = np.array([0.6, 0.6, 0.6])
    truth = np.array([0.4, 0.1, 0.7])
    np.testing.assert_allclose(interval_score(lower, upper, truth), [0.4, 2.4, 2.4])


def test_interval_score_is_least_at_the_true_quantiles() -> None:
    """The interval score must be least (best) for the interval between the true quantiles: on draws
    from a known distribution, a wider and a narrower interval must both score worse.
    """
    draws = np.random.default_rng(1).normal(size=200_000)
    scores = {
        z: float(interval_score(np.full(1, -z), np.full(1, z), draws).mean())
        for z in (1.2, 1.645, 2.2)
    }
    assert scores[1.645] < min(scores[1.2], scores[2.2])


def test_inflated_noise_does_not_win_the_innovation_likelihood(drives: TuningSet) -> None:
    """The likelihood of the innovations (measurement minus prediction) must be lower with the
    measurement noise 4.5 R than with the right noise R. This must hold although fewer innovations
    exceed their expected bound with 4.5 R.
    """
    usual, inflated = (
        scores_of(Memberships(ln_scales=(s, s)), drives, ESTIMATOR) for s in (0.0, 1.5)
    )
    assert inflated.log_likelihood < usual.log_likelihood
    assert inflated.nis_ratio < usual.nis_ratio


def test_each_objective_maximises_its_own_score(drives: TuningSet) -> None:
    vector = Memberships().to_vector()
    found = scores_of(Memberships(), drives, ESTIMATOR)
    assert set(OBJECTIVES) == {"interval", "innovation", "predictive"}
    assert objective_on(drives, ESTIMATOR, "interval")(vector) == -detection_cost(found)
    assert objective_on(drives, ESTIMATOR, "innovation")(vector) == found.log_likelihood


def test_vector_that_is_no_membership_counts_as_the_worst(drives: TuningSet) -> None:
    vector = Memberships().to_vector()
    assert objective_on(drives, ESTIMATOR, "interval")(np.full_like(vector, np.nan)) == -np.inf


def test_false_and_missed_ice_are_counted_on_their_own_samples() -> None:
    truth = np.array([0.1, 0.1, 0.9, 0.9])
    upper = np.array([0.3, 0.8, 0.3, 1.0])
    used = np.array([0.95, 0.95, 0.1, 0.1])
    found = detection_scores(np.full(4, 0.05), upper, truth, used)
    assert (found["false_ice"], found["missed_ice"]) == (0.5, 0.5)


def test_false_ice_and_missed_ice_both_cost() -> None:
    plain = TuningScores(0.5, 0.9, 300.0, 1.0, surface_score=0.5, false_ice=0.0, missed_ice=0.0)
    for worse in ({"false_ice": 0.01}, {"missed_ice": 0.2}):
        assert detection_cost(replace(plain, **worse)) > detection_cost(plain) + 0.05


def test_an_unknown_objective_is_refused(drives: TuningSet) -> None:
    with pytest.raises(InputError, match="objective"):
        objective_on(drives, ESTIMATOR, "rmse")


def test_default_is_among_the_choices_and_all_lie_within_the_bounds() -> None:
    lower, upper = Memberships.bounds()
    for value, positions, least, largest in zip(
        Memberships().to_vector(), candidate_values(7), lower, upper, strict=True
    ):
        assert value in positions
        assert np.all((least <= positions) & (positions <= largest))
        assert np.all(np.diff(positions) > 0)


def test_a_wrong_calibration_costs_a_prediction_alike_on_both_sides() -> None:
    worths = [TuningScores(0.5, 0.9, 300.0, ratio) for ratio in (1.0, 0.5, 2.0)]
    right, small, large = (OBJECTIVES["predictive"](one) for one in worths)
    assert right == 300.0
    assert small == pytest.approx(large)
    assert small < right - 20.0


def test_tuning_towns_and_manoeuvres_share_no_seed() -> None:
    both = record_all("train", 2.0)
    assert len(both.vehicles) == len(TRAIN) + sum(TOWNS["train"][1] for _ in TOWNS["train"][0])
    assert both.signals.shape[:2] == both.mu.shape == (200, len(both.vehicles))
    assert not set(TOWNS["train"][0]) & set(TOWNS["held_out"][0])


def arguments(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    tune.add_arguments(parser)
    return parser.parse_args(words)


@pytest.mark.campaign
@pytest.mark.parametrize("objective", ["interval", "innovation", "predictive"])
def test_quick_tuning_writes_a_valid_file_and_reports_its_progress(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], objective: str
) -> None:
    out = tmp_path / "tuned.json"
    assert (
        tune.run(arguments("--quick", "--seed", "4", "--objective", objective, "--out", str(out)))
        == 0
    )
    reported = capsys.readouterr().out
    assert reported.count("elapsed") == 2 * tune.QUICK_ITERATIONS
    for way in WAYS:
        assert f"\n{way} " in reported
    tuned = load_tuned(out)
    scores = tuned.document.scores
    provenance = tuned.document.provenance
    for way in ("random", "colony"):
        gain = OBJECTIVES[objective](TuningScores(**scores[way].train.model_dump()))
        assert gain >= OBJECTIVES[objective](TuningScores(**scores["default"].train.model_dump()))
    assert (
        provenance.command
        == f"edge-agent tune --seed 4 --ants 3 --iterations 2 --repeats 1 --objective {objective} "
        "--quick"
    )
    assert (
        max(scores, key=lambda way: tune._search_worth(scores[way].held_out, objective))
        == tuned.document.winner
    )
    assert {way: len(found) for way, found in tuned.document.candidates.items()} == {
        "random": 1,
        "colony": 1,
    }
    assert provenance.budget.evaluations == {"random": 6, "colony": 6}


def test_unusable_output_and_time_are_refused_before_the_search(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "d.parquet"
    files = ["--out", str(log), "--vehicle-out", str(log.with_suffix(".json"))]
    assert main(["simulate", "slalom", "--duration", "1", *files]) == 0
    before = log.read_bytes()
    capsys.readouterr()
    words = ["tune", str(log), "--quick", "--out"]
    for out in (log, log.with_suffix(".json"), tmp_path):
        assert main([*words, str(out)]) == 2
        assert capsys.readouterr().err.startswith("error: out: ")
    assert log.read_bytes() == before
    table = pq.read_table(log)
    pq.write_table(table.set_column(0, "t", pa.array([0.0] * table.num_rows)), log)
    assert main([*words, str(tmp_path / "tuned.json")]) == 2
    assert f"error: log: {log}: most samples have the same time" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "value"),
    [("--ants", "0"), ("--repeats", "0"), ("--iterations", "-2"), ("--seed", "-1")],
)
def test_options_out_of_range_are_refused_by_name(option: str, value: str) -> None:
    with pytest.raises(InputError, match=option):
        tune.run(arguments("--quick", option, value))


def test_progress_line_has_iteration_best_mean_elapsed_and_remaining() -> None:
    lines: list[str] = []
    now = iter([100.0, 102.0])
    print_progress = tune.progress_printer("colony", 5, lambda: next(now), lines.append)
    print_progress(Iteration(1, -1.25, -2.5, 12))
    words = " ".join(lines[0].split())
    assert words == "colony 1/5 best -1.2500 mean -2.5000 evaluations 12 elapsed 2 s left 8 s"


def test_table_has_a_row_per_way_and_set_of_drives() -> None:
    score = Score(interval_score=0.5, coverage=0.9, log_likelihood=1.0, nis_ratio=1.1)
    rows = tune.comparison_table(
        {way: SplitScores(train=score, held_out=score) for way in WAYS}
    ).splitlines()[1:]
    assert [row.split()[0] for row in rows] == [way for way in WAYS for _ in range(2)]


def test_other_drive_gives_another_score(drives: TuningSet) -> None:
    other = record_drives((replace(TRAIN[0], seed=77), *TRAIN[1:3]), 4.0)
    assert scores_of(Memberships(), other, ESTIMATOR) != scores_of(Memberships(), drives, ESTIMATOR)


def test_tuning_can_use_the_users_own_drives(tmp_path: Path) -> None:
    """A user's recorded drives, in which the true friction is unknown, must be usable for tuning.
    The fuzzy sets are then scored by how well the filter predicts the next measurement, on the last
    third of the recordings.
    """
    logs = []
    found = []
    for name, seed in (("one", "1"), ("two", "2")):
        logs.append(str(tmp_path / f"{name}.parquet"))
        words = [
            "--duration",
            "6",
            "--seed",
            seed,
            "--sensors",
            "rough",
            "--rate",
            "50",
            "--out",
            logs[-1],
        ]
        assert (
            main(["simulate", "slalom", *words, "--vehicle-out", str(tmp_path / "car.json")]) == 0
        )
    car = ["--vehicle", str(tmp_path / "car.json")]
    for given in (logs[:1], logs):
        out = tmp_path / f"{len(given)}.json"
        assert main(["tune", *given, *car, "--quick", "--out", str(out)]) == 0
        found.append(load_tuned(out).document)
        assert found[-1].objective == "predictive"
        assert found[-1].scores["default"].held_out.interval_score is None
        assert str(tmp_path) not in out.read_text()
    assert found[0].scores != found[1].scores
    replayed = [
        "replay",
        logs[0],
        *car,
        "--memberships",
        str(out),
        "--out",
        str(tmp_path / "e.parquet"),
    ]
    assert main(replayed) in (0, 3)
    assert main(["tune", *logs, *car, "--quick", "--objective", "interval", "--out", str(out)]) == 2
    assert main(["tune", logs[0], *car, "--out", str(out)]) == 2
