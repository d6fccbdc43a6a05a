"""Evaluation of the calibration with simulated inaccurate cars (ROUGH_FLEET): the errors of the
learned quantities, and the benefit.

Errors are divided by the standard deviations that the calibration states. The benefit is a narrower
interval of friction.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from edge_agent.app.estimator_factory import bank_of
from edge_agent.calibration.learn import learn_calibration
from edge_agent.inputs.correct import correct_log
from edge_agent.lab.simulation import SimulatedFleet
from edge_agent.lab.simulation.fleet import VEHICLE_STREAM
from edge_agent.lab.simulation.misaligned import Misaligned
from edge_agent.lab.simulation.place import GOTHENBURG
from edge_agent.lab.simulation.presets import nominal, one_of_a_fleet
from edge_agent.lab.simulation.sensors import ROUGH_FLEET, ErrorColumn, error_row
from schemas.numeric import FloatArray
from schemas.runtime.figures import Figure
from schemas.signals import WHEELS, S
from tests.benchmarks.inputs.planted import RATE_HZ, drives

# Drives of each car. Each drive continues on the road of the previous one.
DRIVES = 10
DRIVE_S = 60
CARS_AT_ONCE: Final = 5
JUDGED_S: Final = 120  # length of the following drive, which is evaluated
SETTLED_S: Final = 10.0  # first part of that drive, which is not evaluated
ESTIMATOR: Final = "aco-fckf"


def true_errors(seed: int, car: int) -> dict[str, float]:
    """Return the true sensor and vehicle errors of the simulated inaccurate car number `car`, by
    the name of the quantity that the calibration learns.
    """
    error = error_row(ROUGH_FLEET, GOTHENBURG, seed, car)
    mounted = error[ErrorColumn.MOUNTED :]
    offset = error[ErrorColumn.OFFSET :]
    radii = mounted[Misaligned.RADIUS : Misaligned.RADIUS + 4]
    off = (1.0 + radii) / (1.0 + radii.mean()) - 1.0
    return {
        **{f"radius_{wheel}": float(value) for wheel, value in zip(WHEELS, off, strict=True)},
        "ax": float(mounted[Misaligned.AX] + offset[S.AX]),
        "ay": float(mounted[Misaligned.AY] + offset[S.AY]),
        "yaw_rate": float(offset[S.YAW_RATE]),
        "steer_offset": float(mounted[Misaligned.ZERO] + offset[S.DELTA]),
        "steer_gain": float(1.0 + mounted[Misaligned.GAIN]),
        **{
            f"{name}_lag": float(mounted[Misaligned.LAG + device] - mounted[Misaligned.LAG])
            for name, device in (("steer", 1), ("wheel", 2))
        },
        # The simulated cars have the same cornering stiffness per load at both axles.
        "understeer": 0.0,
        "force_gain": float(error[ErrorColumn.GAIN + S.TORQUE]) * _mass_radius_ratio(seed, car),
    }


def _mass_radius_ratio(seed: int, car: int) -> float:
    """Return the true mass times the true wheel radius of an inaccurate car, divided by the same
    product according to its vehicle file.
    """
    rng = np.random.default_rng([seed, car, VEHICLE_STREAM])
    true = one_of_a_fleet(car, "car", rng)
    file = nominal(true, rng)
    return true.vehicle.mass * true.vehicle.wheel_radius / (file.mass * file.wheel_radius)


class Narrowed(NamedTuple):
    """Friction estimates of some cars without calibration (`plain_…`) and with it: mean width of
    the 90 % interval of friction, and coverage, the share of true frictions inside the interval.
    """

    plain_width: float
    plain_coverage: float
    width: float
    coverage: float


def learn_and_narrow(cars: int, seed: int, judged_s: int = JUDGED_S) -> Narrowed:
    """Learn a calibration for each inaccurate car from DRIVES drives, and measure how much it
    narrows the interval of the car's friction.

    Friction is estimated in the next drive, without and with the calibration. Return the width and
    the coverage of both intervals, averaged over cars and samples.
    """
    fleet = SimulatedFleet("hills", cars, seed, RATE_HZ, rough=1.0)
    t, signals = _drive_fleet(fleet, DRIVES * DRIVE_S)[:2]
    size = len(t) // DRIVES
    parts = [slice(k * size, (k + 1) * size) for k in range(DRIVES)]
    learned = [
        vehicle.model_copy(
            update={
                "calibration": learn_calibration([(t[p, n], signals[p, n]) for p in parts], vehicle)
            }
        )
        for n, vehicle in enumerate(fleet.vehicles)
    ]
    t, signals, mu = _drive_fleet(fleet, judged_s)
    judged = slice(round(SETTLED_S * RATE_HZ), None)
    found = []
    for vehicles in (fleet.vehicles, learned):
        corrected = np.stack(
            [correct_log(t[:, n], signals[:, n], vehicle) for n, vehicle in enumerate(vehicles)],
            axis=1,
        )
        estimated = bank_of(ESTIMATOR, vehicles).advance(t, corrected)
        inside = (estimated.mu_lower <= mu) & (mu <= estimated.mu_upper)
        found += [
            float((estimated.mu_upper - estimated.mu_lower)[judged].mean()),
            float(inside[judged].mean()),
        ]
    return Narrowed(*found)


def _drive_fleet(fleet: SimulatedFleet, seconds: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Simulate a drive of a fleet for `seconds`; return times (T, N), sensor signals (T, N, 18),
    and the true mean friction of the wheels (T, N).
    """
    parts = []
    for _ in range(seconds):
        t, signals = fleet.step(round(RATE_HZ))
        parts.append((t, signals, fleet.truth.mu_wheel.mean(axis=-1)))
    t, signals, mu = (np.concatenate([part[k] for part in parts]) for k in range(3))
    return t, signals, mu


