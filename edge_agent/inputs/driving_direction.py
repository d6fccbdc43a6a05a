"""Sign of the wheel speeds of a car that drives backwards.

Most wheel-speed sensors do not report the direction. A positive speed in reverse contradicts the
yaw rate and the accelerations, and the filter would take each parking manoeuvre for a slide on ice.
While a car starts from standstill, the sign of its acceleration shows the direction. The direction
holds until the car stands again.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.runtime.records import Records, records
from schemas.signals import S
from schemas.vehicle import Vehicle

STANDS_M_S: Final = 0.1  # [m/s] speed of the wheels below which the car may stand
SETTLED_S: Final = 0.5  # [s] time after which a car that has stopped no longer pitches
REST_S: Final = 1.0  # [s] time after that in which a_x at standstill is averaged
# [m/s^2] Beyond this change of a_x the car moves, although many sensors report no speed below
# 1 m/s.
QUIET_M_S2: Final = 0.3
# [m/s] velocity gained since standstill, according to a_x, that shows the direction. A change of
# the slope by 3 % (.3 m/s^2) needs a second to feign it.
SURE_M_S: Final = 0.3
PROBABLY_M_S: Final = (
    -0.05
)  # [m/s] velocity gained by a car that probably begins to drive backwards
# [1] smallest and largest speed of the wheels over the velocity gained. Other ratios mean that the
# wheels slide, or that the slope has changed.
ALIKE: Final = (0.5, 3.0)
UNDECIDED_M_S: Final = 2.0  # [m/s] a car that reaches this speed undecided drives forwards
FASTEST_REVERSE_M_S: Final = 10.0  # [m/s] reverse gears of cars end at about 30 km/h
GAP_S: Final = 0.5  # [s] a_x is not integrated over a longer gap between two samples
NEGATIVE_RAD_S: Final = -0.2  # [rad/s] a wheel speed below this shows a sensor with sign


class DirectionRecord:
    """State of the search for the direction of travel, kept from one sample to the next."""

    time: float  # [s] time of the last sample
    stopped: float  # [s] time at which the wheels stopped; NaN while they turn
    resting_ax: float  # [m/s^2] a_x at standstill: offset and slope
    gained: float  # [m/s] velocity gained since standstill, according to a_x
    is_decided: bool  # True if the direction is known, or no standstill has been seen
    is_backwards: bool
    has_sign: bool  # True once a wheel speed was negative


class DrivingDirection:
    """Corrector of the sign of one vehicle's wheel speeds. The samples may be passed in blocks of
    any length.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._radius = vehicle.wheel_radius
        self._state = records(DirectionRecord, 1)
        self._state["time"] = np.nan
        self._state["stopped"] = np.nan
        self._state["is_decided"] = True

    def advance(self, t: FloatArray, signals: FloatArray) -> FloatArray:
        """Return signals (T, 18) with negative wheel speeds where the car drives backwards, for
        the next samples at the times t (T,) [s]. Where it begins to do so, the speeds are NaN.

        If there is nothing to correct, the result is the array `signals` itself.
        """
        signs = np.ones(len(t))
        find_signs(self._state, self._radius, t, signals, signs)
        if (signs == 1.0).all():
            return signals
        signals = signals.copy()
        signals[:, S.OMEGA : S.OMEGA + 4] *= signs[:, None]
        return signals


def sign_wheels(t: FloatArray, signals: FloatArray, vehicle: Vehicle) -> FloatArray:
    """Return all signals (T, 18) of a log with times t (T,) [s], with negative wheel speeds where
    the car drives backwards.
    """
    return DrivingDirection(vehicle).advance(t, signals)


@compiled
def find_signs(
    states: Records[DirectionRecord],
    radius: float,
    t: FloatArray,
    signals: FloatArray,
    signs: FloatArray,
) -> None:
    """Write into `signs` (T,) the factor of the wheel speeds at each of the samples (T, 18) with
    times t (T,) [s]: -1 where the car drives backwards although the speeds are positive, NaN where
    it probably begins to do so, else 1. `radius` is that of the wheels [m].
    """
    state = states[0]
    for k in range(len(t)):
        step = t[k] - state.time
        step = step if 0.0 < step < GAP_S else 0.0
        state.time = t[k]
        total = 0.0
        count = 0
        for wheel in range(4):
            omega = signals[k, S.OMEGA + wheel]
            if not math.isnan(omega):
                total += omega
                count += 1
                state.has_sign = state.has_sign or omega < NEGATIVE_RAD_S
        if count > 0:
            _follow(state, radius * total / count, signals[k, S.AX], step)
        if state.has_sign:
            signs[k] = 1.0
        elif state.is_backwards:
            signs[k] = -1.0
        elif not state.is_decided and state.gained < PROBABLY_M_S:
            signs[k] = math.nan
        else:
            signs[k] = 1.0


@compiled
def _follow(state: DirectionRecord, speed: float, ax: float, step: float) -> None:
    """Update the direction with the mean speed of the wheels [m/s] and a_x [m/s^2], NaN if missing,
    of a sample `step` [s] after the last one.
    """
    change = 0.0 if math.isnan(ax) else ax - state.resting_ax
    if speed < STANDS_M_S:
        if math.isnan(state.stopped):
            state.stopped = state.time
            state.gained = 0.0
            state.is_decided = False
        rests = state.time - state.stopped - SETTLED_S
        if rests <= 0.0:
            return
        state.is_backwards = False
        if rests <= REST_S:
            state.resting_ax += change * min(step / rests, 1.0)
        elif abs(change) < QUIET_M_S2:
            state.gained = 0.0
        else:
            state.gained += change * step
        return
    state.stopped = math.nan
    if state.is_decided:
        state.is_backwards = state.is_backwards and speed < FASTEST_REVERSE_M_S
        return
    state.gained += change * step
    size = abs(state.gained)
    if size >= SURE_M_S and ALIKE[0] * size <= speed <= ALIKE[1] * size:
        state.is_decided = True
        state.is_backwards = state.gained < 0.0
    elif speed > UNDECIDED_M_S:
        state.is_decided = True
        state.is_backwards = False
