"""Vertical wheel loads with quasi-static load transfer.

Legend
    m           mass [kg]
    h           height of the centre of gravity [m]
    L           wheelbase [m]
    a, b        distances from the centre of gravity to the front and rear axle [m]
    a_x, a_y    acceleration of the centre of gravity [m/s^2]
    Fz          wheel load [N], in the order fl, fr, rl, rr

Signs follow ISO 8855: forward acceleration moves load to the rear, and a left turn (a_y > 0) to the
right wheels.
"""

from __future__ import annotations

from edge_agent.dynamics.parameters import Body, Four
from schemas.runtime.jit import inlined
from schemas.thresholds import GRAVITY

# [1] smallest wheel load over the static one, so that force over load stays finite
LEAST_LOAD_SHARE = 0.02


@inlined
def wheel_loads(body: Body, ax: float, ay: float) -> Four:
    """Return the loads (fl, fr, rl, rr) [N] at accelerations ax, ay [m/s^2].

    The lateral transfer of each axle is proportional to the load it carries (equal roll stiffness
    per load).
    """
    mass = body.mass
    height = body.cg_height
    # Factors that do not depend on ax and ay are in brackets, so that they are computed only once.
    per_base = 1.0 / (body.to_front + body.to_rear)
    pitch = ax * (mass * height * per_base)
    front = mass * GRAVITY * body.to_rear * per_base - pitch
    rear = mass * GRAVITY * body.to_front * per_base + pitch
    shift_front = front * (ay * (height / (GRAVITY * body.track_front)))
    shift_rear = rear * (ay * (height / (GRAVITY * body.track_rear)))
    least = LEAST_LOAD_SHARE * mass * GRAVITY / 4.0
    return (
        max(0.5 * front - shift_front, least),
        max(0.5 * front + shift_front, least),
        max(0.5 * rear - shift_rear, least),
        max(0.5 * rear + shift_rear, least),
    )
