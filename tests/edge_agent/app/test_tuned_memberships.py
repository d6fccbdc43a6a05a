"""Tests of files with tuned memberships (parameters of fuzzy sets). They must state their origin,
and an invalid file must be refused with the name of its wrong field.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app.tuned_memberships import (
    FOLDER,
    WAYS,
    Document,
    load_tuned,
    parse_tuned,
    save_tuned,
    shipped_memberships,
)
from edge_agent.cli.tune import DURATION_S
from edge_agent.lab.tuning import study
from edge_agent.lab.tuning.objectives import TuningScores, detection_cost, record_all, scores_of
from schemas.errors import InputError

Change = Callable[[dict[str, Any]], object]


def document(memberships: Memberships | None = None) -> dict[str, Any]:
    """Return the content of a complete file of tuned memberships (parameters of fuzzy sets), as
    parsed JSON.
    """
    score = {"interval_score": 0.5, "coverage": 0.9, "log_likelihood": 1.5, "nis_ratio": 0.9}
    return {
        "estimator": "aco-fckf",
        "memberships": (memberships or Memberships()).to_json(),
        "objective": "interval",
        "scores": {way: {"train": dict(score), "held_out": dict(score)} for way in WAYS},
        "provenance": {
            "command": "edge-agent tune --seed 3",
            "seed": 3,
            "date": "2026-01-31T07:00:00+00:00",
            "commit": "unknown",
            "machine": "any",
            "versions": {"numpy": "2.1"},
            "budget": {"ants": 2, "iterations": 3, "evaluations": {"random": 6, "colony": 5}},
        },
    }


def test_memberships_and_provenance_survive_the_way_through_a_file(tmp_path: Path) -> None:
    path = tmp_path / "new" / "tuned.json"
    written = Document.model_validate(document(Memberships(ln_scales=(0.3, -0.2))))
    save_tuned(path, written)
    read = load_tuned(path)
    assert read.document == written
    assert read.memberships == Memberships(ln_scales=(0.3, -0.2))


def broken(change: Change) -> str:
    """Return the text of a file of tuned memberships (parameters of fuzzy sets) after `change` has
    made it invalid.
    """
    spoiled = document()
    change(spoiled)
    return json.dumps(spoiled)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (
            lambda d: d["memberships"].update(inputs=[-0.8, 0.0, -0.4, 1.0, 4.0]),
            "memberships.inputs",
        ),
        (
            lambda d: d["memberships"].update(outputs=[0.2, 0.1, 0.0, -0.1, -0.2]),
            "memberships.outputs",
        ),
        (lambda d: d["memberships"].update(ln_scales=[9.0, 0.0]), "memberships.ln_scales"),
        (lambda d: d["memberships"].update(inputs=[-0.8, 0.0]), "memberships.inputs"),
        (lambda d: d["memberships"].pop("outputs"), "memberships.outputs"),
        (lambda d: d["memberships"].update(vertices=[1.0]), "memberships.vertices"),
        (lambda d: d["scores"].pop("random"), "scores.random"),
        (
            lambda d: d["scores"]["colony"]["held_out"].pop("nis_ratio"),
            "scores.colony.held_out.nis_ratio",
        ),
        (lambda d: d["provenance"].pop("command"), "provenance.command"),
        (lambda d: d["provenance"].update(seed=-1), "provenance.seed"),
        (lambda d: d["provenance"]["budget"].update(ants=0), "provenance.budget.ants"),
        (lambda d: d.update(note="x"), "note"),
    ],
)
def test_a_broken_document_is_refused_by_the_name_of_its_field(change: Change, field: str) -> None:
    with pytest.raises(InputError) as refused:
        parse_tuned(broken(change), "tuned file")
    assert refused.value.field == field
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("number", ["NaN", "Infinity"])
def test_numbers_that_are_not_finite_are_refused(number: str) -> None:
    text = json.dumps(document()).replace('"nis_ratio": 0.9', f'"nis_ratio": {number}', 1)
    with pytest.raises(InputError, match="nis_ratio"):
        parse_tuned(text, "tuned file")


def test_text_that_is_not_json_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        parse_tuned("{", "tuned file")
    with pytest.raises(InputError, match="cannot read"):
        load_tuned(tmp_path / "none.json")
    with pytest.raises(InputError, match="cannot read"):
        shipped_memberships("ckf")


def test_a_file_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="out"):
        save_tuned(tmp_path, Document.model_validate(document()))


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.json")), ids=lambda path: path.stem)
def test_shipped_memberships_load_cover_the_range_and_state_origin(path: Path) -> None:
    tuned = load_tuned(path)
    assert tuned.document.estimator == path.stem
    lower, upper = Memberships.bounds()
    vector = tuned.memberships.to_vector()
    assert np.all((lower <= vector) & (vector <= upper))
    assert tuned.memberships.inputs[0] < 0.0 < tuned.memberships.inputs[-1]
    assert tuned.document.provenance.command.startswith("edge-agent tune --seed")
    assert "--quick" not in tuned.document.provenance.command


def test_the_default_estimator_has_a_shipped_file() -> None:
    assert load_tuned(FOLDER / "aco-fckf.json").document.estimator == "aco-fckf"


def test_shipped_memberships_are_those_that_do_best_held_out() -> None:
    document = load_tuned(FOLDER / "aco-fckf.json").document
    held_out = {
        way: detection_cost(TuningScores(**document.scores[way].held_out.model_dump()))
        for way in WAYS
    }
    best = min(WAYS, key=held_out.__getitem__)
    assert document.winner == best
    kept = [Memberships.from_json(one) for one in document.candidates.get(best, [])]
    assert shipped_memberships("aco-fckf") in (kept or [Memberships()])


def test_memberships_of_the_papers_filter_gain_on_held_out_drives() -> None:
    scores = load_tuned(FOLDER / "paper-aco-fckf.json").document.scores
    default = scores["default"].held_out.log_likelihood
    colony = scores["colony"].held_out.log_likelihood
    assert colony > default + 1.0
    found = study.mean_log_likelihood(
        shipped_memberships("paper-aco-fckf"), study.record_noisy_drives(study.HELD_OUT)
    )
    assert found == pytest.approx(colony, rel=0.02)


@pytest.mark.campaign
def test_scores_in_the_shipped_file_are_those_of_the_filter_as_it_is() -> None:
    """The present filter with the shipped memberships (parameters of fuzzy sets) must reach the
    interval score that their file states for the held-out drives. If the filter was changed since
    the tuning, repeat the tuning with `provenance.command` of the file.
    """
    document = load_tuned(FOLDER / "aco-fckf.json").document
    found = scores_of(
        shipped_memberships("aco-fckf"), record_all("held_out", DURATION_S), "aco-fckf"
    )
    assert found.interval_score == pytest.approx(
        document.scores[document.winner].held_out.interval_score, rel=0.02
    )
