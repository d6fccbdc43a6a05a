"""The friction of four wheels as states of a Gaussian filter: its return to the prior over the
distance driven, and the mean over the wheels.

Legend
    mu          friction of a wheel [1]
    P           covariance of the four frictions
    m_0, P_0    prior mean and covariance (moments of the uniform prior)
    lambda      distance constant of forgetting [m]

Over d metres mu' = m_0 + k*(mu - m_0) and P' = k^2*P + (1 - k^2)*P_0, with k = exp(-d/lambda).
Without evidence, friction thus returns to the prior.
"""

from __future__ import annotations

import math

import numpy as np

from edge_agent.estimators.common.output import PRIOR_MU, PRIOR_MU_STD
from edge_agent.filters.householder import triangularize
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

FORGET_M = 190.0  # [m] distance constant of forgetting: one road change per 190 m (errata)
# [s] time within which errors of the tyre model are correlated, so that all samples within it count
# as one measurement (errata)
INDEPENDENT_S = 0.2
DEMAND_HALF = 0.15  # [1] force over load at which the evidence on friction counts by half (errata)
# [1] correlation of friction between both sides, which are mostly on the same surface
SIDE_CORRELATION = 0.9


def prior_root() -> FloatArray:
    """Return the Cholesky factor (4, 4) of the prior covariance of the wheels' friction.

    The wheels of one side are almost equal, and the two sides are correlated. Wheel order fl, fr,
    rl, rr.
    """
    same = 0.99
    other = SIDE_CORRELATION
    correlation = np.array(
        [
            [1.0, other, same, other],
            [other, 1.0, other, same],
            [same, other, 1.0, other],
            [other, same, other, 1.0],
        ]
    )
    return np.asarray(PRIOR_MU_STD * np.linalg.cholesky(correlation))


PRIOR_ROOT = prior_root()


@compiled
def return_to_prior(mean: FloatArray, root: FloatArray, metres: float, work: FloatArray) -> None:
    """Move the estimated friction of four wheels towards the prior for a distance of `metres` [m],
    in place.

    `mean` (4,) and `root` (4, 4) are the friction and the root of its covariance; `work` is a
    scratch array (4, 8) or larger.
    """
    keep = math.exp(-metres / FORGET_M)
    fresh = math.sqrt(max(1.0 - keep * keep, 0.0))
    for i in range(4):
        mean[i] = PRIOR_MU + keep * (mean[i] - PRIOR_MU)
        for j in range(4):
            work[i, j] = keep * root[i, j]
            work[i, 4 + j] = fresh * PRIOR_ROOT[i, j]
    triangularize(work, 4, 8)
    for i in range(4):
        for j in range(4):
            root[i, j] = work[i, j] if j <= i else 0.0


@compiled
def dependence_factor(demand: float, dt: float) -> float:
    """Return the factor by which a filter increases the standard deviation of a measurement, for a
    sample `dt` [s] after the previous one, at a force of `demand` [g].

    The factor grows for two reasons. Errors of the model last for INDEPENDENT_S, so all samples
    within this time together count as one measurement. At small forces, a measurement is mostly
    slip noise, which carries no information on friction.
    """
    return math.sqrt(max(INDEPENDENT_S / dt, 1.0) * (1.0 + (DEMAND_HALF / max(demand, 1e-2)) ** 4))


@compiled
def visible_share(demand: float) -> float:
    """Return the share of the standard deviation of friction that a measurement may reduce, at a
    force of `demand` [g]. It is near 0 at low demand, because the measurement then hardly depends
    on friction, and near 1 at high demand.
    """
    used = (demand / DEMAND_HALF) ** 4
    return used / (1.0 + used)


@compiled
def mean_friction(mean: FloatArray, root: FloatArray, first: int) -> tuple[float, float]:
    """Return (mean, standard deviation) of the average friction of the four wheels. The frictions
    are the states `first` to `first` + 3 of a filter with mean `mean` and covariance root `root`.
    """
    total = 0.0
    square = 0.0
    for j in range(first + 4):
        column = 0.0
        for i in range(first, first + 4):
            column += 0.25 * root[i, j]
        square += column * column
    for i in range(first, first + 4):
        total += 0.25 * mean[i]
    return total, math.sqrt(square)
