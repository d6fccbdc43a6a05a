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

from collections.abc import Collection
from typing import Final, NamedTuple

import numpy as np

from edge_agent.inputs.doctor.drive import RATE_HZ, EvenTimes, correlate_series, smooth_twice
from schemas.numeric import BoolArray, FloatArray
from schemas.signals import S
from schemas.vehicle import Vehicle

LONGEST_S: Final = 0.5  # [s] maximum delay that is searched
LEAST_S: Final = 10.0  # [s] minimum time of driving
# [s] slower changes are removed, because they come from offset and road bank
SLOW_S: Final = 5.0
LEAST_LIKE: Final = 0.9  # minimum correlation at which a lag is used
LEAST_RATE: Final = 1e-5  # [rad/s] a smaller standard deviation of the yaw rate is rounding
ALIKE: Final = 0.02  # correlations that differ by less than this count as equal
SMOOTH_S: Final = 0.1  # [s] width of the running mean, which is applied twice
DRIVEN: Final = 4.0  # [m/s] lags are measured above this speed
SLOWEST: Final = 3.0  # [m/s] below this speed the model's slip angle has no meaning
NEGLIGIBLE: Final = 1e-18  # share of an earlier motion that disappears in a float64
# Difference of correlations that exceeds the error of their computation by Fourier transforms.
NEAR_PEAK: Final = 1e-6
# [s] lead of wheels and steering over the gyroscope in a car without delays, because a tyre's force
# builds up after its slip. The values were measured on twenty simulated rough cars, with other
# seeds than those of the figures.
# The reaction of the body depends on the cornering stiffness in the vehicle file. An error of 10 %
# shifts the lead by 0.01 s (BIAS of steer_lag in learn.py).
LEAD: Final = {"wheel_lag": 0.013, "steer_lag": 0.017}


def find_lags(
    t: FloatArray,
    signals: FloatArray,
    vehicle: Vehicle,
    least: float = LEAST_LIKE,
    names: Collection[str] = tuple(LEAD),
) -> dict[str, float]:
    """Return the lags [s] of a drive, by name, for the lags `names` ("wheel_lag", "steer_lag"). The
    drive has the times t (T,) [s] and the signals (T, 18).

    A lag whose correlation is below `least` is left out. Signals are smoothed less than in other
    checks of the signals, because after smoothing over half a second the peak of the correlation
    would be too flat for a resolution of milliseconds.
    """
    even = EvenTimes(t)
    rims = [
        even.smooth_channel(signals[:, S.OMEGA + wheel], SMOOTH_S) * vehicle.wheel_radius
        for wheel in range(4)
    ]
    v = np.mean(rims, axis=0)
    gyro = even.smooth_channel(signals[:, S.YAW_RATE], SMOOTH_S)
    left = signals[:, S.DELTA]
    front = (rims[1] - rims[0]) / vehicle.track_front
    rear = (rims[3] - rims[2]) / vehicle.track_rear
    delta = even.smooth_channel(
        np.where(np.isfinite(left), left, signals[:, S.DELTA + 1]), SMOOTH_S
    )
    driven = (v > DRIVEN) & np.isfinite(gyro)
    turning = gyro - smooth_twice(gyro, SLOW_S)
    found = {}
    for name in names:
        sides = (
            (0.5 * (front + rear), front, rear)
            if name == "wheel_lag"
            else (_bicycle_yaw_rate(v, delta, vehicle),)
        )
        peaks = list[_Peak]()
        for side in sides:
            peak = _find_delay(side, turning, driven & np.isfinite(side), least)
            peaks += [] if peak is None else [peak]
            if peaks and peaks[0].likeness > 1.0 - ALIKE:
                break  # no other side can agree clearly better with the gyroscope
        # Prefer the mean of both axles. If one axle is locked, its yaw rate shows nothing and
        # distorts the mean. Then the other axle agrees best with the gyroscope.
        if peaks:
            likest = max(peak.likeness for peak in peaks)
            found[name] = (
                next(peak for peak in peaks if peak.likeness > likest - ALIKE).seconds + LEAD[name]
            )
    return found


class _Peak(NamedTuple):
    """Peak of a cross-correlation of two signals: the shift [s] of one series against another at
    which their correlation is largest, and this correlation.
    """

    seconds: float
    likeness: float


def _find_delay(
    side: FloatArray, turning: FloatArray, among: BoolArray, least: float
) -> _Peak | None:
    """Return the delay [s] of the yaw rate `side` (n,) relative to the gyroscope's, with the
    correlation at that delay, over the samples of the mask `among`. `turning` (n,) is the
    gyroscope's yaw rate without its slow changes. Return None if a signal varies too little, or if
    the correlation is below `least`.
    """
    most = round(LONGEST_S * RATE_HZ)
    among = among.copy()
    among[: most + 1] = False
    among[len(among) - most - 1 :] = False
    if among.sum() < LEAST_S * RATE_HZ:
        return None
    left = side - smooth_twice(side, SLOW_S)
    rows = np.flatnonzero(among & np.isfinite(left))
    known = left[rows]
    spread = known.std(), turning[among & np.isfinite(turning)].std()
    if min(spread) < LEAST_RATE:  # a locked axle, or a straight drive
        return None

    def correlate_at(k: int) -> float:
        other = turning[rows - k]
        both = np.isfinite(other)
        return correlate_series(known[both], other[both]) if both.sum() > 2 else 0.0

    like = correlate_by_spectra(left / spread[0], turning / spread[1], among, most)
    for k in np.flatnonzero(~(like < np.nanmax(like, initial=-1.0) - NEAR_PEAK)):
        like[k] = correlate_at(int(k) - most)
    top = int(np.argmax(like))
    if like[top] < least or top in (0, 2 * most):
        return None
    here = like[top]
    before = correlate_at(top - most - 1)
    after = correlate_at(top - most + 1)
    seconds = (top - most + 0.5 * (before - after) / (before - 2.0 * here + after)) / RATE_HZ
    return _Peak(float(seconds), float(here))


