"""Test that detects a car on a lift or on rollers: wheels turn and change speed, but the body does
not accelerate.

On a road, wheels that gain 0.5 m/s² for a second accelerate the body, and the accelerometer shows
it. Wheels that spin on ice are an exception: the body hardly accelerates, but the other wheels show
whether the car moves. Therefore the test requires that one axle stands while the other turns fast,
or that all wheels change their speed while accelerometers and yaw rate show no motion. A car whose
position moves is not on a lift; accelerations in a wrong unit may seem to be at rest.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from edge_agent.inputs.doctor.drive import RATE_HZ, EvenTimes, smooth_twice
from schemas.numeric import FloatArray
from schemas.signals import S
from schemas.thresholds import EARTH_RADIUS_M
from schemas.vehicle import Vehicle

TURNS_M_S: Final = 5.0  # [m/s] rim speed from which an axle turns
STANDS_M_S: Final = 0.3
LEAST_S: Final = 5.0  # [s] minimum time in which an axle turns
# Minimum share of the time with a turning axle in which the other axle stands. Wheels that spin on
# ice do so only for moments.
LEAST_SHARE: Final = 0.8
RESTS_M_S2: Final = 0.3  # [m/s^2] deviation of the accelerometers from their median at rest
RESTS_RAD_S: Final = 0.01
MOVED_M: Final = 100.0  # [m] more than the error of a position
GAINS_M_S2: Final = 0.4  # [m/s^2] root mean square of the wheels' acceleration


def is_on_lift(t: FloatArray, signals: FloatArray, vehicle: Vehicle) -> bool:
    """Return True if wheels turn while the body of the car stands, as on a lift or on rollers. `t`
    are times (T,) [s], `signals` readings (T, 18).
    """
    even = EvenTimes(t, len(t))  # [s] a gap of years must not fill the memory
    if len(even.at) < LEAST_S * RATE_HZ:
        return False
    rims = (
        np.stack(
            [even.interpolate_channel(signals[:, S.OMEGA + wheel]) for wheel in range(4)], axis=1
        )
        * vehicle.wheel_radius
    )
    axles = [
        smooth_twice(np.abs(rims[:, 2 * axle : 2 * axle + 2]).mean(axis=1)) for axle in range(2)
    ]
    fastest = np.fmax(axles[0], axles[1])
    slowest = np.fmin(axles[0], axles[1])
    with np.errstate(invalid="ignore"):
        turns = np.isfinite(fastest) & np.isfinite(slowest) & (fastest > TURNS_M_S)
        one_stands = turns & (slowest < STANDS_M_S)
    if turns.sum() < LEAST_S * RATE_HZ or _moved_m(signals) > MOVED_M:
        return False

    def rests_within(channel: int, limit: float) -> bool:
        value = even.smooth_channel(signals[:, channel])[turns]
        return bool(
            np.isfinite(value).any()
            and np.nanpercentile(np.abs(value - np.nanmedian(value)), 90) < limit
        )

    limits = ((S.AX, RESTS_M_S2), (S.AY, RESTS_M_S2), (S.YAW_RATE, RESTS_RAD_S))
    if not all(rests_within(channel, limit) for channel, limit in limits):
        return False
    gained = np.gradient(fastest, 1.0 / RATE_HZ)[turns]
    gains = float(np.sqrt(np.nanmean(np.square(gained)))) > GAINS_M_S2
    acceleration_std = float(np.nanstd(even.smooth_channel(signals[:, S.AX])[turns]))
    return bool(
        one_stands.sum() > LEAST_SHARE * turns.sum()
        or (gains and acceleration_std < 0.25 * GAINS_M_S2)
    )


def _moved_m(signals: FloatArray) -> float:
    """Return the larger extent [m] of the positions to the north or to the east; 0 without
    positions.
    """
    north = np.radians(signals[:, S.LATITUDE]) * EARTH_RADIUS_M
    east = np.radians(signals[:, S.LONGITUDE]) * EARTH_RADIUS_M * np.cos(north / EARTH_RADIUS_M)
    known = np.isfinite(north) & np.isfinite(east)
    return float(max(np.ptp(north[known]), np.ptp(east[known]))) if known.any() else 0.0
