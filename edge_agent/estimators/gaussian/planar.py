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
    x: FloatArray,
    friction: FloatArray,
    before: FloatArray,
    use: FloatArray,
    gone: float,
    torque: bool,
    shape: float,
) -> None:
    """Move the state x (6,) on by `gone` [s], in place; inputs (15,) run straight from `before` to `use`.

    torque: longitudinal forces come from the wheels' torque, z is the yaw acceleration and friction (4,) is given; the
    velocity follows a_x and a_y of the state alone, which measurements correct for drag and slopes. Else forces come
    from slip and z is the friction of all wheels.
    """
    count = substeps(abs(x[0]), gone)
    step = gone / count
    mu, known, force_x, force_y = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    motion, delta, omega = np.empty(5), np.empty(4), np.empty(4)
    slope_x = slope_y = turn = 0.0
    for wheel in range(4):
        mu[wheel] = min(max(friction[wheel] if torque else x[5], LOWER), UPPER)
        known[wheel] = wheel_force(row, before, use, wheel, gone) if torque else math.nan
    for stage in range(3 * count):
        k, act = stage // 3, stage % 3
        if act == 0:
            vx, vy, rate = x[0], x[1], x[4]
        elif act == 1:
            vx, vy, rate = x[0] + step * slope_x, x[1] + step * slope_y, x[4] + step * turn
            if torque:
                vx, vy = advance_velocity(x[0], x[1], x[2], x[3], x[4], step)
        _between(before, use, (k if act == 0 else k + 1) / count, delta, omega)
        motion[0], motion[1], motion[2], motion[3], motion[4] = vx, vy, rate, x[2], x[3]
        ax, ay, now = response(row, motion, delta, omega, known, mu, shape, force_x, force_y)
        if act == 0:
            slope_x, slope_y = x[2] + x[4] * x[1], x[3] - x[4] * x[0]
            turn = x[5] if torque else now
        elif act == 1:
            if not torque:
                vx = x[0] + 0.5 * step * (slope_x + ax + rate * vy)
                vy = x[1] + 0.5 * step * (slope_y + ay - rate * motion[0])
            rate = x[4] + 0.5 * step * (turn + now)
            x[0], x[1], x[4] = vx, vy, rate
        else:
            x[2], x[3] = ax, ay
            if torque:
                x[5] = now


@compiled
def _between(before: FloatArray, use: FloatArray, share: float, delta: FloatArray, omega: FloatArray) -> None:
    """Steering and wheel speeds at a share of the way from one sample to the next."""
    for wheel in range(4):
        d, w = S.DELTA + wheel, S.OMEGA + wheel
        delta[wheel] = (1.0 - share) * before[d] + share * use[d]
        omega[wheel] = (1.0 - share) * before[w] + share * use[w]
