"""Tests that common tools open the archive without conversion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from fleet_service.archive.format import reading, readme
from fleet_service.archive.maintenance.compaction import compact
from schemas.wire import Kind
from tests.fleet_service.archive.readers import READERS, Seen
from tests.fleet_service.archive.rows import fill


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Seen]:
    """Return an archive whose rows are in compacted (sorted) files, and the results that every tool
    must read from it.
    """
    root = tmp_path_factory.mktemp("archive")
    fill(root, 3, 100)
    compact(root)
    table = pa.concat_tables(reading.read_tables(root, Kind.OBSERVATION))
    with_likelihood = table.num_rows - table["log_likelihood"].null_count
    return root, Seen(table.num_rows, float(np.mean(table["mu"].to_numpy())), with_likelihood, 2)


def test_at_least_these_tools_are_here() -> None:
    assert READERS.keys() >= {"pyarrow", "pandas", "polars", "duckdb"}


@pytest.mark.parametrize("name", READERS)
def test_a_tool_reads_the_observations(archive: tuple[Path, Seen], name: str) -> None:
    root, expected = archive
    seen = READERS[name](root)
    assert seen == pytest.approx(expected, rel=1e-5)


def test_the_page_in_an_archive_names_every_column_with_its_unit(
    archive: tuple[Path, Seen],
) -> None:
    page = (archive[0] / "README.md").read_text()
    assert page == readme.page_text()
    assert "| `speed` | float | m/s | mean speed over the visit; multiples of 0.015625 |" in page
    assert "| `vehicle_bits` | int64 | 64 bits | vehicles, about -64 ln(" in page
