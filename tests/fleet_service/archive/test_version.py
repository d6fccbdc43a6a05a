"""Tests of the versions of archive files: files of earlier versions stay readable, and a file of an
unknown version is refused but not treated as damaged. A process that only reads changes no file.
"""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fleet_service import cli
from fleet_service.app.engine import Engine
from fleet_service.archive.export import extract
from fleet_service.archive.format import layout, reading, segments, version
from fleet_service.archive.format.files import (
    COMPACTED,
    MAP,
    ROLLUP,
    SEGMENT,
    Encoding,
    write_table,
)
from fleet_service.archive.format.load import read_content
from fleet_service.archive.maintenance import rollup
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.archive.maintenance.retention import drop_checkpoints
from fleet_service.replay import checkpoints
from schemas import query, tables
from schemas.config import ServiceConfig
from schemas.errors import InputError
from schemas.wire import Kind
from tests.fleet_service.archive.reference_archive import (
    COLUMNS,
    DATA,
    ROUNDS,
    make_messages,
    now_of,
    read_map,
    write_reference_archive,
)
from tests.fleet_service.archive.rows import fill, rows_of

OLD = DATA / "v1.0"
MADE: dict[str, Any] = json.loads((OLD / "map.json").read_text())
EVERYTHING = extract.Extract(0, 2**62)


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """Return a copy of the archive that was stored before files had versions."""
    return shutil.copytree(OLD / "archive", tmp_path / "old")


def same(found: dict[str, Any], made: dict[str, Any]) -> None:
    """Assert that the map `found`, computed now, equals the stored map `made`. Rounding errors of
    single precision, and of another machine's logarithm, are allowed.

    The stored beliefs (probabilities of friction) come from the present fusion rules. A commit that
    changes the results of these rules must store them again and give the reason.
    """
    assert found["at"] == made["at"]
    np.testing.assert_allclose(found["beliefs"], made["beliefs"], rtol=0.0, atol=1e-6)
    for now, line in zip(found["cells"], made["cells"], strict=True):
        # Since version 1.2 a lower bound has no mu.
        then = line | ({"mu": None} if line["basis"] == "bound" else {})
        assert now == {name: pytest.approx(then[name], abs=1e-5) for name in COLUMNS}


def files(root: Path) -> Iterator[Path]:
    return (path for path in sorted(root.rglob("*.parquet")))


def test_kept_archive_is_of_version_one_and_has_every_kind_of_file(old: Path) -> None:
    kinds = Counter(path.relative_to(old).parts[0] for path in files(old))
    assert kinds.keys() == {"inbox", "observations", "states", "rollup", "map", "weather"}
    digests = set()
    for path in files(old):
        with pq.ParquetFile(path) as file:
            assert (
                version.check_version(
                    path, file.schema_arrow, version.entries_of(file.metadata.metadata)
                )
                == version.OLDEST
            )
            digests.add(version.schema_digest(file.schema_arrow, {}))
    assert digests == version.FIRST
    assert len(checkpoints.list_checkpoints(old)) == 1


@pytest.mark.parametrize("begin", ["checkpoint", "log"])
def test_kept_archive_gives_the_same_map_with_and_without_checkpoint(old: Path, begin: str) -> None:
    if begin == "log":
        drop_checkpoints(old)
    with closing(Engine(ServiceConfig(), old)) as engine:
        assert engine.counts.checkpoints_refused == (begin == "checkpoint"), (
            "it has no digests: the log is replayed"
        )
        same(read_map(engine, MADE["at"]), MADE)
        assert engine.alerts.count == MADE["alerts"] > 0
        engine.intake.ingest(
            [m for turn in range(ROUNDS) for m in make_messages(turn)], now_of(ROUNDS)
        )
        assert engine.counts.duplicates == 8 * 2 * ROUNDS, "it knows every batch again"
    assert not list(old.rglob("*.bad"))


