"""Velocity of a wheel centre and the slip of its tyre.

Legend
    v_x, v_y    velocity of the centre of gravity [m/s]
    r           yaw rate [rad/s]
    (x, y)      wheel position in the body [m]
    delta       road-wheel angle [rad]
    R           wheel radius [m]
    omega       wheel speed [rad/s]
    index w     in the wheel's frame
"""

from __future__ import annotations

import math

from edge_agent.dynamics.parameters import Parameter
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled, inlined

SLOWEST_M_S = 0.5  # [m/s] smallest denominator of slip, which has no meaning near standstill


@compiled
def wheel_position(row: FloatArray, wheel: int) -> tuple[float, float]:
    """Return the position (x, y) [m] of wheel 0..3 (fl, fr, rl, rr) relative to the centre of
    gravity; y is positive to the left.
    """
    front = wheel < 2
    x = row[Parameter.TO_FRONT] if front else -row[Parameter.TO_REAR]
    half = 0.5 * (row[Parameter.TRACK_FRONT] if front else row[Parameter.TRACK_REAR])
    return x, (half if wheel % 2 == 0 else -half)


@compiled
def wheel_velocity(
    row: FloatArray, wheel: int, vx: float, vy: float, yaw_rate: float, delta: float
) -> tuple[float, float]:
    """Return (v_wx, v_wy) [m/s]: the velocity of the wheel's centre along and across the plane of
    the wheel.
    """
    x, y = wheel_position(row, wheel)
    ahead = vx - y * yaw_rate
    left = vy + x * yaw_rate
    cos = math.cos(delta)
    sin = math.sin(delta)
    return cos * ahead + sin * left, cos * left - sin * ahead


@inlined
def along_wheel(
    row: FloatArray,
    wheel: int,
    vx: float,
    vy: float,
    yaw_rate: float,
    direction: tuple[float, float],
) -> float:
    """Return v_wx [m/s]: the velocity of the wheel's centre along the wheel, for a given
    `direction`, the cosine and sine of its steering angle.
    """
    x, y = wheel_position(row, wheel)
    cos, sin = direction
    return cos * (vx - y * yaw_rate) + sin * (vy + x * yaw_rate)


@inlined
def wheel_slips(radius: float, omega: float, along: float, across: float) -> tuple[float, float]:
    """Return the slips (slip_x, slip_y) [1] of a wheel: (R*omega - v_wx)/|v_wx| and -v_wy/|v_wx|,
    the tangent of the slip angle. R is the radius, omega the wheel speed; v_wx and v_wy are the
    velocity of the wheel's centre `along` and `across` its plane [m/s].

    Positive slip_x gives a forward force, positive slip_y a force to the left.
    """
    share = 1.0 / max(abs(along), SLOWEST_M_S)  # divide only once, because a division is slow
    return (radius * omega - along) * share, -across * share
