"""Tests of three removals: of old raw rows, of old pseudonym keys, and of one vehicle's rows.
Removed data must not come back, and all other data must remain.
"""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from fleet_service.app.engine import Engine
from fleet_service.archive.export import extract, mirror
from fleet_service.archive.format import layout, reading, segments, snapshots
from fleet_service.archive.format.load import BAD
from fleet_service.archive.format.segments import Writer
from fleet_service.archive.identity.pseudonyms import Pseudonyms
from fleet_service.archive.maintenance import retention, rollup
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.cli import main
from fleet_service.ingest.inbox import Message
from schemas import grid, wire
from schemas.config import ServiceConfig
from schemas.errors import InputError
from schemas.thresholds import NS as SECOND
from schemas.wire import Batch, Kind
from tests.fleet_service.archive.rows import START, fill, identities, rows_of
from tests.fleet_service.examples import LATITUDE, LONGITUDE, batch, key
from tests.fleet_service.replay.test_checkpoints import keep

DATE = layout.date_of(20_000)
MONTH = f"{DATE:%Y-%m}"


def vehicles_in(root: Path, kind: Kind) -> list[str]:
    return sorted(
        row["vehicle"]
        for table in reading.read_tables(root, kind, ["vehicle"])
        for row in table.to_pylist()
    )


def test_retention_deletes_old_raw_rows_and_keeps_roll_ups(tmp_path: Path) -> None:
    fill(tmp_path, 2, 100)
    compact(tmp_path)
    assert retention.retire_rows(tmp_path, 31, DATE + timedelta(days=31)) == (0, 0)
    days = {
        kind: [path.name for path in layout.day_folders(tmp_path, layout.TABLES[kind])]
        for kind in Kind
    }
    assert days == {kind: [f"date={DATE}", f"date={DATE + timedelta(days=1)}"] for kind in Kind}
    whole = len(identities(tmp_path, Kind.OBSERVATION))
    done = retention.retire_rows(tmp_path, 31, DATE + timedelta(days=32))
    assert done == (2, 4)  # one day of observations and one of states, in two zones each
    left = len(identities(tmp_path, Kind.OBSERVATION))
    assert 0 < left < whole
    rolled = [
        pq.read_table(p, partitioning=None) for p in (tmp_path / rollup.TABLE).rglob("*.parquet")
    ]
    assert sum(table["observations"].to_numpy().sum() for table in rolled) == whole - left
    assert rollup.complete_parts(tmp_path) == 2  # parts of the day that was kept


def test_retention_shorter_than_batch_repetition_is_refused(tmp_path: Path) -> None:
    (tmp_path / "inbox").mkdir()
    with pytest.raises(InputError, match="^raw-days: 7 are too few "):
        retention.retire_rows(tmp_path, 7, DATE)


def test_one_vehicle_is_forgotten_and_the_others_are_not_touched(tmp_path: Path) -> None:
    pseudonyms = Pseudonyms(tmp_path / "keys")
    names = np.array([pseudonyms.of(f"sim-{k:03}", START) for k in range(5)])
    writer = Writer(tmp_path, "shard-0")
    for seed in range(3):
        for kind in Kind:
            rows = rows_of(kind, 60, seed)
            rows["vehicle"] = names[np.arange(60) % 5]
            writer.write(kind, rows)
            if seed == 1:
                compact(tmp_path)
    assert (
        main(["forget", "--archive", str(tmp_path), "--vehicle", "sim-003", "--period", MONTH]) == 0
    )
    for kind in Kind:
        assert vehicles_in(tmp_path, kind) == sorted(names[[0, 1, 2, 4]].tolist() * 36)
    rolled = [
        pq.read_table(p, partitioning=None) for p in (tmp_path / rollup.TABLE).rglob("*.parquet")
    ]
    assert sum(table["observations"].to_numpy().sum() for table in rolled) == 144
    assert compact(tmp_path) == (0, 0, 0)
    assert retention.forget_vehicle(tmp_path, "sim-003", MONTH) == (0, (), None)


