"""Tests of the option of `edge-agent replay` that adds further estimators to a drive's report. The
added estimators must appear in the report, and the option must be refused if no report is
requested.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from edge_agent.cli import main


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """Return the log of a simulated drive of two seconds. The log's folder also contains the
    vehicle file.
    """
    log = tmp_path / "drive.parquet"
    vehicle = ["--vehicle-out", str(tmp_path / "drive.json")]
    assert main(["simulate", "slalom", "--duration", "2", "--out", str(log), *vehicle]) == 0
    return log


def test_compared_estimators_stand_in_the_report(drive: Path, tmp_path: Path) -> None:
    report = tmp_path / "drive.html"
    code = main(["replay", str(drive), "--out", str(report), "--compare", "sr-ukf"])
    assert code in (0, 3)
    assert "sr-ukf" in report.read_text()


def test_comparison_without_a_report_is_refused(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "estimates.parquet")
    assert main(["replay", str(drive), "--out", out, "--compare", "sr-ukf"]) == 2
    assert "compare: works only with a report" in capsys.readouterr().err
