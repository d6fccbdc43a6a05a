"""Functions that write the output columns that every estimator fills.

The papers' filters report friction as the median and the 5 % and 95 % quantiles of a Gaussian,
clipped to the range of the friction grid. These filters cannot separate the evidence of one visit
(the passage of one map cell) from their prior. Therefore they give no evidence, and the agent
publishes the friction interval instead.
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
from schemas.thresholds import SLIPPERY_MU, Z_95

# Mean and standard deviation of the uniform prior of friction, for a road without measurements
PRIOR_MU = 0.5 * (LOWER + UPPER)
PRIOR_MU_STD = (UPPER - LOWER) / math.sqrt(12.0)


@compiled
def write_motion(
    output: FloatArray,
    motion: tuple[float, float, float],
    variances: tuple[float, float, float],
) -> None:
    """Write velocity [m/s], yaw rate [rad/s] and sideslip [rad] with their standard deviations to
    `output`, the estimates of one sample.

    `motion` is v_x, v_y [m/s] and yaw rate [rad/s]; `variances` are the variances of these three.
    """
    vx, vy, yaw_rate = motion
    var_x, var_y, var_rate = variances
    speed = max(abs(vx), SLOWEST_M_S)
    output[Column.VX] = vx
    output[Column.VY] = vy
    output[Column.YAW_RATE] = yaw_rate
    output[Column.SIDESLIP] = math.atan2(vy, speed)
    output[Column.VX_STD] = math.sqrt(var_x)
    output[Column.VY_STD] = math.sqrt(var_y)
    output[Column.YAW_RATE_STD] = math.sqrt(var_rate)
    output[Column.SIDESLIP_STD] = math.sqrt(var_y + (vy / speed) ** 2 * var_x) / speed


@compiled
def write_states(output: FloatArray, mean: FloatArray, root: FloatArray, yaw_rate: int) -> None:
    """Write the motion estimated by a filter with its standard deviations to `output`. `mean` is
    the state of the filter (elements 0 and 1 are v_x and v_y), and `root` the root of its
    covariance. `yaw_rate` is the index of the yaw rate.
    """
    write_motion(
        output,
        (mean[0], mean[1], mean[yaw_rate]),
        (variance(root, 0), variance(root, 1), variance(root, yaw_rate)),
    )


@compiled
def write_quality(
    output: FloatArray, utilised: float, nis: float, adaptation: float, log_likelihood: float
) -> None:
    """Write four quality figures of a sample to `output`: `utilised` (grip in use), `nis`
    (normalised squared difference of measurement and prediction), `adaptation` (largest factor on
    the measurement noise R), and the log-likelihood of the measurements.
    """
    output[Column.MU_UTILISED] = utilised
    output[Column.INNOVATION_NIS] = nis
    output[Column.ADAPTATION] = adaptation
    output[Column.INNOVATION_LOG_LIKELIHOOD] = log_likelihood


@compiled
def write_friction(output: FloatArray, first: int, mu: float, std: float) -> None:
    """Write the median, 5 % and 95 % quantiles of friction into columns `first` to `first` + 2. If
    these are the columns of the whole vehicle (`first` is Column.MU), also write P(mu <
    SLIPPERY_MU).

    `mu` and `std` are mean and standard deviation of the friction. Each quantile is clipped to the
    range of the friction grid.
    """
    if first == Column.MU:
        output[Column.P_SLIPPERY] = 0.5 * math.erfc((mu - SLIPPERY_MU) / (std * math.sqrt(2.0)))
    wide = Z_95 * std
    output[first] = min(max(mu, LOWER), UPPER)
    output[first + 1] = min(max(mu - wide, LOWER), UPPER)
    output[first + 2] = min(max(mu + wide, LOWER), UPPER)


@compiled
def write_prior(output: FloatArray, first: int) -> None:
    """Write the median, 5 % and 95 % quantiles of the uniform prior of friction (unknown road) into
    the columns `first` to `first` + 2 of `output`. If these are the columns of the whole vehicle,
    also write P(mu < SLIPPERY_MU).
    """
    if first == Column.MU:
        output[Column.P_SLIPPERY] = (SLIPPERY_MU - LOWER) / (UPPER - LOWER)
    output[first] = 0.5 * (LOWER + UPPER)
    output[first + 1] = 0.95 * LOWER + 0.05 * UPPER
    output[first + 2] = 0.05 * LOWER + 0.95 * UPPER


@compiled
def write_unknown(output: FloatArray) -> None:
    """Write to `output` the estimates before the first usable sample: the friction prior, and zero
    motion with a large standard deviation.
    """
    write_motion(output, (0.0, 0.0, 0.0), (UNKNOWN_V_STD**2, 1.0, 1.0))
    output[Column.SIDESLIP_STD] = 1.0
    write_quality(output, 0.0, 0.0, 1.0, 0.0)
    write_prior(output, Column.MU)
    for first in range(Column.WHEELS, output.shape[0], 3):
        write_prior(output, first)


@compiled
def limit_friction(mean: FloatArray, root: FloatArray, i: int, largest_std: float) -> None:
    """Clip state i of a filter, the friction, to its possible range in `mean` (n,). Reduce its
    standard deviation in the covariance root (n, n) to at most `largest_std`.
    """
    mean[i] = min(max(mean[i], LOWER), UPPER)
    std = math.sqrt(variance(root, i))
    if std > largest_std:
        for j in range(i + 1):
            root[i, j] *= largest_std / std
