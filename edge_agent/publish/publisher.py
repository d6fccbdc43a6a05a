"""Publisher: the thread between the estimation loop and the network: batch, store, send, settle,
resend.

The loop only calls `offer`, which never blocks. Only the sender thread uses disk and network. Every
batch is on disk before it is sent, and stays there until the service has settled it. A second
thread opens the sessions and waits for the routers as long as necessary.
"""

from __future__ import annotations

import logging
import queue
import sqlite3
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import zenoh

from edge_agent.observe.observation_builder import RecordBlock
from edge_agent.publish.batching import Batcher, Draft
from edge_agent.publish.outbox import Outbox, Stream
from edge_agent.publish.spool_file import is_damage
from edge_agent.publish.zenoh_link import Link
from schemas.config import AgentConfig
from schemas.errors import WireError
from schemas.runtime.link_watch import LinkWatch
from schemas.thresholds import NS
from schemas.wire import Kind, decode_ack

TICK_S: Final = 0.05  # how often the sender looks for due batches when nothing is offered
QUEUE_LIMIT: Final = 20_000  # blocks of records; many minutes of a disk that does not answer
WAITING_LIMIT: Final = 10_000  # batches kept in memory while the disk refuses
RESEND_LIMIT: Final = 64  # batches offered again per round, so that fresh ones are not held up
RESEND_PER_VEHICLE: Final = 4  # of these on average; a link waits between two messages of one kind
CLOCK_OFF_S: Final = 30.0  # between a service's clock and ours: what is further ahead it refuses
# beyond the deadline, for a put or a close that hangs on a frozen router
CLOSE_GRACE_S: Final = 0.5

log = logging.getLogger(__name__)


@dataclass
class Counts:
    """Records by kind and by result."""

    offered: dict[Kind, int] = field(default_factory=lambda: dict.fromkeys(Kind, 0))
    published: dict[Kind, int] = field(default_factory=lambda: dict.fromkeys(Kind, 0))
    acknowledged: dict[Kind, int] = field(default_factory=lambda: dict.fromkeys(Kind, 0))
    rejected: dict[Kind, int] = field(default_factory=lambda: dict.fromkeys(Kind, 0))
    dropped: dict[Kind, int] = field(default_factory=lambda: dict.fromkeys(Kind, 0))
    late: dict[Kind, int] = field(
        default_factory=lambda: dict.fromkeys(Kind, 0)
    )  # batches, not records
    resent_batches: int = 0
    bad_acks: int = 0
    failures: int = 0  # of the sending thread, which goes on


