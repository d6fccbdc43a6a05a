"""Evaluation of the warnings that a car gives its driver. It measures how many simulated cars that
approach a slippery stretch of road are warned in time, and how many warnings are false.

The drivers are simulated; the warning code is that of the agent. The connection never fails, and
the map contains all roads, with errors of standard deviation SPREAD (see `known_town`). The
positions have the errors of the car's receiver.

An approach starts on road that is not slippery, so a drive from snow onto ice does not count. A
warning is in time if the car could stop before the stretch from the place of the warning, and if
the warning is still active on arrival. Stopping takes 1.5 s of reaction, then braking at 3 m/s², or
less if the friction before the stretch allows only less. A warning is false if nothing slippery
lies within a lane's width of the path that the car then drove. A narrower limit would be
meaningless, because map cells are no narrower than a lane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from edge_agent.ahead.horizon import COMFORT, horizon_length, look_ahead
from edge_agent.ahead.local_map import LocalMap
from edge_agent.ahead.path import GivenRoute, Path, Pose, straight_path
from edge_agent.ahead.roads import ways_on
from edge_agent.ahead.warnings import Active, update_warnings
from edge_agent.lab.simulation import SimulatedFleet
from edge_agent.observe.cell_tracker import locate_vehicles, new_tracks
from schemas.numeric import FloatArray
from schemas.runtime.figures import Figure
from schemas.thresholds import GRAVITY, NS, REACTION_S
from tests.benchmarks.ahead.known_town import map_of_places, places_of

RATE_HZ: Final = 50.0
AFTER_S: Final = 80.0  # time of the scenario by which all its events have happened
SETTLE_S: Final = 10.0  # after this time all cars are moving
NEW_M: Final = 60.0  # length of road without slippery places that must precede an approach
# Below this friction the map states P(slippery) > 0.9, and the service raises an alert.
ALERTED: Final = 0.3
# Above SLIPPERY_MU, because a slippery stretch may begin in a cell that is only half ice.
NEAR_SLIPPERY: Final = 0.45
BESIDE_M: Final = 3.5
BESIDE_HZ: Final = 10.0
# Least numbers of approaches and kilometres. With fewer, targets of 0.99 and of 1 in 1 000 km could
# be met by chance.
LEAST_ARRIVED = 100
LEAST_KM = 1000.0
START_NS: Final = 1_800_000_000 * NS


@dataclass
class Approaches:
    """Number of approaches to slippery stretches and number of warnings, each summed over all cars
    and towns.
    """

    arrived: int = 0
    warned: int = 0
    raised: int = 0
    false: int = 0
    metres: float = 0.0
    # [m] distance by which each warning came too late.
    short: list[float] = field(default_factory=list)


@dataclass
class _Raised:
    """One warning to a driver.

    Attributes:
        at: time at which the warning began [s].
        distance: distance from the car to the slippery stretch at that time [m].
        length: length of the slippery stretch [m].
        ended: time at which the warning ended [s].
    """

    at: int
    distance: float
    length: float
    ended: float = float("inf")


@dataclass
class _Track:
    """Record of one car. For each second it has the distance that the car has driven [m], the car's
    speed [m/s], the friction under the car, and the smallest friction near the car. It also has the
    warnings that the car gave its driver.
    """

    metre: list[float] = field(default_factory=list)
    speed: list[float] = field(default_factory=list)
    mu: list[float] = field(default_factory=list)
    beside: list[float] = field(default_factory=list)
    raised: dict[str, _Raised] = field(default_factory=dict)
    active: tuple[Active, ...] = ()


def approach_figures(seeds: Sequence[int], seconds: float, vehicles: int = 24) -> list[Figure]:
    """Return figures over random towns, for cars that know their route and for cars that do not.
    The figures are the share of approaches to slippery stretches that were warned in time, and the
    rate of false warnings.
    """
    found = {routed: Approaches() for routed in (True, False)}
    for seed in seeds:
        for routed, counts in found.items():
            drive_town(seed, seconds, vehicles, counts, routed=routed)
    out = []
    for routed, ending in ((True, ""), (False, ".unrouted")):
        counts = found[routed]
        km = counts.metres / 1e3
        out += [
            Figure(
                f"ahead.warned_share{ending}",
                counts.warned / counts.arrived if counts.arrived else float("nan"),
                "",
                0.99 if routed and counts.arrived >= LEAST_ARRIVED else None,
                "more",
            ),
            Figure(
                f"ahead.false_per_1000km{ending}",
                1e3 * counts.false / km if km else float("nan"),
                "",
                1 if routed and km >= LEAST_KM else None,
            ),
            Figure(f"ahead.approaches{ending}", counts.arrived, "to alerted stretches"),
            Figure(f"ahead.driven_km{ending}", km, "km"),
        ]
    return out


def drive_town(
    seed: int, seconds: float, vehicles: int, counts: Approaches, *, routed: bool
) -> None:
    """Simulate one town, and add its approaches to slippery stretches and its warnings to `counts`.
    If `routed` is True, the cars know their route.
    """
    fleet = SimulatedFleet(f"hills-{seed}", vehicles, seed, RATE_HZ, rough=0.5)
    known = map_of_places(places_of(fleet.scenario, AFTER_S), START_NS)
    tracks = [_Track() for _ in range(vehicles)]
    located_tracks = new_tracks(vehicles)
    steps = round(RATE_HZ)
    driven = np.zeros(vehicles)
    fleet.step(round(AFTER_S * RATE_HZ))
    for second in range(int(seconds)):
        t, signals = fleet.step(steps)
        located_tracks, located = locate_vehicles(located_tracks, t, signals)
        true = fleet.truth
        moved = np.hypot(np.diff(true.x, axis=0), np.diff(true.y, axis=0)).sum(axis=0)
        driven += moved
        counts.metres += float(moved.sum())
        beside = _least_beside(fleet, float(t[-1, 0]))
        for k, track in enumerate(tracks):
            latitude, longitude, yaw = (
                float(column[-1, k])
                for column in (located.latitude, located.longitude, located.yaw)
            )
            pose = Pose(latitude, longitude, yaw, float(true.vx[-1, k]), START_NS + second * NS)
            track.metre.append(float(driven[k]))
            track.speed.append(pose.speed)
            track.mu.append(float(true.mu_wheel[:, k].min()))
            track.beside.append(float(beside[k]))
            if np.isfinite([latitude, longitude, yaw]).all():
                _record_look(track, pose, known, _paths_of(fleet, k, pose, known, routed=routed))
    for track in tracks:
        _count_outcome(track, counts)


def _least_beside(fleet: SimulatedFleet, t: float) -> FloatArray:
    """Return, for each of N vehicles, the smallest friction (N,) within BESIDE_M of the path that
    the vehicle drove in the second before the time `t` [s].
    """
    true = fleet.truth
    every = round(RATE_HZ / BESIDE_HZ)
    x = true.x[::every]
    y = true.y[::every]
    yaw = true.yaw[::every]
    lanes = [
        (x - side * np.sin(yaw), y + side * np.cos(yaw)) for side in (-BESIDE_M, 0.0, BESIDE_M)
    ]
    found = [
        fleet.scenario.friction(t, *(column.ravel() for column in lane)).reshape(x.shape)
        for lane in lanes
    ]
    return np.asarray(np.min(found, axis=(0, 1)))


def _paths_of(
    fleet: SimulatedFleet, k: int, pose: Pose, known: LocalMap, *, routed: bool
) -> list[Path]:
    length = horizon_length(pose.speed)
    if routed:
        given = GivenRoute(*fleet.route_ahead(k, length + 50.0)).ahead(pose, length)
        if given is not None:
            return [given]
    return ways_on(pose, known.keys(), length) or [straight_path(pose, length)]


def _record_look(track: _Track, pose: Pose, known: LocalMap, ways: list[Path]) -> None:
    track.active, issued = update_warnings(
        track.active, [look_ahead(way, known, pose.time) for way in ways], pose, known
    )
    look = len(track.metre) - 1
    for one in issued:
        if one.state == "raised":
            track.raised[one.id] = _Raised(look, one.distance_m, one.length_m)
        elif one.state == "ended":
            track.raised[one.id].ended = look


def _count_outcome(track: _Track, counts: Approaches) -> None:
    metre, speed, mu, beside = (
        np.array(column) for column in (track.metre, track.speed, track.mu, track.beside)
    )
    slippery = mu < ALERTED
    for look in np.flatnonzero(slippery[1:] & ~slippery[:-1]) + 1:
        far = metre[look] - metre
        before = (far > 0.0) & (far <= NEW_M)
        if look < SETTLE_S or not before.any() or (mu[before] < NEAR_SLIPPERY).any():
            continue
        counts.arrived += 1
        # The ice begins after the previous sample and at the latest at this one.
        start = float(metre[look - 1])
        standing = (one.at for one in track.raised.values() if one.at < look < one.ended)
        late = min(
            (_stopping_shortfall(metre, speed, mu, at, start) for at in standing),
            default=float("inf"),
        )
        counts.warned += late <= 0.0
        if late > 0.0:
            counts.short.append(late)
    counts.raised += len(track.raised)
    for one in track.raised.values():
        end = metre[one.at] + one.distance + one.length + 30.0
        ahead = (metre >= metre[one.at] - 10.0) & (metre <= end)
        whole = metre[-1] >= end  # the drive reached the end of the stretch
        counts.false += bool(whole and not (beside[ahead] < NEAR_SLIPPERY).any())


def _stopping_shortfall(
    metre: FloatArray, speed: FloatArray, mu: FloatArray, at: int, start: float
) -> float:
    """Return the car's stopping distance at the time `at` [s] minus its distance to the slippery
    stretch, which begins at `start` [m]. The result is 0 or less if the car can stop in time.
    """
    v = float(speed[at])
    on_the_way = (metre >= metre[at]) & (metre <= start)
    brakes = min(GRAVITY * float(mu[on_the_way].min()), COMFORT) if on_the_way.any() else COMFORT
    return v * REACTION_S + v * v / (2.0 * brakes) - (start - float(metre[at]))
