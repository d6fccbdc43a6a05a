"""Status of a publisher for metrics, health and log lines: its sessions, its outbox, and the
acknowledgements.
"""

from __future__ import annotations

from collections.abc import Callable, Collection

from edge_agent.publish.ack_settlement import AckSettlement, Counts
from edge_agent.publish.outbox import Outbox
from edge_agent.publish.session_links import SessionLinks
from schemas.runtime.link_watch import LinkWatch
from schemas.wire import Kind


class PublisherStatus:
    """Figures that are read from the parts of a publisher, on any thread."""

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
    def links(self) -> int:
        """Number of open sessions."""
        return self._sessions.session_count

    @property
    def link_watches(self) -> list[LinkWatch]:
        """The state of each session's link."""
        return self._sessions.link_watches

    @property
    def cut_off(self) -> bool:
        """True if an open session has no router."""
        return self._sessions.is_cut_off

    @property
    def clock_behind_s(self) -> float:
        """Lag of the vehicle's clock behind the service's [s]."""
        return self._settlement.clock_behind_s

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
    def dropped_records(self) -> int:
        """Records dropped for lack of room, in the queue or in the outbox."""
        return sum(self.counts.dropped.values()) + sum(self._outbox.counts.evicted.values())

    def count_unsettled(self, kind: Kind | None = None) -> int:
        """Return the number of unsettled records: in the outbox, also of an earlier start, or not
        yet stored in it.
        """
        counts = self.counts
        kinds = Kind if kind is None else (kind,)
        coming = sum(counts.offered[k] - counts.dropped[k] - counts.published[k] for k in kinds)
        return coming + self._outbox.count_records(self._names, kind)