def test_kept_and_new_files_compact_together_to_the_same_map(old: Path) -> None:
    with closing(Engine(ServiceConfig(), old)) as engine:
        for turn in (ROUNDS, ROUNDS + 1):
            engine.intake.ingest(list(make_messages(turn)), now_of(turn))
            engine.settlement.flush()
    drop_checkpoints(old)
    with closing(Engine(ServiceConfig(), old)) as engine:
        before = read_map(engine, now_of(ROUNDS + 2))
    rows = {str(kind): _identities(old, kind) for kind in Kind}
    assert {kind: len(found) for kind, found in rows.items()} == {"obs": 224, "state": 112}
    compact(old)
    rollup.complete_parts(old)
    assert not any(segments.list_segments(old, kind) for kind in Kind)
    versions = Counter(
        str(read_content(path).version)  # type: ignore[union-attr]
        for path in files(old)
    )
    assert versions.keys() == {"1.0", str(version.VERSION)}
    assert {str(kind): _identities(old, kind) for kind in Kind} == rows
    with closing(Engine(ServiceConfig(), old)) as engine:
        assert read_map(engine, now_of(ROUNDS + 2)) == before, "bit for bit"
    assert extract.cell_hours(old, EVERYTHING)["observations"].to_numpy().sum() == 224
    assert not list(old.rglob("*.bad"))


def test_export_reads_the_kept_files(old: Path) -> None:
    assert extract.read_observations(old, EVERYTHING).num_rows == MADE["rows"]["obs"]
    assert extract.map_then(old, EVERYTHING).num_rows == len(MADE["cells"])
    assert (
        extract.cell_hours(old, EVERYTHING)["observations"].to_numpy().sum() == 8 * 2 * ROUNDS // 2
    )


def _identities(root: Path, kind: Kind) -> list[tuple[str, int, int]]:
    found = pa.concat_tables(reading.read_tables(root, kind, ["vehicle", "seq", "row"]))
    return sorted(zip(*(found[name].to_pylist() for name in found.column_names), strict=True))


def rewrite_file(
    path: Path,
    change: Callable[[pa.Table], pa.Table],
    footer_version: str,
    encoding: Encoding = SEGMENT,
) -> None:
    """Rewrite an archive file in place as a file of another format version: `change` is applied to
    its table, and `footer_version` replaces the entries of its footer.
    """
    found = read_content(path)
    assert found is not None
    write_table(change(found.table), path, encoding, {**found.entries, version.KEY: footer_version})


def without_columns(table: pa.Table) -> pa.Table:
    return table.drop_columns(
        ["tyre_season", "abs_active", "air_temperature", "estimator", "speed"]
    )


def with_columns(table: pa.Table) -> pa.Table:
    return table.append_column(
        "road_wetness", pa.array(np.arange(table.num_rows) / 64.0, pa.float32())
    )


def test_a_missing_column_is_null_and_an_unknown_one_is_passed_over(tmp_path: Path) -> None:
    fill(tmp_path, 3, 20)
    first, second, _ = segments.list_segments(tmp_path, Kind.OBSERVATION)
    rewrite_file(first, without_columns, "1.0")
    rewrite_file(second, with_columns, "1.7")
    read = list(reading.read_tables(tmp_path, Kind.OBSERVATION))
    assert [table.schema.names for table in read] == 3 * [tables.OBSERVATION_ARCHIVE.names]
    assert [table["tyre_season"].null_count for table in read] == [20, 0, 0]
    rows = segments.rows_of(read[0])
    assert np.isnan(rows["speed"]).all()
    assert (rows["abs_active"] == -1).all()
    assert rows["abs_active"].dtype == np.int8
    assert set(rows["estimator"]) == {""}
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        assert engine.state.fusion.size
        assert engine.counts.files_set_aside == 0


def test_segments_before_1_3_have_unknown_controllers_and_wipers(tmp_path: Path) -> None:
    added = ["esc_active", "tcs_active", "wiper"]
    fill(tmp_path, 1, 20)
    (path,) = segments.list_segments(tmp_path, Kind.OBSERVATION)
    rewrite_file(path, lambda table: table.drop_columns(added), "1.2")
    (table,) = reading.read_tables(tmp_path, Kind.OBSERVATION)
    assert [table[name].null_count for name in added] == [20, 20, 20]
    rows = segments.rows_of(table)
    assert (rows["esc_active"] == -1).all()
    assert (rows["tcs_active"] == -1).all()
    assert np.isnan(rows["wiper"]).all()
    compact(tmp_path)
    assert len(_identities(tmp_path, Kind.OBSERVATION)) == 20


