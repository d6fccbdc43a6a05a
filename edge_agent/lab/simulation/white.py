"""The noise of paper 004's experiments: white, on a_x, a_y and the yaw rate only.

Constant noise has one variance on all three. Variable noise follows table 2 on a_y alone, as the
paper says.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from schemas.numeric import FloatArray
from schemas.signals import S

SCHEDULE: Final = (0.04, 0.01, 0.05)  # variances of its table 2 [SI], in turn,
SCHEDULE_S: Final = 2.0  # each for two seconds: a period of six


def scheduled_variance(t: FloatArray) -> FloatArray:
    """Return the variance at the times t (T,) [s] by the SCHEDULE."""
    return np.asarray(np.array(SCHEDULE)[(t / SCHEDULE_S).astype(int) % len(SCHEDULE)])


def on_ay(t: FloatArray, others: float) -> FloatArray:
    """Return variances (T, 3) of a_x, a_y and yaw rate [SI]: a_y by the SCHEDULE, the others
    constant.
    """
    variance = np.full((len(t), 3), others)
    variance[:, 1] = scheduled_variance(t)
    return variance


def add_white(signals: FloatArray, variance: FloatArray, rng: np.random.Generator) -> None:
    """Add noise of variance (T,), or (T, 3) by channel, to the signals (T, 18) of one drive, in
    place.
    """
    by_channel = variance[:, None] if variance.ndim == 1 else variance
    white = rng.normal(size=(len(variance), 3))
    signals[:, S.AX : S.AX + 3] += np.sqrt(by_channel) * white
