"""Relaxation of the tyres. A tyre builds up its force over a distance that it rolls, so its force
follows the slip of the wheel with a delay, which is long at low speed.

    ds'/dt = (v/σ) (s − s')

    s    slip of the wheel, along or across it [1]
    s'   slip that belongs to the tyre's force [1]
    v    speed of the wheel over the ground or of its tread, the larger of both [m/s]
    σ    relaxation length [m]

This is the first-order model of Pacejka, Tyre and Vehicle Dynamics, 3rd ed., chapter 7. There, the
relaxation length decreases with the slip, and a sliding tyre responds at once. Here, a constant
share of the slip acts at once instead.
"""

from __future__ import annotations

import math

from edge_agent.dynamics.slip import SLOWEST_M_S, wheel_slips
from edge_agent.estimators.friction_mixture.state.constants import Constants
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from edge_agent.estimators.friction_mixture.state.workspace import BlockFeatures
from schemas.runtime.jit import compiled


@compiled
def relax_slips(
    memory: MixtureMemory,
    constants: Constants,
    features: BlockFeatures,
    velocity: tuple[float, float],
) -> None:
    """Compute the mean difference s' − s over the block (the samples within 0.05 s), for each wheel
    along and across, and advance the slips s' in `memory` to the end of the block. The differences
    are written to `features`.

    The slips are computed with `velocity`, the velocity (v_x, v_y) [m/s] of the whole mixture, mean
    over the block. The friction hypotheses have almost the same velocity, so they share the
    differences.
    """
    vx, vy = velocity
    for wheel in range(4):
        rolling = features.rolling[wheel]
        cos = features.steer_cos[wheel]
        sin = features.steer_sin[wheel]
        along = cos * vx + sin * vy + features.turn_along[wheel]
        across = cos * vy - sin * vx + features.turn_across[wheel]
        slip_x, slip_y = wheel_slips(1.0, rolling, along, across)
        speed = max(abs(along), SLOWEST_M_S)
        fastest = speed if math.isnan(rolling) else max(speed, abs(rolling))
        rolled = fastest * features.duration / constants.physical.relaxation_length
        delayed = (1.0 - constants.physical.direct_slip) / rolled
        for slip, built, late in (
            (slip_x, memory.built_along, features.late_along),
            (slip_y, memory.built_across, features.late_across),
        ):
            if math.isnan(slip):  # an unknown slip is not delayed
                built[wheel] = math.nan
                late[wheel] = 0.0
                continue
            before = 0.0 if math.isnan(built[wheel]) else built[wheel] - slip
            after = before * math.exp(-rolled)
            built[wheel] = slip + after
            late[wheel] = delayed * (before - after)
