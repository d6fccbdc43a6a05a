"""Lookout: a thread that looks up the map's values for the road ahead of each vehicle. It does so
once a second, and immediately when alerts change.

The estimation loop passes positions to this thread by the method `set_poses`, which never blocks
the loop.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import zenoh

from edge_agent.ahead.horizon import Horizon, horizon_length, look_ahead
from edge_agent.ahead.map_subscriber import MapSubscriber
from edge_agent.ahead.path import GivenRoute, Path, Pose, straight_path
from edge_agent.ahead.prior import MapPrior
from edge_agent.ahead.request_log import FURTHER_M
from edge_agent.ahead.roads import ways_on
from edge_agent.ahead.warnings import Active, update_warnings
from schemas import grid, mugrid
from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import NS
from schemas.wire.ahead import GripWarning, Outlook, Runs, encode_ahead

log = logging.getLogger(__name__)
LOOK_S: Final = 1.0  # [s] time between two look-ups for a vehicle
STALE_S: Final = 3.0  # [s] age of a car's last position from which the lookout ignores the car
# [s] shortest time between two look-ups, so that a burst of alerts causes only one look-up.
AGAIN_S: Final = 0.1

OnWarning = Callable[[str, GripWarning], None]
RouteOf = Callable[[int], GivenRoute | None]


@dataclass
class _ServedVehicle:
    name: str
    subscriber: MapSubscriber | None = None
    active: tuple[Active, ...] = ()  # active warnings
    next_look: float = 0.0  # monotonic times [s] of the next and of the last look-up
    last_look: float = -1.0
    is_urgent: bool = False
    places: frozenset[int] = frozenset()  # keys of the places on the possible paths ahead
    outlook: Outlook | None = None


@dataclass
class LookoutCounts:
    """Counters of the lookout (thread that looks up the map ahead): look-ups, warnings, failed
    look-ups and processor time [s]. `subscribers` are the vehicles' map receivers by name.
    """

    looks: int = 0
    warnings: int = 0
    failures: int = 0
    busy_s: float = 0.0  # [s] processor time of the lookout's thread
    subscribers: dict[str, MapSubscriber] = field(default_factory=dict)

    def total_of(self, counter: str) -> int:
        """Return the sum of a counter, such as "bytes", over the map receivers of all vehicles."""
        return sum(one.counts[counter] for one in self.subscribers.values())

    def values(self) -> dict[str, float]:
        """Return the counters, by name, that the agent prints in its last line of output."""
        refused = sum(
            n
            for one in self.subscribers.values()
            for name, n in one.counts.items()
            if name.startswith("refused")
        )
        return {
            "warnings": self.warnings,
            "looks": self.looks,
            "look_s": round(self.busy_s, 3),
            "heard_bytes": self.total_of("bytes"),
            "heard_alerts": self.total_of("alerts"),
            "heard_refused": refused,
        }


class Lookout:
    """Thread that looks up the map ahead of several vehicles, which are identified by name.

    Args:
        names: names of the vehicles; vehicle k below has the name with index k.
        on_warning: function that the thread calls with the vehicle's name and each warning.
        route_of: function that returns the route that the user gave for vehicle k, or None to
            follow the roads visible in the map.
        is_served: function that returns True if the lookout must serve vehicle k; by default it
            serves all.
        on_horizons: function called after each look-up with the vehicle's name, its horizons (map
            values along each possible path) and its pose.
    """

    def __init__(
        self,
        names: Sequence[str],
        on_warning: OnWarning,
        route_of: RouteOf = lambda _: None,
        is_served: Callable[[int], bool] = lambda _: True,
        on_horizons: Callable[[str, list[Horizon], Pose], None] = lambda *_: None,
    ) -> None:
        self._on_warning = on_warning
        self._route_of = route_of
        self._on_horizons = on_horizons
        self._served = {k: _ServedVehicle(name) for k, name in enumerate(names) if is_served(k)}
        self._number = {vehicle.name: k for k, vehicle in self._served.items()}
        self._poses: Sequence[Pose] = ()
        self._prior = MapPrior(len(names))
        self._current_grip = np.full((len(names), 3), np.nan)
        self._wake = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run_looks, name="lookout", daemon=True)
        self.counts = LookoutCounts()

    def start(self) -> None:
        """Start the lookout's thread, which looks up the map ahead of the vehicles."""
        self._thread.start()

    def attach(self, name: str, session: zenoh.Session) -> None:
        """Begin to receive the map of the road ahead for the vehicle `name`, over its opened Zenoh
        session.
        """
        k = self._number.get(name)
        if k is not None:
            vehicle = self._served[k]
            subscriber = MapSubscriber(
                name, session, lambda places: self._request_look(vehicle, places)
            )
            vehicle.subscriber = subscriber
            self.counts.subscribers[name] = subscriber

    def set_poses(self, poses: Sequence[Pose]) -> None:
        """Store the present poses (position, heading, speed) of the vehicles; item k belongs to
        vehicle k.
        """
        self._poses = poses

    def combine_beliefs(
        self, places: IntArray, beliefs: tuple[FloatArray, FloatArray] | None
    ) -> None:
        """Combine the friction beliefs (probabilities) of the vehicles' filters with the map's
        belief as a prior. Store median and interval of the result as the friction at each vehicle.

        Args:
            places: (N,) current place (cell·4 + sector) of each vehicle, -1 where unknown.
            beliefs: result of `EstimatorBank.beliefs`: beliefs of the filters, and likelihoods of
                their measurements in the current place; None for an estimator without beliefs.
        """
        if beliefs is None:
            return
        map_beliefs: dict[int, FloatArray | None] = {}
        for k in self._prior.entered_vehicles(places):
            subscriber = self._served[k].subscriber if k in self._served else None
            if subscriber is None or places[k] < 0:
                map_beliefs[k] = None
            # The estimation loop must not wait. If the lock is taken, the loop tries again at its
            # next step.
            elif subscriber.map_lock().acquire(blocking=False):
                try:
                    map_beliefs[k] = subscriber.local_map.belief_at(int(places[k]), time.time_ns())
                finally:
                    subscriber.map_lock().release()
        informed = self._prior.step(places, *beliefs, map_beliefs)
        self._current_grip = np.column_stack(
            [mugrid.quantiles(informed, q) for q in (0.5, 0.05, 0.95)]
        )

    def latest_outlook(self, name: str) -> Outlook | None:
        """Return the latest outlook of the vehicle `name` (its warnings, and the map values of the
        road ahead). Return None before the first look-up.
        """
        return self._served[self._number[name]].outlook

    def close(self, within_s: float = 1.0) -> None:
        """Stop the lookout's thread; the vehicles' sessions stay open."""
        self._stop.set()
        self._wake.set()
        if self._thread.ident is not None:
            self._thread.join(within_s)

    def _request_look(self, vehicle: _ServedVehicle, places: list[int]) -> None:
        if not vehicle.places.isdisjoint(places) or any(
            not one.places.isdisjoint(places) for one in vehicle.active
        ):
            vehicle.is_urgent = True
            self._wake.set()

    def _run_looks(self) -> None:
        while not self._stop.is_set():
            self._wake.clear()
            now = time.monotonic()
            began = time.thread_time()
            ready = [
                k
                for k, vehicle in self._served.items()
                if vehicle.next_look <= now
                or (vehicle.is_urgent and now - vehicle.last_look >= AGAIN_S)
            ]
            for k in sorted(ready, key=lambda k: not self._served[k].is_urgent):
                self._serve_vehicle(k, now)
                if any(vehicle.is_urgent for vehicle in self._served.values()):
                    break  # start again with the vehicles that received an alert
            self.counts.busy_s += time.thread_time() - began
            if not ready:
                urgent = any(vehicle.is_urgent for vehicle in self._served.values())
                next_due = min(
                    (vehicle.next_look for vehicle in self._served.values()), default=now + LOOK_S
                )
                self._wake.wait(AGAIN_S / 2.0 if urgent else max(next_due - time.monotonic(), 0.0))

    def _serve_vehicle(self, k: int, now: float) -> None:
        vehicle = self._served[k]
        # Spread the first look-ups over LOOK_S, so that a thousand cars of one process do not look
        # at the same moment.
        first = vehicle.last_look < 0.0
        vehicle.next_look = now + LOOK_S * ((k * 0.618034) % 1.0 if first else 1.0)
        vehicle.last_look = now
        vehicle.is_urgent = False
        poses = self._poses
        if vehicle.subscriber is None or k >= len(poses):
            return
        pose = poses[k]
        if not np.isfinite([pose.latitude, pose.longitude, pose.yaw, pose.speed]).all():
            return
        if time.time_ns() - pose.time > STALE_S * NS:
            return
        try:
            self._look_ahead(k, vehicle, vehicle.subscriber, pose)
        except Exception:  # the lookout must continue after any error
            self.counts.failures += 1
            log.exception(
                "looking ahead for %s failed; it is tried again with the next position",
                vehicle.name,
            )

    def _look_ahead(
        self, k: int, vehicle: _ServedVehicle, subscriber: MapSubscriber, pose: Pose
    ) -> None:
        length = horizon_length(pose.speed)
        with subscriber.map_lock():
            paths = paths_ahead(pose, self._route_of(k), subscriber, length + FURTHER_M)
            horizons = [
                look_ahead(path.first_metres(length), subscriber.local_map, pose.time)
                for path in paths
            ]
            vehicle.active, issued = update_warnings(
                vehicle.active, horizons, pose, subscriber.local_map
            )
        vehicle.places = frozenset(np.concatenate([path.places.ravel() for path in paths]).tolist())
        self.counts.looks += 1
        self._on_horizons(vehicle.name, horizons, pose)
        for warning in issued:
            self.counts.warnings += 1
            self._on_warning(vehicle.name, warning)
        ended = tuple(warning for warning in issued if warning.state == "ended")
        vehicle.outlook = Outlook(
            vehicle.name,
            pose.time,
            paths[0].kind,
            (*(one.warning for one in vehicle.active), *ended),
            runs_of_places(horizons[0]),
            tuple(self._current_grip[k].tolist()),
        )
        subscriber.follow_paths(paths, pose, length)
        outlook = vehicle.outlook
        subscriber.publish_view(lambda: encode_ahead(outlook))


