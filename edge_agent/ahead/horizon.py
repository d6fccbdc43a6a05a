"""Horizon: the map's values for each metre of the road ahead, and the safe speed there. The module
is pure (no I/O, no clock).

A metre without map data limits no speed and causes no warning.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from edge_agent.ahead.local_map import MEASURED, UNKNOWN, LocalMap, PlaceBelief
from edge_agent.ahead.path import NONE, Path
from schemas import mugrid
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.stopping import stopping_speed
from schemas.thresholds import GRAVITY, REACTION_S

# [m] safety margin of one cell: the map gives the start of a stretch no better
MARGIN_M: Final = 10.0
# [m/s^2] braking that passengers do not feel as hard. Adaptive cruise control may brake with up to
# 3.5 m/s^2 (ISO 15622).
COMFORT: Final = 3.0
COMFORT_ACROSS: Final = 3.0  # [m/s^2] comfortable lateral acceleration in bends
SIGHT_M: Final = 60.0  # [m] distance within which a car in a town must be able to stop
# Assumed lower end of the friction of a road that no vehicle has measured: the 5 % quantile of the
# uniform prior.
UNKNOWN_LOWER: Final = mugrid.LOWER + 0.05 * (mugrid.UPPER - mugrid.LOWER)
SHORTEST_M: Final = 150.0  # [m] minimum length of a horizon
LONGEST_M: Final = 1000.0  # [m] maximum length of a horizon
# P(slippery) from which the car warns. The service raises an alert at 0.9; without a link, such a
# belief fades to about 0.8 within half an hour.
WARN_ABOVE: Final = 0.8
# Minimum number of vehicles for a warning, as for an alert, so that one bad sensor causes none.
LEAST_VEHICLES: Final = 2


class Horizon(NamedTuple):
    """Map values along one path ahead of the car, one value per metre, (M,) each; NaN where
    unknown.

    Attributes:
        path: the path, divided into M steps of one metre.
        key: map cell and heading sector of each metre (cell·4 + sector), NONE where nothing is
            known.
        mu: median friction; NaN also where only lower bounds are known.
        mu_lower, mu_upper: 5 % and 95 % quantiles of the friction.
        p_slippery: probability that the friction is below 0.4.
        age_s: time since a vehicle last observed the place [s].
        basis: origin of the values, a constant of `local_map`: UNKNOWN, BOUND (only a lower bound),
            MEASURED or BORROWED (from neighbouring places).
        slippery: True if the metre justifies a warning of slipperiness.
        alerted: True if an alert of the fleet service is active there.
        safe_speed: highest safe speed [m/s], computed by the function `safe_speed`; NaN where
            unknown.
    """

    path: Path
    key: IntArray
    mu: FloatArray
    mu_lower: FloatArray
    mu_upper: FloatArray
    p_slippery: FloatArray
    age_s: FloatArray
    basis: IntArray
    slippery: BoolArray
    alerted: BoolArray
    safe_speed: FloatArray


def horizon_length(speed: float) -> float:
    """Return the distance [m] over which the car must look ahead at `speed` [m/s]. It is the
    stopping distance on a road of unknown friction.
    """
    stop = speed * (REACTION_S + 2.0) + MARGIN_M + speed**2 / (2.0 * UNKNOWN_LOWER * GRAVITY)
    return float(min(max(stop, SHORTEST_M), LONGEST_M))


def look_ahead(path: Path, known: LocalMap, now: int) -> Horizon:
    """Return the horizon (map values for each metre) along a path. The values come from the local
    map `known`, at the time `now` [ns UTC].
    """
    places, inverse = np.unique(path.places, return_inverse=True)
    found = known.look_up(places, now)
    inverse = inverse.reshape(path.places.shape)
    is_known = (found.basis != UNKNOWN)[inverse] & (path.places != NONE)
    # For each metre take the first place with an alert, else the first measured place, else the
    # first place of which the map knows anything.
    is_measured = found.basis[inverse] == MEASURED
    rank = np.select([~is_known, found.alerted[inverse], is_measured], [3, 0, 1], default=2)
    column = rank.argmin(axis=1)
    row = inverse[np.arange(len(column)), column]
    is_unknown = rank.min(axis=1) == 3
    slippery = justifies_warning(found)
    values = (
        np.where(is_unknown, np.nan, column[row])
        for column in (found.mu, found.mu_lower, found.mu_upper, found.p_slippery, found.age_s)
    )
    mu, lower, upper, p, age = values
    basis = np.where(is_unknown, UNKNOWN, found.basis[row])
    return Horizon(
        path,
        np.where(is_unknown, NONE, places[row]),
        mu,
        lower,
        upper,
        p,
        age,
        basis,
        np.where(is_unknown, False, slippery[row]),
        np.where(is_unknown, False, found.alerted[row]),
        safe_speed(
            path.curvature,
            np.where((basis == MEASURED) | (slippery[row] & ~is_unknown), lower, np.nan),
        ),
    )


def justifies_warning(found: PlaceBelief) -> BoolArray:
    """Return a mask (n,) of the n places (one per map cell and heading sector) in `found`. It is
    True if an alert is active, or enough vehicles measured the place as slippery.
    """
    firm = (
        (found.basis == MEASURED)
        & (found.p_slippery >= WARN_ABOVE)
        & (found.vehicles >= LEAST_VEHICLES)
    )
    return np.asarray(found.alerted | firm)


def safe_speed(curvature: FloatArray, mu_lower: FloatArray) -> FloatArray:
    """Return the safe speed [m/s] at each metre (M,). At this speed a car can take bends of
    `curvature` [1/m] and stop within SIGHT_M metres, if the friction is `mu_lower`, the lower end
    of its interval.

    The result falls towards a slower place, so that the car can reach that place's speed by
    comfortable braking. It falls less steeply if cornering leaves less grip for braking. Where
    `mu_lower` is NaN (not measured), the result is NaN, except on the braking distance before a
    slower place.
    """
    measured = np.isfinite(mu_lower)
    bend = np.abs(np.nan_to_num(curvature))
    expected = np.where(measured, mu_lower, UNKNOWN_LOWER)
    grip = GRAVITY * expected
    cornering = np.minimum(grip, COMFORT_ACROSS) / np.maximum(bend, 1e-6)
    squares = np.where(
        measured, np.minimum(cornering, stopping_speed(expected, SIGHT_M) ** 2), np.inf
    ).tolist()
    brakes = np.minimum(grip, COMFORT).tolist()
    bends = bend.tolist()
    for k in range(len(squares) - 2, -1, -1):
        if squares[k + 1] < squares[k]:
            across = min(squares[k + 1] * bends[k] / brakes[k], 1.0)
            squares[k] = min(
                squares[k], squares[k + 1] + 2.0 * brakes[k] * math.sqrt(1.0 - across * across)
            )
    found = np.sqrt(np.array(squares))
    return np.asarray(np.where(np.isinf(found), np.nan, found))


def braking_from(horizon: Horizon) -> FloatArray:
    """Return v^2/2 (M,) [m^2/s^2] for each metre ahead, where v is the highest current speed from
    which the car can stop within that distance.

    The assumed deceleration is gravity times the lower end of the friction interval, at most a
    comfortable deceleration. On an unknown road, the assumed friction is UNKNOWN_LOWER.
    """
    lower = np.where(np.isfinite(horizon.mu_lower), horizon.mu_lower, UNKNOWN_LOWER)
    return np.asarray(np.cumsum(np.minimum(GRAVITY * lower, COMFORT)))
