"""Simulated drives for the tests of the estimators; each is simulated once and cached."""

from __future__ import annotations

from functools import cache

import numpy as np
import pyarrow as pa

from edge_agent.lab.simulation import DriveSetup, simulate_manoeuvre
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, S
from schemas.vehicle import Vehicle

TORQUE = slice(S.TORQUE, S.TORQUE + 4)
OMEGA = slice(S.OMEGA, S.OMEGA + 4)


def signals_of(log: pa.Table) -> FloatArray:
    """Return the signals (T, 18) of a simulated drive from its table `log`."""
    return np.stack([log[name].to_numpy() for name in CHANNELS], axis=-1).astype(float)


@cache
def drive(
    name: str, mu: float | None, seed: int = 1, seconds: float | None = None
) -> tuple[FloatArray, FloatArray, Vehicle]:
    """Return times t (T,) [s], signals (T, 18) and vehicle data of the named manoeuvre, driven with
    ordinary sensors. The road has the friction `mu`, or the manoeuvre's own if `mu` is None.
    """
    log, vehicle = simulate_manoeuvre(
        name, mu=mu, seed=seed, duration_s=seconds, setup=DriveSetup(sensors="mems")
    )
    return log["t"].to_numpy(), signals_of(log), vehicle


def join_drives(*parts: tuple[FloatArray, FloatArray, Vehicle]) -> tuple[FloatArray, FloatArray]:
    """Return times (T,) and signals (T, 18) of several drives in succession; each begins 10 ms
    after the previous one ends.
    """
    clock = []
    rows = []
    end = 0.0
    for t, signals, _ in parts:
        clock.append(t - t[0] + end)
        rows.append(signals)
        end = clock[-1][-1] + 0.01
    return np.concatenate(clock), np.concatenate(rows)


def drive_over_joints() -> tuple[FloatArray, FloatArray, Vehicle]:
    """Return times, signals and vehicle data of a gentle acceleration on a dry motorway, without
    torque signals. The road has joints. At each joint the wheel speeds of an axle jump by 3 to 4 %
    for 50 ms.

    The recording of a real drive in tests/data/rav4.blf has such jumps at 1.7 and 38.4 s.
    """
    vehicle = drive("straight", 0.85)[2]
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 12.0, 0.01)
    signals = np.zeros((len(t), len(CHANNELS)))
    signals[:, :3] = rng.normal(0.0, (0.05, 0.05, 0.002), (len(t), 3))
    signals[:, S.AX] += 1.4
    signals[:, TORQUE] = np.nan
    speed = 25.0 + 1.4 * t
    signals[:, OMEGA] = (speed / vehicle.wheel_radius * (1.0 + 0.14 / 20.0))[:, None]
    signals[:, OMEGA] += rng.normal(0.0, 0.03, (len(t), 4))
    for joint in range(300, 1100, 150):
        for first, wheels in ((joint, slice(0, 2)), (joint + 10, slice(2, 4))):
            signals[first : first + 5, OMEGA][:, wheels] *= 1.03 if wheels.start == 0 else 1.04
            signals[first : first + 3, S.AX] -= 2.5
            signals[first + 3 : first + 6, S.AX] += 2.5
    return t, signals, vehicle
