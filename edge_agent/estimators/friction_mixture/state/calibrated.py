"""Prior of the filter's states for vehicles whose vehicle file contains a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from edge_agent.estimators.friction_mixture.state.constants import STATES, NodeState
from schemas.numeric import FloatArray
from schemas.signals import WHEELS
from schemas.thresholds import GRAVITY
from schemas.vehicle import Vehicle

# State -> (quantity of the calibration, deviation due to other effects that the state absorbs).
# Such effects are pitch and slope in a_x, toe and crossfall in the steering offset, another load,
# slip of a driven wheel that the nominal stiffness does not explain, and half a sample of delay.
# Smaller deviations (.03, .0003, .0005) made the intervals wider on six towns of rough cars,
# because effects that no state may absorb look like a contradiction.
LEARNED: Final[dict[int, tuple[str, float]]] = {
    NodeState.BIAS_X: ("ax", 0.12),
    NodeState.STEER: ("steer_offset", 0.0015),
    NodeState.GAIN: ("force_gain", 0.02),
    NodeState.LAG_WHEEL: ("wheel_lag", 0.006),
    NodeState.LAG_STEER: ("steer_lag", 0.006),
    NodeState.STEER_GAIN: ("steer_gain", 0.01),
    **{NodeState.RADIUS + i: (f"radius_{wheel}", 0.0015) for i, wheel in enumerate(WHEELS)},
}


# [rad] change of understeer per g that another load and other tyres cause
EACH_COMPLIANCE: Final = 0.003


def spreads_of(vehicles: Sequence[Vehicle], std: FloatArray) -> FloatArray:
    """Return the standard deviation of the prior of every filter state for every vehicle, (N,
    STATES). It is the common value `std` (STATES,), or a smaller one for a state that the vehicle's
    calibration has measured.

    The means of the priors are not changed, because `inputs.correct` has already corrected the
    signals by the calibration.
    """
    spreads = np.repeat(std[None, :STATES], len(vehicles), axis=0)
    for row, vehicle in zip(spreads, vehicles, strict=True):
        for state, (quantity, each_drive) in LEARNED.items() if vehicle.calibration else ():
            if (estimate := getattr(vehicle.calibration, quantity)) is not None:
                row[state] = min(row[state], np.hypot(estimate[1], each_drive))
        if vehicle.calibration is not None and vehicle.calibration.understeer is not None:
            learned = GRAVITY * vehicle.calibration.understeer[1]
            row[NodeState.COMPLIANCE] = min(
                row[NodeState.COMPLIANCE], np.hypot(learned, EACH_COMPLIANCE)
            )
    return spreads


def means_of(vehicles: Sequence[Vehicle], mean: FloatArray) -> FloatArray:
    """Return the mean of the prior of every filter state for every vehicle, (N, STATES). It is the
    common mean `mean` (STATES,) for every state except understeer (state COMPLIANCE).

    The understeer of a vehicle is the value learned from its drives. If there is none, it is
    computed from the axle data of the vehicle file. Without axle data, understeer also has the
    common mean.
    """
    means = np.repeat(mean[None, :STATES], len(vehicles), axis=0)
    for row, vehicle in zip(means, vehicles, strict=True):
        calibration = vehicle.calibration
        learned = None if calibration is None else calibration.understeer
        per_g = vehicle.understeer_per_g() if learned is None else GRAVITY * learned[0]
        if per_g is not None:
            row[NodeState.COMPLIANCE] = per_g
    return means