def widths(cars: int, seed: int, judged_s: int = JUDGED_S) -> list[Figure]:
    """Estimate the friction of `cars` inaccurate cars without and with their calibration. Return as
    figures the mean width of the friction interval with calibration, this width divided by the one
    without, and the share of true frictions inside the interval for both.
    """
    groups = [
        learn_and_narrow(min(CARS_AT_ONCE, cars - k), seed + k, judged_s)
        for k in range(0, cars, CARS_AT_ONCE)
    ]
    plain, plain_coverage, width, coverage = (
        float(np.mean(column)) for column in zip(*groups, strict=True)
    )
    return [
        Figure("calibration.width_ratio", width / plain, "1", 0.8),
        Figure("calibration.width", width, "1"),
        Figure("calibration.coverage", coverage, "1", 0.88, "more"),
        Figure("calibration.plain_coverage", plain_coverage, "1"),
    ]


def figures(cars: int, seed: int) -> list[Figure]:
    """Learn the calibration of `cars` simulated cars. Return as figures, for each calibrated
    quantity, the RMS over the cars of (learned − true value) / stated standard deviation. The four
    wheel radii count as one quantity.
    """
    away: dict[str, list[float]] = {}
    for first in range(0, cars, CARS_AT_ONCE):
        at = seed + first // CARS_AT_ONCE
        for car, drive in enumerate(
            drives(min(CARS_AT_ONCE, cars - first), at, rough=True, seconds=DRIVES * DRIVE_S)
        ):
            size = len(drive.t) // DRIVES
            parts = [slice(k * size, (k + 1) * size) for k in range(DRIVES)]
            learned = learn_calibration(
                [(drive.t[part], drive.signals[part]) for part in parts], drive.vehicle
            )
            for name, value in true_errors(at, car).items():
                if (estimate := getattr(learned, name)) is not None:
                    key = "radius" if name.startswith("radius") else name
                    away.setdefault(key, []).append((estimate[0] - value) / estimate[1])
    return [
        Figure(
            f"calibration.errors.{name}",
            float(np.sqrt(np.mean(np.square(values)))),
            "1",
            (0.7, 1.3),
            "within",
        )
        for name, values in away.items()
    ]
