"""Delays of devices relative to the inertial unit, each from a comparison of two yaw rates.

    wheel_lag   delay of the yaw rate from the wheels against the gyroscope's; from the mean of both
                axles, or from the axle that agrees best with the gyroscope
    steer_lag   delay of the yaw rate that a bicycle model computes from the measured steering angle
                against the gyroscope's (Rajamani 2012, section 2.3)

    m (v̇_y + v r) = F_f + F_r,           I ṙ = a F_f − b F_r,
    F_f = C_f (δ − (v_y + a r)/v),       F_r = −C_r (v_y − b r)/v

The model has mass m, yaw inertia I, cornering stiffnesses C_f and C_r of the axles, and distances a
and b of the axles from the centre of gravity. δ is the steering angle, v the speed, v_y the lateral
velocity and r the yaw rate. The lag is the shift with the largest correlation of both yaw rates; a
parabola through three samples refines the peak. A lateral force builds up a little later than its
slip, so wheels and steering move slightly before the body turns. LEAD corrects for this.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from edge_agent.inputs.doctor.drive import RATE_HZ, interpolate_near, smooth_twice
from schemas.numeric import BoolArray, FloatArray
from schemas.signals import S
from schemas.vehicle import Vehicle

LONGEST_S: Final = 0.5
LEAST_S: Final = 10.0  # of driving
SLOW_S: Final = 5.0  # what changes more slowly is offset and bank
LEAST_LIKE: Final = 0.9  # correlation from which on a lag is believed
LEAST_RATE: Final = 1e-5  # [rad/s] of yaw; less is rounding
ALIKE: Final = 0.02  # of two correlations
SMOOTH_S: Final = 0.1  # of a running mean, taken twice
LONGEST_DRIVE_S: Final = 1800.0
DRIVEN: Final = 4.0  # [m/s]
SLOWEST: Final = 3.0  # [m/s] for which the model's slip has a meaning
# How fast a body answers to its wheels goes with the file's stiffness: .01 s at 10 % (BIAS of
# steer_lag in learn.py). [s] that wheels and steering are ahead of the gyro where no device is
# late: force behind slip. Both are what twenty simulated rough cars showed, with other seeds than
# those of the figures
LEAD: Final = {"wheel_lag": 0.013, "steer_lag": 0.017}


def find_lags(
    t: FloatArray, signals: FloatArray, vehicle: Vehicle, least: float = LEAST_LIKE
) -> dict[str, float]:
    """Return the lags [s] of a drive by quantity, from times t (T,) [s] and signals (T, 18).

    A lag whose correlation is below `least` is left out. Signals are smoothed less than in other
    checks of the signals, because after smoothing over half a second the peak of the correlation
    would be too flat for a resolution of milliseconds.
    """
    at = np.arange(t[0], min(t[-1], t[0] + LONGEST_DRIVE_S), 1.0 / RATE_HZ)

    def even_column(index: int) -> FloatArray:
        return smooth_twice(interpolate_near(t, signals[:, index], at), SMOOTH_S)

    rims = [even_column(S.OMEGA + wheel) * vehicle.wheel_radius for wheel in range(4)]
    v = np.mean(rims, axis=0)
    gyro = even_column(S.YAW_RATE)
    left = signals[:, S.DELTA]
    front = (rims[1] - rims[0]) / vehicle.track_front
    rear = (rims[3] - rims[2]) / vehicle.track_rear
    delta = smooth_twice(
        interpolate_near(t, np.where(np.isfinite(left), left, signals[:, S.DELTA + 1]), at),
        SMOOTH_S,
    )
    driven = (v > DRIVEN) & np.isfinite(gyro)
    ways = {
        "wheel_lag": (0.5 * (front + rear), front, rear),
        "steer_lag": (_bicycle_yaw_rate(v, delta, vehicle),),
    }
    found = {}
    for name, sides in ways.items():
        peaks = [_find_delay(side, gyro, driven & np.isfinite(side), least) for side in sides]
        told = [peak for peak in peaks if peak is not None]
        if (
            told
        ):  # the mean of the axles comes first: a locked axle says nothing, and spoils the mean
            likest = max(peak.likeness for peak in told)
            found[name] = (
                next(peak for peak in told if peak.likeness > likest - ALIKE).seconds + LEAD[name]
            )
    return found


class _Peak(NamedTuple):
    """Peak of a cross-correlation of two signals: the shift [s] of one series against another at
    which their correlation is largest, and this correlation.
    """

    seconds: float
    likeness: float


def _find_delay(
    left: FloatArray, right: FloatArray, among: BoolArray, least: float
) -> _Peak | None:
    """Return the delay [s] of the signal `left` relative to `right`, with the correlation at that
    delay, over the samples of the mask `among`. Return None if a signal varies too little, or if
    the correlation is below `least`.
    """
    most = round(LONGEST_S * RATE_HZ)
    among = among.copy()
    among[: most + 1] = among[len(among) - most - 1 :] = False
    if among.sum() < LEAST_S * RATE_HZ:
        return None
    left, right = ((x - smooth_twice(x, SLOW_S)) for x in (left, right))
    if (
        np.nanstd(left[among]) < LEAST_RATE or np.nanstd(right[among]) < LEAST_RATE
    ):  # a locked axle, or straight on
        return None
    like = np.zeros(2 * most + 1)
    for k in range(-most, most + 1):
        other = np.roll(right, k)
        both = among & np.isfinite(left) & np.isfinite(other)
        like[k + most] = np.corrcoef(left[both], other[both])[0, 1] if both.sum() > 2 else 0.0
    top = int(np.argmax(like))
    if like[top] < least or top in (0, 2 * most):
        return None
    before, here, after = like[top - 1 : top + 2]
    seconds = (top - most + 0.5 * (before - after) / (before - 2.0 * here + after)) / RATE_HZ
    return _Peak(float(seconds), float(here))


def _bicycle_yaw_rate(speed: FloatArray, steering: FloatArray, vehicle: Vehicle) -> FloatArray:
    """Return the yaw rate (n,) [rad/s] of a bicycle model with the measured steering, integrated by
    the trapezoidal rule.
    """
    m = vehicle.mass
    inertia = vehicle.yaw_inertia
    a = vehicle.cg_to_front_axle
    b = vehicle.cg_to_rear_axle
    per_share = (
        4.0 * vehicle.cornering_stiffness / (a + b)
    )  # of all wheels, shared out by their static load
    c_f = b * per_share
    c_r = a * per_share
    half = 0.5 / RATE_HZ
    motion = np.zeros(2)
    modelled = np.full(len(speed), np.nan)
    before = 0.0
    for k, (v, delta) in enumerate(zip(speed.tolist(), steering.tolist(), strict=True)):
        if not (v > SLOWEST and abs(delta) < 1.0):  # standing, or NaN
            motion = np.zeros(2)
            before = 0.0
            continue
        system = np.array(
            [
                [-(c_f + c_r) / (m * v), (b * c_r - a * c_f) / (m * v) - v],
                [(b * c_r - a * c_f) / (inertia * v), -(a * a * c_f + b * b * c_r) / (inertia * v)],
            ]
        )
        driven = np.array([c_f / m, a * c_f / inertia]) * (half * (before + delta))
        motion = np.linalg.solve(
            np.eye(2) - half * system, motion + half * (system @ motion) + driven
        )
        before, modelled[k] = delta, motion[1]
    return modelled
