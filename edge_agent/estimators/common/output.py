"""The output columns that every estimator writes; friction as the interval of a Gaussian.

Friction is reported as the Gaussian's median and 5 % and 95 % quantiles, clipped to the range of
the friction grid. The papers' filters cannot separate the evidence of one visit from their prior.
Therefore their bank has no evidence, and the agent publishes friction with its interval.
"""

from __future__ import annotations

import math

from edge_agent.dynamics.slip import SLOWEST_M_S
from edge_agent.estimators.common.motion import UNKNOWN_V_STD
from edge_agent.estimators.estimates import Column
from edge_agent.filters.cholesky import variance
from schemas.mugrid import LOWER, UPPER
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.thresholds import Z_95

# what is known of the friction of a road nobody has measured: moments of the uniform prior
PRIOR_MU = 0.5 * (LOWER + UPPER)
PRIOR_MU_STD = (UPPER - LOWER) / math.sqrt(12.0)


@compiled
def write_motion(
    output: FloatArray,
    vx: float,
    vy: float,
    yaw_rate: float,
    var_x: float,
    var_y: float,
    var_rate: float,
) -> None:
    """Write the motion [m/s, rad/s] with its variances."""
    speed = max(abs(vx), SLOWEST_M_S)
    output[Column.VX], output[Column.VY], output[Column.YAW_RATE] = vx, vy, yaw_rate
    output[Column.SIDESLIP] = math.atan2(vy, speed)
    output[Column.VX_STD], output[Column.VY_STD] = math.sqrt(var_x), math.sqrt(var_y)
    output[Column.YAW_RATE_STD] = math.sqrt(var_rate)
    output[Column.SIDESLIP_STD] = math.sqrt(var_y + (vy / speed) ** 2 * var_x) / speed


@compiled
def write_states(output: FloatArray, mean: FloatArray, root: FloatArray, yaw_rate: int) -> None:
    """Write the motion of a filter whose first states are v_x and v_y, and whose state `yaw_rate`
    is the yaw rate.
    """
    write_motion(
        output,
        mean[0],
        mean[1],
        mean[yaw_rate],
        variance(root, 0),
        variance(root, 1),
        variance(root, yaw_rate),
    )


@compiled
def write_quality(
    output: FloatArray, utilised: float, nis: float, adaptation: float, log_likelihood: float
) -> None:
    """Write the grip in use and the statistics of the innovations."""
    output[Column.MU_UTILISED], output[Column.INNOVATION_NIS] = utilised, nis
    output[Column.ADAPTATION], output[Column.INNOVATION_LOG_LIKELIHOOD] = adaptation, log_likelihood


@compiled
def write_friction(output: FloatArray, first: int, mu: float, std: float) -> None:
    """Write median, 5 % and 95 % of friction within its range, from column `first` on."""
    wide = Z_95 * std
    output[first] = min(max(mu, LOWER), UPPER)
    output[first + 1], output[first + 2] = (
        min(max(mu - wide, LOWER), UPPER),
        min(max(mu + wide, LOWER), UPPER),
    )


@compiled
def write_prior(output: FloatArray, first: int) -> None:
    """Write median, 5 % and 95 % of the uniform prior from column `first` on, for an unknown
    road.
    """
    output[first] = 0.5 * (LOWER + UPPER)
    output[first + 1], output[first + 2] = 0.95 * LOWER + 0.05 * UPPER, 0.05 * LOWER + 0.95 * UPPER


@compiled
def write_unknown(output: FloatArray) -> None:
    """Write the output before the first usable sample: the prior of friction, and zero motion with
    a wide spread.
    """
    write_motion(output, 0.0, 0.0, 0.0, UNKNOWN_V_STD**2, 1.0, 1.0)
    output[Column.SIDESLIP_STD] = 1.0
    write_quality(output, 0.0, 0.0, 1.0, 0.0)
    write_prior(output, Column.MU)
    for first in range(Column.WHEELS, output.shape[0], 3):
        write_prior(output, first)


@compiled
def limit_friction(mean: FloatArray, root: FloatArray, i: int, largest_std: float) -> None:
    """Limit friction, state i, to its range, and its spread to `largest_std`."""
    mean[i] = min(max(mean[i], LOWER), UPPER)
    std = math.sqrt(variance(root, i))
    if std > largest_std:
        for j in range(i + 1):
            root[i, j] *= largest_std / std
