"""`make spark-test`: tests that drives estimated on Spark give the same bytes as on this machine,
also if tasks or workers of Spark die.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from edge_agent.app.backfill import estimate_atomically, estimate_drives, tasks_of
from edge_agent.cli import main
from schemas.runtime import spark
from tests import spark_sessions

pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("ignore")]
pytest.importorskip("pyspark", reason="pip install 'gripmap[spark]'")

DRIVES = 3
ESTIMATOR = "aco-fckf"  # `make setup` compiles it; the first run of another estimator takes minutes


@pytest.fixture(scope="module")
def session() -> Iterator[Any]:
    with spark_sessions.spark_session(2) as found:
        yield found


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("drives")
    for seed in range(DRIVES):
        files = [
            "--out",
            str(folder / f"d{seed}.parquet"),
            "--vehicle-out",
            str(folder / f"d{seed}.json"),
        ]
        assert main(["simulate", "slalom", "--duration", "2", "--seed", str(seed), *files]) == 0
    return sorted(folder.glob("*.parquet"))


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_both_engines_write_the_same_bytes_and_errors(
    session: Any,  # noqa: ANN401
    drives: list[Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bad = tmp_path / "bad.parquet"
    bad.write_bytes(b"no log")
    bad.with_suffix(".json").write_bytes(drives[0].with_suffix(".json").read_bytes())
    for engine in ("local", "spark"):
        words = [
            "replay",
            *map(str, [*drives, bad]),
            "--out",
            str(tmp_path / engine),
            "--estimator",
            ESTIMATOR,
        ]
        assert main([*words, "--engine", engine]) == 2
        stderr = capsys.readouterr().err
        assert f"error: {bad}: log:" in stderr
        assert f"4 of 4 logs, {DRIVES * 200} samples" in stderr
    assert len(contents(tmp_path / "local")) == DRIVES
    assert contents(tmp_path / "spark") == contents(tmp_path / "local")


def test_a_task_whose_process_is_killed_after_it_wrote_counts_once(
    session: Any,  # noqa: ANN401
    drives: list[Path],
    tmp_path: Path,
) -> None:
    (tmp_path / "spark").mkdir()
    work = partial(estimate_atomically, estimator=ESTIMATOR, memberships=None)
    dying = spark_sessions.killed_at_first(work, lambda task: task.log.name, tmp_path / "tries")
    outcomes = spark.run_tasks(session, tasks_of(drives, None, tmp_path / "spark"), dying)
    assert sorted(path.name for path in (tmp_path / "tries").iterdir()) == [
        path.name for path in drives
    ], "all died"
    assert [outcome.samples for outcome in outcomes] == [200] * DRIVES
    list(estimate_drives(tasks_of(drives, None, tmp_path / "local"), ESTIMATOR, 1))
    assert contents(tmp_path / "spark") == contents(tmp_path / "local")
