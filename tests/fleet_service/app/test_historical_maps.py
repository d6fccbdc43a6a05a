"""Tests that a map of the past is rebuilt in a subprocess from a limited number of rows, and that a
query which needs more rows is refused.
"""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray

from fleet_service.app import historical_maps
from fleet_service.app.engine import Engine
from fleet_service.archive.format import files, layout, segments
from fleet_service.archive.format.load import load_groups, load_rows
from fleet_service.archive.format.row_filter import ValueRange
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.ingest.inbox import Message
from fleet_service.replay.rebuild import rows_near
from schemas import query, wire
from schemas.config import ServiceConfig
from schemas.errors import InputError
from schemas.wire import Kind
from tests.fleet_service.examples import LATITUDE, LONGITUDE, TILE, batch, key
from tests.waiting import freeze

NEAR = f"{LONGITUDE - 0.1},{LATITUDE - 0.1},{LONGITUDE + 0.1},{LATITUDE + 0.1}"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Return an archive with some rows of one cell in compacted (sorted) files."""
    now = time.time_ns()
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        for seq in range(1, 5):
            sent = [batch(f"car-{k:03}", seq, now, [0.8] * 20) for k in range(5)]
            engine.intake.ingest(
                [Message(Kind.OBSERVATION, key(b.vehicle), wire.encode(b), "") for b in sent], now
            )
            engine.settlement.flush()
    compact(tmp_path)
    return tmp_path


def question(**parameters: str) -> historical_maps.PastQuery:
    return historical_maps.PastQuery(query.parse(parameters), time.time_ns(), 120.0, None)


@pytest.fixture
def asker(root: Path) -> Iterator[historical_maps.HistoricalMaps]:
    with closing(historical_maps.HistoricalMaps(root)) as asker:
        yield asker


def test_rows_are_counted_before_any_is_read(root: Path) -> None:
    now = time.time_ns()
    assert rows_near(root, now, None, 10**6) == 400
    assert rows_near(root, now, historical_maps.box_of(question(bbox=NEAR)), 10**6) == 400
    assert rows_near(root, now, historical_maps.box_of(question(bbox="0,0,1,1")), 10**6) == 0


def test_query_that_reads_too_much_is_refused_and_a_smaller_box_is_not(
    root: Path, asker: historical_maps.HistoricalMaps, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(historical_maps, "MOST_ROWS", 399)
    with pytest.raises(
        InputError, match="at: the query would read too much of the archive; use a smaller bbox"
    ):
        list(asker.ask(question(), lambda _: True))
    assert list(asker.ask(question(bbox="0,0,1,1"), lambda _: True)) == []
    with pytest.raises(
        InputError, match="at: the query would read too much of the archive; use a smaller bbox"
    ):
        # The box itself contains as many rows.
        list(historical_maps.replies_to(root, question(bbox=NEAR)))
    monkeypatch.setattr(historical_maps, "LOOKED_ROWS", 399)
    with pytest.raises(InputError, match="at: the query would read too much"):
        list(asker.ask(question(bbox=NEAR), lambda _: True))


@pytest.mark.parametrize("group", [1, 7, 400])
@pytest.mark.campaign
def test_a_filter_finds_the_same_rows_however_they_are_grouped(
    root: Path, monkeypatch: pytest.MonkeyPatch, group: int
) -> None:
    (path,) = layout.compacted_files(root, Kind.OBSERVATION)
    table = pq.read_table(path, partitioning=None)
    monkeypatch.setattr(files, "ROW_GROUP", group)
    files.write_table(table, path, files.COMPACTED)
    assert pq.read_metadata(path).num_row_groups == -(-400 // group)
    schema = segments.SCHEMAS[Kind.OBSERVATION]
    begin = table["leave_time"].cast(pa.int64()).to_numpy()
    wanted: list[tuple[ValueRange, NDArray[Any]]] = [
        (ValueRange("seq", 2, 3), np.isin(table["seq"], [2, 3])),
        (ValueRange("leave_time", most=int(np.median(begin))), begin <= np.median(begin)),
        (
            ValueRange("vehicle", table["vehicle"][7].as_py(), table["vehicle"][7].as_py()),
            np.array([one == table["vehicle"][7].as_py() for one in table["vehicle"].to_pylist()]),
        ),
        (ValueRange("latitude", LATITUDE - 1.0, LATITUDE + 1.0), np.ones(400, bool)),
        (ValueRange("seq", 100), np.zeros(400, bool)),
    ]
    for where, right in wanted:
        for columns in (["vehicle", "seq", "row", "leave_time", "latitude"], None):
            found = load_rows(path, schema, columns, [where])
            assert found is not None
            names = columns or schema.names
            assert repr(found.to_pylist()) == repr(
                table.filter(pa.array(right)).select(names).to_pylist()
            ), where
            taken: list[pa.Table] = []
            assert load_groups(path, schema, names, [where], taken.append)
            assert all(part.num_rows for part in taken), "a row group that holds none is not read"
            assert repr(pa.concat_tables([found.slice(0, 0), *taken]).to_pylist()) == repr(
                found.to_pylist()
            )
    assert 0 < wanted[0][1].sum() < 400


def test_the_answer_of_the_other_process_is_that_of_this_one(
    root: Path, asker: historical_maps.HistoricalMaps
) -> None:
    asked = question(bbox=NEAR)
    (mine,) = historical_maps.replies_to(root, asked)
    (theirs,) = asker.ask(asked, lambda _: True)
    assert theirs == mine
    assert mine[0] == TILE
    assert list(asker.ask(asked, lambda _: False)) == []


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[bytes]]:
    """Return a list. During the test, every process that the service starts is appended to it."""
    found: list[subprocess.Popen[bytes]] = []

    real = subprocess.Popen

    def record_process(command: list[str], stdin: int, stdout: int) -> subprocess.Popen[bytes]:
        found.append(real(command, stdin=stdin, stdout=stdout))
        return found[-1]

    monkeypatch.setattr(subprocess, "Popen", record_process)
    return found


@pytest.mark.campaign
def test_a_process_answers_one_question_after_the_other(
    asker: historical_maps.HistoricalMaps, begun: list[subprocess.Popen[bytes]]
) -> None:
    answers = [
        list(asker.ask(question(bbox=box), lambda _: True)) for box in (NEAR, "0,0,1,1", NEAR)
    ]
    assert [len(answer) for answer in answers] == [1, 0, 1]
    assert len(begun) == 1
    asker.close()
    assert begun[0].poll() is not None


@pytest.mark.campaign
def test_dead_idle_query_process_is_started_again(
    asker: historical_maps.HistoricalMaps, begun: list[subprocess.Popen[bytes]]
) -> None:
    for _ in range(2):
        assert len(list(asker.ask(question(bbox=NEAR), lambda _: True))) == 1
        begun[-1].kill()
        begun[-1].wait()
    assert len(begun) == 2


@pytest.mark.campaign
def test_abandoned_answer_is_not_read_by_the_next_query(
    asker: historical_maps.HistoricalMaps, begun: list[subprocess.Popen[bytes]]
) -> None:
    left = asker.ask(question(bbox=NEAR), lambda _: True)
    next(left)
    left.close()  # type: ignore[attr-defined]  # a generator
    assert len(list(asker.ask(question(bbox=NEAR), lambda _: True))) == 1
    assert len(begun) == 2


@pytest.mark.parametrize("was_idle", [False, True])
def test_a_process_that_hangs_is_killed_and_the_asker_gets_an_error(
    asker: historical_maps.HistoricalMaps,
    begun: list[subprocess.Popen[bytes]],
    monkeypatch: pytest.MonkeyPatch,
    was_idle: bool,
) -> None:
    if was_idle:
        list(asker.ask(question(bbox=NEAR), lambda _: True))
        freeze(begun[0])
    monkeypatch.setattr(historical_maps, "SILENT_S", 0.1)  # a new process needs a second
    with pytest.raises(InputError, match="at: the past map made no progress"):
        list(asker.ask(question(bbox=NEAR), lambda _: True))
    assert [child.poll() for child in begun] == [-signal.SIGKILL]
