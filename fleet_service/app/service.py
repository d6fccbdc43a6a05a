"""The running service. One worker thread connects Zenoh and the engine (the parts of the service
without its network).

Zenoh messages ─► inbox ─► worker thread, in a loop:
                           1. process the messages; publish alerts at once
                           2. give new rows to another thread, which writes them to disk;
                              acknowledge the rows that are on disk
                           3. publish changed map tiles, each at most once a second, if time is left
Zenoh queries  ─► answered in Zenoh's own threads
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Final

import zenoh

from fleet_service.app.clock import SteadyClock
from fleet_service.app.endpoints import Endpoints
from fleet_service.app.engine import Engine
from fleet_service.app.jobs import BackgroundJobs, archive_jobs
from fleet_service.app.metrics import Pulse, collect_metrics, health_problems
from fleet_service.app.publications import WaitingAcks, publish_alerts, publish_tile
from fleet_service.app.status_line import StatusLine
from fleet_service.enrolment.fleet import Enrolment
from fleet_service.ingest.inbox import Inbox, Message
from fleet_service.ingest.rate_limit import RateLimiter
from fleet_service.replication.ownership import Ownership
from fleet_service.serve.queryable import Answering, MapQueryable
from fleet_service.serve.tile_rounds import SHARE_S, TileRounds
from fleet_service.shards.serving import announce_regions, claim_regions, watch_successors
from schemas.config import ServiceConfig, load_config
from schemas.runtime import watchdog, zenoh_session
from schemas.runtime.metrics import serve_metrics
from schemas.wire import Alert

IDLE_S: Final = 0.05  # [s] longest wait for a message: segments and tiles are late by at most this
# [s] Period in which active alerts are published again. A client that reconnects gets them
# within 5 s.
REPEAT_S: Final = 2.0
REPEATED: Final = 1000  # alerts per period (150 kB); further alerts follow in the next periods
# [s] Longest time for one segment or one tile of an answer. Then systemd restarts the service.
HANGS_S: Final = 60.0
# [s] If the worker makes no progress for this time, another service must take over.
STUCK_S: Final = 10.0
LEAVE_S: Final = 1.5  # [s] for the last messages; a service must end within three seconds
# [s] A service that has run for this time was not ended by a faulty checkpoint.
SURVIVED_S: Final = 20.0
# From this number of waiting messages on, the worker publishes only one tile per pass.
BEHIND: Final = 1000


class Service:
    """One running fleet service: it receives reports over Zenoh, updates the map, archives the
    reports, and answers queries.

    Args:
        config: settings.
        root: folder of the archive.
        events: logger of the lines for the operator.
        holding: ownership of the archive; None to open it without a lease (ownership limited in
            time).

    Raises:
        InputError: the archive belongs to another service.
    """

    def __init__(
        self,
        config: ServiceConfig,
        root: Path,
        events: logging.Logger,
        holding: Ownership | None = None,
    ) -> None:
        self._config = config
        self._root = root
        self._events = events
        known = None
        if config.fleet is not None:
            known = set(load_config(config.fleet, Enrolment, "fleet").vehicles)
        self.engine = Engine(config, root, holding)
        self._clock = SteadyClock(self.engine.seen)
        limits = RateLimiter(
            config.vehicle_kb_s * 1e3,
            config.vehicle_burst_kb * 1e3,
            known,
            self.engine.counts,
            shares=dict.fromkeys(config.publishers, config.publisher_kb_s / config.vehicle_kb_s),
        )
        self._replies = MapQueryable(
            Answering(
                self.engine.queries.measure_answer,
                lambda query, is_requested, only: self.engine.queries.answer(
                    query, is_requested, self._clock.now(), only
                ),
            ),
            self.engine.counts,
        )
        self.inbox = Inbox(config.queue_batches, self.engine.counts, limits)
        self._endpoints = Endpoints(config, self.engine, self.inbox, self._replies)
        self.engine.settlement.call_when_written(self.inbox.wake)
        jobs = archive_jobs(self.engine, config, root, self._clock.moment)
        self._jobs = BackgroundJobs(jobs, self.engine.counts, events.info)
        # Exception that ended the worker. Closing the session after it may hang.
        self.failure: BaseException | None = None
        self._session: zenoh.Session | None = None
        self._acks = WaitingAcks()
        self._rounds = TileRounds(
            config.put_s,
            lambda: self.engine.queries.take_changed(self._clock.now()),
            self._put_tiles,
            self.engine.counts,
            time.monotonic,
        )
        self._began = time.monotonic()
        self._stepped_at = self._began
        self._flushed_at = self._began
        self._repeated_at = self._began
        self._status_line = StatusLine(self.engine, self.inbox, self._clock, events)
        self._survived = False
        self._was_replaced = False  # True once another service has the lease

    def run(self, stop: threading.Event) -> None:
        """Serve until `stop` is set; then write the waiting rows to disk, acknowledge them, and
        stop.
        """
        if self.engine.holding.lease is not None:
            self.engine.holding.lease.serves = self._is_working
        try:
            with self._serve_monitoring() as address:
                session = zenoh_session.open_session(self._config.zenoh, stop, self._config.name)
                if session is not None:
                    self._serve(session, stop, f", {address}" if address else "")
        finally:
            self.engine.close(has_failed=self.failure is not None)

    @property
    def exit_code(self) -> int:
        """Return 0 if all admitted data are on disk and nothing failed; 1 otherwise, or if another
        service has taken over.
        """
        has_failed = self.failure is not None or self._was_replaced
        return 1 if has_failed or self.engine.settlement.unsettled else 0

    def _serve(self, session: zenoh.Session, stop: threading.Event, address: str) -> None:
        config = self._config
        with (
            session,
            claim_regions(
                session, config.name, config.regions, stop, self.engine.holding.all_holders
            ) as claims,
            watch_successors(session, claims) as has_successor,
            self._jobs,
            self._endpoints.declare_all(session),
            announce_regions(session, claims),
        ):
            self._session = session
            self._events.info(
                f"ready: {self._config.name}, {self.engine.state.fusion.size} cells from the "
                f"archive{address}"
            )
            watchdog.notify_alive()
            try:
                while not (
                    stop.is_set()
                    or self._has_lost_archive(has_successor)
                    or self.engine.holding.leaves
                ):
                    self._step(session, stop)
                self._shut_down(session, stop)
            except BaseException as error:
                self.failure = error
                stop.set()
                raise

    def _has_lost_archive(self, has_successor: Callable[[], bool]) -> bool:
        """Return True if another service has taken over the archive.

        Normally this service learns this from the lease, which is stored in the bucket (object
        store) with the archive's copy. If the bucket does not answer, this service calls
        `has_successor`, which returns True if another service has announced the same regions.
        """
        holding = self.engine.holding
        if not holding.may_acknowledge and has_successor():
            holding.mark_lost()
        return holding.is_lost

    def _describe_hang(self) -> str | None:
        """Return a description of a part of the service that hangs or has died, so that only a
        restart helps; None if there is none. The worker (the thread that processes messages) calls
        this and is not checked itself.
        """
        if self.engine.settlement.hangs_s >= HANGS_S:
            return (
                f"a segment write has been in progress for {self.engine.settlement.hangs_s:.0f} s"
            )
        if self._replies.hangs_s >= HANGS_S:
            return f"a tile of an answer has been in progress for {self._replies.hangs_s:.0f} s"
        return "the thread of background jobs has ended" if self._jobs.has_ended else None

    def _is_working(self) -> bool:
        """Return True if this service can serve its regions: a router is connected, and the worker
        makes progress.
        """
        session = self._session
        turn_age_s = time.monotonic() - self._stepped_at
        return (
            session is not None
            and turn_age_s < STUCK_S
            and bool(zenoh_session.connected_routers(session))
        )

    def _serve_monitoring(self) -> AbstractContextManager[str | None]:
        """Return a context that serves metrics and health, if the settings ask for it."""
        config = self._config
        engine = self.engine
        root = self._root

        def pulse() -> Pulse:
            session = self._session
            routers = len(zenoh_session.connected_routers(session)) if session else 0
            lag_s = self._clock.lag() * 1e-9
            turn_s = time.monotonic() - self._stepped_at
            return Pulse(turn_s, len(self.inbox), routers, lag_s, self._replies.hangs_s)

        return serve_metrics(
            config.metrics_host,
            config.metrics_port,
            lambda: collect_metrics(engine, pulse(), config, root),
            lambda: health_problems(engine, pulse(), config) + self._jobs.health_problems(),
        )

    def _step(self, session: zenoh.Session, stop: threading.Event) -> None:
        if self.engine.settlement.is_full:
            stop.wait(IDLE_S)
        else:
            wait_s = min(IDLE_S, self.engine.settlement.until_early_s(time.monotonic()))
            has_work = self._rounds.waiting or self._acks
            self._ingest(session, self.inbox.drain(0.0 if has_work else wait_s))
        now = time.monotonic()
        self._stepped_at = now
        self._acks.add(self.engine.settlement.end_flush())
        is_flush_due = now - self._flushed_at >= self._config.segment_s
        if is_flush_due or self.engine.settlement.until_early_s(now) <= 0.0:
            self._flushed_at = now
            self._acks.add(self.engine.settlement.begin_flush())
            self.engine.intake.update_weather(self._clock.now())
        self._acks.publish_part(session)
        if self._rounds.begin() and (at := self._clock.moment()).sure:
            publish_alerts(session, self.engine.alerts.expire(at.now))
        self._rounds.go_on(SHARE_S if len(self.inbox) < BEHIND else 0.0)
        if now - self._repeated_at >= REPEAT_S:
            self._repeated_at = now
            publish_alerts(session, self.engine.alerts.next_to_repeat(REPEATED))
        if self._status_line.is_due(now):
            self._report_status(now)
        if not self._survived and now - self._began >= SURVIVED_S:
            self._survived = True
            self.engine.mark_survived()

    def _report_status(self, now: float) -> None:
        """Write the status line, and notify the watchdog unless a part of the service hangs."""
        self._status_line.write_line(now)
        if hanging := self._describe_hang():
            self._events.info(f"watchdog signal withheld: {hanging}")
        else:
            watchdog.notify_alive()

    def _shut_down(self, session: zenoh.Session, stop: threading.Event) -> None:
        """Process and acknowledge the waiting messages within LEAVE_S [s]. Nothing is lost
        afterwards, because senders keep messages that were not acknowledged.
        """
        if self.engine.holding.is_lost:
            self._was_replaced = True
            # From here on, waiting for a bucket or a router must not delay the end for long.
            stop.set()
            self._events.info(
                "lease lost to another service; senders keep everything that was not acknowledged"
            )
            return
        leaves = self.engine.holding.leaves
        if leaves:
            stop.set()
        deadline = time.monotonic() + LEAVE_S
        while not self.engine.settlement.is_full and time.monotonic() < deadline:
            messages = self.inbox.drain(0.0)
            if not messages:
                break
            self._ingest(session, messages)
        self._acks.add(self.engine.settlement.flush())
        self._acks.publish_all(session)
        if not leaves:  # after a hand-over, the next owner publishes all tiles
            self._rounds.finish(max(deadline - time.monotonic(), 0.0))
        self._status_line.write_line(time.monotonic())

    def _ingest(self, session: zenoh.Session, messages: list[Message]) -> None:
        if messages:
            publish_alerts(session, ingest_messages(self.engine, self._clock, messages))

    def _put_tiles(self, waiting: list[int]) -> int:
        """Publish the first of the waiting tiles, and return their number."""
        streams = self.engine.queries.first_tiles(waiting, self._clock.now())
        for tile, stream in streams.items():
            if stream and self._session is not None:
                publish_tile(self._session, tile, stream)
        return len(streams)


def ingest_messages(engine: Engine, clock: SteadyClock, messages: list[Message]) -> list[Alert]:
    """Let the engine (service without network) process messages now, and pass the times in the
    reports to the clock; return the alerts that are raised or cleared.
    """
    alerts = engine.intake.ingest(messages, clock.moment())
    clock.record_reports(engine.intake.times)
    return alerts
