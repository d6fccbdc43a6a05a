"""Publisher: a thread between the estimation loop and the network. It collects records into
batches, stores and sends them, and sends them again until a service has answered.

The loop only calls `offer`, which never blocks. Only the sender thread uses disk and network. Every
batch is on disk before it is sent, and stays there until the service has settled it (stored or
refused it for good). Other threads open the Zenoh sessions and wait for the routers as long as
necessary.
"""

from __future__ import annotations

import logging
import queue
import sqlite3
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

import zenoh

from edge_agent.observe.observation_builder import RecordBlock
from edge_agent.publish.ack_settlement import AckSettlement, Counts
from edge_agent.publish.batching import Batcher, Draft
from edge_agent.publish.outbox import Outbox
from edge_agent.publish.publisher_status import PublisherStatus
from edge_agent.publish.resend_schedule import LONGEST_RESEND_S
from edge_agent.publish.session_links import SessionLinks
from edge_agent.publish.spool_file import is_damage
from schemas.config import AgentConfig
from schemas.wire import Kind

# [s] interval at which the sender checks for due batches if nothing is offered
TICK_S: Final = 0.05
# blocks of records: many minutes of records if the disk does not respond
QUEUE_LIMIT: Final = 20_000
WAITING_LIMIT: Final = 10_000  # batches kept in memory while the disk rejects writes
RESEND_LIMIT: Final = 64  # batches sent again per round; more would delay new batches
# Mean number per vehicle of batches sent again per round. A link pauses between two messages of one
# kind.
RESEND_PER_VEHICLE: Final = 4
# [s] time after the deadline for a `put` or `close` that hangs on a frozen router
CLOSE_GRACE_S: Final = 0.5

log = logging.getLogger(__name__)


