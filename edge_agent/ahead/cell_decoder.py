"""Decoding and validation of map tiles and alerts received from a fleet service."""

from __future__ import annotations

from contextlib import suppress
from typing import Final

import numpy as np
import pyarrow as pa

from edge_agent.ahead.local_map import BASES, BOUND, ReceivedCells, belief_of
from schemas import grid, keys, mugrid, wire
from schemas.errors import InputError, WireError
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.thresholds import NS
from schemas.wire import Alert
from schemas.wire.tile import decode_tile

AHEAD_OF_TIME_S: Final = 60.0  # [s] largest accepted lead of the service's clock over the car's
# [s] largest accepted age of a cell: three years. In nanoseconds it still fits into an int64.
OLDEST_S: Final = 1e8
# Maximum size of a tile; one with every cell and sector of a dense city has 3 MB.
MOST_TILE_BYTES: Final = 4 << 20
# Tolerance of range checks: values arrive in single precision, and quantiles may be rounded to the
# edges of their bins.
SLACK: Final = 1e-3
# required columns of a tile, with integers and with numbers
_INTEGERS: Final = ("cell", "sector", "vehicles", "last_time")
_NUMBERS: Final = ("mu_lower", "mu_upper", "p_slippery", "age_s")
_BASIS: Final = {name: number for number, name in enumerate(BASES)}


def decode_cells(key: str, payload: bytes, now: int) -> tuple[int, ReceivedCells]:
    """Return the tile (its grid number at zoom 14) and the cells in a message with a map tile.

    `key` and `payload` are the Zenoh key and the bytes of the message; `now` is the car's time [ns
    UTC].

    Raises:
        WireError: the message is invalid; the caller must ignore the whole message.
    """
    tile = _tile_of_key(key, "map")
    if len(payload) > MOST_TILE_BYTES:
        raise WireError(
            "tile",
            f"has {len(payload)} bytes",
            f"query a smaller area: the limit is {MOST_TILE_BYTES} bytes",
        )
    table = decode_tile(payload)
    if any(table[name].null_count for name in (*_INTEGERS, *_NUMBERS, "basis")):
        raise WireError("tile", "has null values", "send every required column without nulls")
    cell, sector, vehicles, last = (_int_column(table, name) for name in _INTEGERS)
    lower, upper, p_slippery, age = (_float_column(table, name) for name in _NUMBERS)
    mu = _float_column(table, "mu")
    basis = np.array([_BASIS.get(str(name), -1) for name in table["basis"].to_pylist()], np.int64)
    is_measured = np.isfinite(mu)
    middle = np.where(is_measured, mu, lower)
    _refuse_rows(
        {
            "cell": grid.tile_of(cell) != tile,
            "sector": (sector < 0) | (sector >= grid.SECTORS),
            "vehicles": vehicles < 1,
            "last_time": (last <= 0) | (last > now + AHEAD_OF_TIME_S * NS),
            "basis": (basis < BOUND) | (is_measured == (basis == BOUND)),
            "mu_lower": ~_is_ordered(mugrid.LOWER, lower, middle),
            "mu_upper": ~_is_ordered(middle, upper, mugrid.UPPER),
            "p_slippery": ~_is_ordered(0.0, p_slippery, 1.0),
            "age_s": ~_is_ordered(0.0, age, OLDEST_S),
        }
    )
    place = cell * grid.SECTORS + sector
    if len(np.unique(place)) < len(place):
        raise WireError("cell", "occurs twice", "send each cell and sector once")
    # Time at which the service made the tile. It may lie well in the past, because the answer may
    # come from a cache.
    map_time = np.minimum(last + (age * NS).astype(np.int64), now)
    belief = belief_of(lower, mu, upper, p_slippery)
    return tile, ReceivedCells(place, belief, basis, vehicles, np.minimum(last, now), map_time)


def _refuse_rows(wrong: dict[str, BoolArray]) -> None:
    """Raise a `WireError` for the first column with a wrong row. `wrong` are masks of the wrong
    rows (n,) by column.
    """
    for name, rows in wrong.items():
        if rows.any():
            raise WireError(
                name,
                f"is not possible in row {int(rows.argmax())}",
                "send values that the table of the map allows",
            )


def decode_alert_message(key: str, payload: bytes, now: int) -> Alert:
    """Return the alert in a message with the Zenoh key `key`; `now` is the car's time [ns UTC].

    Raises:
        WireError: the message is invalid.
    """
    if len(payload) > wire.MAX_BYTES:
        raise WireError("alert", f"has {len(payload)} bytes", f"send at most {wire.MAX_BYTES}")
    return _check_alert(wire.decode_alert(payload), _tile_of_key(key, "alert"), now)


def decode_standing_alerts(key: str, payload: bytes, now: int) -> tuple[int, list[Alert]]:
    """Return the tile (its grid number at zoom 14) and the active alerts in a message that lists
    all active alerts of a tile.

    Raises:
        WireError: the message is invalid.
    """
    tile = _tile_of_key(key, "alert")
    return tile, [_check_alert(alert, tile, now) for alert in wire.decode_standing(payload)]


def _check_alert(alert: Alert, tile: int, now: int) -> Alert:
    has_place = (
        alert.cell >= 0
        and int(grid.tile_of(alert.cell)) == tile
        and 0 <= alert.sector < grid.SECTORS
    )
    has_time = 0 < alert.time <= now + AHEAD_OF_TIME_S * NS
    mu_lower, mu, mu_upper = np.array([[alert.mu_lower], [alert.mu], [alert.mu_upper]])
    has_friction = bool(
        _is_ordered(mugrid.LOWER, mu_lower, mu) & _is_ordered(mu, mu_upper, mugrid.UPPER)
    )
    if not (has_place and has_time and has_friction and 0.0 <= alert.p_slippery <= 1.0):
        raise WireError(
            "alert", "has values out of range", "send values that the message definition allows"
        )
    return alert


def _tile_of_key(key: str, topic: str) -> int:
    parsed = None
    with suppress(InputError):
        parsed = keys.parse(key)
    if parsed is None or parsed.topic.name != topic or parsed.quadint is None:
        raise WireError(
            "key", f"{key[:80]!r} does not name a tile", "publish on the key of the topic"
        )
    return parsed.quadint


def _is_ordered(low: FloatArray | float, middle: FloatArray, high: FloatArray | float) -> BoolArray:
    with np.errstate(invalid="ignore"):
        return np.asarray(
            (middle >= np.asarray(low) - SLACK) & (middle <= np.asarray(high) + SLACK)
        )


def _int_column(table: pa.Table, name: str) -> IntArray:
    return np.asarray(table[name].cast(pa.int64()).to_numpy(), np.int64)


def _float_column(table: pa.Table, name: str) -> FloatArray:
    return np.asarray(table[name].to_numpy(), np.float64)
