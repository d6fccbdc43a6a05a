"""Benchmark of the acknowledgement times of a service whose archive has a copy in a bucket (object
storage), compared with those of a service without a copy. Both are measured alternately.

The bucket is on a real S3 server in a separate process of this machine. A bucket over a network
adds its network delay.
"""

from __future__ import annotations

import json
import statistics
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from deploy.router import open_router
from schemas import keys
from schemas.config import ZenohSettings
from schemas.runtime.figures import Figure
from schemas.runtime.zenoh_session import open_session
from tests.benchmarks.service import ACKS, ack_delays_s, poll_until, run_process
from tests.buckets import bucket_server

TURNS = 3  # alternating runs of each variant, so that other load on the machine affects both
BAR = 2.0


def delays_s(folder: Path, archive: dict[str, Any]) -> list[float]:
    """Start a service with the settings `archive` for its archive, and send reports to this
    service. Return the time [s] from each report to its acknowledgement.
    """
    with ExitStack() as stack:
        router, (endpoint, *_) = open_router(listen="tcp/127.0.0.1:0")
        stack.enter_context(router)
        config = folder / "service.json"
        config.write_text(json.dumps({"zenoh": {"connect": [endpoint]}, "archive": archive}))
        stack.enter_context(run_process("-m", "fleet_service.cli", "run", "--config", str(config)))
        client = open_session(ZenohSettings(connect=[endpoint]))
        assert client is not None
        stack.enter_context(client)
        poll_until(
            lambda: [reply for reply in client.liveliness().get(keys.shard_key("*")) if reply.ok]
        )
        return ack_delays_s(client, "acked-0", (0.0, 0.3), ACKS)


def cluster() -> list[Figure]:
    """Measure the times until acknowledgement of a service whose archive has a copy in a bucket
    (object store), and of a service without a copy. Return their ratio as a figure.
    """
    alone: list[float] = []
    both: list[float] = []
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for turn in range(TURNS):
            alone += delays_s(folder, {"path": str(folder / f"alone-{turn}")})
            with bucket_server(folder / f"objects-{turn}") as bucket:
                both += delays_s(folder, {"path": str(folder / f"both-{turn}"), **bucket.settings})
                objects = sum(name.startswith("inbox/") for name in bucket.read_objects())
            if not objects:
                raise RuntimeError("nothing was put into the bucket")
    least = statistics.median(alone)
    unit = f"of the {least:.3f} s without a bucket; medians of {len(both)} batches"
    return [Figure("cluster.ack_p50_s", statistics.median(both) / least, unit, BAR)]
