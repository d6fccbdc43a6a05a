"""The bank of the papers' estimators: N Gaussian filters (mean (N, n), sqrt_cov (N, n, n)) through one compiled path.

Every estimator brings its memory, its design and a kernel that takes the samples; the bank checks shapes and names
the outputs. Friction is told by the Gaussian's median and 5 % and 95 % quantiles, clipped to the range of the friction
grid. None of these filters tells what a visit's measurements alone say, so `evidence` is None: the agent publishes
friction with its interval.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from edge_agent.dynamics.parameters import P
from edge_agent.dynamics.slip import SLOWEST_M_S, wheel_velocity
from edge_agent.estimators import flags
from edge_agent.estimators.friction_mixture.bank import OUTPUTS, Estimates, FlagArray
from edge_agent.estimators.gaussian.intake import Track, new_track
from edge_agent.estimators.shares import checked, in_shares
from schemas.mugrid import LOWER, UPPER
from schemas.numeric import BoolArray, FloatArray, compiled
from schemas.signals import S

# what is known of the friction of a road nobody has measured: moments of the uniform prior
PRIOR_MU = 0.5 * (LOWER + UPPER)
PRIOR_MU_STD = (UPPER - LOWER) / math.sqrt(12.0)
QUANTILE_95 = 1.6448536269514722  # of the standard normal
FIRST_V_STD = 0.3  # [m/s] of the speed from wheels, and of the lateral speed, at the first sample
UNKNOWN_V_STD = 15.0  # [m/s] without any wheel speed
SLIDING_THETA = 3.0  # normalised slip beyond the peak of every passenger tyre's curve
FASTEST_M_S = 150.0  # an estimate beyond has diverged
FASTEST_TURN = 20.0  # [rad/s]

M = TypeVar("M")


class Stretch(NamedTuple):
    """The next samples of N vehicles, and where their estimates go."""

    rows: FloatArray  # (N, len(P)) parameters
    t: FloatArray  # (T, N) [s]
    signals: FloatArray  # (T, N, 18)
    out: FloatArray  # (15, T, N) in the order of OUTPUTS
    wheels: FloatArray  # (T, N, 4, 3), or (0, N, 4, 3) where friction is one
    health: FlagArray  # (T, N)


Kernel = Callable[[M, Track, Stretch, int, int], None]


class Bank(Protocol):
    """What steps N vehicles at once; see `EstimatorBank.advance`."""

    def advance(
        self, t: FloatArray, signals: FloatArray, closes: BoolArray | None = None, *, threads: int = 1
    ) -> Estimates:
        """Take the next samples of all vehicles."""
        ...


class GaussianBank(Generic[M]):
    """N filters of one paper; made by `create`.

    kernel(memory, track, stretch, first, last) fills what belongs to the vehicles [first, last).
    """

    def __init__(self, rows: FloatArray, memory: M, kernel: Kernel[M], *, wheels: bool = False) -> None:
        self._rows, self._memory, self._kernel, self._wheels = rows, memory, kernel, wheels
        self._track = new_track(len(rows))

    def advance(
        self, t: FloatArray, signals: FloatArray, closes: BoolArray | None = None, *, threads: int = 1
    ) -> Estimates:
        """Take the next samples; arguments and errors as `EstimatorBank.advance`, but no evidence is told."""
        count = len(self._rows)
        t, signals = checked(t, signals, closes, count)
        out, health = np.empty((len(OUTPUTS), *t.shape)), np.zeros(t.shape, np.int32)
        wheels = np.empty((t.shape[0] if self._wheels else 0, count, 4, 3))
        stretch = Stretch(self._rows, t, signals, out, wheels, health)
        in_shares(
            lambda _, first, last: self._kernel(self._memory, self._track, stretch, first, last), count, threads
        )  # fmt: skip
        return Estimates._make((*out, health, wheels if self._wheels else None, None))


@compiled
def tell_motion(
    out: FloatArray, vx: float, vy: float, yaw_rate: float, var_x: float, var_y: float, var_rate: float
) -> None:
    """Outputs of the motion [m/s, rad/s] with its variances."""
    speed = max(abs(vx), SLOWEST_M_S)
    out[0], out[1], out[2], out[3] = vx, vy, yaw_rate, math.atan2(vy, speed)
    out[4], out[5], out[6] = math.sqrt(var_x), math.sqrt(var_y), math.sqrt(var_rate)
    out[7] = math.sqrt(var_y + (vy / speed) ** 2 * var_x) / speed


@compiled
def interval(mu: float, std: float, out: FloatArray) -> None:
    """out (3,) = median, 5 % and 95 % of friction, within its range."""
    out[0] = min(max(mu, LOWER), UPPER)
    out[1] = min(max(mu - QUANTILE_95 * std, LOWER), UPPER)
    out[2] = min(max(mu + QUANTILE_95 * std, LOWER), UPPER)


@compiled
def prior_interval(out: FloatArray) -> None:
    """out (3,) = median, 5 % and 95 % of the uniform prior: nothing is known of the road."""
    out[0], out[1], out[2] = 0.5 * (LOWER + UPPER), 0.95 * LOWER + 0.05 * UPPER, 0.05 * LOWER + 0.95 * UPPER


@compiled
def tell_nothing(out: FloatArray) -> None:
    """Outputs (15,) before the first usable sample."""
    out[:] = 0.0
    out[4], out[5], out[6], out[7] = UNKNOWN_V_STD, 1.0, 1.0, 1.0
    prior_interval(out[8:11])
    out[13] = 1.0


@compiled
def variance(root: FloatArray, i: int) -> float:
    """Variance of state i of a covariance with factor root (n, n)."""
    total = 0.0
    for j in range(i + 1):
        total += root[i, j] * root[i, j]
    return total


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
def sliding(row: FloatArray, use: FloatArray, vx: float, vy: float, mu: float) -> int:
    """The health flag of a wheel past its peak by longitudinal slip, at inputs use (15,)."""
    for wheel in range(4):
        along, _ = wheel_velocity(row, wheel, vx, vy, use[S.YAW_RATE], use[S.DELTA + wheel])
        slip = (row[P.RADIUS] * use[S.OMEGA + wheel] - along) / max(abs(along), SLOWEST_M_S)
        if row[P.SLOPE_X] * abs(slip) > SLIDING_THETA * mu:
            return flags.SLIDING
    return 0
