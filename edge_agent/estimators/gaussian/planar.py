"""The papers' three-degree-of-freedom process model, by Heun's rule: state [v_x, v_y, a_x, a_y, r, z].

Papers 000 (1) to (14), 001, 004 (1) to (12): v_x' = a_x + r*v_y, v_y' = a_y - r*v_x (004 prints the wrong sign),
I_z*r' = moment of the tyres' forces; a_x and a_y are what the forces give. z is friction (004), or the yaw
acceleration, where the papers carry the moment itself (000, 001): divided by I_z it is of a size with the others.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from edge_agent.dynamics.body import advance_velocity
from edge_agent.dynamics.chassis import response
from edge_agent.dynamics.parameters import Body, Four, body, four
from edge_agent.estimators.gaussian.intake import Track, wheel_force
from schemas.mugrid import LOWER, UPPER
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled, inlined
from schemas.signals import S

LONGEST_S = 0.02  # of one of Heun's steps, at a speed of
CALM_M_S = 2.0  # or more: below, the pole of lateral motion, about 170/v [1/s], asks for shorter ones
SHORTEST_SHARE = 0.2
POINTS = 12  # of the cubature rule in six dimensions, side by side in a row
ABREAST = 8  # of them are moved at once, then the rest: constants, so that each loop becomes vectors and nothing else
Inputs: TypeAlias = tuple[Four, Four, Four]  # wheel speeds, cosines and sines of the steering


@compiled
def substeps(speed: float, gone: float) -> int:
    """How many equal steps of Heun's rule are stable over `gone` [s] at `speed` [m/s]."""
    longest = LONGEST_S * min(max(speed / CALM_M_S, SHORTEST_SHARE), 1.0)
    return max(1, math.ceil(gone / longest - 1e-6))


@inlined
def carry(
    row: FloatArray, columns: FloatArray, friction: FloatArray, track: Track, gone: float, torque: bool
) -> None:  # fmt: skip
    """Move the states `columns` (6, POINTS) on by `gone` [s], in place; inputs run straight from before to now.

    torque: longitudinal forces come from the wheels' torque, z is the yaw acceleration and friction (4,) is given; the
    velocity follows a_x and a_y of the state alone, which measurements correct for drag and slopes. Else forces come
    from slip and z is the friction of all wheels.
    """
    slowest = abs(columns[0, 0])
    for p in range(1, POINTS):
        slowest = min(slowest, abs(columns[0, p]))
    times = substeps(slowest, gone)
    unknown = (math.nan, math.nan, math.nan, math.nan)
    known = _forces(row, track.before, track.use, gone) if torque else unknown
    told = four(np.minimum(np.maximum(friction, LOWER), UPPER)) if torque else unknown
    begin = (four(track.before[S.OMEGA : S.TORQUE]), four(track.turned_before[0]), four(track.turned_before[1]))
    for k in range(times):
        end = (four(track.use[S.OMEGA : S.TORQUE]), four(track.turned[0]), four(track.turned[1]))
        if k + 1 < times:
            end = _between(track.before, track.use, (k + 1) / times)
        _heun(body(row), columns, 0, ABREAST, begin, end, known, told, gone / times, torque)
        _heun(body(row), columns, ABREAST, POINTS, begin, end, known, told, gone / times, torque)
        begin = end


@inlined
def _heun(
    vehicle: Body, columns: FloatArray, first: int, last: int, begin: Inputs, end: Inputs, known: Four, told: Four,
    step: float, torque: bool,
) -> None:  # fmt: skip
    """One of Heun's steps of the columns [first, last), in place. Arithmetic alone: the points go side by side."""
    (omega_from, cos_from, sin_from), (omega, cos, sin) = begin, end
    column_v, column_u, column_x, column_y = columns[0], columns[1], columns[2], columns[3]
    column_r, column_z = columns[4], columns[5]
    for p in range(first, last):
        v, u, ax, ay, r, z = column_v[p], column_u[p], column_x[p], column_y[p], column_r[p], column_z[p]
        one = min(max(z, LOWER), UPPER)
        mu = told if torque else (one, one, one, one)
        _, _, turn = response(vehicle, v, u, r, ax, ay, cos_from, sin_from, omega_from, known, mu)
        turn = z if torque else turn
        slope_x, slope_y = ax + r * u, ay - r * v
        ahead, aside, rate = v + step * slope_x, u + step * slope_y, r + step * turn
        vx, vy = advance_velocity(v, u, ax, ay, r, step) if torque else (ahead, aside)
        felt_x, felt_y, again = response(vehicle, vx, vy, rate, ax, ay, cos, sin, omega, known, mu)
        if not torque:
            vx = v + 0.5 * step * (slope_x + felt_x + rate * aside)
            vy = u + 0.5 * step * (slope_y + felt_y - rate * ahead)
        rate = r + 0.5 * step * (turn + again)
        felt_x, felt_y, again = response(vehicle, vx, vy, rate, ax, ay, cos, sin, omega, known, mu)
        column_v[p], column_u[p], column_x[p], column_y[p], column_r[p] = vx, vy, felt_x, felt_y, rate
        column_z[p] = again if torque else z


@inlined
def _between(before: FloatArray, use: FloatArray, share: float) -> Inputs:
    """Wheel speeds, cosines and sines of the steering at a share of the way from one sample to the next."""
    keep, delta, omega = 1.0 - share, S.DELTA, S.OMEGA
    fl, fr = keep * before[delta] + share * use[delta], keep * before[delta + 1] + share * use[delta + 1]
    rl, rr = keep * before[delta + 2] + share * use[delta + 2], keep * before[delta + 3] + share * use[delta + 3]
    return (
        (
            keep * before[omega] + share * use[omega],
            keep * before[omega + 1] + share * use[omega + 1],
            keep * before[omega + 2] + share * use[omega + 2],
            keep * before[omega + 3] + share * use[omega + 3],
        ),
        (math.cos(fl), math.cos(fr), math.cos(rl), math.cos(rr)),
        (math.sin(fl), math.sin(fr), math.sin(rl), math.sin(rr)),
    )


@inlined
def _forces(row: FloatArray, before: FloatArray, use: FloatArray, gone: float) -> Four:
    """Longitudinal forces [N] from the wheels' torque."""
    return (
        wheel_force(row, before, use, 0, gone), wheel_force(row, before, use, 1, gone),
        wheel_force(row, before, use, 2, gone), wheel_force(row, before, use, 3, gone),
    )  # fmt: skip
