"""Tests of the example program of the analytics documentation: it writes the files that the
documentation shows, from a given archive or from a synthetic one.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from fleet_service.analytics import example
from fleet_service.analytics.synthetic import SyntheticFleet


@pytest.mark.campaign
def test_the_example_draws_its_figures(
    tmp_path: Path, archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert example.main(["--archive", str(archive), "--out", str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        "grip.html",
        "worst.html",
        "spells.png",
        "before-after.png",
        "vehicles.png",
    }
    assert "worst: the most slippery stretches" in capsys.readouterr().out


def test_without_an_archive_it_makes_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(example, "WORLD", SyntheticFleet(2000, 1, 10, 4, 40, 4))
    assert example.main(["--out", str(tmp_path)]) == 0
    assert list((tmp_path / "archive" / "observations").rglob("*.parquet"))