def test_compacting_segments_of_several_versions_loses_nothing(tmp_path: Path) -> None:
    fill(tmp_path, 3, 20)
    first, second, _ = segments.list_segments(tmp_path, Kind.OBSERVATION)
    rewrite_file(first, without_columns, "1.0")
    rewrite_file(second, with_columns, "1.7")
    before = _identities(tmp_path, Kind.OBSERVATION)
    compact(tmp_path)
    assert _identities(tmp_path, Kind.OBSERVATION) == before
    parts = []
    for path in layout.compacted_files(tmp_path, Kind.OBSERVATION):
        found = read_content(path)
        assert found is not None
        assert found.version == (1, 7), "who knows the column may be told that it is there"
        parts.append(found.table)
    table = pa.concat_tables(parts)
    assert table.schema.names == [*tables.OBSERVATION_ARCHIVE.names, "road_wetness"]
    assert (table["road_wetness"].null_count, table["tyre_season"].null_count) == (40, 20)
    assert np.sort(table["road_wetness"].drop_null().to_numpy()).tolist() == [
        k / 64.0 for k in range(20)
    ]


def test_forgetting_keeps_columns_and_version_of_a_newer_minor(old: Path) -> None:
    compact(old)
    for path in layout.compacted_files(old, Kind.OBSERVATION):
        rewrite_file(path, with_columns, "1.7", COMPACTED)
    assert (
        cli.main(["forget", "--archive", str(old), "--period", "2024-10", "--vehicle", "sim-003"])
        == 0
    )
    for path in layout.compacted_files(old, Kind.OBSERVATION):
        found = read_content(path)
        assert found is not None
        assert (found.version, "road_wetness" in found.table.column_names) == ((1, 7), True)
        assert reading.SOURCES.decode() in found.entries
    assert len(_identities(old, Kind.OBSERVATION)) == 7 * 2 * ROUNDS


def test_questions_see_files_of_several_versions_as_one_table(tmp_path: Path) -> None:
    for seed, change in enumerate((without_columns, with_columns, lambda table: table)):
        fill(tmp_path, 1, 20, seed)
        rewrite_file(segments.list_segments(tmp_path, Kind.OBSERVATION)[0], change, "1.7")
        compact(tmp_path)
    engine = pytest.importorskip("fleet_service.analytics.engines").QueryEngine(
        "duckdb", tmp_path, EVERYTHING
    )
    seen = engine.answer(engine.observations().select("seq", "tyre_season", "road_wetness"))
    assert (seen.num_rows, seen["tyre_season"].null_count, seen["road_wetness"].null_count) == (
        60,
        20,
        40,
    )


AHEAD = {
    "inbox": SEGMENT,
    "inbox/states": SEGMENT,
    "observations": COMPACTED,
    "states": COMPACTED,
    "weather": SEGMENT,
}


@pytest.mark.parametrize("folder", AHEAD)
def test_archive_of_a_newer_major_version_is_refused_untouched(old: Path, folder: str) -> None:
    path = next((old / folder).glob("*.parquet"), None) or next((old / folder).rglob("*.parquet"))
    rewrite_file(path, lambda table: table, "2.0", AHEAD[folder])
    with pytest.raises(
        InputError, match=r"^archive: .* is of version 2\.0, .* reads 1\.x; use a newer GripMap$"
    ):
        Engine(ServiceConfig(), old)
    assert path.exists()
    assert not list(old.rglob("*.bad"))


