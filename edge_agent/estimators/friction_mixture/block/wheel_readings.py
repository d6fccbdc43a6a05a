"""Checks of the wheel speed signals: impossible jumps, and resolution (smallest step between
different readings).
"""

from __future__ import annotations

import math

from edge_agent.dynamics.parameters import Parameter
from edge_agent.estimators import flags
from edge_agent.estimators.friction_mixture.state.memory import LastInputs
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import S

# [m/s] largest difference from the second slowest wheel. A larger one is not a spinning wheel but a
# decoding error (512 km/h occurred).
SPINS_M_S = 20.0
HELD = 3  # number of unchanged readings after which a change counts as a step, not as noise
# [rad/s] range of steps that occur in wheel speed signals; a step of 1 km/h is .9 rad/s. A reading
# that changes by less than STEP_LEAST counts as unchanged, and a wheel that turns more slowly than
# it counts as standing.
STEP_LEAST = 0.05
STEP_MOST = 2.0
STEP_PACE = 0.1  # [1] weight of a new step in the moving average of steps


@compiled
def refuse_jumps(row: FloatArray, now: FloatArray) -> int:
    """Set wheel speeds in the readings `now` (15,) to NaN where they are impossibly far above the
    speeds of the other wheels. Return the health flags.
    """
    slowest = math.inf
    second = math.inf
    for wheel in range(4):
        slowest, second = two_smallest(slowest, second, now[S.OMEGA + wheel])
    health = 0
    for wheel in range(4):
        if row[Parameter.RADIUS] * (now[S.OMEGA + wheel] - second) > SPINS_M_S:
            now[S.OMEGA + wheel] = math.nan
            health = flags.OUTLIER | flags.NO_WHEEL_SPEED
    return health


@compiled
def two_smallest(smallest: float, second: float, value: float) -> tuple[float, float]:
    """Return the smallest and the second smallest of three numbers, of which `smallest` ≤ `second`;
    a `value` that is NaN does not count.
    """
    if value < smallest:
        return value, smallest
    return smallest, value if value < second else second


@compiled
def note_step(last: LastInputs, wheel: int, omega: float) -> None:
    """Update the estimated resolution (smallest step) of the speed signal of a wheel with its new
    reading `omega` [rad/s].

    A speed that stays constant over several readings and then changes is quantised; the change is
    one step.
    """
    change = abs(omega - last.omega[wheel])
    if change < STEP_LEAST:
        last.omega_held[wheel] += 1
    elif not math.isnan(change):
        if last.omega_held[wheel] >= HELD and change < STEP_MOST:
            last.omega_step[wheel] += STEP_PACE * (change - last.omega_step[wheel])
        last.omega_held[wheel] = 0
