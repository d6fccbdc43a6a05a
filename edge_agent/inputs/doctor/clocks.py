"""Delays of the devices of a car (wheel speeds, steering, inertial unit), computed from the lags
between their signals in the turns of a drive.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from edge_agent.inputs.doctor.diagnosis import Diagnosis, Finding
from edge_agent.inputs.doctor.identities import Fit
from edge_agent.inputs.doctor.scales import CLOCK_CENTRE_S, CLOCK_SETTLED, late_clocks
from edge_agent.inputs.doctor.slip import measure_lags_twice
from schemas.numeric import FloatArray
from schemas.vehicle import Vehicle

# [s] delay between devices that the filter tolerates: standard deviation of its prior
FILTER_BEARS_S: Final = 0.025
# [s] a larger delay is a fault; in cars without faults it is below 0.06 s
LARGEST_LAG_S: Final = 0.085


def _wheels_turn_late(axle: Fit, seconds: float) -> bool:
    """Return True if the wheels' yaw rate (computed from the wheel speeds) confirms that the wheel
    signals lag by `seconds`. `axle` is the fit of this yaw rate to the gyroscope's yaw rate. The
    lag found by the fit must have the same sign and be larger than half of `seconds`.
    """
    return (
        axle.is_known
        and np.isfinite(axle.lag_error_s)
        and axle.lag_s * np.sign(seconds) > 0.5 * abs(seconds)
    )


def find_late_clocks(diagnosis: Diagnosis) -> bool:
    """Look for a device whose clock is late, in the lags of the fitted identities. Add it to the
    findings, or to the unknown channels if another explanation is nearly as good. Return True if
    there is such a device.

    In a slide, the wheels slow down before the car does. Therefore a late speed of the wheels
    without a late yaw rate of the wheels is no fault of their clock.
    """
    late = late_clocks(diagnosis.fits)
    if "wheels" in late and not _wheels_turn_late(diagnosis.fits["axle"], late["wheels"][0]):
        return False
    for device, (seconds, margin) in late.items():
        if margin < CLOCK_SETTLED:
            diagnosis.unknown.append(f"clock of the {device}")
            continue
        way = "late" if seconds > 0.0 else "early"
        words = f"the clock of the {device} is {abs(seconds):.2f} s {way}"
        diagnosis.findings.append(
            Finding(device, "clock", words, delay_s=seconds, confidence=margin)
        )
    return bool(late)


def measure_clocks(
    t: FloatArray, signals: FloatArray, vehicle: Vehicle, diagnosis: Diagnosis
) -> None:
    """Measure the delays of wheel speeds and steering relative to the inertial unit, and store them
    in the diagnosis. Add a finding to the diagnosis for each delay that is too large.
    """
    diagnosis.lags = measure_lags_twice(t, signals, vehicle, diagnosis.fits)
    listed = late_devices(diagnosis)
    for device, seconds in listed.items():
        if abs(seconds) > LARGEST_LAG_S:
            way = "late" if seconds > 0.0 else "early"
            words = f"is {abs(seconds):.2f} s {way}; the estimator tolerates {FILTER_BEARS_S:g} s"
            diagnosis.findings.append(Finding(device, "clock", words, delay_s=seconds))


def late_devices(diagnosis: Diagnosis) -> dict[str, float]:
    """Return the delay [s] of each device (wheel speeds, steering, inertial unit). It follows from
    the lags in `diagnosis`, which were measured in the turns of a drive.

    If wheels and steering differ from the yaw rate by about the same time, the delay is attributed
    to the inertial unit. It is attributed to the gyroscope alone if the unit's accelerometer is not
    late compared with the wheels.
    """
    wheel = diagnosis.lags.get("wheel_lag", 0.0)
    steer = diagnosis.lags.get("steer_lag", 0.0)
    if not (abs(wheel) > LARGEST_LAG_S and abs(wheel - steer) < 0.5 * abs(wheel)):
        return {"wheels": wheel, "steering": steer}
    late = -0.5 * (wheel + steer)
    along = diagnosis.fits["longitudinal"]
    has_lag = along.is_known and np.isfinite(along.lag_error_s)
    alone = has_lag and abs(along.lag_s - CLOCK_CENTRE_S["longitudinal"]) < 0.5 * abs(late)
    return {"gyro" if alone else "imu": late}
