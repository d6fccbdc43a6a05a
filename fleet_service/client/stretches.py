"""Alerts of road stretches, made from alerts of single cells and headings. Pure (no I/O).

Cells with an active alert that are at most LINK_CELLS apart form one stretch; both driving
directions belong to the same stretch. A stretch keeps its id from its first alert until the alerts
of all its cells are over. When two stretches merge, the older id stays. When a stretch splits, the
larger part keeps the id.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from typing import Any, Final, Literal

import numpy as np

from schemas import grid
from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import METRES_PER_DEGREE, NS, SLIPPERY_MU
from schemas.wire import Alert

State = Literal["raised", "changed", "cleared"]
# Largest gap in a stretch: cells in which no vehicle used enough grip, or that a bend cuts; 30 to
# 60 m.
LINK_CELLS: Final = 3
ROUND: Final = 1.3  # least ratio of length and width for which a stretch has a direction


@dataclass(frozen=True)
class StretchAlert:
    """Alert of a road stretch that is slippery, or no longer is.

    Attributes:
        id: identifier, which stays the same as long as the stretch exists.
        state: raised; changed (the stretch grew or shrank); cleared.
        since, time: begin of the alert, and time of this state [ns since 1970, UTC].
        length_m: length along the road [m], at least that of a cell.
        direction: direction of the road, e.g. north-south.
        headings: driving directions of the vehicles that found it slippery.
        latitude, longitude: centre [deg].
        bbox: west, south, east, north [deg].
        mu, mu_lower, mu_upper, p_slippery: values of the cell with the lowest mu.
        vehicles: largest number of vehicles that measured any one cell of the stretch.
        reason: reason stated by the alert of the cell that changed the stretch last.
        points: latitude and longitude [deg] of the cells from one end to the other; branches are
            left out.
    """

    id: str
    state: State
    since: int
    time: int
    length_m: float
    direction: str
    headings: tuple[str, ...]
    latitude: float
    longitude: float
    bbox: tuple[float, float, float, float]
    cells: int
    mu: float
    mu_lower: float
    mu_upper: float
    p_slippery: float
    vehicles: int
    reason: str
    points: tuple[tuple[float, float], ...]

    def to_json_values(self) -> dict[str, Any]:
        """Return all values in a form that JSON supports; times are ISO 8601 text, UTC."""
        return asdict(self) | {"since": format_time(self.since), "time": format_time(self.time)}

    def to_line(self) -> str:
        """Return the alert of the road stretch as one line of text."""
        word = {"raised": "RAISED", "changed": "now", "cleared": "cleared"}[self.state]
        # The reason of an active alert is that of its newest cell, not of the cell with this mu.
        probability = f"P(mu < {SLIPPERY_MU}) = {self.p_slippery:.2f}"
        why = self.reason if self.state == "cleared" else probability
        return (
            f"alert {word} at {self.latitude:.6f}, {self.longitude:.6f}: {self.length_m:.0f} m "
            f"{self.direction}, heading {' and '.join(self.headings)}; mu {self.mu:.2f} "
            f"[{self.mu_lower:.2f}, {self.mu_upper:.2f}], {self.vehicles} vehicles; since "
            f"{format_time(self.since)}, state of {format_time(self.time)}; {why}; id "
            f"{self.id}"
        )


def format_time(ns: int) -> str:
    """Return a time [ns since 1970] as ISO 8601 text, UTC."""
    return f"{datetime.fromtimestamp(ns // NS, UTC):%Y-%m-%dT%H:%M:%SZ}"


class Stretches:
    """Stretches of road with an active alert, updated by alerts of single cells."""

    def __init__(self) -> None:
        self._standing: dict[tuple[int, int], Alert] = {}
        self._known: dict[str, StretchAlert] = {}
        self._members: dict[str, set[int]] = {}
        # messages since the last `take_changes` that ended the alert of a cell
        self._ended: dict[int, Alert] = {}

    def apply_alert(self, alert: Alert) -> None:
        """Record that the alert of a cell was raised or cleared; a repeated call
        changes nothing.
        """
        place = (alert.cell, alert.sector)
        if alert.raised:
            self._standing[place] = alert
        elif self._standing.pop(place, None) is not None:
            self._ended[alert.cell] = alert

    def replace_alerts(
        self, standing: Iterable[Alert], has_service: Callable[[Alert], bool]
    ) -> None:
        """Replace the active alerts with the alerts in `standing`. Alerts that are not in it end
        only if the function `has_service` returns True for their place, that is, if a service
        answers for it.
        """
        present = {(alert.cell, alert.sector): alert for alert in standing}
        self._standing = {
            place: one
            for place, one in self._standing.items()
            if place in present or not has_service(one)
        }
        for alert in present.values():
            self.apply_alert(alert)

    @property
    def standing(self) -> list[StretchAlert]:
        """Return all stretches of road with an active alert, as of the last call of
        `take_changes`.
        """
        return list(self._known.values())

    def take_changes(self) -> list[StretchAlert]:
        """Return the stretches of road whose alert was raised, changed or cleared since the last
        call.
        """
        found = self._group_by_stretch()
        out = []
        for name, group in found.items():
            if name not in self._known:
                out.append(self._make_stretch(name, group))
            elif self._members[name] != _cells_of(group):
                out.append(replace(self._make_stretch(name, group), state="changed"))
        out += [self._end_stretch(name) for name in list(self._known) if name not in found]
        self._ended.clear()
        for name, group in found.items():
            self._known[name] = self._make_stretch(name, group)
            self._members[name] = _cells_of(group)
        return out

    def _end_stretch(self, name: str) -> StretchAlert:
        """Return the alert that ends a stretch of road, and forget the stretch."""
        known = self._known.pop(name)
        cells = self._members.pop(name)
        ends = [self._ended[cell] for cell in cells & self._ended.keys()]
        if ends:
            last = max(ends, key=lambda one: one.time)
            return replace(known, state="cleared", time=last.time, reason=last.reason)
        is_joined = any(cell in cells for cell, _ in self._standing)
        reason = "joined another stretch" if is_joined else "no longer reported by the service"
        return replace(known, state="cleared", reason=reason)

    def _group_by_stretch(self) -> dict[str, list[Alert]]:
        """Return the active alerts of cells, grouped by the id of their road stretch."""
        alerts = sorted(self._standing.values(), key=lambda one: (one.time, one.cell, one.sector))
        label = link_cells(np.array([one.cell for one in alerts], np.int64))
        parts: list[list[Alert]] = [[] for _ in range(int(label.max(initial=-1)) + 1)]
        for one, k in zip(alerts, label.tolist(), strict=True):
            parts[k].append(one)
        out: dict[str, list[Alert]] = {}
        for part in sorted(parts, key=len, reverse=True):
            cells = _cells_of(part)
            names = [
                name
                for name, members in self._members.items()
                if members & cells and name not in out
            ]
            name = (
                min(names, key=lambda one: (self._known[one].since, one))
                if names
                else _new_name(part[0])
            )
            # A part that has split off begins with the same cell, so its name must differ.
            while not names and (name in out or name in self._known):
                name += "b"
            out[name] = part
        return out

    def _make_stretch(self, name: str, group: list[Alert]) -> StretchAlert:
        worst = min(group, key=lambda one: one.mu)
        last = max(group, key=lambda one: one.time)
        known = self._known.get(name)
        headings = tuple(grid.HEADINGS[k] for k in sorted({one.sector for one in group}))
        length, direction, middle, bbox = _measure_shape(
            np.array([one.cell for one in group], np.int64)
        )
        return StretchAlert(
            id=name,
            state="raised",
            since=known.since if known else min(one.time for one in group),
            time=last.time,
            length_m=length,
            direction=direction,
            headings=headings,
            latitude=middle[0],
            longitude=middle[1],
            bbox=bbox,
            cells=len(_cells_of(group)),
            mu=worst.mu,
            mu_lower=worst.mu_lower,
            mu_upper=worst.mu_upper,
            p_slippery=worst.p_slippery,
            vehicles=max(one.vehicles for one in group),
            reason=last.reason,
            points=_centre_line(np.array(sorted(_cells_of(group)), np.int64)),
        )


def link_cells(cell: IntArray) -> IntArray:
    """Return the number of the road stretch to which each cell belongs, (n,). Cells at most
    LINK_CELLS apart belong to the same stretch. Stretches are numbered in the order of their first
    cells.
    """
    distinct, first, of_cell = np.unique(cell, return_index=True, return_inverse=True)
    one, other = _find_neighbours(distinct)
    label = first.copy()  # for each cell, the lowest index found so far in its stretch
    while len(one):
        lower = np.minimum(label[one], label[other])
        joined = label.copy()
        np.minimum.at(joined, one, lower)
        np.minimum.at(joined, other, lower)
        joined = joined[of_cell[joined]]  # adopt the lower index that this cell has found itself
        if (joined == label).all():
            break
        label = joined
    return np.unique(label[of_cell], return_inverse=True)[1]


def _find_neighbours(cell: IntArray) -> tuple[IntArray, IntArray]:
    """Find all pairs of distinct cells that are at most LINK_CELLS apart. Return two arrays with
    one item per pair: the indices in `cell` of the first and of the second cell.
    """
    column, row = (part.astype(np.int64) for part in grid.deinterleave(cell))
    key = column << 32 | row
    order = np.argsort(key)
    first_cells = [np.zeros(0, np.int64)]
    second_cells = [np.zeros(0, np.int64)]
    steps = range(-LINK_CELLS, LINK_CELLS + 1)
    for across, along in ((x, y) for x in steps for y in steps if (x, y) > (0, 0)):
        neighbour_key = (column + across) << 32 | (row + along)
        place = np.minimum(np.searchsorted(key, neighbour_key, sorter=order), len(key) - 1)
        found = key[order[place]] == neighbour_key if len(key) else np.zeros(0, bool)
        first_cells.append(np.flatnonzero(found))
        second_cells.append(order[place[found]])
    return np.concatenate(first_cells), np.concatenate(second_cells)


def _cells_of(group: list[Alert]) -> set[int]:
    return {one.cell for one in group}


def _new_name(first: Alert) -> str:
    return f"{grid.quadkey(first.cell, grid.CELL_ZOOM)}-{first.time // NS:x}"


def _centre_line(cell: IntArray) -> tuple[tuple[float, float], ...]:
    """Return the centres [deg] of distinct cells along a road, in order: the longest path through
    the tree that connects neighbouring cells.
    """
    places = np.stack(grid.deinterleave(cell), axis=1).astype(np.float64)
    tree = _span_tree(places)
    end = int(np.argmax(_walk_tree(tree, 0)[0]))
    length, before = _walk_tree(tree, end)
    way = [int(np.argmax(length))]
    while way[-1] != end:
        way.append(before[way[-1]])
    latitude, longitude = grid.centre(cell[way])
    return tuple(zip(latitude.tolist(), longitude.tolist(), strict=True))


def _span_tree(places: FloatArray) -> list[list[tuple[int, float]]]:
    """Return a minimum spanning tree (Prim) of places (n, 2): for each place, its neighbours in the
    tree with distances. Places more than LINK_CELLS apart are not connected.
    """
    tree: list[list[tuple[int, float]]] = [[] for _ in places]
    nearest = np.full(len(places), np.inf)
    parent = np.zeros(len(places), np.int64)
    is_waiting = np.ones(len(places), bool)
    nearest[0] = 0.0
    for _ in places:
        k = int(np.argmin(np.where(is_waiting, nearest, np.inf)))
        is_waiting[k] = False
        if 0.0 < nearest[k] < np.inf:
            tree[k].append((int(parent[k]), float(nearest[k])))
            tree[int(parent[k])].append((k, float(nearest[k])))
        offset = places - places[k]
        distance = np.hypot(offset[:, 0], offset[:, 1])
        distance[np.abs(offset).max(axis=1) > LINK_CELLS] = np.inf
        closer = is_waiting & (distance < nearest)
        nearest[closer] = distance[closer]
        parent[closer] = k
    return tree


def _walk_tree(tree: list[list[tuple[int, float]]], start: int) -> tuple[FloatArray, list[int]]:
    """Return, for each place in a spanning tree of cells, its distance from `start` along the tree
    (-1 if no path leads there) and the previous place on the path from `start`.
    """
    length = np.full(len(tree), -1.0)
    before = [start] * len(tree)
    length[start] = 0.0
    waiting = [start]
    while waiting:
        k = waiting.pop()
        for other, distance in tree[k]:
            if length[other] < 0.0:
                length[other] = length[k] + distance
                before[other] = k
                waiting.append(other)
    return length, before


def _measure_shape(
    cell: IntArray,
) -> tuple[float, str, tuple[float, float], tuple[float, float, float, float]]:
    """Return length [m], direction, centre [deg] and box [deg] of a set of cells. The direction
    (e.g. north-south) is the axis along which the cells spread the most.
    """
    west, south, east, north = grid.bounds(cell)
    scale = METRES_PER_DEGREE * math.cos(math.radians(float(south.mean())))
    x = (west + east) / 2 * scale
    y = (south + north) / 2 * METRES_PER_DEGREE
    side = float((east[0] - west[0]) * scale)
    spread, axes = np.linalg.eigh(
        np.cov(np.stack([x - x.mean(), y - y.mean()]), ddof=0).reshape(2, 2)
    )
    along = (x - x.mean()) * axes[0, 1] + (y - y.mean()) * axes[1, 1]
    bearing = math.degrees(math.atan2(axes[1, 1], axes[0, 1])) % 180.0
    names = ("east-west", "northeast-southwest", "north-south", "northwest-southeast")
    elongated = np.sqrt(spread[1]) > ROUND * np.sqrt(max(spread[0], 0.0)) and len(cell) > 1
    direction = names[round(bearing / 45.0) % 4] if elongated else "around one place"
    box = (float(west.min()), float(south.min()), float(east.max()), float(north.max()))
    middle = (float((south + north).mean() / 2), float((west + east).mean() / 2))
    return float(np.ptp(along)) + side, direction, middle, box
