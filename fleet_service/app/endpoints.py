"""Subscriptions and queryables that a service declares in its Zenoh session."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from fleet_service.app.engine import Engine
from fleet_service.ingest.inbox import Inbox
from fleet_service.ingest.weather import WeatherMessage
from fleet_service.serve.queryable import MapQueryable
from fleet_service.shards import handover
from schemas import keys, wire
from schemas.config import ServiceConfig
from schemas.wire import Kind


class Endpoints:
    """Subscriptions and queryables of a service for its regions.

    Received batches (messages with records) go to `inbox`, and weather reports to the engine
    (service without network). `replies` answers map queries.
    """

    def __init__(
        self, config: ServiceConfig, engine: Engine, inbox: Inbox, replies: MapQueryable
    ) -> None:
        self._config = config
        self._engine = engine
        self._inbox = inbox
        self._replies = replies

    @contextmanager
    def declare_all(self, session: zenoh.Session) -> Iterator[None]:
        """Provide a context in which the service subscribes to reports, answers queries, and has a
        liveliness token in Zenoh (sign that it is connected).
        """
        regions = self._config.regions
        own = keys.shard_key(self._config.name)
        inputs = [
            session.declare_subscriber(f"{keys.ROOT}/{kind}/{region}/*", self._inbox.callback(kind))
            for kind in Kind
            for region in regions
        ]
        inputs += [
            session.declare_subscriber(f"{keys.ROOT}/weather/{region}", self._enqueue_weather)
            for region in regions
        ]
        queryables = [
            session.declare_queryable(f"{keys.ROOT}/map/{region}/*", self._replies, complete=True)
            for region in regions
        ]
        queryables += [
            session.declare_queryable(
                f"{keys.ROOT}/alert/{region}/*", self._answer_standing, complete=True
            )
            for region in regions
        ]
        if self._engine.holding.lease is not None:
            queryables.append(
                session.declare_queryable(own, lambda query: self._hand_over(query, session))
            )
        # Declare the token last, because a client may query as soon as it sees the token.
        token = session.liveliness().declare_token(own)
        try:
            yield
        finally:
            token.undeclare()
            for subscriber in inputs:
                subscriber.undeclare()
            for queryable in queryables:
                queryable.undeclare()

    def _hand_over(self, query: zenoh.Query, session: zenoh.Session) -> None:
        """Answer a hand-over request, which names a standby (waiting service). If the standby is
        ready, begin an orderly shutdown of this service, so that the standby takes over its
        regions.
        """
        self._engine.holding.to = (
            handover.answer_request(query, session, self._config.regions) or self._engine.holding.to
        )

    def _answer_standing(self, request: zenoh.Query) -> None:
        """Answer a query for the active ("standing") alerts. Clients send this query when they
        start, because they did not receive the alerts that were published before.
        """
        expression = request.key_expr
        with request:
            for tile, alerts in self._engine.alerts.encode_tiles(
                lambda tile: expression.intersects(zenoh.KeyExpr(keys.alert_key(tile)))
            ):
                request.reply(keys.alert_key(tile), alerts, encoding=wire.STANDING_ENCODING)

    def _enqueue_weather(self, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT:
            return
        # A message that is too long is replaced with an empty one, which is refused and counted.
        fits = len(sample.payload) <= wire.MAX_BYTES
        payload = sample.payload.to_bytes() if fits else b""
        message = WeatherMessage(str(sample.key_expr), payload, str(sample.encoding))
        self._engine.intake.weather.enqueue(message)
