"""Simulated drives onto ice, with and without the speed limit that the agent publishes for a
planner.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import numpy as np

from edge_agent.ahead.horizon import COMFORT, SIGHT_M, safe_speed
from edge_agent.ahead.lookout import LOOK_S
from edge_agent.ahead.planner import SteadyLimit, cautious_bound, limit_ahead
from schemas.numeric import FloatArray
from schemas.runtime.figures import Figure
from schemas.thresholds import GRAVITY, NS, REACTION_S

SEED: Final = 4203
STEP_S: Final = 0.1
DELAY_S: Final = 0.3  # reaction delay of the planner
SPREAD: Final = 0.03  # standard deviation of the error of the map's friction on ice
STRAIGHT: Final = 1000  # [m] length of the straight road


def measure_planner(_folder: Path, quick: bool) -> list[Figure]:
    """Simulate drives onto ice. The map knows the friction of the ice only within a 90 % interval.
    Return as figures the shares of drives that can stop within sight, with and without the agent's
    speed limit.
    """
    draw = np.random.default_rng(SEED)
    drives = 200 if quick else 2000
    stops = {True: 0, False: 0}
    for _ in range(drives):
        ice = float(draw.uniform(0.08, 0.3))
        median = max(ice + float(draw.normal(0.0, SPREAD)), 0.06)
        begin = int(draw.integers(150, 600))
        speed = float(draw.uniform(12.0, 28.0))
        dry = float(draw.uniform(0.6, 0.8))
        mu = np.where(np.arange(STRAIGHT) >= begin, median, dry)
        bound = cautious_bound(mu, mu - 1.645 * SPREAD)
        for limited in (True, False):
            entry = _speed_at(begin, speed, safe_speed(np.zeros(STRAIGHT), bound), limited=limited)
            way = entry * REACTION_S + entry**2 / (2.0 * GRAVITY * ice)
            stops[limited] += way <= SIGHT_M
    return [
        Figure(
            "planner.stops_within_sight",
            stops[True] / drives,
            "of simulated entries to ice, with the limit",
            0.99,
            "more",
        ),
        Figure(
            "planner.stops_without",
            stops[False] / drives,
            "of the same entries, without the limit",
        ),
    ]


def _speed_at(begin: int, speed: float, safe: FloatArray, *, limited: bool) -> float:
    """Return the speed [m/s] of a car when it reaches the position `begin` [m]. If `limited` is
    True, the car obeys the agent's speed limit after a delay, by gentle braking.
    """
    limit = SteadyLimit()
    obeyed = math.inf
    waiting = list[tuple[float, float]]()
    at = 0.0
    now = 0.0
    looked = -LOOK_S
    while at < begin:
        if limited and now - looked >= LOOK_S:
            looked = now
            ahead = safe[int(at) :]
            limit.update(limit_ahead(np.arange(len(ahead), dtype=float), ahead), round(now * NS))
            waiting.append((now + DELAY_S, limit.value))
        while waiting and waiting[0][0] <= now:
            obeyed = waiting.pop(0)[1]
        if speed > obeyed:
            speed = max(obeyed, speed - COMFORT * STEP_S)
        at += speed * STEP_S
        now += STEP_S
    return speed
