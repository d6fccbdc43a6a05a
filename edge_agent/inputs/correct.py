"""Correction of signals by a vehicle's calibration: sensor offsets, wheel radii, steering angle and
delays between devices.

The calibration contains errors that were learned from drives. A quantity without a learned error is
not corrected. A learned error is a posterior mean with a prior around zero. Therefore the
correction is smaller than the measured error. The rear steering angle is not corrected. The lateral
acceleration a_y is not corrected either. Its measured offset on a straight road is partly a sensor
error and partly due to the crossfall of the road, which causes a real tyre force. Drives cannot
separate the two.
"""

from __future__ import annotations

import numpy as np

from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, WHEELS, S
from schemas.vehicle import Calibration, Vehicle

# Channels of each device: its first channel, and the first channel after it.
INERTIAL = (S.AX, S.YAW_RATE + 1)
STEERING = (S.DELTA, S.DELTA + 4)
TURNING = (S.OMEGA, S.OMEGA + 4)


class Corrector:
    """Corrector of one vehicle's signals for the sensor errors in its calibration. The samples may
    be passed in blocks of any length.

    Devices have different delays. All readings of a corrected row (sample) describe one moment:
    that of the slowest device's reading, which is up to 0.1 s before the row's time stamp. For each
    faster device the reading nearest to this moment is used, without interpolation.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._calibration = vehicle.calibration
        self._waits = _device_waits(self._calibration)
        self._t = np.empty(0)
        self._rows = np.empty((0, len(CHANNELS)))

    def advance(self, t: FloatArray, signals: FloatArray) -> FloatArray:
        """Correct the next rows (samples) of a log for known sensor errors: times t (T,) [s] and
        signals (T, 18). Return the corrected signals (T, 18).

        If there is nothing to correct, the result is the array `signals` itself.
        """
        if self._calibration is not None:
            signals = _correct_signals(signals, self._calibration)
        if self._waits:
            signals = self._wait_for_latest(t, signals)
        signals = scale_axles(signals, self._vehicle)
        return (
            free_rear_wheels(signals, self._vehicle) if self._vehicle.rear_axle_locked else signals
        )

    def _wait_for_latest(self, t: FloatArray, signals: FloatArray) -> FloatArray:
        """Return signals (T, 18) in which all readings of a row describe one moment: signals of
        faster devices are delayed to match the slowest device.
        """
        times = np.concatenate([self._t, t])
        rows = np.concatenate([self._rows, signals])
        together = signals.copy()
        for channels, wait in self._waits.items():
            at = t - wait
            after = np.clip(np.searchsorted(times, at), 1, max(len(times) - 1, 1))
            near = np.where(
                times[np.minimum(after, len(times) - 1)] - at < at - times[after - 1],
                after,
                after - 1,
            )
            together[:, slice(*channels)] = rows[np.minimum(near, len(times) - 1), slice(*channels)]
        kept = (
            max(0, int(np.searchsorted(times, times[-1] - max(self._waits.values()))) - 2)
            if len(times)
            else 0
        )
        self._t = times[kept:]
        self._rows = rows[kept:]
        return together


def correct_log(t: FloatArray, signals: FloatArray, vehicle: Vehicle) -> FloatArray:
    """Return all signals (T, 18) of a log with times t (T,) [s], corrected for the known sensor
    errors of the vehicle.
    """
    return Corrector(vehicle).advance(t, signals)


def scale_axles(signals: FloatArray, vehicle: Vehicle) -> FloatArray:
    """Return signals (T, 18) converted to wheels that all have the radius `wheel_radius` of the
    vehicle file.

    Wheel speed and torque are scaled so that the speed at the rim and the force on the road stay
    the same. If the vehicle file has no radius per axle, the result is the array `signals` itself.
    """
    for axle in range(2):
        share = vehicle.axle_radius(axle) / vehicle.wheel_radius
        if share == 1.0:
            continue
        signals = signals.copy()
        first = 2 * axle
        signals[..., S.OMEGA + first : S.OMEGA + first + 2] *= share
        signals[..., S.TORQUE + first : S.TORQUE + first + 2] /= share
    return signals


def free_rear_wheels(signals: FloatArray, vehicle: Vehicle) -> FloatArray:
    """Return signals (T, 18) with the rear wheel speeds that freely rolling wheels would have at
    the measured yaw rate. The mean of both rear wheels does not change.

    The function is for a locked axle. Its wheels turn at the same speed, so that in a turn each
    wheel slips by half the track width times the yaw rate. This slip is removed, because it
    contains no information on the total force of the axle.
    """
    signals = signals.copy()
    half = 0.5 * vehicle.track_rear * signals[..., S.YAW_RATE] / vehicle.wheel_radius
    half = np.where(np.isfinite(half), half, 0.0)
    mean = signals[..., S.OMEGA + 2 : S.OMEGA + 4].mean(axis=-1)
    signals[..., S.OMEGA + 2] = mean - half
    signals[..., S.OMEGA + 3] = mean + half
    return signals


def _correct_signals(signals: FloatArray, known: Calibration) -> FloatArray:
    signals = signals.copy()
    for channel, estimate in ((S.AX, known.ax), (S.YAW_RATE, known.yaw_rate)):
        signals[..., channel] -= _value_or(estimate, 0.0)
    for i, wheel in enumerate(WHEELS):
        signals[..., S.OMEGA + i] /= 1.0 + _value_or(getattr(known, f"radius_{wheel}"), 0.0)
    signals[..., S.TORQUE : S.TORQUE + 4] /= _value_or(known.force_gain, 1.0)
    front = slice(S.DELTA, S.DELTA + 2)
    signals[..., front] -= _value_or(known.steer_offset, 0.0)
    signals[..., front] /= _value_or(known.steer_gain, 1.0)
    return signals


def _device_waits(known: Calibration | None) -> dict[tuple[int, int], float]:
    """Return, for each device, the delay [s] that must be added to its signals so that they match
    the slowest device. A device is given by its range of channels (first, last + 1). The slowest
    device itself is left out.
    """
    if known is None or (known.wheel_lag is None and known.steer_lag is None):
        return {}
    late = {
        INERTIAL: 0.0,
        STEERING: _value_or(known.steer_lag, 0.0),
        TURNING: _value_or(known.wheel_lag, 0.0),
    }
    latest = max(late.values())
    return {channels: latest - lag for channels, lag in late.items() if lag < latest}


def _value_or(estimate: tuple[float, float] | None, default: float) -> float:
    return default if estimate is None else estimate[0]
