"""Example program of a third party that uses only the package `schemas` of GripMap, and
eclipse-zenoh, protobuf and pyarrow. An import hook hides GripMap's other packages from the program.

`python -m tests.schemas.third_party ENDPOINT` reports ice by two vehicles, one in protobuf and one
in JSON. It reads acknowledgements, reports, the tile, alerts and the map's answers, and prints the
results as one line of JSON. Do not import this module into another program: the import hook would
then hide GripMap's packages from that program too.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from typing import Any, Final

FORBIDDEN: Final = ("numba", "llvmlite", "scipy", "edge_agent", "fleet_service", "deploy")


class Blocker(MetaPathFinder):
    """Import hook that hides the forbidden packages, as if they were not installed."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: object = None
    ) -> ModuleSpec | None:
        if fullname.partition(".")[0] in FORBIDDEN:
            raise ModuleNotFoundError(f"{fullname} is not installed here", name=fullname)
        return None


sys.meta_path.insert(0, Blocker())

import numpy as np  # noqa: E402
import zenoh  # noqa: E402

from schemas import grid, keys, mugrid, wire  # noqa: E402
from schemas.wire import Batch, Kind  # noqa: E402
from schemas.wire.tile import decode_tile  # noqa: E402
from tests.waiting import matched, until  # noqa: E402

LATITUDE = 57.7
LONGITUDE = 11.97
NORTH = np.pi / 2
CELL = int(grid.cell_of(LATITUDE, LONGITUDE))
REGION = int(grid.region_of(CELL))
TILE = int(grid.tile_of(CELL))
ICE = 0.2
STD = 0.05
VISITS = 6
SECOND = 10**9
JSON_SENDER = "berta"
PROTOBUF_SENDER = "anna"
SENDERS: Final = (PROTOBUF_SENDER, JSON_SENDER)


def protobuf_batch(now: int) -> bytes:
    """Return a batch with observations of one cell and their likelihoods, encoded by `schemas.wire`
    as protobuf bytes.
    """
    leave = now - SECOND * np.arange(VISITS)[::-1]
    log_likelihood = -0.5 * np.square((mugrid.CENTRES - ICE) / STD)
    columns: dict[str, Any] = {
        "enter_time": leave - SECOND // 2,
        "leave_time": leave,
        "latitude": np.full(VISITS, LATITUDE),
        "longitude": np.full(VISITS, LONGITUDE),
        "yaw": np.full(VISITS, NORTH),
        "mu": np.full(VISITS, ICE),
        "mu_lower": np.full(VISITS, 0.12),
        "mu_upper": np.full(VISITS, 0.28),
        "mu_utilised": np.full(VISITS, 0.19),
        "cell": np.full(VISITS, CELL),
        "sector": np.ones(VISITS, np.int8),
        "log_likelihood": mugrid.encode_log_likelihood(np.tile(log_likelihood, (VISITS, 1))),
    }
    return wire.encode(
        Batch(Kind.OBSERVATION, PROTOBUF_SENDER, 41, REGION, 1, 1, columns, "third-party")
    )


def json_batch(now: int) -> bytes:
    """Return the same observations as `protobuf_batch` in handwritten JSON without cell, heading
    sector and region.
    """
    times = [str(now - SECOND * k) for k in reversed(range(VISITS))]
    numbers = {
        "latitude": LATITUDE,
        "longitude": LONGITUDE,
        "yaw": NORTH,
        "mu": ICE,
        "mu_lower": 0.12,
        "mu_upper": 0.28,
        "mu_utilised": 0.19,
    }
    columns = {name: [value] * VISITS for name, value in numbers.items()}
    return json.dumps(
        {"vehicle": JSON_SENDER, "boot": "42", "seq": "1", "enter_time": times, **columns}
    ).encode()