def test_traces_of_a_forgotten_vehicle_are_removed_in_the_mirror_too(tmp_path: Path) -> None:
    root = tmp_path / "archive"
    target = tmp_path / "there"
    now = time.time_ns()
    month = f"{datetime.fromtimestamp(now / 1e9, UTC):%Y-%m}"
    with closing(Engine(ServiceConfig(), root)) as engine:
        for k in range(8):  # six vehicles visit one cell, two others have cells of their own
            latitude = LATITUDE if k < 6 else LATITUDE - 0.001 * k
            one = batch(
                f"car-{k:03}",
                1,
                now,
                [0.8],
                latitude=[latitude],
                cell=[grid.cell_of(latitude, LONGITUDE)],
            )
            engine.intake.ingest(
                [Message(Kind.OBSERVATION, key(one.vehicle), wire.encode(one), "")], now
            )
        engine.settlement.flush()
        snapshot = snapshots.write_snapshot(root, engine.queries.whole_map(now), now)
    assert main(["compact", "--archive", str(root), "--put-to", target.as_uri()]) == 0
    (root / "inbox" / f"shard-0-0000000001-00000001.parquet{BAD}").write_bytes(b"who knows")
    words = [
        "forget",
        "--archive",
        str(root),
        "--period",
        month,
        "--put-to",
        target.as_uri(),
        "--yes",
        "--vehicle",
    ]
    # The row of a cell with five other visitors stays. The row of a cell that only the erased
    # vehicle visited is deleted.
    for vehicle, cells in (
        ("car-001", 3),
        ("car-007", 2),
    ):
        assert main([*words, vehicle]) == 0
        for folder in (root, target):
            table = pq.read_table(folder / snapshot.relative_to(root), partitioning=None)
            assert (table.num_rows, b"geo" in (table.schema.metadata or {})) == (cells, True)
            shared = table.filter(pc.field("vehicles") > 1)
            # Times of a cell that the vehicle visited are rounded to hours.
            for name in ("first_time", "last_time"):
                assert shared[name][0].value % (3600 * 10**6) == 0
            gone = Pseudonyms(root / "keys").of(vehicle, now).encode()
            assert not [path for path in folder.rglob("*.parquet") if gone in path.read_bytes()]
    assert not list(root.rglob(f"*{BAD}"))


def test_a_destroyed_key_makes_the_way_back_to_a_name_unknown(tmp_path: Path) -> None:
    before = Pseudonyms(tmp_path / "keys").of("sim-003", START)
    assert main(["forget", "--archive", str(tmp_path), "--period", MONTH]) == 0
    assert Pseudonyms(tmp_path / "keys").of("sim-003", START) != before


NOON = int(datetime(2026, 1, 31, 12, tzinfo=UTC).timestamp()) * SECOND
DAY = 86_400 * SECOND
ERASED = "time: the data of this month or vehicle were erased; delete the batch"


def acknowledge_batch(engine: Engine, sent: Batch, now: int) -> list[str]:
    """Let the engine (service without network) process the batch `sent`, and write a segment (file
    of new rows). Return the kinds of acknowledgement of the batch.
    """
    engine.intake.ingest([Message(sent.kind, key(sent.vehicle), wire.encode(sent), "")], now)
    streams = [
        stream for _, data in engine.settlement.flush() for stream in wire.decode_ack(data)[1]
    ]
    assert all(stream.durable in ((), ((sent.seq, sent.seq),)) for stream in streams)
    return [
        *("durable" for one in streams if one.durable),
        *(why for one in streams for *_, why in one.rejected),
    ]


def rows_kept(root: Path) -> int:
    return sum(table.num_rows for table in reading.read_tables(root, Kind.OBSERVATION, ["vehicle"]))


