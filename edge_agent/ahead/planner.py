"""Speed limit for a motion planner, computed from the lower bound of friction ahead, and sent as
Autoware's message VelocityLimit.

The limit is the highest speed from which the vehicle can brake comfortably to the safe speed of
each place ahead. When the computed limit falls, the sent limit follows immediately. When it rises,
the sent limit follows only after HOLD_S, so that it does not fluctuate. A road without measurements
gives no limit.

Autoware subscribes to `/planning/scenario_planning/max_velocity_candidates`
(tier4_planning_msgs/msg/VelocityLimit). The message is published in the form that ROS's Zenoh layer
rmw_zenoh expects: CDR bytes, with an attachment of sequence number, time and sender identity.
"""

from __future__ import annotations

import math
import secrets
import struct
from typing import Final

import numpy as np

from edge_agent.ahead.horizon import COMFORT, MARGIN_M, Horizon, safe_speed
from edge_agent.ahead.local_map import MEASURED
from schemas.numeric import FloatArray
from schemas.thresholds import NS

TOPIC: Final = "planning/scenario_planning/max_velocity_candidates"
TYPE: Final = "tier4_planning_msgs::msg::dds_::VelocityLimit_"
# text that rmw_zenoh uses for a sender without a type hash
ANY_HASH: Final = "TypeHashNotSupported"
SENDER: Final = "gripmap"
HOLD_S: Final = 3.0  # [s] time for which a higher limit must last before it is sent
STEP: Final = 1.0  # [m/s] smallest rise of the limit that is sent to a planner
FALL_STEP: Final = 0.2  # [m/s] smallest decrease of the limit that is sent to a planner
# [s] delay of the braking: one second between two look-ups, and the reaction of the planner's
# brakes
LATE_S: Final = 1.3
# Factor that extends the distance from the median to the 5 % quantile to the 0.5 % quantile: ratio
# of the normal quantiles, less 1. One place in twenty has less grip than its 5 % quantile, but a
# planner's limit must hold in 99 % of the places.
CAUTION: Final = 0.566
LEAST_GRIP: Final = 0.02  # minimum friction for the computation of a limit
FREE: Final = 1e3  # [m/s] value sent for "no limit": above any planner's own limit
MIN_JERK: Final = -1.0  # [m/s^3] jerk limits of the braking, as the message requires
MAX_JERK: Final = 1.0
_GID_BYTES: Final = 16  # [byte] size of the identity of a sender


def limit_ahead(distance: FloatArray, safe_speed: FloatArray) -> float:
    """Return the highest speed [m/s] at which the vehicle may drive now; inf if no safe speed is
    known.

    Each place ahead has a safe speed. A vehicle that drives at the returned speed can reach each
    place's safe speed MARGIN_M metres before the place. The vehicle is assumed to brake after
    LATE_S seconds, with the deceleration COMFORT.

    Args:
        distance: (M,) distance of each place from the vehicle [m].
        safe_speed: (M,) safe speed at each place [m/s]; NaN where unknown.
    """
    known = np.isfinite(safe_speed)
    if not known.any():
        return math.inf
    way = np.maximum(distance[known] - MARGIN_M, 0.0)
    safe = safe_speed[known]
    # Solve v^2 = safe^2 + 2 COMFORT (way - v LATE_S) for the speed v.
    late = COMFORT * LATE_S
    braked = np.sqrt(late**2 + safe**2 + 2.0 * COMFORT * way) - late
    return float(np.maximum(braked, safe).min())


def cautious_bound(mu: FloatArray, mu_lower: FloatArray) -> FloatArray:
    """Return a lower bound that the road's friction exceeds with a probability of 99.5 %; NaN where
    unknown. The bound is extrapolated from the median `mu` and the 5 % quantile `mu_lower` of the
    friction. The arrays may have any shape.
    """
    below = np.nan_to_num(mu - mu_lower)
    return np.asarray(np.maximum(mu_lower - CAUTION * below, LEAST_GRIP))


def limit_of(horizons: list[Horizon]) -> float:
    """Return the speed limit [m/s] for the vehicle: the lowest of the limits that the friction on
    each possible path ahead requires. Return inf if no path requires a limit.
    """
    found = []
    for one in horizons:
        known = (one.basis == MEASURED) | one.slippery
        bound = np.where(known, cautious_bound(one.mu, one.mu_lower), np.nan)
        safe = safe_speed(one.path.curvature, bound)
        found.append(limit_ahead(np.arange(len(safe), dtype=np.float64), safe))
    return min(found, default=math.inf)


class SteadyLimit:
    """Speed limit for the motion planner, with hysteresis. It follows a clear fall of the computed
    limit at once, but rises only after the computed limit has been higher for HOLD_S seconds.
    """

    def __init__(self) -> None:
        self.value = math.inf
        self._higher_since: int | None = None

    def update(self, limit: float, now: int) -> bool:
        """Process a computed speed limit [m/s] at the time `now` [ns UTC]. Return True if the limit
        that is sent to the planner has changed.
        """
        if limit < self.value:
            self._higher_since = None
            changed = self.value - limit >= FALL_STEP or self.value == math.inf
            if changed:
                self.value = limit
            return changed
        if limit < self.value + STEP:
            self._higher_since = None
            return False
        if self._higher_since is None:
            self._higher_since = now
        if now - self._higher_since < HOLD_S * NS:
            return False
        self.value = limit
        self._higher_since = None
        return True


def encode_limit(limit: float, now: int) -> bytes:
    """Encode a speed limit [m/s] at the time `now` [ns UTC] as the message VelocityLimit in CDR,
    little endian. A limit of inf (no limit) is written as the value FREE.
    """
    sender = SENDER.encode() + b"\0"
    speed = min(limit, FREE)
    body = struct.pack("<iIfB3x", now // NS, now % NS, speed, 1) + struct.pack(
        "<fff", -COMFORT, MAX_JERK, MIN_JERK
    )
    return b"\x00\x01\x00\x00" + body + struct.pack("<I", len(sender)) + sender


class PlannerKey:
    """Zenoh key, and message attachments, by which one sender publishes speed limits to ROS through
    rmw_zenoh.

    Args:
        domain: ROS domain.
        type_hash: hash of the message type in the installed version of the planner, e.g. RIHS01_…;
            rmw_zenoh receives only messages with this hash.
    """

    def __init__(self, domain: int = 0, type_hash: str = ANY_HASH) -> None:
        self.key = f"{domain}/{TOPIC}/{TYPE}/{type_hash}"
        self._number = 0
        self._identity = secrets.token_bytes(_GID_BYTES)

    def attachment(self, now: int) -> bytes:
        """Return, as bytes, the attachment (sequence number, time, identity of the sender) of the
        next speed-limit message, which is sent at the time `now` [ns UTC].
        """
        self._number += 1
        return struct.pack("<qqB", self._number, now, _GID_BYTES) + self._identity
