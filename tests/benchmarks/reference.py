"""NumPy form of the process function f and the measurement function h that the filter in C
(kernel.c) uses. The filters of other libraries are run with these functions.
"""

from __future__ import annotations

import numpy as np

from edge_agent.dynamics.parameters import Parameter
from schemas.mugrid import LOWER, UPPER
from schemas.numeric import FloatArray
from schemas.thresholds import GRAVITY

RATE = 2
DELTA = 3
OMEGA = 7


def move(
    points: FloatArray, row: FloatArray, before: FloatArray, now: FloatArray, gone: float
) -> FloatArray:
    """Return P states (P, 6) after `gone` seconds, integrated by Heun's rule. This is the process
    function f.

    Args:
        points: states (P, 6).
        row: vehicle parameters (12,).
        before, now: sensor readings (11,) at the beginning and the end of the step.
        gone: length of the step [s].
    """
    mu = np.clip(points[:, 5], LOWER, UPPER)
    vx = points[:, 0]
    vy = points[:, 1]
    ax = points[:, 2]
    ay = points[:, 3]
    rate = points[:, 4]
    _, _, turn = compute_response(row, vx, vy, rate, ax, ay, before, mu)
    slope_x = ax + rate * vy
    slope_y = ay - rate * vx
    x = vx + gone * slope_x
    y = vy + gone * slope_y
    r = rate + gone * turn
    bx, by, again = compute_response(row, x, y, r, ax, ay, now, mu)
    new_x = vx + 0.5 * gone * (slope_x + bx + r * y)
    new_y = vy + 0.5 * gone * (slope_y + by - r * x)
    new_rate = rate + 0.5 * gone * (turn + again)
    felt_x, felt_y, _ = compute_response(row, new_x, new_y, new_rate, ax, ay, now, mu)
    return np.stack([new_x, new_y, felt_x, felt_y, new_rate, points[:, 5]], axis=1)


def compute_response(
    row: FloatArray,
    vx: FloatArray,
    vy: FloatArray,
    rate: FloatArray,
    ax: FloatArray,
    ay: FloatArray,
    readings: FloatArray,
    mu: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the longitudinal, lateral and yaw acceleration, each (P,), of a vehicle with four
    Dugoff tyres in each of P states of motion.
    """
    front = np.array([True, True, False, False])
    left = np.array([1.0, -1.0, 1.0, -1.0])
    base = row[Parameter.TO_FRONT] + row[Parameter.TO_REAR]
    weight = row[Parameter.MASS] * GRAVITY
    pitch = (row[Parameter.MASS] * ax * row[Parameter.CG_HEIGHT] / base)[:, None]
    axle = np.where(
        front,
        weight * row[Parameter.TO_REAR] / base - pitch,
        weight * row[Parameter.TO_FRONT] / base + pitch,
    )
    track = np.where(front, row[Parameter.TRACK_FRONT], row[Parameter.TRACK_REAR])
    roll = (ay * row[Parameter.CG_HEIGHT] / GRAVITY)[:, None]
    load = np.maximum(0.5 * axle - left * axle * roll / track, 0.02 * weight / 4.0)
    x = np.where(front, row[Parameter.TO_FRONT], -row[Parameter.TO_REAR])
    y = left * 0.5 * track
    cos = np.cos(readings[DELTA:OMEGA])
    sin = np.sin(readings[DELTA:OMEGA])
    ahead = vx[:, None] - y * rate[:, None]
    aside = vy[:, None] + x * rate[:, None]
    along = cos * ahead + sin * aside
    across = cos * aside - sin * ahead
    speed = np.maximum(np.abs(along), 0.5)
    grip = mu[:, None] * load
    theta_x = (
        row[Parameter.SLOPE_X]
        * load
        * (row[Parameter.RADIUS] * readings[OMEGA:] - along)
        / speed
        / grip
    )
    theta_y = row[Parameter.SLOPE_Y] * load * -across / speed / grip
    theta = np.maximum(np.hypot(theta_x, theta_y), 1e-12)
    gain = grip * np.where(theta <= 0.5, theta, 1.0 - 0.25 / theta) / theta
    force_x = gain * theta_x
    force_y = gain * theta_y
    f_ahead = cos * force_x - sin * force_y
    f_left = sin * force_x + cos * force_y
    moment = x * f_left - y * f_ahead
    return (
        f_ahead.sum(1) / row[Parameter.MASS],
        f_left.sum(1) / row[Parameter.MASS],
        moment.sum(1) / row[Parameter.YAW_INERTIA],
    )


def predict_measurement(points: FloatArray) -> FloatArray:
    """Return a_x, a_y and yaw rate (P, 3) of states (P, 6). This is the measurement function h."""
    return points[:, 2:5]
