"""What the papers' estimators tell, and what they have in common: N Gaussian filters that step once a sample.

Friction is told by the Gaussian's median and 5 % and 95 % quantiles, clipped to the range of the friction grid. None of
these filters tells what a visit's measurements alone say, so their bank has no evidence: the agent publishes friction
with its interval.
"""

from __future__ import annotations

import math

from edge_agent.dynamics.parameters import P
from edge_agent.dynamics.slip import SLOWEST_M_S, along_wheel
from edge_agent.estimators import flags
from edge_agent.estimators.estimates import Y
from edge_agent.estimators.gaussian.intake import Track
from edge_agent.filters.cholesky import variance
from schemas.mugrid import LOWER, UPPER
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import S
from schemas.thresholds import Z_95

# what is known of the friction of a road nobody has measured: moments of the uniform prior
PRIOR_MU = 0.5 * (LOWER + UPPER)
PRIOR_MU_STD = (UPPER - LOWER) / math.sqrt(12.0)
FIRST_V_STD = 0.3  # [m/s] of the speed from wheels, and of the lateral speed, at the first sample
UNKNOWN_V_STD = 15.0  # [m/s] without any wheel speed
SLIDING_THETA = 3.0  # normalised slip beyond the peak of every passenger tyre's curve
FASTEST_M_S = 150.0  # an estimate beyond has diverged
FASTEST_TURN = 20.0  # [rad/s]


@compiled
def tell_motion(
    told: FloatArray, vx: float, vy: float, yaw_rate: float, var_x: float, var_y: float, var_rate: float
) -> None:
    """The motion [m/s, rad/s] with its variances."""
    speed = max(abs(vx), SLOWEST_M_S)
    told[Y.VX], told[Y.VY], told[Y.YAW_RATE], told[Y.SIDESLIP] = vx, vy, yaw_rate, math.atan2(vy, speed)
    told[Y.VX_STD], told[Y.VY_STD], told[Y.YAW_RATE_STD] = math.sqrt(var_x), math.sqrt(var_y), math.sqrt(var_rate)
    told[Y.SIDESLIP_STD] = math.sqrt(var_y + (vy / speed) ** 2 * var_x) / speed


@compiled
def tell_rest(told: FloatArray, utilised: float, nis: float, adaptation: float, log_likelihood: float) -> None:
    """Grip used, and how the innovations were."""
    told[Y.MU_UTILISED], told[Y.INNOVATION_NIS] = utilised, nis
    told[Y.ADAPTATION], told[Y.INNOVATION_LOG_LIKELIHOOD] = adaptation, log_likelihood


@compiled
def interval(mu: float, std: float) -> tuple[float, float, float]:
    """(median, 5 %, 95 %) of friction, within its range."""
    wide = Z_95 * std
    return (
        min(max(mu, LOWER), UPPER), min(max(mu - wide, LOWER), UPPER), min(max(mu + wide, LOWER), UPPER),
    )  # fmt: skip


@compiled
def tell_prior(told: FloatArray) -> None:
    """Median, 5 % and 95 % of the uniform prior: nothing is known of the road."""
    told[Y.MU], told[Y.MU_LOWER], told[Y.MU_UPPER] = (
        0.5 * (LOWER + UPPER), 0.95 * LOWER + 0.05 * UPPER, 0.05 * LOWER + 0.95 * UPPER,
    )  # fmt: skip


@compiled
def tell_nothing(told: FloatArray) -> None:
    """What is said before the first usable sample."""
    tell_motion(told, 0.0, 0.0, 0.0, UNKNOWN_V_STD**2, 1.0, 1.0)
    told[Y.SIDESLIP_STD] = 1.0
    tell_prior(told)
    tell_rest(told, 0.0, 0.0, 1.0, 0.0)


@compiled
def tell_wheel(told: FloatArray, wheel: int, mu: float, std: float) -> None:
    """Friction of one wheel."""
    told[Y.WHEELS + 3 * wheel + 0], told[Y.WHEELS + 3 * wheel + 1], told[Y.WHEELS + 3 * wheel + 2] = interval(mu, std)


@compiled
def tell_no_wheel(told: FloatArray) -> None:
    """The prior of each wheel, before the first usable sample."""
    for wheel in range(4):
        told[Y.WHEELS + 3 * wheel + 0], told[Y.WHEELS + 3 * wheel + 1] = told[Y.MU], told[Y.MU_LOWER]
        told[Y.WHEELS + 3 * wheel + 2] = told[Y.MU_UPPER]


@compiled
def hold_mu(mean: FloatArray, root: FloatArray, i: int, largest_std: float) -> None:
    """Keep friction, state i, in its range, and its spread within what the range allows."""
    mean[i] = min(max(mean[i], LOWER), UPPER)
    std = math.sqrt(variance(root, i))
    if std > largest_std:
        for j in range(i + 1):
            root[i, j] *= largest_std / std


@compiled
def lost(mean: FloatArray, root: FloatArray, vx: int, vy: int, yaw_rate: int) -> bool:
    """Whether a filter has diverged; yaw_rate -1 where it is no state."""
    bad = not (abs(mean[vx]) < FASTEST_M_S and abs(mean[vy]) < FASTEST_M_S)
    if yaw_rate >= 0:
        bad = bad or not abs(mean[yaw_rate]) < FASTEST_TURN
    for i in range(mean.shape[0]):
        bad = bad or not math.isfinite(mean[i] + root[i, i])
    return bad


@compiled
def sliding(row: FloatArray, track: Track, vx: float, vy: float, mu: float) -> int:
    """The health flag of a wheel past its peak by longitudinal slip, at the inputs in use."""
    health = 0
    for wheel in range(4):
        along = along_wheel(row, wheel, vx, vy, track.use[S.YAW_RATE], track.turned[0, wheel], track.turned[1, wheel])
        gliding = abs(row[P.RADIUS] * track.use[S.OMEGA + wheel] - along) * row[P.SLOPE_X]
        health |= flags.SLIDING if gliding > SLIDING_THETA * mu * max(abs(along), SLOWEST_M_S) else 0
    return health
