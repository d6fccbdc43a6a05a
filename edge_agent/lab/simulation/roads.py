"""Roads as lanes (directed lines of points): centre lines of straights and arcs, one lane per
direction on the right, and connectors through junctions.

    lane       a directed polyline, points about a metre apart, with heading and curvature
    connector  a lane through a junction, from the end of one lane to the start of another road's
    q          lateral acceleration that a driver accepts [m/s^2]
    profile    v²/q at each point [m], where v is the highest speed of this driver. The driver
               brakes before bends and junctions with at most BRAKING·q. v² is proportional to q, so
               one profile serves all drivers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np

from schemas.errors import InputError
from schemas.numeric import FloatArray, IntArray

SPACING_M: Final = 1.0
LANE_OFFSET_M: Final = 2.0  # lanes of opposite directions are 4 m apart
# [m] distance from a junction at which its lanes end; the connectors then have a radius of 8 to 14
# m.
SETBACK_M: Final = 12.0
# [m] length over which a driver smooths the path where arcs meet straights
SMOOTHING_M: Final = 5.0
BRAKING: Final = 0.8  # share of the budget that is used for slowing down
# [1/m] minimum curvature for the choice of speed, also on straights
STRAIGHTEST: Final = 1.0 / 400.0
# [m] v²/q within a junction, where drivers look left and right: speeds of 6 to 9 m/s.
YIELD_M: Final = 16.0
# Length of a Bezier handle over the chord. A cubic Bezier curve of 90 degrees is then nearly a
# circle.
HANDLE: Final = 0.39


class LanePoint(IntEnum):
    """Index of a column in the table of lane points (points along the lanes of the road
    network).
    """

    X = 0  # [m]
    Y = 1
    COS = 2  # cosine of the heading
    SIN = 3
    CURVATURE = 4  # [1/m], positive to the left
    # [m] squared speed over budget, v²/q, for each continuation; MOST_WAYS columns
    PROFILE = 5


MOST_WAYS: Final = 3


@dataclass(frozen=True)
class Road:
    """A road between two junctions. It is straight between its bends, and each bend is an arc of
    `radius` [m].
    """

    start: str
    end: str
    bends: tuple[tuple[float, float], ...] = ()
    radius: float = 35.0


@dataclass(frozen=True)
class Network:
    """Lanes in one table of points, with the columns of LanePoint (points, 8). Lane k has `size[k]`
    points from row `first[k]` on.

    `ways[k]` (MOST_WAYS,) are the indices of the lanes that continue from the end of lane k, and -1
    in unused elements; `spacing[k]` [m] is the distance between its points. The first `roads` lanes
    are roads, the others connectors (lanes through junctions). `starts` (vehicles,) is the lane on
    which each vehicle's drive begins; None: the vehicles are distributed over the roads.
    """

    points: FloatArray
    first: IntArray
    size: IntArray
    spacing: FloatArray
    ways: IntArray
    roads: int
    starts: IntArray | None = None

    def lane(self, k: int) -> FloatArray:
        """Return the points of lane k as rows of a table (n, columns)."""
        return self.points[self.first[k] : self.first[k] + self.size[k]]


def build_network(junctions: dict[str, tuple[float, float]], roads: tuple[Road, ...]) -> Network:
    """Return the network of lanes and connectors for the roads between `junctions` (name -> (x, y)
    [m]).

    Raises:
        InputError: a road leads to an unknown junction, or a junction gives a lane no continuation
            or too many.
    """
    lanes: list[FloatArray] = []
    # Junction at which each lane begins, and number of its road.
    leaves: list[tuple[str, int]] = []
    arrives: list[str] = []
    for number, road in enumerate(roads):
        for name in (road.start, road.end):
            if name not in junctions:
                raise InputError(
                    "roads",
                    f"road {number} leads to {name!r}",
                    f"use one of {', '.join(junctions)}",
                )
        centre = round_corners(
            [junctions[road.start], *road.bends, junctions[road.end]], road.radius
        )
        centre = centre[_inner_points(centre, SETBACK_M)]
        for line, start, end in (
            (centre, road.start, road.end),
            (centre[::-1], road.end, road.start),
        ):
            lanes.append(resample_line(shifted_right(line, LANE_OFFSET_M)))
            leaves.append((start, number))
            arrives.append(end)
    count = len(lanes)
    ways: list[list[int]] = [[] for _ in range(count)]
    for k in range(count):
        for j, (junction, number) in enumerate(leaves[:count]):
            if junction == arrives[k] and number != k // 2:
                ways[k].append(len(lanes))
                lanes.append(connect_lanes(lanes[k], lanes[j]))
                ways.append([j])
        if not 1 <= len(ways[k]) <= MOST_WAYS:
            raise InputError(
                "roads",
                f"lane {k} has {len(ways[k])} successors",
                f"join 2 to {MOST_WAYS + 1} roads",
            )
    return network_of(lanes, ways, count)


def round_corners(corners: list[tuple[float, float]], radius: float) -> FloatArray:
    """Return a line (n, 2) [m] from the first to the last of `corners`, rounded by arcs of `radius`
    [m] at the corners between. Its points are a quarter of a metre apart.
    """
    line = [np.array(corners[0])]
    for before, corner, after in zip(corners[:-2], corners[1:-1], corners[2:], strict=True):
        p = np.array(corner)
        a = _unit_vectors(np.array(before) - p)
        b = _unit_vectors(np.array(after) - p)
        half = math.acos(float(np.clip(a @ b, -1.0, 1.0))) / 2.0  # half the angle between the legs
        centre = p + _unit_vectors(a + b) * radius / math.sin(half)
        start = p + a * radius / math.tan(half)
        end = p + b * radius / math.tan(half)
        swept = math.pi - 2.0 * half
        turn = math.copysign(1.0, float(a[1] * b[0] - a[0] * b[1]))
        spoke = start - centre
        for angle in np.linspace(0.0, swept * turn, max(2, round(radius * swept / 0.25))):
            c = math.cos(angle)
            s = math.sin(angle)
            line.append(
                centre + np.array([c * spoke[0] - s * spoke[1], s * spoke[0] + c * spoke[1]])
            )
        line[-1] = end
    line.append(np.array(corners[-1]))
    return resample_line(np.array(line), 0.25)


def resample_line(line: FloatArray, spacing: float = SPACING_M) -> FloatArray:
    """Return a line of points (x, y), shape (n, 2) [m], with points at equal distances of about
    `spacing` [m]; its course and its ends are unchanged.
    """
    run = _distance_along(line)
    even = np.linspace(0.0, run[-1], max(2, round(run[-1] / spacing) + 1))
    return np.column_stack([np.interp(even, run, line[:, 0]), np.interp(even, run, line[:, 1])])


def shifted_right(line: FloatArray, offset: float) -> FloatArray:
    """Return a line (n, 2) [m] shifted to its right by `offset` [m]."""
    direction = np.gradient(line, axis=0)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return line + offset * np.column_stack([direction[:, 1], -direction[:, 0]])


def connect_lanes(arriving: FloatArray, leaving: FloatArray) -> FloatArray:
    """Return the line through a junction: points (n, 2) [m] of a cubic Bezier curve from the end of
    the lane `arriving` to the start of the lane `leaving`, without a kink.
    """
    p0 = arriving[-1]
    p3 = leaving[0]
    handle = HANDLE * float(np.linalg.norm(p3 - p0))
    p1 = p0 + handle * _unit_vectors(arriving[-1] - arriving[-2])
    p2 = p3 - handle * _unit_vectors(leaving[1] - leaving[0])
    u = np.linspace(0.0, 1.0, 200)[:, None]
    return resample_line(
        (1 - u) ** 3 * p0 + 3 * (1 - u) ** 2 * u * p1 + 3 * (1 - u) * u**2 * p2 + u**3 * p3
    )


def _unit_vectors(v: FloatArray) -> FloatArray:
    unit: FloatArray = v / np.linalg.norm(v)
    return unit


def _distance_along(line: FloatArray) -> FloatArray:
    """Return, for each point of a line (n, 2) [m], its distance from the line's start along the
    line [m].
    """
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def _inner_points(line: FloatArray, setback: float) -> IntArray:
    """Return the indices of those points of a line (n, 2) [m] that are at least `setback` [m] from
    both ends, measured along the line.
    """
    run = _distance_along(line)
    return np.flatnonzero((run >= setback) & (run <= run[-1] - setback))


def network_of(
    lanes: list[FloatArray],
    ways: list[list[int]],
    roads: int,
    allowed: list[FloatArray] | None = None,
) -> Network:
    """Return a network of lanes with headings, curvatures and speed profiles.

    Args:
        lanes: equally spaced points of each lane, (n, 2) [m]; the first `roads` lanes are roads,
            the others connectors.
        ways: for each lane, the indices of the lanes that continue from its end; an empty list if
            every drive ends on it.
        roads: number of lanes that are roads.
        allowed: limit of the speed profile v²/q [m] (squared speed over the acceleration that the
            driver accepts) at each point of each lane, (n,); None: only bends and junctions limit
            the speed.
    """
    size = np.array([len(lane) for lane in lanes])
    spacing = np.array([_distance_along(lane)[-1] / (len(lane) - 1) for lane in lanes])
    onward = np.full((len(lanes), MOST_WAYS), -1)
    for k, targets in enumerate(ways):
        onward[k, : len(targets)] = targets
    tables = [_lane_table(lane) for lane in lanes]
    limits = [
        np.maximum(np.abs(table[:, LanePoint.CURVATURE]), STRAIGHTEST) ** -1 for table in tables
    ]
    for k in range(roads, len(lanes)):
        limits[k] = np.minimum(limits[k], YIELD_M)
    if allowed is not None:
        limits = [
            np.minimum(own, allowed_limit)
            for own, allowed_limit in zip(limits, allowed, strict=True)
        ]
    _plan_speeds(tables, limits, ways, spacing)
    return Network(np.concatenate(tables), np.cumsum(size) - size, size, spacing, onward, roads)


def _lane_table(lane: FloatArray) -> FloatArray:
    """Return the table of the points of one lane, one row each, with position, heading and smoothed
    curvature. The speed profile is infinite until it is computed.
    """
    step = np.gradient(lane, axis=0)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    width = int(SMOOTHING_M / SPACING_M)
    padded = np.pad(np.gradient(heading) / np.linalg.norm(step, axis=1), width // 2, mode="edge")
    curvature = np.convolve(padded, np.full(width, 1.0 / width), mode="valid")
    empty = np.full((len(lane), MOST_WAYS), np.inf)
    return np.column_stack([lane, np.cos(heading), np.sin(heading), curvature, empty])


def _plan_speeds(
    tables: list[FloatArray], limits: list[FloatArray], ways: list[list[int]], spacing: FloatArray
) -> None:
    """Write the speed profiles of all lanes into `tables`, the tables of their points.

    A profile is v²/q [m], where v is a driver's highest speed and q the acceleration that the
    driver accepts. `limits` are the profile's upper limits by bends and junctions. Each lane is
    computed backwards from its end, so that the driver can brake in time. This is repeated until no
    profile changes. With the lateral acceleration a, braking is at most BRAKING·sqrt(q² − a²).
    """
    while True:
        before = [table[0, LanePoint.PROFILE :].copy() for table in tables]
        for k, table in enumerate(tables):
            for way, target in enumerate(ways[k]):
                allowed = float(tables[target][0, LanePoint.PROFILE :].min())
                for i in range(len(table) - 1, -1, -1):
                    allowed = min(allowed, float(limits[k][i]))
                    table[i, LanePoint.PROFILE + way] = allowed
                    across = min(allowed * abs(float(table[i, LanePoint.CURVATURE])), 1.0)
                    allowed += 2.0 * BRAKING * math.sqrt(1.0 - across * across) * spacing[k]
        if all(
            np.array_equal(old, table[0, LanePoint.PROFILE :])
            for old, table in zip(before, tables, strict=True)
        ):
            return