def test_measurements_of_a_forgotten_month_stay_refused_over_restarts(tmp_path: Path) -> None:
    """A batch of a month whose data are erased must be refused, also after restarts. The archive
    cannot recognise such a batch any more. A vehicle's outbox (store of unacknowledged messages)
    may send it again if the acknowledgement was lost.
    """
    old = batch("car-001", 1, NOON, [0.8])
    away = batch("car-002", 1, NOON - DAY, [0.8])
    after = NOON + 3 * DAY
    later = batch("car-001", 2, after, [0.8])
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        assert acknowledge_batch(engine, old, after + SECOND) == ["durable"]
        assert acknowledge_batch(engine, later, after + SECOND) == ["durable"]
    assert main(["forget", "--archive", str(tmp_path), "--period", "2026-01", "--yes"]) == 0
    for _ in range(2):  # first replayed from the log, then from a checkpoint
        with closing(Engine(ServiceConfig(), tmp_path)) as engine:
            assert acknowledge_batch(engine, old, after + SECOND) == [ERASED], (
                "settled, or its car would send it for ever"
            )
            assert acknowledge_batch(engine, away, after + SECOND) == [ERASED], (
                "of that month, and never there"
            )
            assert acknowledge_batch(engine, later, after + SECOND) == ["durable"]
            assert (engine.counts.refused["erased"], engine.counts.duplicates) == (2, 1)
            assert rows_kept(tmp_path) == 2
            assert engine.state.fusion.live.visits[: engine.state.fusion.size].sum() == 2
            keep(engine, tmp_path)
    assert not list((tmp_path / "keys").glob("2026-01.key"))


def test_a_forgotten_vehicles_measurements_stay_refused_over_restarts(tmp_path: Path) -> None:
    """Reports of an erased vehicle must be refused, also after restarts. A vehicle's outbox (store
    of unacknowledged messages), restored from a backup, may send reports that were acknowledged
    long ago.
    """
    old, other, late = (batch(f"car-00{k}", 1, NOON + k * SECOND, [0.8]) for k in (1, 2, 3))
    late = replace(late, vehicle="car-001", boot=2)
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        for one in (old, other):
            assert acknowledge_batch(engine, one, NOON + DAY) == ["durable"]
    assert retention.forget_vehicle(tmp_path, "car-001", "2026-01").rows == 1
    for _ in range(2):
        with closing(Engine(ServiceConfig(), tmp_path)) as engine:
            assert acknowledge_batch(engine, replace(old, boot=9), NOON + DAY) == [ERASED], (
                "told as a new one"
            )
            assert acknowledge_batch(engine, other, NOON + DAY) == ["durable"], (
                "known, and counted once"
            )
            assert acknowledge_batch(engine, late, NOON + DAY) == ["durable"], "measured since"
            assert engine.counts.refused["erased"] == 1
        assert rows_kept(tmp_path) == 2
    (mark,) = (tmp_path / "keys").glob("*.erased")
    assert Pseudonyms(tmp_path / "keys").of("car-001", NOON) in mark.name
    retention.forget_period(tmp_path, "2026-01")
    assert [path.name.count(".") for path in (tmp_path / "keys").glob("*.erased")] == [2], (
        "it goes with the key"
    )


def test_forgetting_a_month_does_not_readmit_an_already_forgotten_vehicle(
    tmp_path: Path,
) -> None:
    other, last = (batch(f"car-00{k}", 1, NOON + k * SECOND, [0.8]) for k in (1, 2))
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        assert [acknowledge_batch(engine, one, NOON + DAY) for one in (other, last)] == [
            ["durable"],
            ["durable"],
        ]
    retention.forget_vehicle(tmp_path, "car-002", "2026-01")
    retention.forget_period(tmp_path, "2026-01")
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        assert [acknowledge_batch(engine, one, NOON + DAY) for one in (other, last)] == [
            [ERASED],
            [ERASED],
        ]


def test_a_file_whose_only_vehicle_was_forgotten_is_empty_and_not_damaged(tmp_path: Path) -> None:
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        assert acknowledge_batch(engine, batch("car-001", 1, NOON, [0.8]), NOON + DAY) == [
            "durable"
        ]
    assert retention.forget_vehicle(tmp_path, "car-001", "2026-01").rows == 1
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        assert engine.counts.files_set_aside == 0
    assert not list(tmp_path.rglob(f"*{BAD}"))
    assert rows_kept(tmp_path) == 0


def test_forgetting_the_current_month_ends_at_its_newest_row(tmp_path: Path) -> None:
    seen = batch("car-001", 1, NOON - DAY, [0.8])
    new = batch("car-001", 2, NOON, [0.8])
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        assert acknowledge_batch(engine, seen, NOON) == ["durable"]
    assert main(["forget", "--archive", str(tmp_path), "--period", "2026-01", "--yes"]) == 0
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        assert [acknowledge_batch(engine, one, NOON) for one in (seen, new)] == [
            [ERASED],
            ["durable"],
        ]
    assert rows_kept(tmp_path) == 2


