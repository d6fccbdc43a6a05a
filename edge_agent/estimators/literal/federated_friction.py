"""The friction filter of paper 000 as printed: two cubature sub-filters, and a master that fuses
their results. The vehicle's motion is given. Numbers in brackets are the paper's equations.

The state is [mu_fl, mu_fr, mu_rl, mu_rr], a random walk (28). The first sub-filter measures [a_x,
a_y, r], and the second [a_y, r] (53). F_x follows from wheel torque (10).

Legend
    P_f, Q      covariance and process noise of the master
    beta_i      information share of sub-filter i; its P_i = P_f/beta_i, Q_i = Q/beta_i (15) to (20)

The information shares follow from (54), which gives more information to the worse sub-filter. The
cubature points use singular values (40), (41).

The code differs from the paper in two points. Both information shares start at one half, because
the printed start value of zero would cause a division by zero. In (52), the code uses P_f where the
paper prints the inverse of P_f.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from edge_agent.estimators.literal.given_motion import GivenMotion
from edge_agent.estimators.literal.wheel_forces import WheelForces
from edge_agent.estimators.literal.wheel_friction_ukf import FrictionRun
from schemas.numeric import FloatArray
from schemas.signals import S

STATES: Final = 4
LEAST_SHARE: Final = 0.01  # [1] smallest information share of a sub-filter


class FederatedSetting(NamedTuple):
    """Settings of the friction filter of paper 000 as printed: variances, initial friction and tyre
    option.
    """

    process: float = 1.0  # Q: variance that each friction gains per sample
    start: float = 1.0  # P_0: initial variance
    first: tuple[float, float, float] = (90.0, 1e4, 1e4)  # R of sub-filter 1: a_x, a_y, r
    second: tuple[float, float] = (1e4, 1e4)  # R of sub-filter 2: a_y, r
    mu: float = 1.0
    proportional: bool = True


AS_PRINTED: Final = FederatedSetting()
"""Setting of the paper (equation 57)."""


def estimate(motion: GivenMotion, setting: FederatedSetting) -> FrictionRun:
    """Run the friction filter of paper 000 as printed over a drive. Return the friction of the four
    wheels at each sample, (T, 4), in a `FrictionRun`.
    """
    forces = WheelForces.for_drive(motion, proportional=setting.proportional, single=False)
    given_x = motion.wheel_forces()
    signals = motion.signals
    noise = (np.diag(setting.first), np.diag(setting.second))
    mu = np.empty((len(motion.t), STATES))
    mean = np.full(STATES, setting.mu)
    covariance: FloatArray = setting.start * np.eye(STATES)
    shares = np.array([0.5, 0.5])
    mu[0] = mean
    for k in range(1, len(motion.t)):
        inverse = np.zeros((STATES, STATES))
        information = np.zeros(STATES)
        sizes = np.empty(2)
        for sub in range(2):
            predicted = (covariance + setting.process * np.eye(STATES)) / shares[sub]
            points = _cubature_points(mean, predicted)
            force = forces.tyre_forces(k, points)
            force[..., 0] = given_x[k]
            outcomes = forces.body_accelerations(k, force)
            outcomes[:, 2] = signals[k - 1, S.YAW_RATE] + motion.step * outcomes[:, 2]
            reading = signals[k, [S.AX, S.AY, S.YAW_RATE]]
            local, spread = _update_sub_filter(
                mean, predicted, points, outcomes[:, sub:], reading[sub:], noise[sub]
            )
            sizes[sub] = np.trace(spread)
            part = np.linalg.inv(spread)
            inverse += part
            information += part @ local
        covariance = np.asarray(np.linalg.inv(inverse), float)
        mean = covariance @ information
        shares = np.clip(sizes / sizes.sum(), LEAST_SHARE, 1.0 - LEAST_SHARE)
        mu[k] = mean
    return FrictionRun(mu, 0.0)


def _cubature_points(mean: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the cubature points (8, 4) of a state with mean (4,) and covariance (4, 4). The square
    root of the covariance is computed by singular values.
    """
    axes, sizes, _ = np.linalg.svd(covariance)
    spread = np.sqrt(STATES) * (axes * np.sqrt(sizes)).T
    return np.concatenate([mean + spread, mean - spread])


def _update_sub_filter(
    mean: FloatArray,
    covariance: FloatArray,
    points: FloatArray,
    outcomes: FloatArray,
    reading: FloatArray,
    noise: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return mean (4,) and covariance (4, 4) of a sub-filter after its measurement update,
    equations (42) to (48) of paper 000.
    """
    predicted = outcomes.mean(axis=0)
    deviations = outcomes - predicted
    off = points - mean
    count = len(points)
    expected = deviations.T @ deviations / count + noise
    gain = np.linalg.solve(expected, deviations.T @ off / count).T
    return mean + gain @ (reading - predicted), covariance - gain @ expected @ gain.T
