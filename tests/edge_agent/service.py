"""Router on a free port, and a simulated service that stores batches and acknowledges them, over
real Zenoh sessions.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Self

import zenoh

from schemas import keys
from schemas.config import ZenohSettings
from schemas.runtime.zenoh_session import open_session
from schemas.wire import ACK_ENCODING, Batch, Kind, StreamAck, decode, encode_ack
from tests.ports import free_ports

DEADLINE_S = 120.0  # time for the first start after a change, which compiles the kernels


class Router:
    """Zenoh router in this process. After `stop` and `start` it has the same address."""

    def __init__(self) -> None:
        self.endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
        self.start()

    def start(self) -> None:
        config = zenoh.Config()
        settings = {
            "mode": "router",
            "listen/endpoints": [self.endpoint],
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "scouting/delay": 0,
            "transport/shared_memory/enabled": False,
        }
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        self._session = zenoh.open(config)

    def stop(self) -> None:
        self._session.close()

    @property
    def settings(self) -> ZenohSettings:
        return ZenohSettings(
            connect=[self.endpoint], config={"connect/retry": {"period_init_ms": 50}}
        )


@dataclass
class Service:
    """Simulated service that stores received messages. It acknowledges them while `answer` is True.
    The function `refuse(batch)` may return a reason to reject a batch instead.
    """

    router: Router
    answer: bool = True
    refuse: Callable[[Batch], str | None] = lambda batch: None
    batches: list[Batch] = field(default_factory=list)
    keys: list[str] = field(default_factory=list)
    _changed: threading.Condition = field(default_factory=threading.Condition)

    def __enter__(self) -> Self:
        session = open_session(self.router.settings)
        assert session is not None
        self.session = session
        for kind in Kind:
            session.declare_subscriber(f"{keys.ROOT}/{kind}/**", self._hearing(kind))
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()

    def _hearing(self, kind: Kind) -> Callable[[zenoh.Sample], None]:
        def hear(sample: zenoh.Sample) -> None:
            batch = decode(sample.payload.to_bytes(), str(sample.encoding), kind)
            with self._changed:
                self.batches.append(batch)
                self.keys.append(str(sample.key_expr))
                self._changed.notify_all()
            if self.answer:
                self.acknowledge(batch)

        return hear

    def acknowledge(self, batch: Batch) -> None:
        reason = self.refuse(batch)
        durable = () if reason else ((batch.seq, batch.seq),)
        rejected = ((batch.seq, 0, reason),) if reason else ()
        ack = StreamAck(batch.boot, batch.kind, batch.region, durable, rejected)
        self.put_ack(batch.vehicle, encode_ack(batch.vehicle, [ack]))

    def put_ack(self, vehicle: str, payload: bytes) -> None:
        self.session.put(keys.ack_key(vehicle), payload, encoding=ACK_ENCODING)

    def wait(self, condition: Callable[[list[Batch]], bool]) -> None:
        """Wait until `condition` is true for the list of batches that this service has received."""
        with self._changed:
            assert self._changed.wait_for(lambda: condition(self.batches), DEADLINE_S), (
                f"{len(self.batches)} batches"
            )

    def count_records(self) -> int:
        """Return the number of received records. A batch that the agent sent again counts once."""
        return sum(
            dict(zip(self.identities(), (b.rows for b in self.batches), strict=True)).values()
        )

    def identities(self) -> list[tuple[str, int, Kind, int, int]]:
        return [(b.vehicle, b.boot, b.kind, b.region, b.seq) for b in self.batches]
