"""Drives for the tests of the estimators, simulated once."""

from __future__ import annotations

from functools import cache

import numpy as np

from edge_agent.lab.simulation import simulate_manoeuvre
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS
from schemas.vehicle import Vehicle


@cache
def drive(
    name: str, mu: float | None, seed: int = 1, seconds: float | None = None
) -> tuple[FloatArray, FloatArray, Vehicle]:
    """t (T,) [s], signals (T, 18), nominal vehicle of a manoeuvre with ordinary sensors; its own friction if None."""
    log, vehicle = simulate_manoeuvre(name, mu=mu, seed=seed, duration_s=seconds, sensors="mems")
    return log["t"].to_numpy(), np.stack([log[c].to_numpy() for c in CHANNELS], axis=-1).astype(float), vehicle


def joined(*parts: tuple[FloatArray, FloatArray, Vehicle]) -> tuple[FloatArray, FloatArray]:
    """Drives one after the other, 10 ms apart."""
    clock, rows, end = [], [], 0.0
    for t, signals, _ in parts:
        clock.append(t - t[0] + end)
        rows.append(signals)
        end = clock[-1][-1] + 0.01
    return np.concatenate(clock), np.concatenate(rows)