def test_the_commands_refuse_a_newer_major_version_in_one_line(
    old: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    archive = ["--archive", str(old), "--out", str(old / "out.csv")]
    for what, encoding in (("observations", COMPACTED), ("rollup", ROLLUP), ("map", MAP)):
        rewrite_file(next((old / what).rglob("*.parquet")), lambda table: table, "2.0", encoding)
        more = ["--snapshot"] if what == "map" else []  # replays read only the last month
        assert cli.main(["export", what, *archive, *more]) == 2
        assert "is of version 2.0" in capsys.readouterr().err
    rewrite_file(segments.list_segments(old, Kind.OBSERVATION)[0], lambda table: table, "3.1")
    assert cli.main(["compact", "--archive", str(old)]) == 2
    assert "is of version 3.1" in capsys.readouterr().err
    assert not list(old.rglob("*.bad"))


def test_missing_required_column_is_reported_by_name(tmp_path: Path) -> None:
    fill(tmp_path, 1, 5)
    (path,) = segments.list_segments(tmp_path, Kind.OBSERVATION)
    rewrite_file(path, lambda table: table.drop_columns(["seq"]), "1.9")
    with pytest.raises(InputError, match="^archive: a file has no column seq; "):
        Engine(ServiceConfig(), tmp_path)


def test_a_wider_type_of_the_same_column_is_read(tmp_path: Path) -> None:
    fill(tmp_path, 2, 5)
    path = segments.list_segments(tmp_path, Kind.OBSERVATION)[0]

    def wider(table: pa.Table) -> pa.Table:
        place = table.column_names.index("health")
        return table.set_column(place, "health", table["health"].cast(pa.int64()))

    rewrite_file(path, wider, "1.2")
    compact(tmp_path)
    assert (
        pa.concat_tables(reading.read_tables(tmp_path, Kind.OBSERVATION))
        .schema.field("health")
        .type
        == pa.int32()
    )
    rewrite_file(
        next(layout.compacted_files(tmp_path, Kind.OBSERVATION)),
        lambda t: t.set_column(
            t.column_names.index("health"), "health", pa.array(["flat"] * t.num_rows)
        ),
        "1.2",
    )
    with pytest.raises(InputError, match="^archive: column health is string and not int32; "):
        list(reading.read_tables(tmp_path, Kind.OBSERVATION))


@pytest.mark.parametrize(
    "name",
    ["mu_utilised", "gripmap.version", "gripmap.digest", "gripmap.sources", "log_likelihood"],
)
def test_a_changed_name_in_a_footer_is_damage_and_no_other_version(
    tmp_path: Path, name: str
) -> None:
    fill(tmp_path, 1, 5)
    compact(tmp_path)
    path = next(layout.compacted_files(tmp_path, Kind.OBSERVATION))
    assert read_content(path) is not None
    path.write_bytes(path.read_bytes().replace(name.encode(), name[:-1].encode() + b"z"))
    assert read_content(path) is None


@pytest.mark.campaign
def test_reader_skips_damaged_files_and_renames_none(
    old: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    with closing(Engine(ServiceConfig(), old)) as engine:
        harmed = [
            segments.list_segments(old, Kind.OBSERVATION)[0],
            next(layout.compacted_files(old, Kind.OBSERVATION)),
            next((old / rollup.TABLE).rglob("*.parquet")),
            next((old / "weather").glob("*.parquet")),
        ]
        for path in harmed:
            path.write_bytes(path.read_bytes()[:-30])
        whole = 8 * 2 * ROUNDS
        assert extract.read_observations(old, EVERYTHING).num_rows < whole
        assert extract.cell_hours(old, EVERYTHING)["observations"].to_numpy().sum() < whole // 2
        past = query.parse({"at": "2024-10-05T00:01:00Z"})
        assert list(engine.queries.answer(past, lambda _: True, now_of(ROUNDS)))
        log_text = caplog.text + capfd.readouterr().err  # a separate process reads historical maps
        assert all(f"{path} is damaged and is ignored" in log_text for path in harmed)
        assert all(path.exists() for path in harmed)
        assert not list(old.rglob("*.bad"))
    compact(old)
    assert [path.name for path in old.rglob("*.bad")] == [harmed[0].name + ".bad"]
    with closing(Engine(ServiceConfig(), old)) as engine:
        # The service does not read the damaged roll-up file.
        assert engine.counts.files_set_aside == 3


def test_every_written_file_states_version_and_digest(tmp_path: Path) -> None:
    write_reference_archive(tmp_path)
    for path in files(tmp_path):
        found = read_content(path)
        assert found is not None
        assert found.version == version.VERSION, path
        assert version.DIGEST in found.entries
    for path in checkpoints.list_checkpoints(tmp_path):
        for file in path.glob("*.arrow"):
            with pa.memory_map(str(file)) as source:
                metadata = pa.ipc.open_file(source).schema.metadata or {}
            assert metadata[version.KEY.encode()].decode() == str(version.VERSION)


def test_rows_with_null_are_written_again_as_they_are_read(tmp_path: Path) -> None:
    table = segments.table_of(Kind.OBSERVATION, rows_of(Kind.OBSERVATION, 5)).drop_columns(
        ["speed"]
    )
    write_table(table, tmp_path / "one.parquet", SEGMENT)
    found = read_content(tmp_path / "one.parquet")
    assert found is not None
    assert found.table.equals(table)
