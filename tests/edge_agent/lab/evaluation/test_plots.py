"""Tests that every plot has a caption, and that an estimator has the same colour in all plots."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge_agent.app.estimator_factory import bank_of
from edge_agent.lab.evaluation import plots
from edge_agent.lab.evaluation.batch import run_estimator, simulate_realistic
from edge_agent.lab.evaluation.campaign import PlottedDrive
from edge_agent.lab.evaluation.detection import ROC_FLAG_MU, ROC_NATS
from edge_agent.lab.seeds import FIGURES
from schemas.runtime.figures import Figure
from schemas.runtime.palette import line_of


@pytest.fixture(scope="module")
def drives() -> dict[str, PlottedDrive]:
    """Return a drive, a double lane change, with the estimates of each of two estimators, by
    estimator name.
    """
    batch = simulate_realistic(plots.SCENARIOS["004.dlc"], [FIGURES])
    return {
        name: PlottedDrive(batch, run_estimator(bank_of(name, batch.vehicles), batch))
        for name in ("ckf", "sr-ukf")
    }


def test_title_states_manoeuvre_speed_friction_vehicle_and_seed(
    drives: dict[str, PlottedDrive],
) -> None:
    title = plots.drive_title("004.dlc", drives["ckf"], 7)
    assert title == "004.dlc: double lane change, 80 km/h\nfrom 22 m/s, μ 0.85, sedan, seed 7"
    assert plots.drive_title("of a user", drives["ckf"], 7).startswith("of a user: drive\n")


def test_the_roc_plot_shows_belief_slip_flag_and_oracle(tmp_path: Path) -> None:
    names = [f"roc.{limit:g}" for limit in ROC_NATS] + [f"flag.{limit:g}" for limit in ROC_FLAG_MU]
    found = [
        Figure(f"{name}.{what}.rough", 0.5, "1")
        for name in names
        for what in ("ice", "snow", "false_events")
    ]
    found += [
        Figure("passes.ice.short.rough", 0.8, "1"),
        Figure("false_events.short.rough", 50.0, "per 1000 km"),
    ]
    found += [Figure("oracle.ice.favoured.short.rough", 0.9, "1")]
    text = plots.draw_detection(found, tmp_path / "detection.svg").read_text()
    assert text.startswith("<?xml")
    assert line_of("aco-fckf").colour in text


@pytest.mark.campaign
def test_a_plot_is_a_picture_or_print_and_an_estimator_has_its_colour(
    drives: dict[str, PlottedDrive], tmp_path: Path
) -> None:
    for form, begin in (("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")):
        path = plots._scenario("004.dlc", dict(reversed(drives.items())), 7, tmp_path / f"a.{form}")
        assert path.read_bytes().startswith(begin)
    text = (tmp_path / "a.svg").read_text()
    assert all(line_of(name).colour in text for name in drives)
    assert line_of("ckf") != line_of("sr-ukf")
    assert line_of("of a user").colour not in text
