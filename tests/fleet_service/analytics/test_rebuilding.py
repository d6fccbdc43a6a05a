"""Tests that a map rebuilt zone by zone (in squares of zoom 7) equals the map from a replay of the
whole archive. The rebuild's roll-ups (hourly statistics) must equal those in the archive.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from fleet_service.analytics.past_map import map_at
from fleet_service.analytics.rebuilding import (
    Rebuild,
    rebuild,
    rebuild_zone,
    require_empty,
    zones_of,
)
from fleet_service.analytics.synthetic import SyntheticFleet
from fleet_service.archive.export.extract import Extract
from fleet_service.archive.format import layout
from fleet_service.archive.format.reading import files_near
from fleet_service.archive.maintenance import rollup
from fleet_service.cli import main
from schemas import grid
from schemas.errors import InputError
from schemas.wire import Kind
from tests.fleet_service.analytics.border import (
    BORDER,
    UNTIL,
    contents,
    difference,
    fill,
    rebuilt_map,
)

WORLD = SyntheticFleet(rows=8_000, days=1, vehicles=40, roads=6, length=60, icy=4, seed=7)


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("border") / "archive"
    fill(root, WORLD)
    return root


def rebuild_archive(root: Path, out: Path, engine: str = "local") -> Path:
    out.mkdir()
    assert sum(one.cells for one in rebuild(Rebuild(root, out, UNTIL), engine)) > 500
    return out


def test_zone_by_zone_the_map_is_that_of_a_whole_replay(archive: Path, tmp_path: Path) -> None:
    assert len(zones_of(archive)) == 3
    whole = map_at(archive, Extract(0, UNTIL))
    east = whole["longitude"].to_numpy()
    step = 360.0 / (1 << grid.CELL_ZOOM)
    sides = {bool(side) for side in east[np.abs(east - BORDER) < 2 * step] > BORDER}
    assert sides == {False, True}, "nobody crossed the border"
    assert difference(rebuilt_map(rebuild_archive(archive, tmp_path / "out")), whole) <= 1e-6


def test_the_roll_ups_are_those_of_the_archive_byte_for_byte(archive: Path, tmp_path: Path) -> None:
    out = rebuild_archive(archive, tmp_path / "out")
    assert contents(out / rollup.TABLE) == contents(archive / rollup.TABLE)
    assert len(contents(out / rollup.TABLE)) == len(
        list(layout.compacted_files(archive, Kind.OBSERVATION))
    )


def test_repeated_zone_leaves_the_same_files_and_no_draft(archive: Path, tmp_path: Path) -> None:
    out = rebuild_archive(archive, tmp_path / "out")
    before = contents(out)
    rebuild_zone(Rebuild(archive, out, UNTIL), zones_of(archive)[0])
    assert contents(out) == before
    assert {path.name for path in out.iterdir()} == {"map", "rollup"}


def test_only_files_of_zones_near_a_box_are_read(archive: Path) -> None:
    files = list(layout.compacted_files(archive, Kind.OBSERVATION))
    zones = {
        layout.partition_of(path).zone
        for path in files_near(files, (BORDER - 0.1, 57.0, BORDER + 0.1, 58.0))
    }
    assert len(zones) == 2
    assert files_near(files, None) == files
    assert not files_near(files, (0.0, 0.0, 1.0, 1.0))


def test_rebuild_reports_its_result_and_refuses_a_non_empty_folder(
    archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "rebuild",
        "--archive",
        str(archive),
        "--out",
        str(tmp_path / "out"),
        "--to",
        "2026-01-28",
    ]
    assert main(words) == 0
    assert capsys.readouterr().out.startswith(f"3 zones in {tmp_path / 'out'}: ")
    assert len(pq.read_schema(next((tmp_path / "out" / "map").glob("*/*/*.parquet"))).names) > 20
    assert main(words) == 2
    assert "give a new folder" in capsys.readouterr().err
    assert main([*words[:3], "--out", str(tmp_path / "other"), "--engine", "abacus"]) == 2
    assert "engine: 'abacus' is unknown" in capsys.readouterr().err
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="out: cannot use"):
        require_empty(tmp_path / "file")
