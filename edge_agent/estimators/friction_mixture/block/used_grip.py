"""Reported grip in use: the larger force over load of the two axles, smoothed over `abrupt_time`.

The reported value is the largest one of the last second. The force is smoothed first, because the
largest of twenty noisy values would show the sensor noise more than the tyre forces. The filter
also weights its evidence on friction by the force over load; for this purpose the force is not
smoothed.

Where torque is missing while the car brakes, both axles are assumed to have the same brake force
per load. ABS and brake-force distribution have this effect near the limit. With a fixed share
instead, the force of an unloaded rear axle would exceed the grip of any tyre.
"""

from __future__ import annotations

import math

from edge_agent.estimators.friction_mixture.state.constants import Constants
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from edge_agent.estimators.friction_mixture.state.workspace import BlockFeatures
from schemas.runtime.jit import compiled
from schemas.thresholds import GRAVITY

# [1] largest reported grip. Tyres of road cars cannot use more; a larger value comes from a bump or
# from a wrong load.
MOST_USED = 1.5


@compiled
def used_grip(memory: MixtureMemory, constants: Constants, features: BlockFeatures) -> float:
    """Return the grip in use [1]: the larger force over load of the two axles, smoothed over time.
    The smoothed forces in `memory` are updated with the block (the samples within 0.05 s).
    """
    share = 1.0 - math.exp(-features.duration / constants.physical.abrupt_time)
    most = 0.0
    for axle in range(2):
        left = 2 * axle
        right = left + 1
        along = (
            features.load_share[left] * features.force[left]
            + features.load_share[right] * features.force[right]
        )
        if (
            features.change < 0.0
            and features.force_unit[left] != 0.0
            and features.force_unit[right] != 0.0
        ):
            along = features.change / GRAVITY
        side = features.side[axle]
        force = memory.axle_force
        force[axle, 0] += share * (along - force[axle, 0])
        force[axle, 1] += share * ((0.0 if math.isnan(side) else side) - force[axle, 1])
        most = max(most, math.hypot(force[axle, 0], force[axle, 1]))
    return min(most, MOST_USED)
