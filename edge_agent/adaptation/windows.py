"""Measurement noise from a moving window of innovations in which larger innovations have more
weight (paper 002, equations 24 and 25).

Legend
    e_j         innovation (measurement minus prediction) j of the last N, for one measurement
    c_j         weight of e_j: its absolute value |e_j|
    P           variance of the predicted measurement, without noise
    R           noise variance: sum(c_j*e_j^2)/sum(c_j)/2 - P

Two points differ from the paper. The sum is divided by the sum of the weights, which the paper does
not do. The factor one half is added; with this factor R is correct for normally distributed errors,
because then E|e|^3 / E|e| = 2 var(e).
"""

from __future__ import annotations

from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled


@compiled
def push_innovation(window: FloatArray, innovation: float) -> None:
    """Insert the newest innovation at the front of the window (N,), and drop the oldest
    innovation.
    """
    for j in range(window.shape[0] - 1, 0, -1):
        window[j] = window[j - 1]
    window[0] = innovation


@compiled
def weighted_noise(
    window: FloatArray, predicted: float, nominal: float, least: float, largest: float
) -> float:
    """Return the noise variance R of one measurement from its last innovations, `window` (N,),
    limited to [least, largest]*nominal. While the window is not full, return `nominal`.

    `predicted` is the variance of the predicted measurement, without noise.
    """
    weight = 0.0
    total = 0.0
    for error in window:
        size = abs(error)
        if not size >= 0.0:
            return nominal
        weight += size
        total += size * error * error
    if weight <= 0.0:
        return least * nominal
    return min(max(0.5 * total / weight - predicted, least * nominal), largest * nominal)