def paths_ahead(
    pose: Pose, route: GivenRoute | None, subscriber: MapSubscriber, length: float
) -> list[Path]:
    """Return the possible paths ahead of a vehicle, `length` [m] long: the route given by the user,
    else the roads visible in the map, else one path straight on.

    `subscriber` holds the received map; the caller must hold its lock.
    """
    route_path = route.ahead(pose, length) if route is not None else None
    if route_path is not None:
        return [route_path]
    return ways_on(pose, subscriber.local_map.keys(), length) or [straight_path(pose, length)]


def runs_of_places(horizon: Horizon) -> Runs:
    """Divide a horizon (map values for each metre ahead) into runs, and return the runs. A run is a
    sequence of metres that lie in the same place (map cell and heading sector).
    """
    key = horizon.key
    starts = np.append(
        0, np.flatnonzero((key[1:] != key[:-1]) | (horizon.basis[1:] != horizon.basis[:-1])) + 1
    )
    ends = np.append(starts[1:], len(key))
    place = np.maximum(key[starts], 0)
    return Runs(
        starts.astype(np.float64),
        ends.astype(np.float64),
        place // grid.SECTORS,
        place % grid.SECTORS,
        horizon.mu[starts],
        horizon.mu_lower[starts],
        horizon.mu_upper[starts],
        horizon.p_slippery[starts],
        horizon.age_s[starts],
        horizon.basis[starts],
        np.fmin.reduceat(horizon.safe_speed, starts),
    )
