"""The papers' three-degree-of-freedom process model, by Heun's rule: state [v_x, v_y, a_x, a_y, r, z].

Papers 000 (1) to (14), 001, 004 (1) to (12): v_x' = a_x + r*v_y, v_y' = a_y - r*v_x (004 prints the wrong sign),
I_z*r' = moment of the tyres' forces; a_x and a_y are what the forces give. z is friction (004), or the yaw
acceleration, where the papers carry the moment itself (000, 001): divided by I_z it is of a size with the others.
"""

from __future__ import annotations

import math

import numpy as np

from edge_agent.dynamics.body import advance_velocity
from edge_agent.dynamics.chassis import response
from edge_agent.estimators.gaussian.intake import wheel_force
from schemas.mugrid import LOWER, UPPER
from schemas.numeric import FloatArray, compiled
from schemas.signals import S

LONGEST_S = 0.02  # of one of Heun's steps, at a speed of
CALM_M_S = 2.0  # or more: below, the pole of lateral motion, about 170/v [1/s], asks for shorter ones
SHORTEST_SHARE = 0.2


@compiled
def substeps(speed: float, gone: float) -> int:
    """How many equal steps of Heun's rule are stable over `gone` [s] at `speed` [m/s]."""
    longest = LONGEST_S * min(max(speed / CALM_M_S, SHORTEST_SHARE), 1.0)
    return max(1, math.ceil(gone / longest - 1e-6))


@compiled
def carry(
    row: FloatArray,
    points: FloatArray,
    friction: FloatArray,
    before: FloatArray,
    use: FloatArray,
    gone: float,
    torque: bool,
) -> None:
    """Move the states points (P, 6) on by `gone` [s], in place; inputs (15,) run straight from `before` to `use`.

    torque: longitudinal forces come from the wheels' torque, z is the yaw acceleration and friction (4,) is given; the
    velocity follows a_x and a_y of the state alone, which measurements correct for drag and slopes. Else forces come
    from slip and z is the friction of all wheels.
    """
    slowest = abs(points[0, 0])
    for p in range(points.shape[0]):
        slowest = min(slowest, abs(points[p, 0]))
    count = substeps(slowest, gone)
    step = gone / count
    mu, known, omega, steering = np.empty(4), np.empty(4), np.empty(4), np.empty((4, 2))
    for wheel in range(4):
        known[wheel] = wheel_force(row, before, use, wheel, gone) if torque else math.nan
        mu[wheel] = min(max(friction[wheel], LOWER), UPPER)
    _inputs(before, use, 0.0, omega, steering)
    for k in range(count):
        omega_from, steering_from = omega.copy(), steering.copy()
        _inputs(before, use, (k + 1) / count, omega, steering)
        for p in range(points.shape[0]):
            if not torque:
                mu[:] = min(max(points[p, 5], LOWER), UPPER)
            v, u, ax, ay, r = points[p, 0], points[p, 1], points[p, 2], points[p, 3], points[p, 4]
            _, _, turn = response(row, v, u, r, ax, ay, steering_from, omega_from, known, mu)
            turn = points[p, 5] if torque else turn
            slope_x, slope_y = ax + r * u, ay - r * v
            ahead, aside, rate = v + step * slope_x, u + step * slope_y, r + step * turn
            vx, vy = advance_velocity(v, u, ax, ay, r, step) if torque else (ahead, aside)
            felt_x, felt_y, again = response(row, vx, vy, rate, ax, ay, steering, omega, known, mu)
            if not torque:
                vx = v + 0.5 * step * (slope_x + felt_x + rate * aside)
                vy = u + 0.5 * step * (slope_y + felt_y - rate * ahead)
            rate = r + 0.5 * step * (turn + again)
            points[p, 0], points[p, 1], points[p, 4] = vx, vy, rate
            points[p, 2], points[p, 3], again = response(row, vx, vy, rate, ax, ay, steering, omega, known, mu)
            if torque:
                points[p, 5] = again


@compiled
def _inputs(before: FloatArray, use: FloatArray, share: float, omega: FloatArray, steering: FloatArray) -> None:
    """Wheel speeds (4,) and turned steering (4, 2) at a share of the way from one sample to the next."""
    for wheel in range(4):
        d, w = S.DELTA + wheel, S.OMEGA + wheel
        delta = (1.0 - share) * before[d] + share * use[d]
        omega[wheel] = (1.0 - share) * before[w] + share * use[w]
        steering[wheel, 0], steering[wheel, 1] = math.cos(delta), math.sin(delta)