class Publisher:
    """Publishes records of the named vehicles; column `vehicle` of the records is an index into
    `names`.

    `on_open` is called with each vehicle's session when it is open, for other publications and
    subscriptions.
    """

    def __init__(
        self,
        names: Sequence[str],
        outbox: Outbox,
        config: AgentConfig,
        estimator: str,
        clock: Callable[[], float] = time.monotonic,
        on_open: Callable[[str, zenoh.Session], None] = lambda *_: None,
        wall: Callable[[], int] = time.time_ns,
    ) -> None:
        self._on_open = on_open
        self._names = dict.fromkeys(names)
        self._outbox = outbox
        self._config = config
        self._clock = clock
        self._wall = wall
        self.clock_behind_s = 0.0
        self._batcher = Batcher(
            names, outbox.boot, estimator, flush_s=config.flush_s, rows=config.batch_rows
        )
        self._offered: queue.Queue[RecordBlock] = queue.Queue(QUEUE_LIMIT)
        self._acks: queue.SimpleQueue[tuple[str, bytes]] = queue.SimpleQueue()
        self._links: dict[str, Link] = {}
        self._connected: dict[str, bool] = {}
        self._epochs: dict[str, int] = {}
        self._waiting: list[Draft] = []
        self._closing = threading.Event()
        self._stopped = threading.Event()
        self._deadline = float("inf")
        self._sender = threading.Thread(target=self._send_loop, name="sender", daemon=True)
        self._connector = threading.Thread(target=self._open_links, name="connector", daemon=True)
        self.counts = Counts()

    def start(self) -> None:
        """Start to open sessions and to send."""
        self._connector.start()
        self._sender.start()

    @property
    def links(self) -> int:
        """Number of open sessions."""
        return len(self._links)

    @property
    def link_watches(self) -> list[LinkWatch]:
        """The state of each session's link."""
        return [link.watch for link in list(self._links.values())]

    @property
    def cut_off(self) -> bool:
        """True if an open session has no router."""
        return not all(list(self._connected.values()))

    @property
    def unanswered_s(self) -> float:
        """Time [s] for which sent batches have been without an answer."""
        return self._outbox.unanswered_s(self._clock())

    @property
    def stranded_records(self) -> int:
        """Records in the outbox under names of other vehicles: of a former name."""
        return self._outbox.count_stranded(self._names)

    @property
    def fill_share(self) -> float:
        """Used share of the outbox."""
        return self._outbox.bytes / self._outbox.capacity_bytes

    @property
    def unanswered_records(self) -> int:
        """Records of batches that were given up, because only later ones were answered."""
        return self._outbox.counts.unanswered

    @property
    def damage_counts(self) -> tuple[int, int]:
        """Number of times that the outbox was found damaged, and records known to be lost by it."""
        return self._outbox.counts.damages, self._outbox.counts.damaged

    @property
    def is_broken(self) -> bool:
        """True if the sending thread has died: records are accepted, and dropped when there is
        no room.
        """
        return (
            self._sender.ident is not None
            and not self._sender.is_alive()
            and not self._closing.is_set()
        )

    def count_unsettled(self, kind: Kind | None = None) -> int:
        """Return the number of unsettled records: in the outbox, also of an earlier start, or not
        yet stored in it.
        """
        counts = self.counts
        kinds = Kind if kind is None else (kind,)
        coming = sum(counts.offered[k] - counts.dropped[k] - counts.published[k] for k in kinds)
        return coming + self._outbox.count_records(self._names, kind)

    @property
    def dropped_records(self) -> int:
        """Records dropped for lack of room, in the queue or in the outbox."""
        return sum(self.counts.dropped.values()) + sum(self._outbox.counts.evicted.values())

    def offer(self, *blocks: RecordBlock) -> None:
        """Queue records; never blocks. Records that do not fit are dropped and counted."""
        for records in blocks:
            if not len(records.vehicle):
                continue
            self.counts.offered[records.kind] += len(records.vehicle)
            try:
                self._offered.put_nowait(records)
            except queue.Full:
                self.counts.dropped[records.kind] += len(records.vehicle)

    def close(self, within_s: float) -> bool:
        """Flush, wait at most `within_s` for acknowledgements, stop; False if something hung and
        was abandoned.
        """
        self._deadline = self._clock() + within_s
        self._closing.set()
        self._sender.join(within_s + CLOSE_GRACE_S)
        self._stopped.set()
        closer = threading.Thread(target=self._close_links, name="closer", daemon=True)
        closer.start()
        closer.join(CLOSE_GRACE_S)
        if self._sender.is_alive() or closer.is_alive():
            return False
        try:
            self._outbox.close()
        except sqlite3.Error as error:
            log.warning(
                "settled batches cannot be deleted from the outbox (%s) and will be sent again",
                error,
            )
        return True

    def _open_links(self) -> None:
        for name in self._names:
            link = Link.open(self._config.zenoh, name, self._receive_ack, self._stopped)
            if link is None:
                return
            self._links[name] = link
            self._on_open(name, link.session)

    def _close_links(self) -> None:
        self._connector.join()
        for link in self._links.values():
            link.close()

    def _receive_ack(self, vehicle: str, payload: bytes) -> None:
        self._acks.put((vehicle, payload))

    def _send_loop(self) -> None:
        while not self._is_finished():
            try:
                self._send_round()
            except sqlite3.Error as error:
                if is_damage(error):
                    self._recover_outbox()
                else:
                    log.warning("the outbox cannot be read or written (%s); trying again", error)
                self._stopped.wait(TICK_S)
            except Exception:  # whatever it is: estimation goes on, and so must this thread
                self.counts.failures += 1
                log.exception("sending failed; trying again")
                self._stopped.wait(TICK_S)

    def _send_round(self) -> None:
        self._take_offered()
        self._settle_acks()
        self._check_connections()
        self._waiting += self._batcher.take_due(self._clock(), everything=self._closing.is_set())
        self._store_and_send()
        self._outbox.delete_settled()
        self._resend_due()

    def _recover_outbox(self) -> None:
        """Save the readable content of an outbox that was damaged during use, and continue."""
        try:
            self._outbox.recover_file()
        except (sqlite3.Error, OSError) as error:
            log.warning("the damaged outbox cannot be repaired (%s); trying again", error)

    def _is_finished(self) -> bool:
        if not self._closing.is_set():
            return False
        return not self.count_unsettled() or self._clock() >= self._deadline

    def _take_offered(self) -> None:
        try:
            self._add_records(self._offered.get(timeout=TICK_S))
            while True:
                self._add_records(self._offered.get_nowait())
        except queue.Empty:
            return

    def _add_records(self, records: RecordBlock) -> None:
        try:
            self._batcher.add(records, self._clock())
        except Exception:
            self.counts.failures += 1
            self.counts.dropped[records.kind] += len(records.vehicle)
            log.exception("%d records that cannot be sent are dropped", len(records.vehicle))

    def _store_and_send(self) -> None:
        """Commit waiting records, then send them. A disk that refuses is tried again in the next
        round.
        """
        if not self._waiting:
            return
        try:
            batches = self._outbox.store(self._waiting, self._clock())
        except sqlite3.Error as error:
            log.warning(
                "the outbox refuses %d batches (%s); trying again", len(self._waiting), error
            )
            for draft in self._waiting[:-WAITING_LIMIT]:
                self.counts.dropped[draft.kind] += draft.records
            self._waiting = self._waiting[-WAITING_LIMIT:]
            if is_damage(error):
                raise
            return
        except Exception:
            log.exception("a batch cannot be written")
            self._drop_unwritable()
            return
        for draft in self._waiting:
            self.counts.published[draft.kind] += draft.records
        self._waiting = []
        for batch in batches:
            if batch.fresh and self._connected.get(batch.stream.vehicle):
                self._links[batch.stream.vehicle].put(batch)

    def _drop_unwritable(self) -> None:
        """Drop only the drafts that protobuf refuses."""
        waiting = self._waiting
        self._waiting = []
        for draft in waiting:
            try:
                draft.encode(1, 1)
            except Exception:  # noqa: BLE001 whatever it is, the others must go
                self.counts.failures += 1
                self.counts.dropped[draft.kind] += draft.records
            else:
                self._waiting.append(draft)

    def _resend_due(self) -> None:
        there = {name for name, connected in self._connected.items() if connected}
        limit = min(RESEND_LIMIT, RESEND_PER_VEHICLE * len(there))
        for batch in self._outbox.due_batches(self._clock(), limit, there) if there else ():
            self.counts.resent_batches += self._links[batch.stream.vehicle].put(batch)

    def _compare_clocks(self, reported: int) -> None:
        """Compare our clock with that of a service [ns], 0 if unknown; an acknowledgement is
        about a second old.
        """
        if not reported:
            return
        behind = (reported - self._wall()) / NS
        if abs(behind) > CLOCK_OFF_S and abs(behind - self.clock_behind_s) > CLOCK_OFF_S:
            log.warning(
                "the clock is %.0f s behind the service's: reports arrive late or are refused",
                behind,
            )
        self.clock_behind_s = behind

    def _check_connections(self) -> None:
        """Note for each vehicle whether it has a router. Batches in flight when a link breaks are
        lost; they are sent again on the next link."""
        for name, link in list(self._links.items()):
            epoch = link.watch.epoch
            if epoch != self._epochs.get(name, 0):
                self._epochs[name] = epoch
                self._outbox.reset_in_flight(name, self._clock())
            self._connected[name] = link.is_connected

    def _settle_acks(self) -> None:
        while not self._acks.empty():
            vehicle, payload = self._acks.get()
            try:
                named, streams = decode_ack(payload)
            except WireError as error:
                self.counts.bad_acks += 1
                log.warning("an acknowledgement for %s cannot be read: %s", vehicle, error)
                continue
            if named != vehicle:
                self.counts.bad_acks += 1
                continue
            for ack in streams:
                stream = Stream(vehicle, ack.boot, ack.kind, ack.region)
                self.counts.acknowledged[ack.kind] += self._outbox.settle_ranges(
                    stream, ack.durable
                )
                self.counts.late[ack.kind] += sum(last - first + 1 for first, last in ack.late)
                self._compare_clocks(ack.time)
                for seq, row, reason in ack.rejected:
                    records = self._outbox.settle_ranges(stream, [(seq, seq)])
                    self.counts.rejected[ack.kind] += records
                    if records:
                        log.warning(
                            "%s batch %d of %s was rejected at row %d: %s",
                            ack.kind,
                            seq,
                            vehicle,
                            row,
                            reason,
                        )
