"""Foreign DENM that report ice where there is none, the Kuksa provider against the published
protocol, and readers of MCAP.
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
from fleet_service.client.cits.denm import ICE, Denm
from fleet_service.client.cits.foreign import encode_reports
from fleet_service.ingest.inbox import Message
from schemas.config import ServiceConfig
from schemas.runtime.figures import Figure
from schemas.tables import ESTIMATES_SCHEMA
from schemas.thresholds import NS
from schemas.wire import JSON, Kind
from tests.benchmarks.iov.routes import unpack_wheel
from tests.waiting import until

START: Final = 1_700_000_000 * NS
KUKSA: Final = (
    "0.6.0"  # version of kuksa-client, whose generated modules are the published protocol
)


def measure_foreign(_folder: Path, quick: bool) -> list[Figure]:
    """Report false ice at many places, again and again, by one foreign publisher."""
    draw = np.random.default_rng(4204)
    places = draw.normal((57.7, 11.97), 0.02, (20 if quick else 200, 2)).tolist()
    turns = 10
    alerts = 0
    with TemporaryDirectory() as folder:
        engine = Engine(ServiceConfig(), Path(folder) / "archive")
        try:
            for turn in range(turns):
                now = START + 30 * turn * NS
                for k, (latitude, longitude) in enumerate(places):
                    denm = Denm(99, k, 99, START, now, None, (latitude, longitude), 5.0, 3600)
                    said = replace(denm, sub_cause=ICE, heading=0.0)
                    batches = encode_reports(said, "cits-se", 5, 1 + k + len(places) * turn, now)
                    engine.intake.ingest(
                        [Message(Kind.OBSERVATION, key, body, JSON) for key, body in batches], now
                    )
                alerts = max(alerts, len(engine.alerts.all))
            taken = engine.counts[Kind.OBSERVATION]
        finally:
            engine.close()
    return [
        Figure("denm.foreign_false_alerts", float(alerts), "alerts by foreign DENM alone", 0.0),
        Figure("denm.foreign_reports", float(taken), "foreign reports taken", 100.0, "more"),
    ]


def measure_kuksa(folder: Path, quick: bool) -> list[Figure]:
    """Write to a gRPC server made from the published modules of kuksa.val.v2."""
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


def _number(point: Any) -> float | None:  # noqa: ANN401 modules of the wheel have no types
    return float(point.value.float) if point.HasField("value") else None


@contextmanager
def _broker() -> Iterator[tuple[int, dict[str, Any]]]:
    """Serve kuksa.val.v2 with types of VSS; return the port, and data points by path."""
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
    """Read a drive's estimates by the three readers of the format's owners."""
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
