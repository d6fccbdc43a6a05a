"""The friction filter of paper 003 as printed, and the unscented Kalman filter (UKF) with which the
paper compares it.

The four states are the frictions mu_fl, mu_fr, mu_rl, mu_rr of the wheels, a random walk. The
vehicle's motion is given. Both filters represent the state by unscented points. The measurement is
[a_x, a_y, r] (section 3.1). The code uses the change of the yaw rate r over one sample. Therefore
the third measurement is the yaw acceleration r' [rad/s^2]. With `torque_rows`, the measurement also
has the longitudinal force F_x of each wheel from its torque balance. Without these rows, only two
of the four frictions are observable on a straight road.

Legend: X_i, Z_i points of state and measurement, side weight w = 1/(2*alpha^2*n), e_i = Z_i - Z_0,
d = sum of w*e_i.

Square-root form (section 3.2): The square roots of covariances are computed by singular values.
With the printed alpha = .001 the central point has a weight of -10^6, which has no real root.
However, the following equation is exact, and all weights on its right side are positive:

    sum(W_i*(Z_i - z)*(Z_i - z)') = sum(w*e_i*e_i') + (beta - alpha^2)*d*d'

The code uses the right side, in single and in double precision.

Covariance form (section 3.1; "UKF" in the paper's comparison): The filter computes the sums as in
textbooks. Digits cancel in these sums, because the weights are about 10^6. In single precision the
covariance then has no Cholesky factor at some steps. The filter then uses the last valid factor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from edge_agent.estimators.literal.given_motion import GivenMotion
from edge_agent.estimators.literal.wheel_forces import WheelForces
from schemas.numeric import FloatArray
from schemas.signals import S

STATES: Final = 4


class UnscentedSetting(NamedTuple):
    """Variances and options of the friction filter of paper 003."""

    alpha: float = 0.001
    beta: float = 2.0
    kappa: float = 0.0
    process: float = 1e-4  # Q of each friction per sample; the paper says "a slight noise variance"
    noise: tuple[float, float, float] = (1e-3, 1e-3, 1e-4)  # R of a_x, a_y, r'
    torque_noise: float = 1.0  # R of the wheels' forces [N^2]
    start: float = 0.25  # P_0: initial variance
    mu: float = 0.8  # [1] initial friction
    torque_rows: bool = True
    proportional: bool = True  # True if stiffness is proportional to friction
    square_root: bool = True
    single: bool = False


AS_PRINTED: Final = UnscentedSetting()
"""Setting of the paper, with the printed alpha, kappa and beta. Q, R and P_0 are lost in the text
copy; their sizes here follow its description.
"""
UKF: Final = UnscentedSetting(square_root=False)
UKF_SINGLE: Final = UnscentedSetting(square_root=False, single=True)


@dataclass(frozen=True)
class FrictionRun:
    """Result of a run: friction of the wheels over a drive (T, 4), and the share of steps whose
    covariance had no Cholesky factor.
    """

    mu: FloatArray
    lost: float


def estimate(motion: GivenMotion, setting: UnscentedSetting) -> FrictionRun:
    """Run the friction filter of paper 003 as printed over a drive; return the friction of the four
    wheels at each sample, and the share of failed factorisations.
    """
    model = _Model(motion, setting)
    steps = len(motion.t)
    mu = np.empty((steps, STATES))
    mean = np.full(STATES, setting.mu, model.kind)
    root = np.eye(STATES, dtype=model.kind) * np.sqrt(setting.start).astype(model.kind)
    mu[0] = mean
    lost = 0
    step = _square_root_step if setting.square_root else _covariance_step
    covariance = root @ root.T
    for k in range(1, steps):
        mean, covariance, root, failed = step(model, k, mean, covariance, root)
        lost += failed
        mu[k] = mean
    return FrictionRun(mu, lost / (steps - 1))


class _Model:
    """Measurement model of the friction filter of paper 003: the measurements of a drive, and the
    function that predicts them, in single or double precision.
    """

    def __init__(self, motion: GivenMotion, setting: UnscentedSetting) -> None:
        self.setting = setting
        self.kind: Any = np.float32 if setting.single else np.float64
        self.forces = WheelForces.for_drive(
            motion, proportional=setting.proportional, single=setting.single
        )
        signals = motion.signals
        turning = np.diff(signals[:, S.YAW_RATE], prepend=signals[0, S.YAW_RATE]) / motion.step
        rows = [signals[:, S.AX], signals[:, S.AY], turning]
        noise = list(setting.noise)
        if setting.torque_rows:
            rows += list(motion.wheel_forces().T)
            noise += [setting.torque_noise] * 4
        self.readings: FloatArray = np.stack(rows, axis=1).astype(self.kind)
        self.noise_root: FloatArray = np.diag(np.sqrt(noise)).astype(self.kind)
        process = np.sqrt(setting.process) * np.eye(STATES)
        self.process_root: FloatArray = process.astype(self.kind)
        scale = setting.alpha**2 * (STATES + setting.kappa)
        self.spread = self.kind(np.sqrt(scale))
        self.side = self.kind(0.5 / scale)
        centre = (scale - STATES) / scale
        self.mean_weights = np.full(2 * STATES + 1, self.side)
        self.cov_weights = self.mean_weights.copy()
        self.mean_weights[0] = centre
        self.cov_weights[0] = centre + 1.0 - setting.alpha**2 + setting.beta
        self.bend = self.kind(np.sqrt(setting.beta - setting.alpha**2))

    def sigma_points(self, mean: FloatArray, root: FloatArray) -> FloatArray:
        """Return the unscented points (9, 4) of the state for its mean (4,) and covariance root (4,
        4).
        """
        spread = self.spread * root.T
        return np.concatenate([mean[None], mean + spread, mean - spread])

    def predicted_measurements(self, k: int, points: FloatArray) -> FloatArray:
        """Return the measurements at sample `k` that the states `points` (9, 4) predict, (9, number
        of measurements).
        """
        force = self.forces.tyre_forces(k, points)
        accelerations = self.forces.body_accelerations(k, force)
        if not self.setting.torque_rows:
            return accelerations
        return np.concatenate([accelerations, force[..., 0]], axis=1)


def _root_of(columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a square root of the covariance columns*columns', as the singular vectors U and the
    singular values s of `columns`: columns*columns' = U*s^2*U'. The values s are never negative.
    """
    axes, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return axes, sizes


