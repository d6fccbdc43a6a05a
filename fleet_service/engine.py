"""The service without its network: messages in; alerts, tiles, acknowledgements and answers out.

One worker calls `take`, `flush`, `tiles` and `fading`; queries come from other threads, so that a lock guards the map.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from fleet_service.acks import Acks
from fleet_service.admit import Clock, Streams
from fleet_service.alerts import Alerts
from fleet_service.answer import answer
from fleet_service.archive.files import lock
from fleet_service.archive.pseudonyms import Pseudonyms
from fleet_service.archive.rebuild import observations, replay, restore_streams
from fleet_service.archive.segments import Rows, Writer
from fleet_service.fusion import Fusion
from fleet_service.ingest import Admitted, Candidate, Intake, Message
from fleet_service.map_state import MapState, arrow_stream, cell_table
from schemas.config import ServiceConfig
from schemas.errors import InputError
from schemas.numeric import IntArray
from schemas.query import MapQuery
from schemas.wire import Alert, Kind

# Rows that wait for the disk at the most; beyond, nothing is taken from the queue until a segment is written.
WAITING_ROWS = 1_000_000


class Engine:
    """State of one service, rebuilt from its archive.

    Args:
        config: settings.
        root: of the archive; it is locked while the engine is open.

    Raises:
        InputError: another service holds the archive.
        OSError: the archive cannot be read or written.
    """

    def __init__(self, config: ServiceConfig, root: Path) -> None:
        self._config, self._root = config, root
        self._lock_file = lock(root)
        self.counts: Counter[str] = Counter()
        self.fusion = Fusion(config.lateness_s)
        self.map = MapState(self.fusion)
        self._alerts = Alerts(self.fusion)
        self._guard = threading.Lock()
        self._acks = Acks()
        streams = Streams()
        self._intake = Intake(streams, Pseudonyms(root / "keys"), self.counts, self._acks)
        self._writer = Writer(root, config.name)
        self._waiting: dict[Kind, list[Rows]] = {kind: [] for kind in Kind}
        self._unsettled: list[Candidate] = []
        for folded in replay(root, self.fusion):  # first: it reads whole files, and sets damaged ones aside
            self._alerts.folded(folded.slots)
            self.map.changed(folded.slots)
        restore_streams(root, streams)

    def close(self) -> None:
        """Give the archive free."""
        self._lock_file.close()

    @property
    def full(self) -> bool:
        """Whether too many rows wait for the disk."""
        return sum(len(rows["row"]) for kind in Kind for rows in self._waiting[kind]) >= WAITING_ROWS

    @property
    def alerts(self) -> int:
        """Cells under an alert."""
        return len(self._alerts.raised)

    @property
    def alerted(self) -> IntArray:
        """Slots under an alert, (k,)."""
        return np.array(sorted(self._alerts.raised), np.int64)

    def take(self, messages: Sequence[Message], now: int) -> list[Alert]:
        """Admit and fuse; returns the alerts that this raises or clears."""
        clock = Clock(now, int(self._config.clock_ahead_s * 1e9), int(self._config.oldest_s * 1e9))
        out: list[Alert] = []
        for kind, admitted in self._intake.admit(messages, clock).items():
            if not admitted.candidates:
                continue
            if kind is Kind.OBSERVATION:
                out += self._fuse(admitted)
            self.counts[kind] += len(admitted.rows["row"])
            self._waiting[kind].append(admitted.rows)
            self._unsettled += admitted.candidates
        return out

    def _fuse(self, admitted: Admitted) -> list[Alert]:
        rows = admitted.rows
        with self._guard:
            folded = self.fusion.fold(observations(rows, rows["vehicle_number"]))
            self.map.changed(folded.slots)
            raised = self._alerts.folded(folded.slots)
        rows["late"], rows["weight"] = folded.late, folded.weight
        self.counts["late"] += int(folded.late.sum())
        return raised

    def flush(self) -> list[tuple[str, bytes]]:
        """Write what waits as durable segments; returns vehicle and bytes of the acknowledgements to put after it.

        A full disk is counted and tried again at the next call; nothing of it is acknowledged.
        """
        try:
            for kind, waiting in self._waiting.items():
                if waiting:
                    rows = {name: np.concatenate([part[name] for part in waiting]) for name in waiting[0]}
                    self._writer.write(kind, rows)
                    waiting.clear()
        except OSError:
            self.counts["segment_failures"] += 1
        else:
            self._intake.settled(self._unsettled)
            self._unsettled.clear()
        return self._acks.messages()

    def tiles(self, now: int) -> list[tuple[int, bytes]]:
        """Tile and Arrow stream of every tile that changed since the last call, as far as it is public."""
        out = []
        for tile in self.map.take_dirty():
            with self._guard:
                slots = self.map.slots(tile)
                public = slots[self.fusion.live.vehicles[slots] >= self._config.public_vehicles]
                table = cell_table(self.fusion, public, now)
            if table.num_rows:
                out.append((tile, arrow_stream(table)))
        return out

    def fading(self, now: int) -> list[Alert]:
        """Alerts that time alone cleared."""
        with self._guard:
            return self._alerts.faded(now)

    def answer(self, query: MapQuery, wanted: Callable[[int], bool], now: int) -> list[tuple[int, bytes]]:
        """Tile and payload of every reply to a query.

        Raises:
            InputError: a route too long, a time in the future, or an archive that cannot be read.
        """
        least = max(query.min_vehicles, self._config.public_vehicles)
        query = query.model_copy(update={"min_vehicles": least})
        if query.at is None:
            with self._guard:
                return list(answer(self.map, query, wanted, now))
        at = int(query.at.timestamp() * 1e9)
        if at > now:
            raise InputError("at", "lies in the future", "give a time that has been")
        past = Fusion(self._config.lateness_s)
        try:
            for _ in replay(self._root, past, received_until=at):
                pass  # folding is what counts; the alerts of then are history
        except OSError as error:
            raise InputError("at", f"the archive cannot be read ({error.strerror})", "ask again later") from error
        return list(answer(MapState(past), query, wanted, at))
