"""Tests of the speed limit for a planner. A car that keeps the limit must be able to stop on ice
within sight. A lower limit must apply at once, a higher one only after a while. A ROS decoder must
read the message.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from edge_agent.ahead.horizon import COMFORT, MARGIN_M, SIGHT_M
from edge_agent.ahead.planner import (
    FREE,
    HOLD_S,
    PlannerKey,
    SteadyLimit,
    cautious_bound,
    encode_limit,
    limit_ahead,
)
from schemas.stopping import stopping_speed
from schemas.thresholds import NS

DEFINITIONS = {
    "tier4_planning_msgs/msg/VelocityLimitConstraints": (
        "float32 min_acceleration\nfloat32 max_jerk\nfloat32 min_jerk\n"
    ),
    "tier4_planning_msgs/msg/VelocityLimit": (
        "builtin_interfaces/Time stamp\nfloat32 max_velocity\nbool use_constraints\n"
        "tier4_planning_msgs/VelocityLimitConstraints constraints\nstring sender\n"
    ),
}


@pytest.mark.parametrize("limit", [8.25, math.inf])
def test_a_ros_decoder_reads_the_message(limit: float) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    read: Any = store.deserialize_cdr(
        encode_limit(limit, 17 * NS + 5), "tier4_planning_msgs/msg/VelocityLimit"
    )
    assert (read.stamp.sec, read.stamp.nanosec) == (17, 5)
    assert read.max_velocity == min(limit, FREE)
    assert read.use_constraints
    assert read.constraints.min_acceleration == -COMFORT
    assert read.sender == "gripmap"
    assert bytes(
        store.serialize_cdr(read, "tier4_planning_msgs/msg/VelocityLimit")
    ) == encode_limit(limit, 17 * NS + 5)


def enter_ice(speed: float, mu: float, metres: int, *, limited: bool) -> float:
    """Return the speed [m/s] at which a car enters ice of friction `mu`, if it starts `metres`
    before the ice at `speed` [m/s]. If `limited`, the driver keeps the speed limit.
    """
    safe = np.full(metres + 50, np.nan)
    safe[metres:] = stopping_speed(mu, SIGHT_M)
    at = 0.0
    step = 0.05
    while at < metres:
        ahead = safe[int(at) :]
        limit = limit_ahead(np.arange(len(ahead), dtype=float), ahead) if limited else math.inf
        speed = max(speed - COMFORT * step, min(speed, limit))
        at += speed * step
    return speed


@pytest.mark.parametrize("limited", [True, False])
def test_limit_lets_a_car_stop_within_sight_on_ice(limited: bool) -> None:
    draw = np.random.default_rng(3)
    stops = list[bool]()
    for _ in range(50):
        speed = draw.uniform(12.0, 36.0)
        mu = draw.uniform(0.06, 0.3)
        metres = int(speed**2 / (2.0 * COMFORT) + MARGIN_M + draw.uniform(5.0, 100.0))
        entered = enter_ice(speed, mu, metres, limited=limited)
        stops.append(entered <= float(stopping_speed(mu, SIGHT_M)) + 1e-6)
    assert sum(stops) == 50 if limited else sum(stops) < 10


def test_bound_for_a_machine_is_lower_where_the_map_is_less_sure() -> None:
    mu = np.array([0.2, 0.2, 0.1, math.nan, math.nan])
    lower = np.array([0.18, 0.1, 0.05, 0.15, math.nan])
    bound = cautious_bound(mu, lower)
    np.testing.assert_allclose(bound[:4], [0.1687, 0.0434, 0.0217, 0.15], atol=1e-4)
    assert math.isnan(bound[4])


def test_limit_falls_at_once_and_rises_after_a_while() -> None:
    steady = SteadyLimit()
    assert not steady.update(math.inf, 0)
    assert steady.update(8.0, NS)
    assert steady.value == 8.0
    assert not steady.update(12.0, 2 * NS)
    assert not steady.update(7.9, 3 * NS), "less than a step"
    assert steady.update(5.0, 4 * NS)
    assert not steady.update(math.inf, 5 * NS)
    assert steady.update(math.inf, 5 * NS + round(HOLD_S * NS))
    assert steady.value == math.inf


def test_unmeasured_road_gives_no_speed_limit() -> None:
    assert limit_ahead(np.arange(5.0), np.full(5, np.nan)) == math.inf
    assert PlannerKey(3, "RIHS01_ab").key.startswith(
        "3/planning/scenario_planning/max_velocity_candidates/"
    )
