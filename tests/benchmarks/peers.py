"""The benchmark's filter in plain NumPy and in filter libraries, for comparison of their speed. All
have the same process and measurement functions f and h, and the same noise covariances Q and R.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Any, NamedTuple

import numpy as np

from edge_agent.estimators.paper_aco_fckf import STEP_S, Setting
from schemas.numeric import FloatArray
from tests.benchmarks.reference import move, predict_measurement

PYTHON_STEPS = 300  # these filters are slow; this number is enough for a median


class Problem(NamedTuple):
    """Input of the compared filters: vehicle parameters (12,), sensor readings (T, 11), speed at
    the first reading [m/s], and time between readings [s].
    """

    row: FloatArray  # (12,) vehicle parameters
    readings: FloatArray  # (T, 11) sensor readings
    gone: float  # [s] time between readings
    speed: float  # [m/s] speed at the first reading

    def start(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return mean (6,) and covariance (6, 6) of the initial state, covariance Q (6, 6) of the
        process noise per sample, and covariance R (3, 3) of the measurement noise.
        """
        setting = Setting()
        mean = np.array([self.speed, 0.0, *self.readings[0, :3], setting.mu])
        noise = np.diag(setting.process) * self.gone / STEP_S
        return mean, np.diag(setting.start), noise, np.diag(setting.noise)


class Peer(NamedTuple):
    """Filter that is made with another library.

    Attributes:
        drive: function that runs this filter over the readings.
        bar: smallest accepted value of the speed of our filter divided by the speed of this filter.
    """

    drive: Callable[[Problem], object]
    bar: float


def by_numpy(problem: Problem) -> FloatArray:
    """Run a cubature filter on NumPy arrays, with all sigma points computed together. Return the
    mean (6,) after the last reading.
    """
    mean, cov, noise, R = problem.start()
    n = len(mean)
    xi = np.sqrt(n) * np.concatenate([np.eye(n), -np.eye(n)])
    for k in range(1, PYTHON_STEPS + 1):
        before = problem.readings[k - 1]
        now = problem.readings[k]
        points = move(mean + xi @ np.linalg.cholesky(cov).T, problem.row, before, now, problem.gone)
        mean = points.mean(0)
        cov = (points - mean).T @ (points - mean) / len(xi) + noise
        points = mean + xi @ np.linalg.cholesky(cov).T
        outcomes = predict_measurement(points)
        expected = outcomes.mean(0)
        S = (outcomes - expected).T @ (outcomes - expected) / len(xi) + R
        K = np.linalg.solve(S, (outcomes - expected).T @ (points - mean) / len(xi)).T
        mean = mean + K @ (now[:3] - expected)
        cov = cov - K @ S @ K.T
    return mean


def by_filterpy(problem: Problem) -> FloatArray:
    """Run filterpy's cubature filter over the readings. Return the mean (6, 1) after the last
    reading.
    """
    from filterpy.kalman import CubatureKalmanFilter

    inputs: dict[str, FloatArray] = {}

    def f(x: FloatArray, gone: float) -> FloatArray:
        return move(x.reshape(1, -1), problem.row, inputs["before"], inputs["now"], gone).reshape(
            x.shape
        )

    def h(x: FloatArray) -> FloatArray:
        return predict_measurement(x.reshape(1, -1)).reshape(3, *x.shape[1:])

    made = CubatureKalmanFilter(6, 3, problem.gone, h, f)
    mean, made.P, made.Q, made.R = problem.start()
    made.x = mean.reshape(made.x.shape)
    for k in range(1, PYTHON_STEPS + 1):
        inputs["before"] = problem.readings[k - 1]
        inputs["now"] = problem.readings[k]
        made.predict()
        made.update(problem.readings[k, :3].reshape(made.z.shape if made.z.size == 3 else (3, 1)))
    return np.asarray(made.x)


def by_stonesoup(problem: Problem) -> FloatArray:
    """Run Stone Soup's cubature predictor and updater over the readings. Return the mean (6, 1)
    after the last reading.
    """
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.base import TransitionModel
    from stonesoup.predictor.kalman import CubatureKalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import CubatureKalmanUpdater

    mean, cov, noise, R = problem.start()
    inputs: dict[str, FloatArray] = {}

    class Motion(TransitionModel):  # type: ignore[misc]
        """Transition model of Stone Soup with the benchmark's process function f and noise
        covariance Q.
        """

        ndim_state = 6

        def function(self, state: Any, noise: bool = False, **rest: object) -> Any:  # noqa: ANN401
            points = np.asarray(state.state_vector, dtype=float)
            moved = move(points.T, problem.row, inputs["before"], inputs["now"], problem.gone).T
            return type(state.state_vector)(moved)

        def covar(self, **rest: object) -> FloatArray:
            return noise

        def rvs(self, *args: object, **rest: object) -> FloatArray:
            return np.zeros((6, 1))

        def pdf(self, *args: object, **rest: object) -> float:
            return 0.0

    predictor = CubatureKalmanPredictor(Motion())
    updater = CubatureKalmanUpdater(LinearGaussian(6, (2, 3, 4), R))
    began = datetime(2026, 1, 1)
    state = GaussianState(mean.reshape(-1, 1), cov, began)
    for k in range(1, PYTHON_STEPS + 1):
        inputs["before"] = problem.readings[k - 1]
        inputs["now"] = problem.readings[k]
        moment = began + timedelta(seconds=k * problem.gone)
        detection = Detection(problem.readings[k, :3].reshape(-1, 1), timestamp=moment)
        state = updater.update(SingleHypothesis(predictor.predict(state, moment), detection))
    return np.asarray(state.state_vector, dtype=float)


PEERS = {
    "numpy": Peer(by_numpy, 100),
    "filterpy": Peer(by_filterpy, 500),
    "stonesoup": Peer(by_stonesoup, 500),
}