@pytest.mark.parametrize(
    ("period", "problem"), [("2026-13", "is not a month"), ("1999-01", "has no key of 1999-01")]
)
def test_invalid_period_is_reported(tmp_path: Path, period: str, problem: str) -> None:
    with pytest.raises(InputError, match=f"^period: .*{problem}"):
        retention.forget_vehicle(tmp_path, "sim-003", period)


def test_forget_refuses_an_archive_with_a_running_service(tmp_path: Path) -> None:
    with (
        closing(Engine(ServiceConfig(), tmp_path)),
        pytest.raises(InputError, match="belongs to a running service"),
    ):
        retention.forget_period(tmp_path, MONTH)


def test_compacted_files_are_mirrored_once_per_version(tmp_path: Path) -> None:
    root = tmp_path / "archive"
    target = tmp_path / "there"
    fill(root, 2, 50)
    assert main(["compact", "--archive", str(root), "--put-to", target.as_uri()]) == 0
    copies = {path.relative_to(target): path.read_bytes() for path in target.rglob("*.parquet")}
    originals = [path for folder in mirror.FOLDERS for path in (root / folder).rglob("*.parquet")]
    assert copies == {path.relative_to(root): path.read_bytes() for path in originals}
    assert not [path for path in target.rglob("*") if path.name.endswith(".tmp")]
    assert mirror.copy_new_files(root, target.as_uri()) == 0
    originals[0].write_bytes(originals[1].read_bytes() + b"")
    assert mirror.copy_new_files(root, target.as_uri()) == 1
    with pytest.raises(InputError, match="^put_to: cannot use nonsense://x "):
        mirror.copy_new_files(root, "nonsense://x")


@pytest.mark.parametrize("ending", [".parquet", ".geojson", ".csv"])
@pytest.mark.parametrize("what", ["observations", "rollup"])
def test_parts_are_exported(
    tmp_path: Path, what: str, ending: str, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "archive"
    out = tmp_path / f"out{ending}"
    fill(root, 2, 50)
    assert main(["compact", "--archive", str(root)]) == 0
    capsys.readouterr()
    words = [
        "--bbox",
        "11.9,57,12.1,58",
        "--from",
        str(DATE),
        "--to",
        str(DATE + timedelta(days=1)),
    ]
    assert main(["export", what, "--archive", str(root), *words, "--out", str(out)]) == 0
    rows = pa.concat_tables(reading.read_tables(root, Kind.OBSERVATION))
    inside = (segments.to_nanoseconds(rows["leave_time"]) < START + 600 * 10**9) & (
        rows["latitude"].to_numpy() > 57
    )
    printed_rows = int(capsys.readouterr().out.split()[0])
    assert 0 < printed_rows <= inside.sum()
    assert what == "rollup" or printed_rows == inside.sum()
    if ending == ".parquet":
        assert pq.read_table(out).num_rows == printed_rows


@pytest.mark.parametrize(
    ("words", "start"),
    [
        (["map", "--snapshot", "--out", "map.parquet"], "error: to: the archive has no snapshot"),
        (["observations", "--out", "x.xls"], "error: out: x.xls has no known ending"),
        (
            ["observations", "--from", "yesterday", "--out", "x.csv"],
            "error: from: 'yesterday' is not a time",
        ),
        (["observations", "--out", "/nowhere/at/all.csv"], "error: out: cannot write"),
    ],
)
def test_a_wrong_export_is_one_line(
    tmp_path: Path, words: list[str], start: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "inbox").mkdir()
    assert main(["export", *words, "--archive", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith(start)


def test_an_export_of_the_map_is_the_newest_snapshot_before_a_time(tmp_path: Path) -> None:
    from fleet_service.archive.format import snapshots
    from tests.fleet_service.archive.test_geo import a_map

    for k, cells in enumerate((5, 9)):
        snapshots.write_snapshot(tmp_path, a_map(cells), START + k * 3600 * 10**9)
    assert extract.map_then(tmp_path, extract.Extract(0, START + 1800 * 10**9)).num_rows == 5
    assert extract.map_then(tmp_path, extract.Extract(0, START + 3600 * 10**9)).num_rows == 9
