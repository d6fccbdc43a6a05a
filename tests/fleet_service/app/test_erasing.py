"""Tests of the erasure of a vehicle while the service runs and the vehicle drives on: no data of
this vehicle remains, and no data of others is lost.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from contextlib import closing
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import zenoh

from fleet_service.app import erasing
from fleet_service.app.engine import Engine
from fleet_service.archive.format import reading
from fleet_service.archive.identity import erasure_requests
from fleet_service.archive.identity.erasure_requests import Erasure
from fleet_service.archive.identity.pseudonyms import Pseudonyms
from fleet_service.archive.maintenance.retention import drop_checkpoints
from fleet_service.cli import main
from fleet_service.ingest.inbox import Message
from fleet_service.replay import checkpoints
from schemas import grid, keys, wire
from schemas.config import ServiceConfig, ZenohSettings
from schemas.errors import InputError
from schemas.wire import Batch, Kind
from schemas.wire.tile import decode_tile
from tests.fleet_service.app.test_kill import service
from tests.fleet_service.app.test_service import Fleet
from tests.fleet_service.examples import LATITUDE, LONGITUDE, SECOND, TILE, batch, key
from tests.waiting import until

GONE = "sim-009"
OTHERS = ("sim-001", "sim-002", "sim-003")
ALONE = LATITUDE - 0.002  # latitude of a cell in the same tile that no other vehicle visits
FAR = LATITUDE - 0.0078  # latitude of a cell in another tile that no other vehicle visits
FAR_TILE = int(grid.tile_of(grid.cell_of(FAR, LONGITUDE)))
PATIENCE_S = 120.0  # time for a start and for a process that imports everything, on a busy machine
MONTH = f"{datetime.now(UTC):%Y-%m}"


def sent_by(vehicle: str, seq: int, *, is_far: bool) -> Batch:
    """Return a vehicle's batch with three visits (passes through cells). The first is to a cell
    that all vehicles visit. If `is_far`, the others are to a cell of the same tile and to a cell of
    another tile, else to the first cell again.
    """
    now = time.time_ns() - SECOND
    latitude = np.array([LATITUDE, ALONE, FAR] if is_far else [LATITUDE] * 3)
    cell = grid.cell_of(latitude, np.full(3, LONGITUDE))
    return batch(vehicle, seq, now, [0.8] * 3, latitude=latitude, cell=cell)


def pseudonyms_of(root: Path) -> list[str]:
    tables = reading.read_tables(root, Kind.OBSERVATION, ["vehicle", "seq", "row"])
    return sorted(map(str, pa.concat_tables(tables)["vehicle"].to_pylist()))


def count_shown(session: zenoh.Session) -> dict[int, int]:
    """Query the map over the session, and return the number of observations of each cell, by cell
    number.
    """
    found: dict[int, int] = {}
    for reply in session.get(keys.map_key(TILE), timeout=PATIENCE_S):
        if reply.ok is not None:
            table = pa.ipc.open_stream(BytesIO(reply.ok.payload.to_bytes())).read_all()
            found |= zip(
                table["cell"].to_numpy().tolist(),
                table["observations"].to_numpy().tolist(),
                strict=True,
            )
    return found


def files_with_traces(root: Path, pseudonym: str) -> list[Path]:
    """Return the files of an archive that contain the name GONE or its pseudonym, as text or as a
    number.
    """
    number = int.from_bytes(bytes.fromhex(pseudonym), signed=True)
    traces = (
        pseudonym.encode(),
        GONE.encode(),
        number.to_bytes(8, "little", signed=True),
        number.to_bytes(8, "big", signed=True),
    )
    files = [path for path in root.rglob("*") if path.is_file()]
    return [path for path in files if any(one in path.read_bytes() for one in traces)]


@pytest.mark.campaign
def test_a_vehicle_is_erased_while_the_service_runs_and_others_drive_on(
    router: ZenohSettings, session: zenoh.Session, tmp_path: Path
) -> None:
    root = tmp_path / "archive"
    fleet = Fleet(session)
    sent = [
        sent_by(vehicle, seq, is_far=vehicle == GONE)
        for seq in range(1, 21)
        for vehicle in (GONE, *OTHERS)
    ]
    alone = int(grid.cell_of(ALONE, LONGITUDE))

    def is_settled() -> bool:
        for one in fleet.list_unsettled(sent)[:20]:
            fleet.publish(one)
        return not fleet.list_unsettled(sent)

    far = list[int]()  # number of cells in each received publication of the far tile

    def count_far(sample: zenoh.Sample) -> None:
        far.append(decode_tile(sample.payload.to_bytes()).num_rows)

    with (
        service(router, tmp_path) as process,
        session.declare_subscriber(keys.map_key(FAR_TILE), count_far),
    ):
        until(is_settled, PATIENCE_S)
        until(lambda: alone in count_shown(session), PATIENCE_S)
        until(lambda: far[-1:] == [1], PATIENCE_S)
        words = ["forget", "--archive", str(root), "--period", MONTH, "--vehicle", GONE, "--json"]
        command = [sys.executable, "-m", "fleet_service.cli", *words]
        with subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True
        ) as eraser:
            seq = 20
            while eraser.poll() is None:
                seq += 1
                sent += [sent_by(vehicle, seq, is_far=False) for vehicle in OTHERS]
                until(is_settled, PATIENCE_S)
            output, _ = eraser.communicate()
        assert (eraser.returncode, json.loads(output)["rows"]) == (0, 60)
        assert seq > 20, "others drove meanwhile"
        assert process.poll() is None
        until(lambda: alone not in count_shown(session), PATIENCE_S)
        until(lambda: far[-1] == 0, PATIENCE_S)
        sent += [sent_by(vehicle, seq + 1, is_far=False) for vehicle in OTHERS]
        until(is_settled, PATIENCE_S)
        at_last = count_shown(session)
        assert not erasure_requests.open_requests(root)
        process.terminate()
        assert process.wait(PATIENCE_S) == 0
    names = Pseudonyms(root / "keys")
    theirs = sorted(
        names.of(vehicle, time.time_ns()) for vehicle in OTHERS for _ in range(3 * (seq + 1))
    )
    assert pseudonyms_of(root) == theirs, "each acknowledged row of the others once, and no other"
    assert files_with_traces(root, names.of(GONE, time.time_ns())) == []
    assert checkpoints.list_checkpoints(root), "what the service began from anew"
    drop_checkpoints(root)
    with closing(Engine(ServiceConfig(), root)) as engine:
        assert engine.state.fusion.live.visits[: engine.state.fusion.size].tolist() == list(
            at_last.values()
        ), "as the log tells it"
        assert sum(at_last.values()) > 3 * 3


def send_visits(engine: Engine, batches: list[Batch]) -> None:
    messages = [
        Message(Kind.OBSERVATION, key(one.vehicle), wire.encode(one), "") for one in batches
    ]
    engine.intake.ingest(messages, time.time_ns())
    engine.settlement.flush()


def fill_engine(root: Path, *names: str, least: int = 1) -> Engine:
    engine = Engine(ServiceConfig(public_vehicles=least), root)
    send_visits(engine, [sent_by(one, 1, is_far=one == GONE) for one in names])
    return engine


def answer_requests(engine: Engine, root: Path, least: int = 1) -> None:
    """Carry out the pending requests to erase a vehicle in a background thread. Meanwhile the
    calling thread acts as the service's worker, which processes messages.
    """
    config = ServiceConfig(public_vehicles=least)
    thread = threading.Thread(
        target=erasing.handle_requests, args=(engine, config, root, threading.Event())
    )
    thread.start()
    while thread.is_alive():
        engine.settlement.flush()
        thread.join(0.01)


def test_month_is_forgotten_while_a_service_runs(tmp_path: Path) -> None:
    with closing(fill_engine(tmp_path, *OTHERS[1:])) as engine:
        sent = sent_by("sim-001", 1, is_far=False)
        engine.intake.ingest(
            [Message(Kind.OBSERVATION, key("sim-001"), wire.encode(sent), "")], time.time_ns()
        )
        engine.settlement.flush()
        before = Pseudonyms(tmp_path / "keys").of("sim-001", time.time_ns())
        question = erasure_requests.write_request(tmp_path, Erasure(MONTH))
        answer_requests(engine, tmp_path)
        assert erasure_requests.answer_to(question) == {"rows": 0, "files": []}
        assert engine.state.fusion.size
        assert not any(stream.vehicle for stream in engine.state.streams)
        assert Pseudonyms(tmp_path / "keys").of("sim-001", time.time_ns()) != before
        again = wire.encode(sent)
        engine.intake.ingest([Message(Kind.OBSERVATION, key("sim-001"), again, "")], time.time_ns())
        assert engine.counts.refused["erased"] == 1, "nobody could tell that it was there before"


@pytest.mark.parametrize(
    ("least", "visitors", "is_shown"),
    [(1, [GONE], True), (2, [GONE, "sim-004"], True), (2, [GONE], False)],
)
def test_tile_that_loses_all_its_cells_is_published_without_cells(
    tmp_path: Path, least: int, visitors: list[str], is_shown: bool
) -> None:
    later = time.time_ns() + 3600 * SECOND

    def count_far(engine: Engine) -> int | None:
        """Return the number of cells in the next publication of the far tile, None without one."""
        if FAR_TILE not in engine.queries.take_changed(later):
            return None
        payload = engine.queries.first_tiles([FAR_TILE], later)[FAR_TILE]
        return decode_tile(payload).num_rows if payload else None

    with closing(fill_engine(tmp_path, *OTHERS, least=least)) as engine:
        send_visits(engine, [sent_by(name, 1, is_far=True) for name in visitors])
        assert count_far(engine) == (1 if is_shown else None)
        erasure_requests.write_request(tmp_path, Erasure(MONTH, GONE))
        answer_requests(engine, tmp_path, least)
        assert count_far(engine) == (0 if is_shown else None)


def test_a_question_that_cannot_be_done_is_answered_and_taken_away(tmp_path: Path) -> None:
    with closing(fill_engine(tmp_path, *OTHERS)) as engine:
        none = erasure_requests.write_request(tmp_path, Erasure("1999-01", GONE))
        (tmp_path / erasure_requests.FOLDER / "other.json").write_text("[]")
        answer_requests(engine, tmp_path)
        with pytest.raises(InputError, match="no key of 1999-01"):
            erasure_requests.answer_to(none)
        with pytest.raises(InputError, match="other.json is unknown"):
            erasure_requests.answer_to(tmp_path / erasure_requests.FOLDER / "other.json")
        assert not erasure_requests.open_requests(tmp_path)


def test_erasure_request_outlives_a_service_and_the_command_does_it(tmp_path: Path) -> None:
    engine = fill_engine(tmp_path, GONE, *OTHERS)
    stopped = threading.Event()
    stopped.set()
    question = erasure_requests.write_request(tmp_path, Erasure(MONTH, GONE))
    assert erasing.handle_requests(engine, ServiceConfig(), tmp_path, stopped) is None
    assert erasure_requests.open_requests(tmp_path) == [question]
    engine.close()
    with closing(Engine(ServiceConfig(), tmp_path)) as again:
        answer_requests(again, tmp_path)
        answer = erasure_requests.answer_to(question)
        assert answer is not None
        assert answer["rows"] == 3
        slots = again.state.fusion.slots_of(
            np.array([grid.cell_of(ALONE, LONGITUDE)]), np.array([0])
        )
        assert slots.tolist() == [-1]
    assert main(["forget", "--archive", str(tmp_path), "--vehicle", GONE, "--period", MONTH]) == 0
