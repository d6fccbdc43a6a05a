"""Readings of one vehicle made fit for a filter that steps once a sample: refusals, gaps, replacements, grip used.

A reading that is missing, infinite or unbelievable is NaN in `now`, and that row of a measurement is left out. Where a
filter takes it as an input it is replaced in `use`: accelerations by nothing and r*v_x, yaw rate and steering by the
last value, torque by the share of m*a_x; a wheel without speed stays NaN and is taken to roll freely.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np

from edge_agent.dynamics.loads import wheel_loads
from edge_agent.dynamics.parameters import P, body, parameter_table
from edge_agent.estimators import flags
from edge_agent.estimators.common.readings import GAP_S, INPUTS, LIMITS, POSITION_S, rolling_speed
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.runtime.records import RecordArray, records
from schemas.signals import S
from schemas.thresholds import GRAVITY
from schemas.vehicle import Vehicle

RING = 64  # grip used: so many slots of at least SLOT_S hold the last second
SLOT_S = 0.02
EXCITED_S = 1.0  # memory of the grip used, by contract

REFUSED, BEGUN, STEPPED = 0, 1, 2  # what became of a sample

# health flags of a channel without a reading; the rear wheels' steering is optional
MISSING = np.array(
    [flags.NO_INERTIAL] * 3 + [flags.NO_STEERING] * 2 + [0] * 2 + [flags.NO_WHEEL_SPEED] * 4 + [flags.NO_TORQUE] * 4
)


class Track:
    """What is carried of the samples of one vehicle."""

    started: bool
    time: float  # of the last sample [s]
    position_time: float  # of the last position [s]
    now: Annotated[FloatArray, INPUTS]  # readings, NaN where there is none
    use: Annotated[FloatArray, INPUTS]  # inputs
    before: Annotated[FloatArray, INPUTS]  # inputs of the sample before
    turned: Annotated[FloatArray, 2, 4]  # cosine and sine of the steering in `use`
    turned_before: Annotated[FloatArray, 2, 4]
    ring_time: Annotated[FloatArray, RING]  # [s]
    ring_used: Annotated[FloatArray, RING]  # [1]
    ring_next: int
    used: float  # largest of the ring within the last second [1]
    used_time: float  # of its slot [s]


def new_filters(kind: type, vehicles: Sequence[Vehicle]) -> RecordArray:
    """A record of `kind` per vehicle, with its `row`; all else is zero, as `take` expects it."""
    filters = records(kind, len(vehicles))
    filters["row"] = parameter_table(vehicles)
    return filters


@compiled
def take(track: Track, row: FloatArray, time: float, sample: FloatArray) -> tuple[int, int, float]:
    """Take sample (18,) of a vehicle at `time` [s]: (health flags, REFUSED | BEGUN | STEPPED, seconds gone)."""
    begins = not track.started
    gone = time - track.time
    if not math.isfinite(time) or not (begins or gone > 0.0):
        return flags.TIME_GAP, REFUSED, 0.0
    silent = not begins and gone > GAP_S
    if begins:
        _begin(track)
    health = _checks(track, time, sample)
    _remember(track)
    _inputs(track, row, sample, begins or silent)
    track.time = time
    _excitation(track, row, time)
    if begins or silent:
        _remember(track)
        return health | flags.RESET | (flags.TIME_GAP if silent else 0), BEGUN, 0.0
    return health, STEPPED, gone


@compiled
def _begin(track: Track) -> None:
    """Nothing has been seen so far; the wheels are straight."""
    track.started = True
    track.position_time = track.used_time = -math.inf
    for wheel in range(4):
        track.turned[0, wheel], track.turned[1, wheel] = 1.0, 0.0
    for k in range(RING):
        track.ring_time[k] = -math.inf


@compiled
def _checks(track: Track, time: float, sample: FloatArray) -> int:
    now, odd, missing = track.now, 0, 0
    for channel in range(INPUTS):
        value = sample[channel]
        there, believed = value == value, abs(value) <= LIMITS[channel]
        now[channel] = value if believed else math.nan
        odd |= flags.OUTLIER if there and not believed else 0
        missing |= 0 if believed else MISSING[channel]
    if math.isfinite(sample[S.LATITUDE]) and math.isfinite(sample[S.LONGITUDE]):
        track.position_time = time
    return odd | missing | (0 if time - track.position_time <= POSITION_S else flags.NO_POSITION)


@compiled
def _remember(track: Track) -> None:
    """The inputs become those of the sample before."""
    for k in range(INPUTS):
        track.before[k] = track.use[k]
    for wheel in range(4):
        track.turned_before[0, wheel], track.turned_before[1, wheel] = track.turned[0, wheel], track.turned[1, wheel]


@compiled
def _inputs(track: Track, row: FloatArray, sample: FloatArray, anew: bool) -> None:
    """Fill `use`; anew: what was used before counts no more."""
    now, use = track.now, track.use
    for k in range(S.YAW_RATE, S.OMEGA):
        value = now[k] if now[k] == now[k] else 0.0 if anew else use[k]
        if k >= S.DELTA and value != use[k]:
            track.turned[0, k - S.DELTA], track.turned[1, k - S.DELTA] = math.cos(value), math.sin(value)
        use[k] = value
    speed = rolling_speed(row, sample)
    use[S.AX] = 0.0 if math.isnan(now[S.AX]) else now[S.AX]
    turning = 0.0 if math.isnan(speed) else use[S.YAW_RATE] * speed
    use[S.AY] = turning if math.isnan(now[S.AY]) else now[S.AY]
    share = 0.25 * row[P.MASS] * use[S.AX] * row[P.RADIUS]
    for wheel in range(4):
        torque = now[S.TORQUE + wheel]
        use[S.OMEGA + wheel] = now[S.OMEGA + wheel]
        use[S.TORQUE + wheel] = share if math.isnan(torque) else torque


@compiled
def _excitation(track: Track, row: FloatArray, time: float) -> None:
    """Grip used by the hardest-working wheel now: hypot of torque over radius and load, and lateral g."""
    use = track.use
    loads, most = wheel_loads(body(row), use[S.AX], use[S.AY]), 0.0
    for wheel in range(4):
        most = max(most, abs(use[S.TORQUE + wheel]) / loads[wheel])
    used = math.sqrt((most / row[P.RADIUS]) ** 2 + (use[S.AY] / GRAVITY) ** 2)
    place = track.ring_next
    if not time - track.ring_time[place] < SLOT_S:
        place = (place + 1) % RING
        track.ring_next, track.ring_time[place], track.ring_used[place] = place, time, used
    else:
        track.ring_used[place] = max(track.ring_used[place], used)
    if track.ring_used[place] >= track.used:
        track.used, track.used_time = track.ring_used[place], track.ring_time[place]
    elif not track.used_time > time - EXCITED_S:
        _look_back(track, time)


@compiled
def _look_back(track: Track, time: float) -> None:
    """The largest of the ring has grown old: which is it now?"""
    track.used = 0.0
    for k in range(RING):
        if track.ring_time[k] > time - EXCITED_S and track.ring_used[k] >= track.used:
            track.used, track.used_time = track.ring_used[k], track.ring_time[k]


@compiled
def wheel_force(row: FloatArray, before: FloatArray, use: FloatArray, wheel: int, step: float) -> float:
    """F_x = (T - J*omega')/R [N] of a wheel from inputs `step` [s] apart (paper 000, equation 10)."""
    gain = use[S.OMEGA + wheel] - before[S.OMEGA + wheel]
    turning = 0.0 if math.isnan(gain) or step <= 0.0 else gain / step
    return float((use[S.TORQUE + wheel] - row[P.WHEEL_INERTIA] * turning) / row[P.RADIUS])
