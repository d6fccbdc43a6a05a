"""Model of the vehicle body on four tyres. It computes the accelerations for a given motion,
steering, wheel speeds and friction.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from edge_agent.dynamics.loads import wheel_loads
from edge_agent.dynamics.parameters import Body, Four, Parameter, body_of
from edge_agent.dynamics.slip import wheel_position, wheel_slips
from edge_agent.dynamics.tyres import combined_dugoff, combined_magic
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled, inlined
from schemas.thresholds import GRAVITY

# Value of `shape` that selects a Dugoff tyre; the shape factor c of the Magic Formula is above 1
DUGOFF = 0.0


@compiled
def wheel_inputs(delta: FloatArray, omega: FloatArray) -> FloatArray:
    """Return an array (4, 3): cosine and sine of the steering angles (4,) [rad], and wheel speeds
    (4,) [rad/s].

    The caller computes this array once and uses it for all states (sigma points) with these angles
    and speeds.
    """
    out = np.empty((4, 3))
    for wheel in range(4):
        out[wheel, 0] = math.cos(delta[wheel])
        out[wheel, 1] = math.sin(delta[wheel])
        out[wheel, 2] = omega[wheel]
    return out


@inlined
def _wheel_slips(
    radius: float, ahead: float, aside: float, cos: float, sin: float, omega: float
) -> tuple[float, float]:
    """Return the (longitudinal, lateral) slips of a wheel.

    `ahead` and `aside` [m/s] are the velocity of the wheel centre in body axes; `cos` and `sin` are
    cosine and sine of the steering angle. If the wheel speed `omega` is unknown (NaN), the returned
    longitudinal slip is 0.
    """
    along = cos * ahead + sin * aside
    across = cos * aside - sin * ahead
    slip_x, slip_y = wheel_slips(radius, omega, along, across)
    return (0.0 if math.isnan(omega) else slip_x), slip_y


@inlined
def stiffness(body: Body, load: float, mu: float, rear: bool) -> tuple[float, float]:
    """Return the slip stiffness (longitudinal [N], lateral [N/rad]) of a tyre under `load` [N] on
    friction `mu`.

    The stiffness is proportional to the load. Three parameters in `body` change this: PROPORTIONAL
    makes the stiffness proportional to friction too, QUADRATIC reduces the stiffness per load under
    high load, and REAR_SLOPE is a factor for the rear axle.
    """
    by_load = 1.0 + body.quadratic - body.quadratic * load * (4.0 / (body.mass * GRAVITY))
    share = (1.0 + body.proportional * (mu - 1.0)) * by_load
    behind = body.rear_slope if rear else 1.0
    return share * (body.slope_x * load), share * behind * (body.slope_y * load)


@compiled
def tyre_forces(
    row: FloatArray,
    motion: FloatArray,
    wheels: FloatArray,
    mu: FloatArray,
    shape: float,
    forces: tuple[FloatArray, FloatArray],
) -> None:
    """Compute the longitudinal and lateral tyre forces [N] of the four wheels in the wheels' axes,
    and write them to the two arrays (4,) of `forces`.

    Args:
        row: vehicle parameters.
        motion: (5,) velocities v_x, v_y [m/s], yaw rate [rad/s], accelerations a_x, a_y [m/s^2];
            the accelerations determine the wheel loads.
        wheels: (4, 3) result of `wheel_inputs`; a wheel with speed NaN rolls freely.
        mu: (4,) friction at the wheels [1].
        shape: selects the tyre model. DUGOFF selects the Dugoff model. Any other value is the
            shape factor c of a Magic Formula with curvature 0.
        forces: receives the longitudinal forces, then the lateral forces.
    """
    parameters = body_of(row)
    loads = wheel_loads(parameters, motion[3], motion[4])
    for wheel in range(4):
        x, y = wheel_position(row, wheel)
        ahead = motion[0] - y * motion[2]
        aside = motion[1] + x * motion[2]
        slip = _wheel_slips(
            row[Parameter.RADIUS],
            ahead,
            aside,
            wheels[wheel, 0],
            wheels[wheel, 1],
            wheels[wheel, 2],
        )
        slopes = stiffness(parameters, loads[wheel], mu[wheel], wheel >= 2)
        if shape == DUGOFF:
            force = combined_dugoff(slip, slopes, mu[wheel], loads[wheel])
        else:
            force = combined_magic(slip, slopes, mu[wheel], loads[wheel], shape, 0.0)
        forces[0][wheel], forces[1][wheel] = force


class PlanarMotion(NamedTuple):
    """Motion of the body: velocity [m/s] forward and to the left, yaw rate [rad/s], and
    accelerations [m/s^2], from which the wheel loads follow.
    """

    vx: float
    vy: float
    yaw_rate: float
    ax: float
    ay: float


class WheelInputs(NamedTuple):
    """Inputs of the four wheels: steering angle, wheel speed, friction, and a given longitudinal
    force that replaces that of the tyre model (NaN: none).
    """

    cos: Four  # cosine of the steering angle
    sin: Four  # sine of the steering angle
    omega: Four  # [rad/s] NaN for a wheel that rolls freely
    force_x: Four  # [N] replaces the tyre's longitudinal force where it is not NaN
    mu: Four


@inlined
def planar_response(
    body: Body, motion: PlanarMotion, wheels: WheelInputs
) -> tuple[float, float, float]:
    """Return the accelerations (a_x, a_y [m/s^2], yaw acceleration [rad/s^2]) of the body that the
    forces of four Dugoff tyres cause.

    For speed, the code is written out per wheel with scalars instead of arrays: the papers' filters
    spend most of their time here.
    """
    vx, vy, rate, ax, ay = motion
    cos, sin, omega, force_x, mu = wheels
    fl, fr, rl, rr = wheel_loads(body, ax, ay)
    a = body.to_front
    b = body.to_rear
    front = 0.5 * body.track_front
    rear = 0.5 * body.track_rear
    aside = vy + a * rate
    x_fl, y_fl = _wheel_force(
        body, vx - front * rate, aside, (fl, mu[0], cos[0], sin[0], omega[0], force_x[0]), False
    )
    x_fr, y_fr = _wheel_force(
        body, vx + front * rate, aside, (fr, mu[1], cos[1], sin[1], omega[1], force_x[1]), False
    )
    aside = vy - b * rate
    x_rl, y_rl = _wheel_force(
        body, vx - rear * rate, aside, (rl, mu[2], cos[2], sin[2], omega[2], force_x[2]), True
    )
    x_rr, y_rr = _wheel_force(
        body, vx + rear * rate, aside, (rr, mu[3], cos[3], sin[3], omega[3], force_x[3]), True
    )
    moment = a * (y_fl + y_fr) - b * (y_rl + y_rr) + front * (x_fr - x_fl) + rear * (x_rr - x_rl)
    per_mass = 1.0 / body.mass
    per_inertia = 1.0 / body.yaw_inertia
    return (
        (x_fl + x_fr + x_rl + x_rr) * per_mass,
        (y_fl + y_fr + y_rl + y_rr) * per_mass,
        moment * per_inertia,
    )


@inlined
def _wheel_force(
    body: Body,
    ahead: float,
    aside: float,
    wheel: tuple[float, float, float, float, float, float],
    rear: bool,
) -> tuple[float, float]:
    """Return the (forward, left) force [N] of a wheel in body axes.

    `ahead` and `aside` [m/s] are the velocity of the wheel centre in body axes. `wheel` is (load,
    friction, cosine and sine of the steering angle, wheel speed, given longitudinal force). If the
    given force is not NaN, it replaces the tyre's longitudinal force.
    """
    load, mu, cos, sin, omega, given_x = wheel
    slip = _wheel_slips(body.radius, ahead, aside, cos, sin, omega)
    force_x, force_y = combined_dugoff(slip, stiffness(body, load, mu, rear), mu, load)
    force_x = force_x if math.isnan(given_x) else given_x
    return cos * force_x - sin * force_y, sin * force_x + cos * force_y
