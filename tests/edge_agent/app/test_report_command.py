"""Tests of the option of `edge-agent replay` that adds further estimators to a drive's report. The
added estimators must appear in the report, and the option must be refused if no report is
requested.
"""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
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


def test_report_contains_the_compared_estimators(drive: Path, tmp_path: Path) -> None:
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


def test_report_of_an_implausible_drive_states_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = tmp_path / "drive.parquet"
    vehicle = tmp_path / "drive.json"
    assert main(["simulate", "slalom", "--out", str(drive), "--vehicle-out", str(vehicle)]) == 0
    log = pq.read_table(drive)
    degrees = pc.multiply(log["yaw_rate"], pa.scalar(57.3, log["yaw_rate"].type))
    log = log.set_column(log.column_names.index("yaw_rate"), "yaw_rate", degrees)
    wrong = tmp_path / "wrong.parquet"
    pq.write_table(log, wrong)
    words = ["replay", str(wrong), "--vehicle", str(vehicle), "--out"]
    for suffix in (".csv", ".html"):
        assert main([*words, str(tmp_path / f"wrong{suffix}")]) == 3
        assert "NOT PLAUSIBLE" in capsys.readouterr().err


@pytest.mark.parametrize("command", [["check"], ["replay", "--out", "estimates.parquet"]])
def test_a_missing_log_is_named_before_its_vehicle_file(
    command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, "missing.parquet"]) == 2
    assert "log: missing.parquet does not exist" in capsys.readouterr().err
