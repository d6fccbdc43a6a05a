"""The grip in use (force over load) as a lower limit of friction: a tyre cannot transmit more than
its friction. Friction hypotheses below the grip in use get a penalty, and the upper end of the
reported friction interval is never below it.
"""

from __future__ import annotations

import math

from edge_agent.estimators.friction_mixture.state.constants import Constants
from edge_agent.estimators.friction_mixture.state.memory import GripInUse, Quantiles
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.thresholds import GRAVITY, UTILISED_WINDOW_S

# [1/s] rate at which the recent maximum of grip in use decreases after UTILISED_WINDOW_S, because
# the road may have changed
FORGOTTEN = 0.5
ABOVE = 0.02  # [1] part of the grip in use that smoothing removes in a hard stop


@compiled
def note_grip(grip: GripInUse, constants: Constants, ax: float, ay: float, dt: float) -> None:
    """Update the smoothed grip in use (horizontal acceleration over g) with the accelerations
    [m/s^2] measured over the last dt [s].

    The penalty of nodes uses the acceleration smoothed over `abrupt_time`, because a bump shakes
    the body. The upper end of the interval uses the one smoothed over a block.
    """
    size = math.hypot(ax, ay) / GRAVITY
    grip.slow += (1.0 - math.exp(-dt / constants.physical.abrupt_time)) * (size - grip.slow)
    grip.fast += (1.0 - math.exp(-dt / constants.chosen.block_time)) * (size - grip.fast)
    grip.age += dt
    if grip.fast >= grip.held:
        grip.held = grip.fast
        grip.age = 0.0
    elif grip.age > UTILISED_WINDOW_S:
        grip.held = max(grip.fast, grip.held - FORGOTTEN * dt)


@compiled
def guard_penalty(grip: GripInUse, constants: Constants, side_mu: FloatArray) -> float:
    """Return the penalty [nat] of a friction hypothesis that lies below the grip in use. `side_mu`
    (2,) is the hypothetical friction on the left and right side; their mean counts. The penalty is
    0 if this mean is not below the grip in use.
    """
    lack = (grip.slow - 0.5 * (side_mu[0] + side_mu[1])) / constants.physical.force_share - 1.0
    return float(min(0.5 * max(lack, 0.0) ** 2, constants.guards.largest_loss))


@compiled
def reported_upper(grip: GripInUse, friction: Quantiles) -> float:
    """Return the upper end of the reported friction interval. It is the larger of `friction.upper`
    and the recent grip in use plus the margin ABOVE.

    The result may exceed 1.2, the end of the friction grid, because racing tyres have a larger
    friction.
    """
    return max(friction.upper, grip.held + ABOVE)


@compiled
def lower_while_sliding(slides: float, used: float, lower: float, error: float) -> float:
    """Return the lower end of the friction interval while wheels slide.

    A sliding tyre may be at its peak: its force lies between the peak and the smaller force of full
    sliding. Only slip distinguishes these two cases, and slip is uncertain because in a slide no
    wheel rolls freely and shows the speed. Therefore, if `slides` is 1, the lower end is at most
    1 - `error` times the grip in use.

    Args:
        slides: fuzzy degree to which a wheel slides, 0 to 1.
        used: grip used within the last second, of the axle that uses more [1].
        lower: lower end according to the probabilities of the assumed friction values [1].
        error: relative error of the grip in use, from mass, torque and load [1].
    """
    return lower - slides * max(lower - (1.0 - error) * used, 0.0)
