"""`make spark-test`: tests that Spark reads the archive and answers every question (predefined
query) as DuckDB does. They need Java and take a minute.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pytest

from fleet_service.analytics.questions import QUESTIONS
from tests.fleet_service.analytics.agreement import differs
from tests.fleet_service.analytics.conftest import HOUR_NS
from tests.fleet_service.archive.readers import by_duckdb, by_spark

pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("ignore")]
pytest.importorskip("pyspark", reason="pip install 'gripmap[spark]'")


def test_spark_reads_the_archive(archive: Path) -> None:
    seen = by_duckdb(archive)
    assert by_spark(archive) == pytest.approx(seen)


# The question "replay" uses no query engine.
@pytest.mark.parametrize("name", [name for name in QUESTIONS if name != "replay"])
def test_engines_agree(
    asked: Callable[..., pa.Table], stations: Path, links: Path, name: str
) -> None:
    from fleet_service.analytics.synthetic import START_NS

    options: dict[str, dict[str, object]] = {
        "before-after": {"at": START_NS + 24 * HOUR_NS},
        "weather": {"stations": stations},
        "contract": {"roads": links, "level": 0.35, "within_s": 3600.0},
    }
    assert (
        differs(
            asked(name, **options.get(name, {})),
            asked(name, "spark", **options.get(name, {})),
            QUESTIONS[name],
        )
        is None
    )
