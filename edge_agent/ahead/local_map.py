"""Local copy of the fleet's map around one car, limited in size; old values fade to unknown. The
module is pure: no I/O, and time is an argument.

A map tile contains four values per cell: 5 % quantile, median and 95 % quantile of the friction,
and the probability that the cell is slippery. From these values this module reconstructs the
belief, a probability distribution of the friction. A road changes with time, so the belief fades
towards that of an unknown road, as in the fleet's map.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final, NamedTuple

import numpy as np

from schemas import grid, mugrid
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.thresholds import CHANGE_S, NS, SLIPPERY_MU
from schemas.wire import Alert

UNKNOWN, BOUND, MEASURED, BORROWED = range(4)
BASES: Final = ("unknown", "bound", "measured", "borrowed")
# [s] time after which a cell that was not received again counts as unknown. By then, the road has
# changed with a probability of 28 %.
HELD_S: Final = 3600.0
# [s] time after which an alert that was not received again counts as ended. The service repeats
# active alerts every few seconds.
ALERT_HELD_S: Final = 600.0
MOST_CELLS: Final = 20_000  # 6 MB of memory: fifty kilometres of road with its side streets
MOST_ALERTS: Final = 4096
# Bit of a place's key that differs between the two directions of one road. Sectors 0 and 2 are
# opposite headings, and so are 1 and 3.
OTHER_WAY: Final = 2


class ReceivedCells(NamedTuple):
    """Map cells (n,) received from the fleet service. `belief` (n, 32) is the probability
    distribution of each cell's friction on the friction grid.
    """

    key: IntArray
    belief: FloatArray
    basis: IntArray
    vehicles: IntArray
    last_time: IntArray  # [ns UTC] time of the last observation
    # [ns UTC] time at which the service made the tile, at most the time of receipt
    map_time: IntArray


class PlaceBelief(NamedTuple):
    """Map values for n places (one per map cell and heading sector), (n,) each. Where the map has
    no data, numbers are NaN and `basis` (origin of the values) is UNKNOWN.
    """

    key: IntArray
    mu: FloatArray
    mu_lower: FloatArray
    mu_upper: FloatArray
    p_slippery: FloatArray
    age_s: FloatArray
    basis: IntArray
    vehicles: IntArray
    alerted: BoolArray


def belief_of(
    lower: FloatArray, mu: FloatArray, upper: FloatArray, slippery: FloatArray
) -> FloatArray:
    """Return the beliefs about n cells (probabilities of friction on the friction grid, (n, 32)),
    computed from the values in a map tile; `mu` may be NaN.

    `lower`, `mu` and `upper` are the 5 %, 50 % and 95 % quantiles, and `slippery` is the
    probability of a slippery road. The distribution function is linear between these values.
    """
    n = len(lower)
    measured = np.isfinite(mu)
    middle = np.where(measured, mu, (lower + upper) / 2.0)
    x = np.column_stack([np.full(n, mugrid.LOWER), lower, middle, upper, np.full(n, mugrid.UPPER)])
    x = np.maximum.accumulate(np.clip(x, mugrid.LOWER, mugrid.UPPER), axis=1)
    f = np.tile([0.0, 0.05, 0.5, 0.95, 1.0], (n, 1))
    out = np.empty((n, mugrid.BINS))
    for k in range(n):
        at = int(np.searchsorted(x[k], SLIPPERY_MU))
        below = f[k, max(at - 1, 0)]
        above = f[k, min(at, 4)]
        knots = np.insert(x[k], at, SLIPPERY_MU)
        shares = np.insert(f[k], at, min(max(slippery[k], below), above))
        knots += np.arange(6) * 1e-9  # makes the knots strictly increasing, as `interp` requires
        upto = np.interp(mugrid.EDGES, knots, shares, left=0.0, right=1.0)
        upto[0] = 0.0
        upto[-1] = 1.0
        out[k] = np.diff(upto)
    return out


NOTHING: Final = ReceivedCells(
    np.zeros(0, np.int64), np.zeros((0, mugrid.BINS)), *(np.zeros(0, np.int64) for _ in range(4))
)


class LocalMap:
    """Local map of one car: the map tiles that the car received last, with at most MOST_CELLS cells
    in total, and the active alerts.
    """

    def __init__(self, most_cells: int = MOST_CELLS) -> None:
        self._most_cells = most_cells
        self._tiles: OrderedDict[int, ReceivedCells] = OrderedDict()
        self._alerts: dict[int, tuple[Alert, int]] = {}
        # cells of all tiles, sorted by key; None if it must be rebuilt
        self._combined: ReceivedCells | None = NOTHING

    @property
    def cells(self) -> int:
        """Return the number of cells in the car's local copy of the map."""
        return sum(len(cells.key) for cells in self._tiles.values())

    @property
    def alerts(self) -> list[Alert]:
        """Return the active alerts of slippery places that the car knows."""
        return [alert for alert, _ in self._alerts.values()]

    def store_cells(self, tile: int, cells: ReceivedCells, now: int) -> None:
        """Store the received cells of a map tile. Newly received values of a place replace earlier
        ones. Earlier values that were received at least HELD_S seconds before `now` [ns UTC] are
        removed.
        """
        before = self._tiles.pop(tile, NOTHING)
        both = _concatenate_cells(
            [_select_cells(before, now - before.map_time < HELD_S * NS), cells]
        )
        latest_first = np.lexsort((both.map_time, both.key))[::-1]
        _, newest = np.unique(both.key[latest_first], return_index=True)
        self._tiles[tile] = _select_cells(both, latest_first[newest])
        self._combined = None
        while len(self._tiles) > 1 and self.cells > self._most_cells:
            self._tiles.popitem(last=False)

    def store_alert(self, alert: Alert, now: int) -> bool:
        """Store a received alert, or remove the stored alert if the received one reports its end.
        Return True if this changes the set of active alerts.
        """
        key = alert.cell * grid.SECTORS + alert.sector
        before = self._alerts.get(key)
        if alert.raised:
            if before is not None and before[0].time > alert.time:
                return False
            if before is None and len(self._alerts) >= MOST_ALERTS:
                return False
            self._alerts[key] = (alert, now)
            return before is None or before[0] != alert
        return self._alerts.pop(key, None) is not None

    def store_standing_alerts(self, tile: int, alerts: list[Alert], now: int) -> list[int]:
        """Replace the active alerts of a map tile by `alerts`; return the keys (cell·4 + sector) of
        the places whose alerts changed.
        """
        standing = {alert.cell * grid.SECTORS + alert.sector: alert for alert in alerts}
        ended = [
            key
            for key in self._alerts
            if key not in standing and int(grid.tile_of(key // grid.SECTORS)) == tile
        ]
        for key in ended:
            del self._alerts[key]
        return ended + [key for key, alert in standing.items() if self.store_alert(alert, now)]

    def drop_old(self, now: int) -> None:
        """Remove from the local map all tiles and alerts that the car received too long before
        `now` [ns UTC].
        """
        for tile in [
            tile
            for tile, cells in self._tiles.items()
            if now - cells.map_time.max(initial=0) > HELD_S * NS
        ]:
            del self._tiles[tile]
            self._combined = None
        for key in [key for key, (_, at) in self._alerts.items() if now - at > ALERT_HELD_S * NS]:
            del self._alerts[key]

    def look_up(self, key: IntArray, now: int) -> PlaceBelief:
        """Return the current values of n places, given by their keys (cell·4 + sector), `key` (n,).

        Ice and water usually cover the lanes of both directions. Therefore an alert for the
        opposite driving direction also counts, unless a vehicle has later measured better friction
        at the place itself.
        """
        cells = self._find_cells(key)
        alerted = self._apply_alerts(cells, now)
        age_s = np.maximum(now - cells.map_time, 0) / NS
        share = -np.expm1(-age_s / CHANGE_S)[:, None]
        faded = (1.0 - share) * cells.belief + share * mugrid.PRIOR
        is_known = (cells.basis != UNKNOWN) & (age_s <= HELD_S)
        lower = np.where(is_known, mugrid.quantiles(faded, 0.05), np.nan)
        mu = np.where(is_known, mugrid.quantiles(faded, 0.5), np.nan)
        upper = np.where(is_known, mugrid.quantiles(faded, 0.95), np.nan)
        return PlaceBelief(
            key,
            np.where(cells.basis == BOUND, np.nan, mu),
            lower,
            upper,
            np.where(is_known, faded @ mugrid.SLIPPERY_SHARE, np.nan),
            np.where(is_known, np.maximum(now - cells.last_time, 0) / NS, np.nan),
            np.where(is_known, cells.basis, UNKNOWN),
            np.where(is_known, cells.vehicles, 0),
            alerted & is_known,
        )

    def _apply_alerts(self, cells: ReceivedCells, now: int) -> BoolArray:
        """Replace the values of n places for which an alert is newer, in place. Return a mask (n,)
        of the places for which an alert counts.
        """
        key = cells.key
        alerted = np.zeros(len(key), np.bool_)
        standing = np.fromiter(self._alerts, np.int64, len(self._alerts))
        has_alert = np.isin(key, standing) | np.isin(key ^ OTHER_WAY, standing)
        for k in np.flatnonzero(has_alert).tolist():
            place = int(key[k])
            is_own = place in self._alerts
            alert, receive_time = self._alerts[place if is_own else place ^ OTHER_WAY]
            if now - receive_time > ALERT_HELD_S * NS:
                continue
            is_measured = cells.basis[k] == MEASURED
            # An alert of the opposite direction does not count if a vehicle has found grip on this
            # side afterwards.
            is_newer = alert.time > cells.last_time[k]
            alerted[k] = is_own or is_newer or not (is_measured or _has_grip(cells.belief[k]))
            # A lower bound contains no value of the friction, so the alert's values replace it.
            if alerted[k] and (alert.time >= cells.last_time[k] or not is_measured):
                cells.belief[k] = _belief_of_alert(alert)
                cells.basis[k] = MEASURED if is_own else BORROWED
                cells.last_time[k] = alert.time
                cells.map_time[k] = receive_time
                cells.vehicles[k] = alert.vehicles
        return alerted

    def belief_at(self, key: int, now: int) -> FloatArray | None:
        """Return the current belief about one place (one map cell and heading sector), as
        probabilities (32,) on the friction grid; None if the map has no recent measured value of
        the place.
        """
        cells = self._find_cells(np.array([key]))
        if cells.basis[0] != MEASURED or now - cells.map_time[0] > HELD_S * NS:
            return None
        share = -np.expm1(-max(now - int(cells.last_time[0]), 0) / NS / CHANGE_S)
        return np.asarray((1.0 - share) * cells.belief[0] + share * mugrid.PRIOR)

    def keys(self) -> IntArray:
        """Return the keys (cell·4 + sector) of all places in the local map, (n,), sorted."""
        return self._all_cells().key

    def _all_cells(self) -> ReceivedCells:
        if self._combined is None:
            found = _concatenate_cells(list(self._tiles.values()))
            order = np.argsort(found.key)
            self._combined = _select_cells(found, order)
        return self._combined

    def _find_cells(self, key: IntArray) -> ReceivedCells:
        """Return a copy of the values of n places, given by their keys `key` (n,). A place without
        values has the prior belief, and 0 in all other columns.
        """
        whole = self._all_cells()
        if not len(whole.key):
            zeros = [np.zeros(len(key), np.int64) for _ in range(4)]
            return ReceivedCells(key, np.tile(mugrid.PRIOR, (len(key), 1)), *zeros)
        row = np.minimum(np.searchsorted(whole.key, key), len(whole.key) - 1)
        is_known = whole.key[row] == key
        return ReceivedCells(
            key=key,
            belief=np.where(is_known[:, None], whole.belief[row], mugrid.PRIOR),
            basis=np.where(is_known, whole.basis[row], 0),
            last_time=np.where(is_known, whole.last_time[row], 0),
            map_time=np.where(is_known, whole.map_time[row], 0),
            vehicles=np.where(is_known, whole.vehicles[row], 0),
        )


def _has_grip(belief: FloatArray) -> bool:
    """Return True if the lower bound of a belief (32,) excludes a slippery road."""
    return bool(mugrid.quantiles(belief[None], 0.05)[0] >= SLIPPERY_MU)


def _belief_of_alert(alert: Alert) -> FloatArray:
    values = (alert.mu_lower, alert.mu, alert.mu_upper, alert.p_slippery)
    return np.asarray(belief_of(*(np.array([value]) for value in values))[0])


def _select_cells(cells: ReceivedCells, rows: IntArray | BoolArray) -> ReceivedCells:
    return ReceivedCells._make(column[rows] for column in cells)


def _concatenate_cells(parts: list[ReceivedCells]) -> ReceivedCells:
    return ReceivedCells._make(
        np.concatenate(columns) for columns in zip(NOTHING, *parts, strict=True)
    )
