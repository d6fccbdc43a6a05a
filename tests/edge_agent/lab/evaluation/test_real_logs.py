"""Tests of the evaluation of recorded drives in a folder. The estimates are compared with the true
values where these were measured. Ice that is reported on a road with grip must count as false.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from edge_agent.cli import main
from edge_agent.estimators.estimates import Column
from edge_agent.inputs.doctor.adopt import Adopted
from edge_agent.inputs.doctor.diagnosis import Diagnosis
from edge_agent.inputs.signal_log import SignalLog
from edge_agent.lab.evaluation.real_logs import LogFigures, judge_estimates, judge_folder, table_row
from edge_agent.lab.simulation.presets import PRESETS
from schemas.errors import InputError
from schemas.signals import CHANNELS, Health, S

CAR = PRESETS["sedan"].vehicle
SPEED = 20.0
TRUTH = {"t": "t", "vx": "true_vx", "vy": "true_vy", "mu": "true_mu_fl"}


def judge(
    friction: float,
    *,
    known: float | None = None,
    slippery: float = 0.0,
    health: int = 0,
    used: float = 0.0,
) -> LogFigures:
    """Return the evaluation figures of a made-up log: ten seconds at 20 m/s, with a reported
    friction interval from 0.4 to 0.8 (wider at the first sample). `friction` is the true friction
    in the log, NaN if it was not measured.
    """
    t = np.arange(0.0, 10.0, 0.01)
    signals = np.full((len(t), len(CHANNELS)), np.nan)
    signals[:, S.OMEGA : S.OMEGA + 4] = SPEED / CAR.wheel_radius
    signals[:, [S.AX, S.AY]] = [0.0, 9.81 * used]
    values = np.zeros((len(t), int(Column.WHEELS)))
    values[:, [Column.MU_LOWER, Column.MU_UPPER]] = [0.4, 0.8]
    values[0, [Column.MU_LOWER, Column.MU_UPPER]] = [0.1, 1.1]
    values[:, [Column.VX, Column.VY, Column.HEALTH]] = [SPEED, 0.5, health]
    values[:, Column.P_SLIPPERY] = slippery
    truth = {
        "vx": np.full(len(t), SPEED),
        "vy": np.full(len(t), 0.2),
        "mu": np.full(len(t), friction),
    }
    adopted = Adopted(SignalLog(t, signals, None, None, None), CAR, Diagnosis(), [])
    return judge_estimates("log", adopted, values, truth, known, 2)


@pytest.mark.parametrize(("friction", "right"), [(0.6, 1.0), (0.3, 0.0), (0.9, 0.0)])
def test_interval_is_right_only_if_it_contains_the_measured_friction(
    friction: float, right: float
) -> None:
    found = judge(friction)
    assert (found.informative, found.right) == (1.0, right)
    assert found.vy == pytest.approx(0.3)
    assert found.sideslip == pytest.approx(
        np.degrees(np.arctan(0.5 / 20.0) - np.arctan(0.2 / 20.0))
    )


@pytest.mark.parametrize(
    ("known", "used", "right"),
    [(0.8, 0.0, 1.0), (1.0, 0.0, 0.0), (None, 0.7, 1.0), (None, 0.9, 0.0)],
)
def test_interval_without_median_must_reach_known_or_used_grip(
    known: float | None, used: float, right: float
) -> None:
    assert judge(np.nan, known=known, used=used).right == right


def test_ice_is_false_on_a_road_that_grips_alone_and_contradiction_counts() -> None:
    assert judge(0.7, slippery=0.95).ice == 1.0
    assert judge(0.7, slippery=0.5).ice == 0.0
    assert np.isnan(judge(0.2, slippery=0.95).ice)
    assert judge(0.7, health=int(Health.CONTRADICTION)).contradicted == 1.0
    assert judge(0.7).contradicted == 0.0


def test_logs_of_a_folder_are_judged_and_reported(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    out = tmp_path / "out"
    logs.mkdir()
    files = ["--out", str(logs / "a.parquet"), "--vehicle-out", str(logs / "a.json")]
    assert main(["simulate", "slalom", "--duration", "8", *files]) == 0
    drive = pq.read_table(logs / "a.parquet")
    truth = drive.select(list(TRUTH.values())).rename_columns(list(TRUTH))
    pq.write_table(truth, logs / "a.truth.parquet")
    (logs / "a.meta.json").write_text(json.dumps({"mu_known": 0.5}))
    assert main(["evaluate", "--only", "real", "--logs", str(logs), "--out", str(out)]) in (0, 1)
    figures = {
        row["name"]: row["value"] for row in json.loads((out / "figures.json").read_text())[1:]
    }
    assert figures["real.logs"] == 1
    assert 0.0 < figures["real.sideslip"] < 2.0
    assert table_row(judge_folder(logs)[0]) in (out / "report.md").read_text()


def test_a_folder_without_logs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="vehicle file"):
        judge_folder(tmp_path)
    out = ["--out", str(tmp_path / "out")]
    assert main(["evaluate", "--only", "real", *out]) == 2
    assert main(["evaluate", "--logs", str(tmp_path), *out]) == 2
    assert not (tmp_path / "out").exists()
