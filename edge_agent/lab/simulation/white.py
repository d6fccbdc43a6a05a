"""White noise of paper 004's experiments, on a_x, a_y and the yaw rate only.

Constant noise has the same variance on all three signals. Variable noise affects a_y alone, as the
paper states; its variance follows the paper's table 2.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from schemas.numeric import FloatArray
from schemas.signals import S

SCHEDULE: Final = (0.04, 0.01, 0.05)  # successive variances in table 2 of paper 004 [SI]
SCHEDULE_S: Final = 2.0  # [s] duration of each variance; the period is six seconds


def scheduled_variance(t: FloatArray) -> FloatArray:
    """Return the variance of the measurement noise at the times t (T,) [s], according to table 2 of
    paper 004. Its unit is the square of the signal's SI unit.
    """
    return np.asarray(np.array(SCHEDULE)[(t / SCHEDULE_S).astype(int) % len(SCHEDULE)])


def on_ay(t: FloatArray, other_variance: float) -> FloatArray:
    """Return noise variances (T, 3) of a_x, a_y and yaw rate [SI units squared] at the times t
    (T,): according to SCHEDULE for a_y, and the constant `other_variance` for the other two.
    """
    variance = np.full((len(t), 3), other_variance)
    variance[:, 1] = scheduled_variance(t)
    return variance


def add_white(signals: FloatArray, variance: FloatArray, rng: np.random.Generator) -> None:
    """Add white noise to a_x, a_y and yaw rate in the signals (T, 18) of one drive, in place.
    `variance` has the shape (T,) if all three have the same variance, otherwise (T, 3).
    """
    by_channel = variance[:, None] if variance.ndim == 1 else variance
    white = rng.normal(size=(len(variance), 3))
    signals[:, S.AX : S.AX + 3] += np.sqrt(by_channel) * white
