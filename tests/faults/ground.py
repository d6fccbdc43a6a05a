"""Environment of the attacks: two routers with TLS and access list, a running service, honest
vehicles and readers, and listeners.

No step waits by sleeping. Messages of one priority keep their order on each path. So if a marker
message is sent after an attack and received, no message of the attack is still in transit. Messages
that reached the service wait for its worker thread, which processes them in order. So only the
acknowledgement of a later batch shows that the service has processed and counted the messages of
the attack.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import zenoh

from fleet_service.app.service import Service
from schemas import keys, wire
from schemas.config import ServiceConfig
from schemas.errors import WireError
from tests.event_lines import logger_into
from tests.fleet_service.examples import SECOND, TILE, batch, key
from tests.secured import READER, ROUTERS, SERVICE, VEHICLES, Network, settings
from tests.waiting import matched, until

HONEST, ROGUE = VEHICLES
RESEND_S = 0.5  # [s] time until a message is sent again after a restart of the routers
MARKER = f"{keys.ROOT}/map/0000/000/000/0000"


@dataclass
class Listener:
    """Zenoh session that records all messages on some key expressions. The records show the effects
    of an attack.
    """

    session: zenoh.Session
    expressions: tuple[str, ...]
    received: list[tuple[str, bool, bytes]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._subscribers = [
            self.session.declare_subscriber(one, self._record_sample) for one in self.expressions
        ]

    def _record_sample(self, sample: zenoh.Sample) -> None:
        put = sample.kind == zenoh.SampleKind.PUT
        self.received.append((str(sample.key_expr), put, sample.payload.to_bytes()))

    def has_payload(self, payload: bytes) -> bool:
        """Return True if the listener (subscriber that observes the effects of an attack) received
        a message that contains this payload.
        """
        return any(payload in message for _, _, message in list(self.received))


class Ground:
    """Environment of an attack: running routers, service and listeners. The attacker is enrolled as
    a vehicle and connected to the second router.
    """

    def __init__(self, network: Network, service: Service, stack: ExitStack) -> None:
        self.network = network
        self.service = service
        self._stack = stack
        self.folder = network.folder
        self.monitor = Listener(self.open_session(SERVICE), ("gripmap/**",))
        self.reader = Listener(
            self.open_session(READER, ROUTERS[1]), (f"{keys.ROOT}/map/**", f"{keys.ROOT}/alert/**")
        )
        self.honest = Listener(self.open_session(HONEST), (keys.ack_key(HONEST),))
        self._probe = self.open_session(SERVICE)
        self._marks = 0
        self._seq = 0

    def open_session(self, name: str, router: str = ROUTERS[0], **changed: object) -> zenoh.Session:
        """Open a Zenoh session with the certificate of `name` at the router `router`. The keywords
        `changed` replace TLS settings. The session is closed together with this environment.
        """
        return self._stack.enter_context(self.network.open_session(name, router, **changed))

    @property
    def admitted_count(self) -> int:
        """Return the number of observations that the attacked service has accepted so far."""
        return self.service.engine.counts.observations

    def drive(self, session: zenoh.Session | None = None, name: str = HONEST) -> None:
        """Send a valid batch of one observation of the vehicle `name`, repeatedly, until the
        service has acknowledged the batch as durable.
        """
        self._seq += 1
        sent = batch(name, self._seq, time.time_ns() - SECOND, [0.8])
        session = session or self.honest.session

        def is_settled() -> bool:
            session.put(key(name), wire.encode(sent), encoding=wire.ENCODING[sent.kind])
            with suppress(TimeoutError):
                until(lambda: self._is_durable(sent), RESEND_S)
            return self._is_durable(sent)

        until(is_settled)

    def _is_durable(self, sent: wire.Batch) -> bool:
        """Return True if the service has acknowledged the batch `sent` as durable (stored on disk).

        Other messages on the Zenoh key of these acknowledgements are ignored: acknowledgements of
        earlier batches, and forged ones that cannot be decoded.
        """
        for place, _, payload in list(self.monitor.received):
            if place == keys.ack_key(sent.vehicle):
                with suppress(WireError):
                    _, streams = wire.decode_ack(payload)
                    durable = [
                        reach
                        for stream in streams
                        if stream.boot == sent.boot
                        for reach in stream.durable
                    ]
                    if any(first <= sent.seq <= last for first, last in durable):
                        return True
        return False

    def await_judgement(self) -> None:
        """Wait until the service has processed and counted every message that reached it before
        this call.
        """
        self.drive()

    def await_effects(self, session: zenoh.Session, *listeners: Listener) -> None:
        """Wait until every message that `session` has sent is delivered, and until the listeners
        have received all messages that resulted from it.
        """
        list(session.get(f"{keys.ROOT}/map/**"))
        self._marks += 1
        mark = f"mark {self._marks}".encode()
        self._probe.put(MARKER, mark)
        for one in (self.monitor, self.reader, *listeners):
            until(lambda one=one: one.has_payload(mark))  # type: ignore[misc]


@contextmanager
def open_ground(network: Network) -> Iterator[Ground]:
    """Yield the environment of the attacks: a running service behind the routers, and sessions of
    honest parties.
    """
    config = ServiceConfig(
        zenoh=settings(network.endpoints[ROUTERS[0]], network.folder),
        name=SERVICE,
        put_s=0.1,
        segment_s=0.05,
    )
    lines: list[str] = []
    service = Service(config, Path(network.folder, "archive"), logger_into(lines))
    stop = threading.Event()
    thread = threading.Thread(target=service.run, args=(stop,))
    thread.start()
    try:
        until(lambda: any(line.startswith("ready") for line in lines))
        with ExitStack() as stack:
            found = Ground(network, service, stack)
            # Wait until the second router knows that the service answers queries. Its path is the
            # longer one, and only a session with the service's rights learns this.
            querier = found.open_session(SERVICE, ROUTERS[1]).declare_querier(keys.map_key(TILE))
            matched(querier)
            querier.undeclare()
            yield found
    finally:
        stop.set()
        thread.join()
