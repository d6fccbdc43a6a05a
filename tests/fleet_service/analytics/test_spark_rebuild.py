"""`make spark-test`: tests that a rebuild of the map on Spark equals a local one byte for byte,
also if tasks are killed meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from fleet_service.analytics.rebuilding import (
    Rebuild,
    RebuildResult,
    rebuild,
    rebuild_zone,
    zones_of,
)
from fleet_service.analytics.synthetic import SyntheticFleet
from schemas.errors import InputError
from schemas.runtime import spark
from tests import spark_sessions
from tests.fleet_service.analytics.border import UNTIL, contents, fill

pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("ignore")]
pytest.importorskip("pyspark", reason="pip install 'gripmap[spark]'")

WORLD = SyntheticFleet(rows=4_000, days=1, vehicles=30, roads=6, length=60, icy=4, seed=8)


@pytest.fixture(scope="module")
def session() -> Iterator[Any]:
    with spark_sessions.spark_session(2) as found:
        yield found


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("border") / "archive"
    fill(root, WORLD)
    return root


def test_both_engines_write_the_same_bytes(
    session: Any,  # noqa: ANN401
    archive: Path,
    tmp_path: Path,
) -> None:
    done: dict[str, list[RebuildResult]] = {}
    for engine in ("local", "spark"):
        (tmp_path / engine).mkdir()
        done[engine] = list(rebuild(Rebuild(archive, tmp_path / engine, UNTIL), engine))
    assert done["spark"] == done["local"]
    assert contents(tmp_path / "spark") == contents(tmp_path / "local")
    assert len(contents(tmp_path / "local")) > 3


def test_a_task_whose_process_is_killed_after_it_wrote_counts_once(
    session: Any,  # noqa: ANN401
    archive: Path,
    tmp_path: Path,
) -> None:
    out = tmp_path / "out"
    tries = tmp_path / "tries"
    out.mkdir()
    dying = spark_sessions.killed_at_first(
        partial(rebuild_zone, Rebuild(archive, out, UNTIL)), str, tries
    )
    zones = zones_of(archive)
    outcomes = spark.run_tasks(session, zones, dying)
    assert {path.name for path in tries.iterdir()} == {str(zone) for zone in zones}, (
        "none was killed"
    )
    (tmp_path / "local").mkdir()
    assert outcomes == list(rebuild(Rebuild(archive, tmp_path / "local", UNTIL)))
    assert contents(out) == contents(tmp_path / "local")


def _refuse_task(task: str) -> str:
    raise InputError("log", f"{task} is no log", "give another")


def test_errors_of_spark_tasks_are_reported_as_input_errors(
    session: Any,  # noqa: ANN401
) -> None:
    with pytest.raises(InputError, match="log: 1.parquet is no log; give another"):
        spark.run_tasks(session, ["1.parquet"], _refuse_task)
    with pytest.raises(InputError, match="engine: Spark gave up: "):
        spark.run_tasks(session, ["x"], partial(int, base=10))
    assert spark.run_tasks(session, [], _refuse_task) == []
