"""Test for a diverged motion estimate, and for wheels that slide (health flag SLIDING)."""

from __future__ import annotations

import math

from edge_agent.dynamics.parameters import Parameter
from edge_agent.dynamics.slip import SLOWEST_M_S, along_wheel
from edge_agent.estimators import flags
from edge_agent.estimators.common.inputs import InputTrack
from edge_agent.estimators.common.readings import LIMITS
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import S

# [m/s] error of v_x from the wheel speeds, and of v_y, at the first sample
FIRST_V_STD = 0.3
UNKNOWN_V_STD = 15.0  # [m/s] error of v_x without any wheel speed
SLIDING_THETA = 3.0  # [1] normalised slip that is beyond the peak of every passenger car tyre
FASTEST_M_S = 150.0  # [m/s] An estimate beyond this limit has diverged.


@compiled
def has_diverged(mean: FloatArray, root: FloatArray, yaw_rate: int) -> bool:
    """Return True if a filter has diverged, that is, if its motion is not finite or physically
    impossible.

    `mean` (n,) is the state of the filter: elements 0 and 1 are v_x and v_y, and `yaw_rate` is the
    index of the yaw rate. `root` (n, n) is the root of its covariance.
    """
    bad = not (abs(mean[0]) < FASTEST_M_S and abs(mean[1]) < FASTEST_M_S)
    bad = bad or not abs(mean[yaw_rate]) < LIMITS[S.YAW_RATE]
    for i in range(mean.shape[0]):
        bad = bad or not math.isfinite(mean[i] + root[i, i])
    return bad


@compiled
def sliding_flag(row: FloatArray, track: InputTrack, vx: float, vy: float, mu: float) -> int:
    """Return the health flag SLIDING if the longitudinal slip of any wheel, at velocity vx, vy
    [m/s] and friction `mu`, lies beyond the peak of the tyre curve; else return 0.
    """
    health = 0
    yaw_rate = track.inputs[S.YAW_RATE]
    for wheel in range(4):
        along = along_wheel(
            row,
            wheel,
            vx,
            vy,
            yaw_rate,
            (track.steering[0, wheel], track.steering[1, wheel]),
        )
        gliding = (
            abs(row[Parameter.RADIUS] * track.inputs[S.OMEGA + wheel] - along)
            * row[Parameter.SLOPE_X]
        )
        health |= (
            flags.SLIDING if gliding > SLIDING_THETA * mu * max(abs(along), SLOWEST_M_S) else 0
        )
    return health