def _square_root_step(
    model: _Model, k: int, mean: FloatArray, covariance: FloatArray, root: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, bool]:
    """Run one step of the friction filter in square-root form. Return (mean, covariance, root,
    False).

    This form does not use `covariance` and returns it unchanged. False states that no Cholesky
    factor was missing; this form needs none.
    """
    axes, sizes = _root_of(np.concatenate([root, model.process_root], axis=1))
    points = model.sigma_points(mean, axes * sizes)
    outcomes = model.predicted_measurements(k, points)
    side = np.sqrt(model.side)
    state = side * (points[1:] - points[0]).T
    bent = (outcomes[1:] - outcomes[0]).T
    deviation = model.side * bent.sum(axis=1)
    measured = np.concatenate([side * bent, model.bend * deviation[:, None]], axis=1)
    state = np.concatenate([state, np.zeros((STATES, 1), model.kind)], axis=1)
    axes, sizes = _root_of(np.concatenate([measured, model.noise_root], axis=1))
    gain = (state @ measured.T) @ (axes / sizes**2) @ axes.T
    innovation = model.readings[k] - outcomes[0] - deviation
    after, lengths = _root_of(
        np.concatenate([state - gain @ measured, gain @ model.noise_root], axis=1)
    )
    return mean + gain @ innovation, covariance, after * lengths, False


def _cholesky_or_last(covariance: FloatArray, last: FloatArray) -> tuple[FloatArray, bool]:
    """Return (Cholesky factor of `covariance`, False). If rounding has left no factor, return
    (`last`, True), the last valid factor.
    """
    try:
        return np.asarray(np.linalg.cholesky(covariance)), False
    except np.linalg.LinAlgError:
        return last, True


def _covariance_step(
    model: _Model, k: int, mean: FloatArray, covariance: FloatArray, root: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, bool]:
    """Run one step of the friction filter in covariance form, as in textbooks.

    Return (mean, covariance, root, True if a Cholesky factor was missing).
    """
    root, lost = _cholesky_or_last(covariance, root)
    points = model.sigma_points(mean, root)
    mean = model.mean_weights @ points
    off = points - mean
    covariance = (model.cov_weights[:, None] * off).T @ off + model.process_root**2
    root, lost_again = _cholesky_or_last(covariance, root)
    points = model.sigma_points(mean, root)
    outcomes = model.predicted_measurements(k, points)
    predicted = model.mean_weights @ outcomes
    off = points - mean
    deviations = outcomes - predicted
    weighted = model.cov_weights[:, None] * deviations
    expected = weighted.T @ deviations + model.noise_root**2
    cross = (model.cov_weights[:, None] * off).T @ deviations
    gain = np.linalg.solve(expected, cross.T).T
    innovation = model.readings[k] - predicted
    after = covariance - gain @ expected @ gain.T
    return mean + gain @ innovation, after, root, lost or lost_again
