"""Body and four tyres together: what the vehicle would feel in a state, for given steering, wheel speeds and friction.

Legend: v_x, v_y velocity of the centre of gravity [m/s], r yaw rate [rad/s], a_x, a_y accelerations [m/s^2], mu peak
adhesion per wheel [1], delta steering [rad], omega wheel speed [rad/s], F_x, F_y forces in the wheel's frame [N].
"""

from __future__ import annotations

import math

from edge_agent.dynamics.body import accelerations
from edge_agent.dynamics.loads import wheel_loads
from edge_agent.dynamics.parameters import P
from edge_agent.dynamics.slip import slips, wheel_velocity
from edge_agent.dynamics.tyres import combined_dugoff, combined_magic
from schemas.numeric import FloatArray, compiled

DUGOFF = 0.0  # in place of a Magic Formula shape c, which is above 1


@compiled
def tyre_forces(
    row: FloatArray,
    motion: FloatArray,
    delta: FloatArray,
    omega: FloatArray,
    mu: FloatArray,
    shape: float,
    force_x: FloatArray,
    force_y: FloatArray,
) -> None:
    """Fill force_x, force_y (4,) [N] at motion (5,) = v_x, v_y, r, a_x, a_y; the accelerations give the loads.

    shape: c of the Magic Formula (e = 0), or DUGOFF. A wheel whose speed is NaN rolls freely.
    """
    loads = wheel_loads(row, motion[3], motion[4])
    for wheel in range(4):
        along, across = wheel_velocity(row, wheel, motion[0], motion[1], motion[2], delta[wheel])
        turning = omega[wheel]
        slip_x, slip_y = slips(row[P.RADIUS], along / row[P.RADIUS] if math.isnan(turning) else turning, along, across)
        load = loads[wheel]
        stiff_x, stiff_y = row[P.SLOPE_X] * load, row[P.SLOPE_Y] * load
        if shape == DUGOFF:
            pair = combined_dugoff(slip_x, slip_y, stiff_x, stiff_y, mu[wheel], load)
        else:
            pair = combined_magic(slip_x, slip_y, stiff_x, stiff_y, mu[wheel], load, shape, 0.0)
        force_x[wheel], force_y[wheel] = pair


@compiled
def response(
    row: FloatArray,
    motion: FloatArray,
    delta: FloatArray,
    omega: FloatArray,
    known_x: FloatArray,
    mu: FloatArray,
    shape: float,
    force_x: FloatArray,
    force_y: FloatArray,
) -> tuple[float, float, float]:
    """(a_x, a_y [m/s^2], yaw acceleration [rad/s^2]) of the tyres' forces; arguments as `tyre_forces`.

    known_x (4,) [N] replaces the tyre's longitudinal force where it is not NaN.
    """
    tyre_forces(row, motion, delta, omega, mu, shape, force_x, force_y)
    for wheel in range(4):
        if not math.isnan(known_x[wheel]):
            force_x[wheel] = known_x[wheel]
    return accelerations(row, force_x, force_y, delta)
