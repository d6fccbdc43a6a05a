"""Simulation of several drives of one scenario as a batch, and estimation of their motion and
friction by an estimator bank (one filter per drive).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from edge_agent.estimators import Estimates, EstimatorBank
from edge_agent.lab.simulation import DriveSetup, Fault, simulate_manoeuvre
from edge_agent.lab.simulation.manoeuvres import Friction
from edge_agent.lab.simulation.presets import TrueVehicle
from edge_agent.lab.simulation.sensors import Sensors
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, per_wheel
from schemas.vehicle import Vehicle

# Sensors of ordinary drives. Their accelerometers are fixed to the body and measure a part of
# gravity when the body rolls and pitches.
USUAL = "mems-leak"
# [Hz] The simulator holds the steering constant during a sample. At this rate, a slow sensor does
# not record steps.
FINE_HZ = 500.0


@dataclass(frozen=True)
class DriveSpec:
    """Specification of a simulated manoeuvre, taken from a paper or made for the default
    estimator's evaluation: vehicle, speed [m/s], friction, sampling rate, duration.

    `road` is the name of the relief (slopes of the road), and `slope` a constant slope added to it.
    `torque` is False if wheel torque is not recorded.
    """

    manoeuvre: str
    vehicle: TrueVehicle
    mu: Friction | None = None
    speed: float | None = None
    rate_hz: float = 100.0
    duration_s: float | None = None
    about: str = ""
    road: str = "level"
    slope: float = 0.0
    torque: bool = True


@dataclass(frozen=True)
class DriveSet:
    """N simulated drives of T samples: times t (T, N) [s], sensor readings `signals` (T, N, 18),
    true values by name (T, N), and the N vehicle files that the estimators get.
    """

    t: FloatArray
    signals: FloatArray
    truth: dict[str, FloatArray]
    vehicles: list[Vehicle]

    @property
    def mu_wheel(self) -> FloatArray:
        """Return the true friction of the wheels, (T, N, 4)."""
        return np.stack([self.truth[name] for name in per_wheel("true_mu")], axis=-1)

    @property
    def mu(self) -> FloatArray:
        """Return the true mean friction of the four wheels, (T, N)."""
        return np.asarray(self.mu_wheel.mean(axis=-1))

    def last(self, seconds: float) -> slice:
        """Return the slice of sample indices that covers the last `seconds` [s] of the drives."""
        return slice(int(np.searchsorted(self.t[:, 0], self.t[-1, 0] - seconds)), None)


def simulate_realistic(
    scenario: DriveSpec, seeds: Sequence[int], sensors: str | Sensors = USUAL
) -> DriveSet:
    """Simulate one drive of the scenario per seed with the given sensors, by default ordinary ones.
    The vehicle file that the estimators get has errors of a few per cent.
    """
    return join_drives([_simulate_drive(scenario, seed, sensors, 1) for seed in seeds])


def simulate_ideal(scenario: DriveSpec) -> DriveSet:
    """Simulate one drive with error-free sensors and an exact vehicle file. The simulation runs at
    a higher rate than the scenario's sampling rate.
    """
    step = max(1, round(FINE_HZ / scenario.rate_hz))
    return join_drives(
        [_simulate_drive(replace(scenario, rate_hz=scenario.rate_hz * step), 0, "ideal", step)]
    )


def _simulate_drive(
    scenario: DriveSpec, seed: int, sensors: str | Sensors, step: int
) -> tuple[pa.Table, Vehicle]:
    log, vehicle = simulate_manoeuvre(
        scenario.manoeuvre,
        mu=scenario.mu,
        speed=scenario.speed,
        seed=seed,
        duration_s=scenario.duration_s,
        setup=DriveSetup(
            rate_hz=scenario.rate_hz,
            vehicle=scenario.vehicle,
            sensors=sensors,
            road=scenario.road,
            slope=scenario.slope,
            faults=() if scenario.torque else (Fault("missing", "torque"),),
        ),
    )
    return log.take(np.arange(0, len(log), step)), vehicle


def join_drives(drives: Sequence[tuple[pa.Table, Vehicle]]) -> DriveSet:
    """Join simulated drives of equal length into one set of drives, so that one estimator bank can
    process all of them together.
    """

    def stack_column(name: str) -> FloatArray:
        return np.stack(
            [log[name].to_numpy(zero_copy_only=False) for log, _ in drives], axis=1
        ).astype(float)

    names = [name for name in drives[0][0].column_names if name.startswith("true_")]
    signals = np.stack([stack_column(name) for name in CHANNELS], axis=-1)
    return DriveSet(
        stack_column("t"),
        signals,
        {name: stack_column(name) for name in names},
        [vehicle for _, vehicle in drives],
    )


def repeat_drive(batch: DriveSet, count: int) -> DriveSet:
    """Return a batch with `count` copies of the drive in `batch`, which must contain a single
    drive. Different noise can then be added to the copies.
    """
    truth = {name: np.repeat(value, count, axis=1) for name, value in batch.truth.items()}
    return DriveSet(
        np.repeat(batch.t, count, axis=1),
        np.repeat(batch.signals, count, axis=1),
        truth,
        batch.vehicles * count,
    )


def run_estimator(bank: EstimatorBank, batch: DriveSet) -> Estimates:
    """Return the estimates of motion and friction that an estimator bank computes from the signals
    of the drives.
    """
    return bank.advance(batch.t, batch.signals)