class Publisher:
    """Publisher of the records of the vehicles `names`. The column `vehicle` of the records is an
    index into these names.

    `on_open(name, session)` is called when the Zenoh session of a vehicle is open. Other components
    of the agent then publish and subscribe on the same session.

    `disk_error` is the reason why the outbox cannot be read or written; "" if it can.
    """

    def __init__(
        self,
        names: Sequence[str],
        outbox: Outbox,
        config: AgentConfig,
        estimator: str,
        clock: Callable[[], float] = time.monotonic,
        on_open: Callable[[str, zenoh.Session], None] = lambda *_: None,
    ) -> None:
        self._names = dict.fromkeys(names)
        self._outbox = outbox
        self._clock = clock
        self.counts = Counts()
        self._settlement = AckSettlement(outbox, self.counts)
        self._stopped = threading.Event()
        self._links = SessionLinks(
            self._names, config.zenoh, on_open, self._settlement.receive_ack, self._stopped
        )
        self.status = PublisherStatus(
            self._names, outbox, self._links, self._settlement, self.counts, clock
        )
        self._batcher = Batcher(
            names, outbox.boot, estimator, flush_s=config.flush_s, rows=config.batch_rows
        )
        self._offered: queue.Queue[RecordBlock] = queue.Queue(QUEUE_LIMIT)
        self._waiting: list[Draft] = []
        self.disk_error = ""
        self._closing = threading.Event()
        self._deadline = float("inf")
        self._sender = threading.Thread(target=self._send_loop, name="sender", daemon=True)

    def start(self) -> None:
        """Start the threads that open the Zenoh sessions, and the one that stores and sends
        batches.
        """
        self._links.start()
        self._sender.start()

    @property
    def is_broken(self) -> bool:
        """Return True if the sender thread has died. The queue then still accepts records until it
        is full, and further records are dropped.
        """
        return (
            self._sender.ident is not None
            and not self._sender.is_alive()
            and not self._closing.is_set()
        )

    def count_unsettled(self, kind: Kind | None = None) -> int:
        """Return the number of records of one kind, or of all kinds, that no service has settled
        (acknowledged or refused) yet. It includes records that are not in the outbox yet.
        """
        return self.status.count_unsettled(kind)

    def offer(self, *blocks: RecordBlock) -> None:
        """Queue records for publication without blocking. A block of records that does not fit into
        the queue is dropped, and its records are counted.
        """
        for records in blocks:
            if not len(records.vehicle):
                continue
            self.counts.offered[records.kind] += len(records.vehicle)
            try:
                self._offered.put_nowait(records)
            except queue.Full:
                self.counts.dropped[records.kind] += len(records.vehicle)

    def close(self, within_s: float) -> bool:
        """Send the remaining records, wait at most `within_s` seconds for acknowledgements, and
        stop. Records that the disk has not accepted by then are dropped.

        Return False if a thread did not stop in time; it then continues to run.
        """
        self._deadline = self._clock() + within_s
        self._closing.set()
        self._sender.join(within_s + CLOSE_GRACE_S)
        self._stopped.set()
        closer = threading.Thread(target=self._links.close, name="closer", daemon=True)
        closer.start()
        closer.join(CLOSE_GRACE_S)
        if self._sender.is_alive():
            return False
        for kind in Kind:
            self.counts.dropped[kind] = self.counts.offered[kind] - self.counts.published[kind]
        if closer.is_alive():
            return False
        try:
            self._outbox.close()
        except sqlite3.Error as error:
            log.warning(
                "settled batches cannot be deleted from the outbox (%s) and will be sent again",
                error,
            )
        return True

    def _send_loop(self) -> None:
        while not self._is_finished():
            try:
                self._send_round()
            except sqlite3.Error as error:
                if is_damage(error):
                    self._recover_outbox()
                else:
                    text = "the outbox cannot be read or written"
                    self.disk_error = _log_if_changed(text, error, self.disk_error)
                self._stopped.wait(TICK_S)
            except Exception:  # the sender must continue after any error
                self.counts.failures += 1
                log.exception("sending failed; trying again")
                self._stopped.wait(TICK_S)

    def _send_round(self) -> None:
        self._take_offered()
        self._settlement.settle_received()
        for vehicle in self._links.update_connections():
            self._outbox.reset_in_flight(vehicle, self._clock())
        self._waiting += self._batcher.take_due(self._clock(), flush_all=self._closing.is_set())
        self._store_and_send()
        self._resend_due()  # before the deletion, which a full disk may refuse
        self._outbox.delete_settled()
        if not self._waiting:
            self.disk_error = ""

    def _recover_outbox(self) -> None:
        """Recover the readable content of an outbox (store of batches on disk) that was damaged
        during use, and continue with the recovered outbox. After an error, wait, because the next
        attempt reads the whole file again.
        """
        try:
            self._outbox.recover_file()
        except (sqlite3.Error, OSError) as error:
            log.warning("the damaged outbox cannot be repaired (%s); trying again", error)
            self._closing.wait(LONGEST_RESEND_S)

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
        """Commit the waiting records to the outbox, then send them. If the disk does not accept the
        write, the next round tries again.
        """
        if not self._waiting:
            return
        try:
            batches = self._outbox.store(self._waiting, self._clock())
        except sqlite3.Error as error:
            text = f"the outbox refuses {len(self._waiting)} batches"
            self.disk_error = _log_if_changed(text, error, self.disk_error)
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
        connected = self._links.connected_names
        for batch in batches:
            if batch.fresh and batch.stream.vehicle in connected:
                self._links.put_batch(batch)

    def _drop_unwritable(self) -> None:
        """Drop the drafts (batches not stored yet) that protobuf cannot encode, and keep the
        others.
        """
        waiting = self._waiting
        self._waiting = []
        for draft in waiting:
            try:
                draft.encode(1, 1)
            except Exception:  # noqa: BLE001 no error may block the other drafts
                self.counts.failures += 1
                self.counts.dropped[draft.kind] += draft.records
            else:
                self._waiting.append(draft)

    def _resend_due(self) -> None:
        connected = self._links.connected_names
        if not connected:
            return
        limit = min(RESEND_LIMIT, RESEND_PER_VEHICLE * len(connected))
        for batch in self._outbox.due_batches(self._clock(), limit, connected):
            is_sent = self._links.put_batch(batch)
            if is_sent and not batch.fresh:
                self.counts.resent_batches += 1


def _log_if_changed(text: str, error: sqlite3.Error, last: str) -> str:
    """Log an error of the outbox if its message differs from `last`, because each round tries
    again. Return its message.
    """
    if str(error) != last:
        log.warning("%s (%s); trying again", text, error)
    return str(error)
