"""Tests of a running service over real Zenoh sessions, used as vehicles, clients and operators do.
Acknowledged reports must be on the map, ice must raise an alert, and bad input must be refused.
"""

from __future__ import annotations

import dataclasses
import json
import queue
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zenoh

from schemas import grid, keys, tables, wire
from schemas.config import ZenohSettings
from schemas.wire import Batch, Kind
from tests.fleet_service.conftest import Running, running
from tests.fleet_service.examples import (
    CELL,
    LATITUDE,
    LONGITUDE,
    REGION,
    SECOND,
    TILE,
    batch,
    key,
    send,
)
from tests.waiting import PATIENCE_S, matched, until

VEHICLES = ("sim-001", "sim-002", "sim-003")


class Fleet:
    """Client that publishes batches and stores the acknowledgements, tiles and alerts that it
    receives.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self.durable: defaultdict[str, set[int]] = defaultdict(set)
        self.rejected: list[tuple[str, int, int, str]] = []
        self.tiles: queue.Queue[tuple[str, pa.Table]] = queue.Queue()
        self.alerts: queue.Queue[wire.Alert] = queue.Queue()
        self.acks = 0
        session.declare_subscriber(f"{keys.ROOT}/ack/*", self._record_ack)
        session.declare_subscriber(f"{keys.ROOT}/map/**", self._record_tile)
        self.repeated = 0
        self._last: dict[tuple[int, int], wire.Alert] = {}
        session.declare_subscriber(f"{keys.ROOT}/alert/**", self._record_alert)

    def await_services(self, *regions: int) -> Fleet:
        """Wait until a fleet service listens in each region of `regions` (region numbers, default
        REGION). It must receive observations, vehicle states and map queries of this client. Return
        this client.
        """
        for region in regions or (REGION,):
            for name in (
                keys.observation_key(region, "sim-000"),
                keys.state_key(region, "sim-000"),
            ):
                publisher = self.session.declare_publisher(name)
                matched(publisher)
                publisher.undeclare()
            querier = self.session.declare_querier(keys.map_key(region << 8))
            matched(querier)
            querier.undeclare()
        return self

    def _record_ack(self, sample: zenoh.Sample) -> None:
        vehicle, streams = wire.decode_ack(sample.payload.to_bytes())
        assert str(sample.key_expr) == keys.ack_key(vehicle)
        for stream in streams:
            for first, last in stream.durable:
                self.durable[vehicle].update(range(first, last + 1))
            self.rejected += [(vehicle, *refused) for refused in stream.rejected]
        self.acks += 1

    def _record_alert(self, sample: zenoh.Sample) -> None:
        alert = wire.decode_alert(sample.payload.to_bytes())
        if self._last.get((alert.cell, alert.sector)) == alert:
            self.repeated += 1  # the service has published this alert again
        else:
            self._last[alert.cell, alert.sector] = alert
            self.alerts.put(alert)

    def _record_tile(self, sample: zenoh.Sample) -> None:
        self.tiles.put(
            (str(sample.key_expr), pa.ipc.open_stream(sample.payload.to_bytes()).read_all())
        )

    def publish(self, sent: Batch) -> None:
        send(self.session, sent)

    def list_unsettled(self, sent: list[Batch]) -> list[Batch]:
        """Return those of the batches `sent` that the service has not acknowledged yet."""
        return [one for one in sent if one.seq not in self.durable[one.vehicle]]

    def settle(self, *sent: Batch) -> None:
        """Publish batches, and wait until all of them are acknowledged."""
        for one in sent:
            self.publish(one)
        until(lambda: all(one.seq in self.durable[one.vehicle] for one in sent))


@pytest.fixture
def fleet(service: Running, session: zenoh.Session) -> Fleet:
    return Fleet(session).await_services()


def ask(
    session: zenoh.Session, parameters: str = "", where: str = "**"
) -> list[tuple[str, str, bytes]]:
    """Query the map, and return (key, encoding, payload) of every reply. The test fails on an error
    reply.
    """
    selector = f"{keys.ROOT}/map/{where}" + (f"?{parameters}" if parameters else "")
    replies = list(session.get(selector, timeout=PATIENCE_S))
    assert all(reply.ok for reply in replies), [
        reply.err.payload.to_string() for reply in replies if reply.err
    ]
    return [
        (str(r.ok.key_expr), str(r.ok.encoding), r.ok.payload.to_bytes()) for r in replies if r.ok
    ]


def alive(session: zenoh.Session) -> list[str]:
    """Return the liveliness tokens by which running services show that they are alive."""
    return [
        str(reply.ok.key_expr)
        for reply in session.liveliness().get(f"{keys.ROOT}/shard/*")
        if reply.ok
    ]


def now() -> int:
    return time.time_ns() - SECOND


def test_acknowledged_rows_are_in_a_segment_and_on_the_map(
    fleet: Fleet, service: Running, tmp_path: Path
) -> None:
    fleet.settle(*(batch(vehicle, 1, now(), [0.8, 0.82]) for vehicle in VEHICLES))
    table = pa.concat_tables(
        [pq.read_table(path) for path in (tmp_path / "archive/inbox").glob("*.parquet")]
    )
    assert table.schema.equals(tables.OBSERVATION_ARCHIVE)
    assert table.num_rows == 6
    assert not set(table["vehicle"].to_pylist()) & set(VEHICLES)
    (name, encoding, payload) = ask(fleet.session)[0]
    assert (name, encoding) == (keys.map_key(TILE), wire.ARROW)
    cells = pa.ipc.open_stream(payload).read_all()
    assert cells.schema.equals(tables.MAP_SCHEMA)
    (row,) = cells.to_pylist()
    assert (row["cell"], row["basis"], row["vehicles"], row["observations"]) == (
        CELL,
        "measured",
        3,
        6,
    )
    assert row["mu_lower"] < 0.8 < row["mu_upper"] < 1.0
    assert row["west"] < LONGITUDE < row["east"]
    assert row["south"] < LATITUDE < row["north"]


def test_changed_tile_is_published_on_its_own_key(fleet: Fleet) -> None:
    fleet.settle(batch("sim-001", 1, now(), [0.8]))
    name, table = fleet.tiles.get(timeout=PATIENCE_S)
    assert name == keys.map_key(TILE)
    assert table["cell"].to_pylist() == [CELL]


def test_repeated_batch_is_acknowledged_again_and_not_counted_again(
    fleet: Fleet, service: Running
) -> None:
    sent = batch("sim-001", 1, now(), [0.8])
    fleet.settle(sent)
    before = fleet.acks
    fleet.publish(sent)
    until(lambda: fleet.acks > before)
    assert service.service.engine.counts.duplicates == 1
    assert service.service.engine.state.fusion.live.visits[0] == 1


def test_a_batch_with_one_bad_row_is_rejected_with_row_and_reason(
    fleet: Fleet, service: Running
) -> None:
    fleet.publish(batch("sim-001", 1, now(), [0.8, 0.8, 0.8], speed=[10.0, 400.0, 10.0]))
    until(lambda: fleet.rejected)
    assert fleet.rejected == [
        ("sim-001", 1, 1, "speed: lies outside [0, 100]; correct it at the source")
    ]
    assert service.service.engine.counts.refused["speed"] == 1
    assert service.service.engine.state.fusion.size == 0


@pytest.mark.parametrize(
    ("name", "payload", "encoding", "rule"),
    [
        (key("sim-001"), b"\xff\x00 garbage", "", "payload"),
        (key("sim-001"), b"{broken", wire.JSON, "payload"),
        (key("sim-001"), wire.encode(batch("sim-001", 1, now(), [0.8])), "image/png", "encoding"),
        (key("sim-002"), wire.encode(batch("sim-001", 1, now(), [0.8])), "", "vehicle"),
        (
            f"{keys.ROOT}/obs/*/*/*/sim-001",
            wire.encode(batch("sim-001", 1, now(), [0.8])),
            "",
            "key",
        ),
        (
            keys.observation_key(REGION + 1, "sim-001"),
            wire.encode(batch("sim-001", 1, now(), [0.8])),
            "",
            "region",
        ),
    ],
)
def test_foreign_messages_are_counted_and_the_service_continues(
    fleet: Fleet, service: Running, name: str, payload: bytes, encoding: str, rule: str
) -> None:
    fleet.session.put(name, payload, encoding=encoding)
    until(lambda: service.service.engine.counts.refused[rule] == 1)
    fleet.settle(batch("sim-001", 1, now(), [0.8]))
    assert service.service.engine.state.fusion.live.visits[0] == 1


def seconds() -> Iterator[int]:
    """Return an iterator of times [ns] for successive reports of vehicles. The times are one second
    apart, begin 30 s ago, and end before the present.
    """
    return iter(range(now() - 30 * SECOND, now(), SECOND))


def test_ice_raises_an_alert_after_few_passes_and_grip_clears_it(fleet: Fleet) -> None:
    moments = seconds()
    fleet.settle(*(batch(f"sim-{k:03}", 1, now() - 90 * SECOND, [0.85]) for k in range(6)))
    for passes in range(8):
        fleet.settle(batch(f"sim-{passes:03}", 2, next(moments), [0.2]))
        if not fleet.alerts.empty():
            break
    alert = fleet.alerts.get(timeout=PATIENCE_S)
    assert passes <= 4
    assert (alert.cell, alert.raised) == (CELL, True)
    assert alert.p_slippery > 0.9
    for k in range(10):
        fleet.settle(batch(f"sim-{100 + k}", 1, next(moments), [0.85]))
    cleared = fleet.alerts.get(timeout=PATIENCE_S)
    assert (cleared.cell, cleared.raised, cleared.reason) == (
        CELL,
        False,
        "later visits measured good grip",
    )


def standing(session: zenoh.Session) -> list[wire.Alert]:
    """Query the service for all active alerts, as a client does that connects after they were
    raised. Return the alerts.
    """
    asked = session.get(f"{keys.ROOT}/alert/**", timeout=PATIENCE_S)
    replies = [reply.ok for reply in asked if reply.ok]
    assert all(str(reply.encoding) == wire.STANDING_ENCODING for reply in replies)
    return [alert for reply in replies for alert in wire.decode_standing(reply.payload.to_bytes())]


def test_late_client_can_query_active_alerts(fleet: Fleet) -> None:
    assert not standing(fleet.session)
    moments = seconds()
    fleet.settle(*(batch(f"sim-{k:03}", 1, next(moments), [0.2]) for k in range(3)))
    raised = fleet.alerts.get(timeout=PATIENCE_S)
    assert standing(fleet.session) == [raised]
    assert not [reply for reply in fleet.session.get(keys.alert_key(TILE + 1)) if reply.ok]
    for k in range(10):
        fleet.settle(batch(f"sim-{100 + k}", 1, next(moments), [0.85]))
    fleet.alerts.get(timeout=PATIENCE_S)
    assert not standing(fleet.session)


def test_one_liar_raises_no_alert_however_often_it_reports(fleet: Fleet, service: Running) -> None:
    fleet.settle(batch("sim-001", 1, now(), [0.3], with_likelihood=False, used=0.1))
    for seq in range(1, 30):
        fleet.settle(batch("liar-01", seq, now(), [0.15, 0.15, 0.15]))
    assert service.service.engine.alerts.count == 0
    assert fleet.alerts.empty()


def test_restart_gives_the_same_map_and_counts_no_row_twice(
    router: ZenohSettings, session: zenoh.Session, tmp_path: Path
) -> None:
    rng = np.random.default_rng(6)
    sent = [
        batch(
            f"sim-{k % 7:03}",
            1 + k // 7,
            now(),
            list(0.7 + 0.1 * rng.random(3)),
            with_likelihood=k % 2 == 0,
        )
        for k in range(40)
    ]
    with running(router, tmp_path) as first:
        fleet = Fleet(session).await_services()
        fleet.settle(*sent)
        before = first.service.engine.state.fusion
    with running(router, tmp_path) as second:
        after = second.service.engine.state.fusion
        counts = second.service.engine.counts
        at = int(before.live.time.max())
        slots = np.arange(before.size)
        slots_after = after.slots_of(before.cell[slots], before.sector[slots])
        np.testing.assert_allclose(
            before.beliefs(slots, at), after.beliefs(slots_after, at), atol=1e-6
        )
        acks = fleet.acks
        for one in sent:
            fleet.publish(one)
        until(lambda: counts.duplicates == len(sent) and fleet.acks > acks)
        assert counts.observations == 0
    kept = [pq.read_table(path) for path in (tmp_path / "inbox").glob("*.parquet")]
    rows = sum(table.num_rows for table in kept)
    assert rows == sum(one.rows for one in sent)


def test_states_are_archived_and_acknowledged(fleet: Fleet, tmp_path: Path) -> None:
    columns = {
        "time": np.array([now()]),
        "latitude": np.array([LATITUDE]),
        "longitude": np.array([LONGITUDE]),
        "vx": np.array([15.0], np.float32),
    }
    state = Batch(Kind.STATE, "sim-001", 5, REGION, 1, 1, columns, "ckf")
    fleet.session.put(
        keys.state_key(REGION, "sim-001"), wire.encode(state), encoding=wire.ENCODING[Kind.STATE]
    )
    until(lambda: 1 in fleet.durable["sim-001"])
    (path,) = (tmp_path / "archive/inbox/states").glob("*.parquet")
    assert pq.read_table(path).schema.equals(tables.STATE_ARCHIVE)
    assert pq.read_table(path)["cell"].to_pylist() == [CELL]


def test_a_person_can_publish_with_one_line_of_json(fleet: Fleet, service: Running) -> None:
    text = {
        "vehicle": "by-hand",
        "boot": "1",
        "seq": "1",
        "enterTime": [str(now())],
        "latitude": [LATITUDE],
        "longitude": [LONGITUDE],
        "yaw": [0.1],
        "mu": [0.3],
        "muUtilised": [0.29],
    }
    fleet.session.put(key("by-hand"), json.dumps(text), encoding=wire.JSON)
    until(lambda: 1 in fleet.durable["by-hand"])
    assert service.service.engine.state.fusion.live.visits[0] == 1


def test_arrow_geojson_and_json_answers_agree(fleet: Fleet) -> None:
    fleet.settle(batch("sim-001", 1, now(), [0.8]))
    arrow = pa.ipc.open_stream(ask(fleet.session)[0][2]).read_all().to_pylist()[0]
    (_, geo_encoding, geo_text), (_, encoding, text) = (
        ask(fleet.session, f"format={form}")[0] for form in ("geojson", "json")
    )
    assert (geo_encoding, encoding) == (wire.GEOJSON, wire.JSON)
    geo = json.loads(geo_text)
    plain = json.loads(text)
    assert geo["type"] == "FeatureCollection"
    (feature,) = geo["features"]
    assert feature["geometry"]["coordinates"][0][0] == [arrow["longitude"], arrow["latitude"]]
    for cell in (feature["properties"], plain["cells"][0]):
        assert cell["mu"] == pytest.approx(arrow["mu"], abs=0.01)
        assert cell["cell"] == CELL
        assert cell["last_time"].startswith(f"{arrow['last_time']:%Y-%m-%dT%H:%M:%S}")


def test_box_route_vehicles_and_key_choose_the_cells(fleet: Fleet) -> None:
    fleet.settle(batch("sim-001", 1, now(), [0.8]))
    session = fleet.session
    around = f"{LONGITUDE - 0.01},{LATITUDE - 0.01},{LONGITUDE + 0.01},{LATITUDE + 0.01}"
    assert len(ask(session, f"bbox={around}")) == 1
    assert not ask(session, f"bbox={LONGITUDE + 1},{LATITUDE},{LONGITUDE + 2},{LATITUDE + 1}")
    assert not ask(session, "min_vehicles=2")
    eastwards = f"{LONGITUDE - 0.01},{LATITUDE}|{LONGITUDE + 0.01},{LATITUDE}"
    westwards = f"{LONGITUDE + 0.01},{LATITUDE}|{LONGITUDE - 0.01},{LATITUDE}"
    assert len(ask(session, f"route={eastwards}")) == 1
    assert not ask(session, f"route={westwards}")
    assert len(ask(session, where=keys.chunks(TILE, 14))) == 1
    assert not ask(session, where=keys.chunks(TILE + 1, 14))


def test_borrowed_cells_are_returned_only_on_request(fleet: Fleet) -> None:
    fleet.settle(*(batch(vehicle, 1, now(), [0.3]) for vehicle in VEHICLES))
    rows = pa.ipc.open_stream(ask(fleet.session, "basis=borrowed")[0][2]).read_all().to_pylist()
    own = next(row for row in rows if row["cell"] == CELL)
    others = [row for row in rows if row["cell"] != CELL]
    assert len(others) == 8
    assert {row["basis"] for row in others} == {"borrowed"}
    assert all(
        row["mu_upper"] - row["mu_lower"] > own["mu_upper"] - own["mu_lower"] for row in others
    )
    assert own["basis"] == "measured"


def test_the_map_of_the_past_is_rebuilt_from_the_archive(fleet: Fleet) -> None:
    fleet.settle(*(batch(vehicle, 1, now(), [0.8]) for vehicle in VEHICLES))
    between = time.time_ns()
    fleet.settle(*(batch(vehicle, 2, now(), [0.2]) for vehicle in VEHICLES))
    at = np.datetime_as_string(np.datetime64(between, "ns"), "us", "UTC")
    (_, _, past) = ask(fleet.session, f"at={at}")[0]
    (_, _, present) = ask(fleet.session)[0]
    then, here = (
        pa.ipc.open_stream(payload).read_all().to_pylist()[0] for payload in (past, present)
    )
    assert (then["observations"], here["observations"]) == (3, 6)
    assert then["mu"] > 0.7


@pytest.mark.parametrize(
    ("parameters", "start"),
    [
        ("bbox=1,2,3", "bbox: "),
        ("bbox=3,2,1,4", "bbox: "),
        ("format=xml", "format: "),
        ("min_vehicles=many", "min_vehicles: "),
        ("route=1,2", "route: "),
        ("route=0,0|90,0", "route: is 10019 km long"),
        ("at=2999-01-01T00:00:00Z", "at: lies in the future"),
        ("colour=red", "colour: is not a parameter"),
    ],
)
def test_a_bad_query_gets_an_error_that_names_the_field(
    fleet: Fleet, parameters: str, start: str
) -> None:
    (reply,) = fleet.session.get(f"{keys.ROOT}/map/**?{parameters}", timeout=PATIENCE_S)
    assert reply.err is not None
    assert reply.err.payload.to_string().startswith(start)
    assert "; " in reply.err.payload.to_string()


def test_service_has_a_liveliness_token_while_it_runs(
    router: ZenohSettings, session: zenoh.Session, tmp_path: Path
) -> None:
    with running(router, tmp_path, name="shard-7"):
        until(lambda: alive(session) == [keys.shard_key("shard-7")])
    until(lambda: not alive(session))


def test_two_services_share_the_world_and_a_query_gets_both(
    router: ZenohSettings, session: zenoh.Session, tmp_path: Path
) -> None:
    far: dict[str, Any] = {
        "latitude": [-33.9],
        "longitude": [18.4],
        "cell": [int(grid.cell_of(-33.9, 18.4))],
    }
    region = int(grid.region_of(far["cell"][0]))
    own_region, other_region = (
        f"{keys.chunks(place, 10).split('/')[0]}/*/*" for place in (REGION, region)
    )
    with (
        running(router, tmp_path / "a", name="shard-a", regions=[own_region]) as a,
        running(router, tmp_path / "b", name="shard-b", regions=[other_region]) as b,
    ):
        fleet = Fleet(session).await_services(REGION, region)
        fleet.settle(batch("sim-001", 1, now(), [0.8]))
        sent = dataclasses.replace(batch("sim-002", 1, now(), [0.8], **far), region=region)
        session.put(
            keys.observation_key(region, "sim-002"),
            wire.encode(sent),
            encoding=wire.ENCODING[sent.kind],
        )
        until(lambda: 1 in fleet.durable["sim-002"])
        assert a.service.engine.state.fusion.size == b.service.engine.state.fusion.size == 1
        assert {name for name, _, _ in ask(session)} == {
            keys.map_key(TILE),
            keys.map_key(int(grid.tile_of(far["cell"][0]))),
        }


def test_stopping_service_flushes_and_acknowledges_received_rows(
    router: ZenohSettings, session: zenoh.Session, tmp_path: Path
) -> None:
    with running(router, tmp_path) as run:
        fleet = Fleet(session).await_services()
        sent = batch("sim-001", 1, now(), [0.8])
        fleet.publish(sent)
        until(lambda: len(run.service.inbox) or run.service.engine.counts.observations)
        run.service.engine.counts.runs["checkpoint"] += 1
    until(lambda: 1 in fleet.durable["sim-001"])
    assert run.lines[-1].startswith("status: 1 observations")
    assert "_runs" not in run.lines[-1]
