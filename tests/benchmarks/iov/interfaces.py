"""Benchmarks of three interfaces to other systems.

DENM     hazard messages of other parties report ice where there is none
Kuksa    the agent writes signals to a stub server with the interface kuksa.val.v2
MCAP     the readers of the official library read a file of estimates
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import pyarrow as pa

from edge_agent.app.estimates_file import write_table
from edge_agent.app.kuksa_provider import CONDITION, FRICTION, KuksaProvider, surface_condition
from edge_agent.publish.vss import road_friction
from fleet_service.app.engine import Engine
from fleet_service.client.cits.denm import ICE, Denm, decode_denm, encode_denm
from fleet_service.client.cits.foreign import encode_reports
from fleet_service.ingest.inbox import Message
from schemas import grid, keys
from schemas.config import ServiceConfig
from schemas.runtime.figures import Figure
from schemas.tables import ESTIMATES_SCHEMA
from schemas.thresholds import NS
from schemas.wire import JSON, Kind
from tests.benchmarks.iov.routes import unpack_wheel
from tests.waiting import until

START: Final = 1_700_000_000 * NS
# Friction reports of three vehicles: one slid on ice, one braked on a dry road, and one used little
# grip.
SLID: Final = {"mu": 0.2, "mu_lower": 0.12, "mu_upper": 0.28, "mu_utilised": 0.19}
DRY: Final = {"mu": 0.8, "mu_lower": 0.7, "mu_upper": 0.9, "mu_utilised": 0.7}
PASSED: Final = {"mu": 0.5, "mu_lower": 0.1, "mu_upper": 1.1, "mu_utilised": 0.1}
# Version of kuksa-client whose generated modules define the published protocol.
KUKSA: Final = "0.6.0"


def measure_foreign(_folder: Path, quick: bool) -> list[Figure]:
    """Let one foreign publisher (another party's service, which sends DENM warnings) report ice in
    three situations: alone, where enrolled vehicles measure grip, and where one enrolled vehicle
    measures ice too. Return the numbers of alerts and of accepted reports as figures.

    In the first two situations no alert may be raised. In the third one the alert must be raised.
    This is the control, because a publisher that is never believed would also raise no false alert.
    """
    draw = np.random.default_rng(4204)
    places = draw.normal((57.7, 11.97), 0.02, (20 if quick else 200, 2)).tolist()
    alone, taken = _alerted(places, foreign=True)
    contradicted, _ = _alerted(places, DRY, DRY, foreign=True)
    own, _ = _alerted(places, PASSED, PASSED, SLID)
    confirmed, _ = _alerted(places, PASSED, PASSED, SLID, foreign=True)
    return [
        Figure(
            "denm.foreign_false_alerts",
            float(alone + contradicted),
            "alerts by foreign DENM alone, or where two own vehicles find grip",
            0.0,
        ),
        Figure("denm.foreign_reports", float(taken), "foreign reports taken", 100.0, "more"),
        Figure("denm.own_witness_alerts", float(own), "alerts by one own vehicle alone", 0.0),
        Figure(
            "denm.foreign_confirmed",
            confirmed / len(places),
            "of the places where one own vehicle finds ice too, under alert",
            0.95,
            "more",
        ),
    ]


def _alerted(
    places: list[tuple[float, float]], *own: dict[str, float], foreign: bool = False
) -> tuple[int, int]:
    """Let a service receive reports about `places`. Return the number of places with an alert, and
    the number of foreign reports that the service accepted.

    Args:
        places: latitude and longitude [deg].
        own: friction values that enrolled vehicles report at every place, one entry per vehicle.
        foreign: True if a foreign publisher warns of ice at all places.
    """
    under_alert = set[int]()
    cells = [int(grid.cell_of(*place)) for place in places]
    with TemporaryDirectory() as folder:
        engine = Engine(ServiceConfig(publishers=["cits-se"]), Path(folder) / "archive")
        try:
            for turn in range(10):
                now = START + 30 * turn * NS
                for k, place in enumerate(places):
                    batches = [
                        _own_report(f"car-{k}-{n}", 1 + turn, now, place, friction)
                        for n, friction in enumerate(own)
                    ]
                    if foreign:
                        batches += _foreign_reports(k, 1 + k + len(places) * turn, now, place)
                    engine.intake.ingest(
                        [Message(Kind.OBSERVATION, key, body, JSON) for key, body in batches], now
                    )
                under_alert |= {alert.cell for alert in engine.alerts.all}
            taken = engine.counts.observations
        finally:
            engine.close()
    assert len(set(cells)) > 0.9 * len(cells)
    return sum(cell in under_alert for cell in cells), taken


def _foreign_reports(
    number: int, seq: int, now: int, place: tuple[float, float]
) -> list[tuple[str, bytes]]:
    """Return a foreign publisher's warning of ice at a place as batches, by key."""
    denm = Denm(99, number, 99, START, now, None, place, 2.0, 3600)
    decoded = decode_denm(encode_denm(replace(denm, sub_cause=ICE, heading=0.0)))
    return encode_reports(decoded, "cits-se", 5, seq, now)


def _own_report(
    name: str, seq: int, now: int, place: tuple[float, float], friction: dict[str, float]
) -> tuple[str, bytes]:
    """Return key and JSON of a vehicle's six visits to one place (passes through its map cell),
    heading north.
    """
    visits = 6
    region = int(grid.region_of(int(grid.cell_of(*place))))
    values = {"latitude": place[0], "longitude": place[1], "yaw": np.pi / 2, **friction}
    columns: dict[str, Any] = {column: [value] * visits for column, value in values.items()}
    columns["enter_time"] = [str(now - k * NS) for k in reversed(range(visits))]
    batch = {"vehicle": name, "boot": "5", "seq": str(seq), "first_held": str(seq), **columns}
    return keys.observation_key(region, name), json.dumps(batch).encode()


def measure_kuksa(folder: Path, quick: bool) -> list[Figure]:
    """Let `KuksaProvider` write signals to a stub of the Kuksa databroker, and return one figure:
    the share of the values that the stub received correctly (`kuksa.written`).

    The stub is a local gRPC server for the published interface kuksa.val.v2. Its generated modules
    come from the package kuksa-client. No real broker runs.
    """
    draw = np.random.default_rng(4205)
    wheel = folder / "kuksa"
    if not wheel.exists():
        unpack_wheel("kuksa-client", KUKSA, wheel)
    sys.path.insert(0, str(wheel))
    try:
        right = 0
        count = 50 if quick else 500
        with _broker() as (port, values):
            provider = KuksaProvider(f"127.0.0.1:{port}")
            for k in range(count):
                lower, mu, upper = np.sort(draw.uniform(0.05, 1.2, 3)).tolist()
                used = mu if k % 2 else 0.0
                signals = road_friction(mu, lower, upper, used)
                provider.write(signals, START + k)
                until(lambda k=k: provider.written >= 4 * (k + 1))  # type: ignore[misc]
                expected = [signals.get(path) for path in FRICTION]
                read = [_number(values[path]) for path in FRICTION]
                right += sum(
                    a == b or (a is not None and b is not None and abs(a - b) < 1e-4)
                    for a, b in zip(expected, read, strict=True)
                )
                right += values[CONDITION].value.string == surface_condition(signals)
            provider.close()
    finally:
        sys.path.remove(str(wheel))
    return [Figure("kuksa.written", right / (4 * count), "of the values", 1.0, "more")]


def _number(point: Any) -> float | None:  # noqa: ANN401 the wheel's modules have no types
    return float(point.value.float) if point.HasField("value") else None


@contextmanager
def _broker() -> Iterator[tuple[int, dict[str, Any]]]:
    """Run a stub of a Kuksa databroker: a gRPC server that implements only `PublishValue` of
    kuksa.val.v2.

    Like a real broker, it accepts a value only if the VSS path is known and the value has the type
    of this path. The known paths are those of the road friction signals. Yield the port, and the
    received data points by path.
    """
    import grpc
    from kuksa.val.v2 import val_pb2, val_pb2_grpc  # type: ignore[import-not-found]

    kinds = dict.fromkeys(FRICTION, "float") | {CONDITION: "string"}
    values: dict[str, Any] = {}

    class Service(val_pb2_grpc.VALServicer):  # type: ignore[misc]
        def PublishValue(self, request: Any, context: Any) -> Any:  # noqa: ANN401, N802
            path = request.signal_id.path
            point = request.data_point
            if path not in kinds:
                context.abort(grpc.StatusCode.NOT_FOUND, path)
            if point.HasField("value") and point.value.WhichOneof("typed_value") != kinds[path]:
                context.abort(grpc.StatusCode.INVALID_ARGUMENT, f"{path} is {kinds[path]}")
            values[path] = point
            return val_pb2.PublishValueResponse()

    server = grpc.server(ThreadPoolExecutor(2))
    val_pb2_grpc.add_VALServicer_to_server(Service(), server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        yield port, values
    finally:
        server.stop(0.5).wait()


def measure_mcap(folder: Path, quick: bool) -> list[Figure]:
    """Write a drive's estimates as an MCAP file, read it with the three readers of the official
    MCAP library, and return the figures.
    """
    from mcap.reader import NonSeekingReader, SeekingReader
    from mcap.records import Message as Record
    from mcap.stream_reader import StreamReader

    count = 1000 if quick else 20_000
    draw = np.random.default_rng(4206)
    columns = [
        pa.array(0.01 * np.arange(count) if field.name == "t" else draw.normal(size=count)).cast(
            field.type, safe=False
        )
        for field in ESTIMATES_SCHEMA
    ]
    table = pa.Table.from_arrays(columns, schema=ESTIMATES_SCHEMA)
    path = folder / "drive.mcap"
    write_table("out", path, table)
    rows = table.to_pylist()
    failed = 0
    for reader in (SeekingReader, NonSeekingReader):
        with path.open("rb") as file:
            found = [
                json.loads(one.data)
                for _, _, one in reader(file, validate_crcs=True).iter_messages()
            ]
        failed += found != rows
    with path.open("rb") as file:
        records = StreamReader(file, validate_crcs=True).records
        failed += [json.loads(one.data) for one in records if isinstance(one, Record)] != rows
    return [Figure("mcap.readers_failed", float(failed), "of three readers", 0.0)]