def correlate_by_spectra(
    left: FloatArray, right: FloatArray, among: BoolArray, most: int
) -> FloatArray:
    """Return the correlation of `left` (n,) with `right` (n,) for every shift of `right` by -most
    to most samples. Only samples of the mask `among` count, and only those at which both signals
    are known.

    All sums over samples are computed together by fast Fourier transforms, with an accuracy of
    about ten digits. The result is NaN where too few samples or too little variation are left.
    """
    size = 1 << (len(left) + most).bit_length()
    known = among & np.isfinite(left)
    x = np.where(known, left, 0.0)
    finite = np.isfinite(right)
    y = np.where(finite, right, 0.0)
    one, of_x, of_xx = np.fft.rfft(np.stack([known, x, x * x]), size)
    two, of_y, of_yy = np.conj(np.fft.rfft(np.stack([finite, y, y * y]), size))
    products = [one * two, of_x * two, of_xx * two, one * of_y, one * of_yy, of_x * of_y]
    shifts = np.fft.irfft(np.stack(products), size)
    n, x_sum, xx_sum, y_sum, yy_sum, xy_sum = np.concatenate(
        [shifts[:, size - most :], shifts[:, : most + 1]], axis=1
    )
    x_size = n * xx_sum - x_sum * x_sum
    y_size = n * yy_sum - y_sum * y_sum
    usable = (n > 10.0) & (np.minimum(x_size, y_size) > 1e-3 * n * n)
    size_of_both = np.sqrt(np.where(usable, x_size * y_size, 1.0))
    return np.where(usable, (n * xy_sum - x_sum * y_sum) / size_of_both, np.nan)


def _bicycle_yaw_rate(speed: FloatArray, steering: FloatArray, vehicle: Vehicle) -> FloatArray:
    """Return the yaw rate (n,) [rad/s] of a bicycle model with the measured steering, integrated by
    the trapezoidal rule: (1 - h A_k) x_k = (1 + h A_k) x_{k-1} + h b (delta_{k-1} + delta_k), where
    x is (v_y, r), h half a time step, and A_k the model at the speed of sample k.

    All samples are computed together by recursive doubling (Kogge and Stone 1973): from
    x_k = P_k x_{k-1} + q_k follows x_k = P_k P_{k-1} x_{k-2} + P_k q_{k-1} + q_k, and so on. The
    motion is zero before the first sample and where the car stands or a reading is missing.
    """
    m = vehicle.mass
    inertia = vehicle.yaw_inertia
    a = vehicle.cg_to_front_axle
    b = vehicle.cg_to_rear_axle
    # Stiffness of all four wheels, divided between the axles by their static load.
    per_share = 4.0 * vehicle.cornering_stiffness / (a + b)
    c_f = b * per_share
    c_r = a * per_share
    half = 0.5 / RATE_HZ
    drives = (speed > SLOWEST) & (np.abs(steering) < 1.0)  # also False where a value is NaN
    v = np.where(drives, speed, 1.0)
    delta = np.where(drives, steering, 0.0)
    coupling = b * c_r - a * c_f
    system = np.array(
        [
            [-(c_f + c_r) / (m * v), coupling / (m * v) - v],
            [coupling / (inertia * v), -(a * a * c_f + b * b * c_r) / (inertia * v)],
        ]
    )
    unit = np.eye(2)[:, :, None]
    implicit = unit - half * system
    determinant = implicit[0, 0] * implicit[1, 1] - implicit[0, 1] * implicit[1, 0]
    inverse = (
        drives
        / determinant
        * np.array([[implicit[1, 1], -implicit[0, 1]], [-implicit[1, 0], implicit[0, 0]]])
    )
    step = np.einsum("ijn,jkn->ikn", inverse, unit + half * system)
    steered = half * (delta + np.concatenate([[0.0], delta[:-1]]))
    motion = np.einsum("ijn,j->in", inverse, np.array([c_f / m, a * c_f / inertia])) * steered
    reach = 1
    while reach < len(speed) and np.abs(step).max() > NEGLIGIBLE:
        motion[:, reach:] += np.einsum("ijn,jn->in", step[:, :, reach:], motion[:, :-reach])
        step[:, :, reach:] = np.einsum("ijn,jkn->ikn", step[:, :, reach:], step[:, :, :-reach])
        step[:, :, :reach] = 0.0
        reach *= 2
    return np.where(drives, motion[1], np.nan)
