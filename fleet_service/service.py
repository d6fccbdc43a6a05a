"""The running service: Zenoh on one side, the engine on the other, one worker between them.

subscribers ─► inbox ─► worker: take ─► alerts at once
                                flush ─► segment on disk ─► acknowledgements
                                tiles once a second
queryables  ─► answers, in Zenoh's threads
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import zenoh

from fleet_service.engine import Engine
from fleet_service.ingest import Inbox, Message
from schemas import grid, keys, query, transport, wire
from schemas.config import ServiceConfig
from schemas.errors import InputError
from schemas.wire import Alert, Kind

MESSAGES_PER_TURN: Final = 4096  # so that a flood does not delay alerts, segments and tiles by more than a moment
IDLE_S: Final = 0.05  # longest wait for a message; bounds how late a segment or a tile can be
STATUS_S: Final = 5.0
LEAVE_S: Final = 1.5  # of the three seconds in which a service is gone
TEXT: Final = "text/plain"


class Service:
    """One service.

    Args:
        config: settings.
        root: of the archive.
        say: takes the lines for the operator.

    Raises:
        InputError: the archive belongs to another service.
    """

    def __init__(self, config: ServiceConfig, root: Path, say: Callable[[str], None]) -> None:
        self._config, self._say = config, say
        self.engine = Engine(config, root)
        self.inbox = Inbox(config.queue_batches, self.engine.counts)
        self._put_at = self._flushed_at = self._said_at = time.monotonic()
        self._said = 0

    def run(self, stop: threading.Event) -> None:
        """Serve until `stop` is set; then flush, acknowledge and leave."""
        session = transport.open_session(self._config.zenoh, stop)
        if session is None:
            self.engine.close()
            return
        try:
            with session, self._declared(session):
                fusion = self.engine.fusion
                self._say(f"ready: {self._config.name}, {fusion.size} cells from the archive")
                while not stop.is_set():
                    self._turn(session, stop)
                self._leave(session)
        finally:
            self.engine.close()

    @contextmanager
    def _declared(self, session: zenoh.Session) -> Iterator[None]:
        regions = self._config.regions
        token = session.liveliness().declare_token(keys.shard_key(self._config.name))
        inputs = [
            session.declare_subscriber(f"{keys.ROOT}/{kind}/{region}/*", self.inbox.callback(kind))
            for kind in Kind
            for region in regions
        ]
        queryables = [
            session.declare_queryable(f"{keys.ROOT}/map/{region}/*", self._reply, complete=True) for region in regions
        ]
        try:
            yield
        finally:
            for subscriber in inputs:
                subscriber.undeclare()
            for queryable in queryables:
                queryable.undeclare()
            token.undeclare()

    def _turn(self, session: zenoh.Session, stop: threading.Event) -> None:
        if self.engine.full:
            stop.wait(IDLE_S)
        else:
            self._take(session, self.inbox.drain(IDLE_S, MESSAGES_PER_TURN))
        now = time.monotonic()
        if now - self._flushed_at >= self._config.segment_s:
            self._flushed_at = now
            self._settle(session)
        if now - self._put_at >= self._config.put_s:
            self._put_at = now
            self._put_alerts(session, self.engine.fading(time.time_ns()))
            self._put_tiles(session)
        if now - self._said_at >= STATUS_S:
            self._status(now)

    def _leave(self, session: zenoh.Session) -> None:
        """Take what is waiting, as far as LEAVE_S allows, and settle it; the rest its senders keep."""
        deadline = time.monotonic() + LEAVE_S
        while not self.engine.full and time.monotonic() < deadline:
            messages = self.inbox.drain(0.0, MESSAGES_PER_TURN)
            if not messages:
                break
            self._take(session, messages)
        self._settle(session)
        self._put_tiles(session)
        self._status(time.monotonic())

    def _take(self, session: zenoh.Session, messages: list[Message]) -> None:
        if messages:
            self._put_alerts(session, self.engine.take(messages, time.time_ns()))

    def _settle(self, session: zenoh.Session) -> None:
        for vehicle, ack in self.engine.flush():
            put(session, keys.ack_key(vehicle), ack, wire.ACK_ENCODING)

    def _put_tiles(self, session: zenoh.Session) -> None:
        for tile, stream in self.engine.tiles(time.time_ns()):
            put(session, keys.map_key(tile), stream, wire.ARROW)

    def _put_alerts(self, session: zenoh.Session, alerts: list[Alert]) -> None:
        for alert in alerts:
            put(session, keys.alert_key(int(grid.tile_of(alert.cell))), wire.encode_alert(alert), wire.ALERT_ENCODING)

    def _status(self, now: float) -> None:
        counts = self.engine.counts
        rate = (counts[Kind.OBSERVATION] - self._said) / max(now - self._said_at, 1e-9)
        self._said_at, self._said = now, counts[Kind.OBSERVATION]
        rest = ", ".join(f"{name} {n}" for name, n in sorted(counts.items()) if n and name not in set(Kind))
        self._say(
            f"status: {counts[Kind.OBSERVATION]} observations ({rate:.0f}/s), {counts[Kind.STATE]} states, "
            f"{self.engine.fusion.size} cells, {self.engine.alerts} alerts, queue {len(self.inbox)}"
            + (f"; {rest}" if rest else "")
        )

    def _reply(self, asked: zenoh.Query) -> None:
        with asked:
            try:
                pairs: Iterable[tuple[str, str]] = asked.parameters  # type: ignore[assignment] # stub: no iterable
                wanted = query.parse({name: value for name, value in pairs if not name.startswith("_")})  # Zenoh's own
                expression = asked.key_expr
                tiles = self.engine.answer(
                    wanted, lambda tile: expression.intersects(zenoh.KeyExpr(keys.map_key(tile))), time.time_ns()
                )
            except InputError as error:
                self.engine.counts["bad_queries"] += 1
                asked.reply_err(str(error), encoding=TEXT)
                return
            for tile, payload in tiles:
                asked.reply(keys.map_key(tile), payload, encoding=wanted.format.encoding)


def put(session: zenoh.Session, key: str, payload: bytes, encoding: str) -> None:
    """Put with the quality of service of the key's topic."""
    topic = keys.parse(key).topic
    congestion = zenoh.CongestionControl.BLOCK if topic.block else zenoh.CongestionControl.DROP
    session.put(
        key, payload, encoding=encoding, priority=getattr(zenoh.Priority, topic.priority), congestion_control=congestion
    )