def open_session(endpoint: str) -> zenoh.Session:
    """Open a client session to one router with Zenoh's own configuration."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


class Heard:
    """Messages that the third party's subscribers received and decoded, by topic. If a message is
    unreadable, the error is stored instead.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self.acks: dict[str, list[wire.StreamAck]] = {}
        self.batches: list[Batch] = []
        self.tiles: list[tuple[str, int]] = []
        self.alerts: list[wire.Alert] = []
        self.errors: list[str] = []
        session.declare_subscriber(f"{keys.ROOT}/*/**", self._record_sample)

    def _record_sample(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        payload = sample.payload.to_bytes()
        encoding = str(sample.encoding)
        try:
            topic = keys.parse(key).topic.name
            if topic == "ack":
                vehicle, streams = wire.decode_ack(payload)
                self.acks.setdefault(vehicle, []).extend(streams)
            elif topic == "alert":
                self.alerts.append(wire.decode_alert(payload))
            elif topic == "map":
                self.tiles.append((encoding, decode_tile(payload).num_rows))
            elif topic == "obs":
                self.batches.append(wire.decode(payload, encoding, Kind.OBSERVATION))
        # Zenoh would swallow the exception, but the test must find it.
        except Exception as error:  # noqa: BLE001
            self.errors.append(f"{key}: {error!r}")


def query_replies(session: zenoh.Session, selector: str) -> list[tuple[str, bytes]]:
    """Return (encoding, payload) of every reply to a query. An error reply gives ("error", its
    text).
    """
    return [
        (str(reply.ok.encoding), reply.ok.payload.to_bytes())
        if reply.ok is not None
        else ("error", reply.err.payload.to_bytes() if reply.err else b"no reply")
        for reply in session.get(selector)
    ]


def find_blocked() -> list[str]:
    """Return the names of the forbidden packages that this process cannot import."""
    out = []
    for name in FORBIDDEN:
        try:
            import_module(name)
        except ModuleNotFoundError:
            out.append(name)
    return out


def publish_reports(session: zenoh.Session) -> None:
    """Publish one batch of observations in each encoding, when a service listens to them."""
    sent = {
        PROTOBUF_SENDER: (protobuf_batch(time.time_ns()), wire.ENCODING[Kind.OBSERVATION]),
        JSON_SENDER: (json_batch(time.time_ns()), wire.JSON),
    }
    for vehicle, (payload, encoding) in sent.items():
        publisher = session.declare_publisher(
            keys.observation_key(REGION, vehicle), encoding=encoding
        )
        matched(publisher)
        publisher.put(payload)


def main(endpoint: str) -> None:
    """Publish reports, receive messages, query the map, and print the results."""
    with open_session(endpoint) as session:
        listener = Heard(session)
        publish_reports(session)
        until(
            lambda: (
                listener.errors
                or (
                    len(listener.acks) == len(SENDERS)
                    and listener.alerts
                    and listener.tiles
                    and listener.batches
                )
            )
        )
        box = (
            f"bbox={LONGITUDE - 0.01},{LATITUDE - 0.01},{LONGITUDE + 0.01},{LATITUDE + 0.01};"
            "min_vehicles=2"
        )
        ((arrow, tile),) = query_replies(session, f"{keys.ROOT}/map/**?{box}")
        ((_, document),) = query_replies(session, f"{keys.ROOT}/map/**?{box};format=json")
        ((_, features),) = query_replies(session, f"{keys.map_key(TILE)}?{box};format=geojson")
        ((standing, alerts),) = query_replies(session, keys.alert_key(TILE))
        ((_, refusal),) = query_replies(session, f"{keys.ROOT}/map/**?bbox=1,2,3")
    print(
        json.dumps(
            {
                "errors": listener.errors,
                "acks": {
                    vehicle: [stream[:1] + stream[2:] for stream in streams]
                    for vehicle, streams in listener.acks.items()
                },
                "batches": [
                    [batch.vehicle, batch.rows, batch.region] for batch in listener.batches
                ],
                "tiles": listener.tiles,
                "alerts": [asdict(alert) for alert in listener.alerts],
                "standing": [standing, [alert.cell for alert in wire.decode_standing(alerts)]],
                "arrow": [arrow, decode_tile(tile).drop(["first_time", "last_time"]).to_pylist()],
                "json": json.loads(document),
                "geojson": json.loads(features),
                "refusal": refusal.decode(),
                "sent": {
                    "cell": CELL,
                    "region": REGION,
                    "visits": VISITS,
                    "vehicles": list(SENDERS),
                },
                "loaded": sorted({name.partition(".")[0] for name in sys.modules} & set(FORBIDDEN)),
                "blocked": find_blocked(),
            }
        )
    )


if __name__ == "__main__":
    main(sys.argv[1])
