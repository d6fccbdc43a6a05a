"""Simulated fleet service for tests of cars that look ahead: it answers queries for the map and for
active alerts, and publishes alerts.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import pyarrow as pa
import zenoh

from schemas import grid, keys, query, tables, wire
from schemas.config import ZenohSettings
from schemas.numeric import FloatArray, IntArray
from schemas.runtime.zenoh_session import open_session
from schemas.thresholds import GRAVITY, NS
from schemas.wire import Alert


def tile_payload(key: IntArray, friction: float | FloatArray, now: int, **changes: object) -> bytes:
    """Return the bytes of a map tile as a service sends it. `key` are its places (cell·4 + heading
    sector) and `friction` their friction. The keywords `changes` replace columns of the tile's
    table.
    """
    n = len(key)
    mu = np.broadcast_to(friction, len(key))
    lower = np.maximum(mu - 0.1, 0.06)
    cell = key // grid.SECTORS
    sector = (key % grid.SECTORS).astype(np.int8)
    latitude, longitude = grid.centre(cell)
    west, south, east, north = grid.bounds(cell)
    columns: dict[str, Any] = {
        "cell": cell,
        "sector": sector,
        "mu": mu,
        "mu_lower": lower,
        "mu_upper": np.minimum(mu + 0.1, 1.19),
        "p_slippery": (mu < 0.4).astype(float),
        "basis": ["measured"] * n,
        "vehicles": np.full(n, 4),
        "observations": np.full(n, 9),
        "first_time": np.full(n, now - 60 * NS),
        "last_time": np.full(n, now - NS),
        "age_s": np.full(n, 1.0),
        "latitude": latitude,
        "longitude": longitude,
        "west": west,
        "south": south,
        "east": east,
        "north": north,
        "safe_deceleration": GRAVITY * lower,
    } | changes
    table = pa.table(
        {f.name: pa.array(columns[f.name]).cast(f.type, safe=False) for f in tables.MAP_SCHEMA}
    ).cast(tables.MAP_SCHEMA)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, tables.MAP_SCHEMA) as writer:
        writer.write_table(table)
    return bytes(sink.getvalue().to_pybytes())


@dataclass
class MadeUpService:
    """Simulated service with places of known friction (`mu` by cell·4 + heading sector) and active
    alerts; it records the queries.

    All places were observed at the time `now` [ns]. An answer states the age of these observations.
    If `kept` is True, the stated age does not grow, as if a store repeated old answers.
    """

    settings: ZenohSettings
    now: int
    mu: dict[int, float] = field(default_factory=dict)
    standing: list[Alert] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)
    lock: threading.Lock = field(default_factory=threading.Lock)
    kept: bool = False

    def __enter__(self) -> Self:
        session = open_session(self.settings)
        assert session is not None
        self.session = session
        self._map = session.declare_queryable(
            f"{keys.ROOT}/map/*/*/*/*", self._answer_query, complete=True
        )
        self._alerts = session.declare_queryable(
            f"{keys.ROOT}/alert/*/*/*/*", self._answer_standing, complete=True
        )
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()

    def put(self, alert: Alert) -> None:
        """Publish the beginning or the end of an alert (`alert.raised`) as the service does."""
        tile = int(grid.tile_of(alert.cell))
        self.session.put(
            keys.alert_key(tile), wire.encode_alert(alert), encoding=wire.ALERT_ENCODING
        )

    def tile_answer(self, key: IntArray, mu: FloatArray) -> bytes:
        """Return the answer to a query for map places (cell·4 + heading sector) of a tile, with the
        friction values `mu`.
        """
        age = 1.0 if self.kept else 1.0 + (time.time_ns() - self.now) / NS
        return tile_payload(key, mu, self.now, age_s=np.full(len(key), age))

    def _answer_query(self, asked: zenoh.Query) -> None:
        with asked:
            self.asked.append(str(asked.selector))
            box = query.parse(dict(asked.parameters)).bbox  # type: ignore[call-overload]
            for tile, key in _by_tile(np.array(sorted(self.mu), np.int64)).items():
                inside = (
                    key if box is None else key[grid.touches(box, grid.bounds(key // grid.SECTORS))]
                )
                if len(inside) and asked.key_expr.intersects(zenoh.KeyExpr(keys.map_key(tile))):
                    mu = np.array([self.mu[k] for k in inside.tolist()])
                    asked.reply(
                        keys.map_key(tile), self.tile_answer(inside, mu), encoding=wire.ARROW
                    )

    def _answer_standing(self, asked: zenoh.Query) -> None:
        with asked:
            with self.lock:
                standing = list(self.standing)
            self.asked.append(str(asked.selector))
            for tile in {int(grid.tile_of(alert.cell)) for alert in standing}:
                if asked.key_expr.intersects(zenoh.KeyExpr(keys.alert_key(tile))):
                    in_tile = [alert for alert in standing if int(grid.tile_of(alert.cell)) == tile]
                    asked.reply(
                        keys.alert_key(tile),
                        wire.encode_standing(in_tile),
                        encoding=wire.STANDING_ENCODING,
                    )


def _by_tile(key: IntArray) -> dict[int, IntArray]:
    tiles = grid.tile_of(key // grid.SECTORS)
    return {int(tile): key[tiles == tile] for tile in np.unique(tiles)}
