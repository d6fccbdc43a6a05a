"""Status of a publisher for metrics, health checks and log lines: its sessions, its outbox (store
of batches on disk), and the acknowledgements.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path

from edge_agent.publish.ack_settlement import AckSettlement, Counts
from edge_agent.publish.outbox import Outbox
from edge_agent.publish.session_links import SessionLinks
from schemas.runtime.link_watch import LinkWatch
from schemas.wire import Kind


class PublisherStatus:
    """Status of a publisher (connections, delays and counts), which may be read on any thread."""

    def __init__(
        self,
        names: Collection[str],
        outbox: Outbox,
        sessions: SessionLinks,
        settlement: AckSettlement,
        counts: Counts,
        clock: Callable[[], float],
    ) -> None:
        self._names = names
        self._outbox = outbox
        self._sessions = sessions
        self._settlement = settlement
        self._clock = clock
        self.counts = counts

    @property
    def outbox_path(self) -> Path:
        """The absolute path of the outbox's file."""
        return self._outbox.path.absolute()

    @property
    def links(self) -> int:
        """Return the number of open Zenoh sessions."""
        return self._sessions.session_count

    @property
    def link_watches(self) -> list[LinkWatch]:
        """Return, for each Zenoh session, the object that watches its link to the router."""
        return self._sessions.link_watches

    @property
    def cut_off(self) -> bool:
        """Return True if at least one open Zenoh session is not connected to a router."""
        return self._sessions.is_cut_off

    @property
    def clock_behind_s(self) -> float:
        """Return the time [s] by which the vehicle's clock is behind the clock of the fleet
        service.
        """
        return self._settlement.clock_behind_s

    @property
    def unanswered_s(self) -> float:
        """Return how long sent batches have been unanswered [s], for the vehicle and region with
        the longest wait; 0 if none waits.
        """
        return self._outbox.schedule.unanswered_s(self._clock())

    @property
    def stranded_records(self) -> int:
        """Return the number of records in the outbox that are not sent because they belong to
        vehicle names that this agent does not have, for example after a change of name.
        """
        return self._outbox.held.count_stranded(self._names)

    @property
    def fill_share(self) -> float:
        """Return the used share [1] of the capacity of the outbox."""
        return self._outbox.held.bytes / self._outbox.capacity_bytes

    @property
    def unanswered_records(self) -> int:
        """Return the number of records in batches that are no longer sent, because the service
        answered later batches of the same stream but not these.
        """
        return self._outbox.counts.unanswered

    @property
    def damage_counts(self) -> tuple[int, int]:
        """Return two numbers: how often the outbox was found damaged, and how many records are
        known to be lost by this.
        """
        return self._outbox.counts.damages, self._outbox.counts.damaged

    @property
    def dropped_records(self) -> int:
        """Return the number of records dropped for lack of space, in the queue or in the outbox."""
        return sum(self.counts.dropped.values()) + sum(self._outbox.counts.evicted.values())

    @property
    def lost_records(self) -> int:
        """Return the number of records that were lost: dropped for lack of space, given up without
        an answer, or damaged.
        """
        return self.dropped_records + self.unanswered_records + self.damage_counts[1]

    def count_unsettled(self, kind: Kind | None = None) -> int:
        """Return the number of records of one kind, or of all kinds, that no service has settled
        (acknowledged or refused). They are in the outbox, where some may come from an earlier run
        of the agent, or they are not stored yet.
        """
        counts = self.counts
        kinds = Kind if kind is None else (kind,)
        coming = sum(counts.offered[k] - counts.dropped[k] - counts.published[k] for k in kinds)
        return coming + self._outbox.held.count_records(self._names, kind)
