"""Tests of Iceberg tables over the archive: pyiceberg and DuckDB find every compacted (sorted) row
once, also after rows were removed.
"""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing, suppress
from datetime import timedelta
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from fleet_service.archive.format import layout
from fleet_service.archive.format.segments import Writer
from fleet_service.archive.identity.pseudonyms import Pseudonyms
from fleet_service.archive.maintenance import iceberg, retention
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.cli import main
from schemas.errors import InputError
from schemas.wire import Kind
from tests.benchmarks.iceberg import rows_different, table_of
from tests.fleet_service.archive.rows import START, fill, rows_of

pytest.importorskip("pyiceberg", reason="pip install 'gripmap[iceberg]'")
DATE = layout.date_of(20_000)
MONTH = f"{DATE:%Y-%m}"


def export_tables(root: Path, capsys: pytest.CaptureFixture[str], *more: str) -> dict[str, int]:
    capsys.readouterr()
    words = ["export", "iceberg", "--archive", str(root), "--catalog", uri(root), "--json", *more]
    assert main(words) == 0
    document = json.loads(capsys.readouterr().out)
    return {name: document[name] for name in ("added", "dropped", "rows")}


def uri(root: Path) -> str:
    return f"sqlite:///{root.parent}/tables.db"


def test_archive_and_catalogue_in_folders_with_spaces(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "Straßen 1" / "archive"
    root.parent.mkdir()
    fill(root, 1, 100)
    compact(root)
    assert export_tables(root, capsys)["added"] > 0
    assert export_tables(root, capsys)["added"] == 0
    assert rows_different(root, uri(root)) == 0


@pytest.mark.campaign
def test_compacted_files_are_registered_once_and_the_log_never(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "archive"
    writer = fill(root, 2, 100)
    compact(root)
    writer.write(Kind.OBSERVATION, rows_of(Kind.OBSERVATION, 30, 9))  # these rows wait in the inbox
    # Files of two days, two zones and two kinds.
    assert export_tables(root, capsys) == {
        "added": 8,
        "dropped": 0,
        "rows": 400,
    }
    assert export_tables(root, capsys) == {"added": 0, "dropped": 0, "rows": 400}
    assert rows_different(root, uri(root)) == 0
    compact(root)
    assert rows_different(root, uri(root)) == 30  # the new rows are not exported yet
    assert export_tables(root, capsys)["rows"] == 430
    assert rows_different(root, uri(root)) == 0
    table = table_of(uri(root), Kind.OBSERVATION)
    connection = table.scan(selected_fields=("cell", "boot", "mu")).to_duckdb("seen")
    assert connection.execute("select count(*), count(distinct boot) from seen").fetchone() == (
        230,
        3,
    )


def test_retention_removes_rows_from_iceberg_tables_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "archive"
    fill(root, 2, 100)
    compact(root)
    export_tables(root, capsys)
    assert retention.retire_rows(root, 31, DATE + timedelta(days=32)) == (2, 4)
    # All rows can be read, so no table refers to a deleted file.
    assert rows_different(root, uri(root)) == 0
    counts = export_tables(root, capsys)
    assert (counts["added"], counts["dropped"]) == (0, 0)
    assert 0 < counts["rows"] < 400


def test_retention_waits_for_an_unreachable_catalogue(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "archive"
    fill(root, 1, 50)
    compact(root)
    export_tables(root, capsys)
    files = sorted(root.rglob("zone=*/*.parquet"))
    (tmp_path / "tables.db").rename(tmp_path / "elsewhere.db")
    (tmp_path / "tables.db").mkdir()
    with pytest.raises(InputError, match="^catalog: sqlite://.*OperationalError"):
        retention.retire_rows(root, 31, DATE + timedelta(days=32))
    assert set(files) <= set(root.rglob("zone=*/*.parquet"))
    (tmp_path / "tables.db").rmdir()
    (tmp_path / "elsewhere.db").rename(tmp_path / "tables.db")
    assert retention.retire_rows(root, 31, DATE + timedelta(days=32)) == (2, 4)
    assert rows_different(root, uri(root)) == 0


def test_a_forgotten_vehicle_is_in_no_table_and_the_others_come_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "archive"
    pseudonyms = Pseudonyms(root / "keys")
    names = np.array([pseudonyms.of(f"sim-{k:03}", START) for k in range(5)])
    writer = Writer(root, "shard-0")
    for kind in Kind:
        rows = rows_of(kind, 100)
        rows["vehicle"] = names[np.arange(100) % 5]
        writer.write(kind, rows)
    compact(root)
    assert export_tables(root, capsys)["rows"] == 200
    assert (
        main(["forget", "--archive", str(root), "--vehicle", "sim-003", "--period", MONTH, "--yes"])
        == 0
    )
    # The rewritten files are no longer listed, and the table can be read.
    seen = table_of(uri(root), Kind.OBSERVATION).scan().to_arrow()
    assert names[3] not in seen["vehicle"].to_pylist()
    for kind in Kind:
        table = table_of(uri(root), kind)
        # An earlier snapshot lists the vehicle, but its files are deleted.
        for snapshot in table.snapshots():
            with suppress(FileNotFoundError):
                former = table.scan(snapshot_id=snapshot.snapshot_id).to_arrow()
                assert names[3] not in former["vehicle"].to_pylist()
    assert export_tables(root, capsys)["rows"] == 160
    assert export_tables(root, capsys) == {"added": 0, "dropped": 0, "rows": 160}
    assert rows_different(root, uri(root)) == 0
    for path in tmp_path.rglob("*.avro"):
        assert names[3].encode() not in path.read_bytes()


def test_iceberg_tables_can_refer_to_the_files_of_a_mirror(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "archive"
    target = tmp_path / "there"
    fill(root, 1, 50)
    assert main(["compact", "--archive", str(root), "--put-to", target.as_uri()]) == 0
    assert export_tables(root, capsys, "--at", target.as_uri())["rows"] == 100
    paths = [task.file.file_path for task in table_of(uri(root), Kind.STATE).scan().plan_files()]
    assert paths
    assert all(path.startswith(target.as_uri()) for path in paths)
    with pytest.raises(InputError, match="^catalog: this archive is registered at "):
        iceberg.register_files(root, iceberg.Place(uri(root), "other", root.as_uri()))


def test_registration_is_stored_under_stable_names(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "archive"
    fill(root, 1, 50)
    compact(root)
    export_tables(root, capsys)
    record = root / iceberg.RECORD
    stored = {"catalog": uri(root), "namespace": iceberg.NAMESPACE, "at": f"file://{root}"}
    assert json.loads(record.read_bytes()) == stored
    assert iceberg.place_of(root) == iceberg.Place(*stored.values())
    record.write_text(json.dumps({"catalog": uri(root)}))
    with pytest.raises(InputError, match="^archive: .* is damaged"):
        iceberg.place_of(root)


def test_the_namespace_is_the_one_that_is_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "archive"
    fill(root, 1, 50)
    compact(root)
    export_tables(root, capsys, "--namespace", "north")
    with closing(sqlite3.connect(tmp_path / "tables.db")) as catalogue:
        found = {
            name for (name,) in catalogue.execute("select table_namespace from iceberg_tables")
        }
    assert found == {"north"}


def test_two_archives_share_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for k in range(2):
        fill(tmp_path / f"archive-{k}", 1, 50, seed=k)
        compact(tmp_path / f"archive-{k}")
        assert export_tables(tmp_path / f"archive-{k}", capsys)["rows"] == 100
    assert export_tables(tmp_path / "archive-0", capsys) == {"added": 0, "dropped": 0, "rows": 100}
    tables = [table_of(uri(tmp_path / "archive-0"), kind) for kind in Kind]
    whole = pa.concat_tables([table.scan(selected_fields=("boot",)).to_arrow() for table in tables])
    assert set(whole["boot"].to_pylist()) == {0, 1}
    assert whole.num_rows == 200


@pytest.mark.parametrize(
    ("words", "start"),
    [
        (["--archive", "{root}"], "error: catalog: is missing for export iceberg"),
        (
            ["--archive", "{root}", "--catalog", "sqlite:///x.db", "--out", "x.csv"],
            "error: out: has no effect on export",
        ),
        (
            ["--archive", "{root}", "--catalog", "nobody-knows-it"],
            "error: catalog: nobody-knows-it: ",
        ),
    ],
)
def test_a_wrong_export_is_one_line(
    tmp_path: Path, words: list[str], start: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "inbox").mkdir()
    assert main(["export", "iceberg", *(word.format(root=tmp_path) for word in words)]) == 2
    assert capsys.readouterr().err.startswith(start)
