"""Subscriber of the demo, which receives tiles and alerts while the fleet drives."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field

import pyarrow as pa
import pyarrow.ipc
import zenoh

from schemas import wire
from schemas.wire import Alert


def read_tile(payload: bytes) -> pa.Table:
    """Decode the bytes of a message with one map tile, and return the tile's cells as a table."""
    return pa.ipc.open_stream(payload).read_all()


@dataclass
class Listener:
    """Subscriber to all map tiles and alerts of a fleet service. It stores the newest version of
    each tile, and every different alert with its time of receipt [ns].
    """

    session: zenoh.Session
    tiles: dict[str, pa.Table] = field(default_factory=dict)
    alerts: list[tuple[int, Alert]] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        self.session.declare_subscriber("gripmap/v1/map/**", self._on_tile)
        self.session.declare_subscriber("gripmap/v1/alert/**", self._on_alert)

    def _on_tile(self, sample: zenoh.Sample) -> None:
        with self._lock:
            self.tiles[str(sample.key_expr)] = read_tile(sample.payload.to_bytes())

    def _on_alert(self, sample: zenoh.Sample) -> None:
        alert = wire.decode_alert(sample.payload.to_bytes())
        with self._lock:
            # The service publishes an active alert repeatedly.
            if all(alert != known for _, known in self.alerts):
                self.alerts.append((time.time_ns(), alert))

    def close(self) -> None:
        """Close the listener's Zenoh session; an open session would prevent the process from
        ending.
        """
        self.session.close()

    def progress(self) -> str:
        """Return one line of text about the received map. It states the number of known cells, of
        measured cells, of cells that two or more vehicles visited, and of active alerts.
        """
        with self._lock:
            cells = pa.concat_tables(self.tiles.values()) if self.tiles else None
            alerts = list(self.alerts)
        if cells is None:
            return "no report yet: the vehicles start, and compile their kernels the first time"
        basis = cells["basis"].to_pylist()
        several = int((cells["vehicles"].to_numpy() >= 2).sum())
        standing = {(alert.cell, alert.sector): alert.raised for _, alert in alerts}
        return (
            f"{len(basis):5d} cells, {basis.count('measured'):4d} measured, {several:4d} by two or "
            f"more vehicles, {sum(standing.values()):3d} active alerts"
        )

    def whole_map(self) -> pa.Table:
        """Query the whole map and return its cells as a table."""
        replies = self.session.get(
            "gripmap/v1/map/**", consolidation=zenoh.ConsolidationMode.NONE, timeout=10.0
        )
        return pa.concat_tables(
            [read_tile(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None]
        )
