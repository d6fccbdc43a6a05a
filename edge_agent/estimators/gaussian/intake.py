"""Readings of one vehicle made fit for a filter that steps once a sample: refusals, gaps, replacements, grip used.

A reading that is missing, infinite or unbelievable is NaN in `now`, and that row of a measurement is left out. Where a
filter takes it as an input it is replaced in `use`: accelerations by nothing and r*v_x, yaw rate and steering by the
last value, torque by the share of m*a_x; a wheel without speed stays NaN and is taken to roll freely.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from edge_agent.dynamics.loads import wheel_loads
from edge_agent.dynamics.parameters import GRAVITY, P, body
from edge_agent.estimators import flags
from edge_agent.estimators.friction_mixture.sample import GAP_S, POSITION_S, limit, reading, rolling_speed
from schemas.numeric import BoolArray, FloatArray, IntArray, compiled
from schemas.signals import S

INPUTS = 15  # channels before the position
RING = 64  # grip used: so many slots of at least SLOT_S hold the last second
SLOT_S = 0.02
EXCITED_S = 1.0  # memory of the grip used, by contract

REFUSED, BEGUN, STEPPED = 0, 1, 2  # what became of a sample


class Track(NamedTuple):
    """What is carried of the samples of N vehicles."""

    started: BoolArray  # (N,)
    time: FloatArray  # (N,) of the last sample [s]
    position_time: FloatArray  # (N,) of the last position [s]
    now: FloatArray  # (N, 15) readings, NaN where there is none
    use: FloatArray  # (N, 15) inputs
    before: FloatArray  # (N, 15) inputs of the sample before
    ring_time: FloatArray  # (N, RING) [s]
    ring_used: FloatArray  # (N, RING) [1]
    ring_next: IntArray  # (N,)


def new_track(count: int) -> Track:
    """The track of `count` vehicles that have not sent a sample."""
    return Track(
        started=np.zeros(count, np.bool_),
        time=np.zeros(count),
        position_time=np.full(count, -np.inf),
        now=np.zeros((count, INPUTS)),
        use=np.zeros((count, INPUTS)),
        before=np.zeros((count, INPUTS)),
        ring_time=np.full((count, RING), -np.inf),
        ring_used=np.zeros((count, RING)),
        ring_next=np.zeros(count, np.int64),
    )


@compiled
def take(track: Track, row: FloatArray, n: int, time: float, sample: FloatArray) -> tuple[int, int, float]:
    """Take sample (18,) of vehicle n at `time` [s]: (health flags, REFUSED | BEGUN | STEPPED, seconds gone)."""
    begins = not track.started[n]
    gone = time - track.time[n]
    if not math.isfinite(time) or not (begins or gone > 0.0):
        return flags.TIME_GAP, REFUSED, 0.0
    silent = not begins and gone > GAP_S
    health = _checks(track, n, time, sample)
    if begins or silent:
        track.started[n] = True
        track.use[n] = 0.0
    track.before[n] = track.use[n]
    _inputs(track, row, n, sample)
    track.time[n] = time
    _excitation(track, row, n, time)
    if begins or silent:
        track.before[n] = track.use[n]
        return health | flags.RESET | (flags.TIME_GAP if silent else 0), BEGUN, 0.0
    return health, STEPPED, gone


@compiled
def _checks(track: Track, n: int, time: float, sample: FloatArray) -> int:
    health = 0
    for channel in range(INPUTS):
        value = sample[channel]
        track.now[n, channel] = reading(sample, channel)
        if not math.isnan(value) and not abs(value) <= limit(channel):
            health |= flags.OUTLIER
    now = track.now[n]
    if math.isfinite(sample[S.LATITUDE]) and math.isfinite(sample[S.LONGITUDE]):
        track.position_time[n] = time
    if not time - track.position_time[n] <= POSITION_S:
        health |= flags.NO_POSITION
    if math.isnan(now[S.AX] + now[S.AY] + now[S.YAW_RATE]):
        health |= flags.NO_INERTIAL
    if math.isnan(now[S.DELTA] + now[S.DELTA + 1]):
        health |= flags.NO_STEERING
    for wheel in range(4):
        if math.isnan(now[S.OMEGA + wheel]):
            health |= flags.NO_WHEEL_SPEED
        if math.isnan(now[S.TORQUE + wheel]):
            health |= flags.NO_TORQUE
    return health


@compiled
def _inputs(track: Track, row: FloatArray, n: int, sample: FloatArray) -> None:
    now, use = track.now[n], track.use[n]
    if not math.isnan(now[S.YAW_RATE]):
        use[S.YAW_RATE] = now[S.YAW_RATE]
    speed = rolling_speed(row, sample)
    use[S.AX] = 0.0 if math.isnan(now[S.AX]) else now[S.AX]
    turning = 0.0 if math.isnan(speed) else use[S.YAW_RATE] * speed
    use[S.AY] = turning if math.isnan(now[S.AY]) else now[S.AY]
    share = 0.25 * row[P.MASS] * use[S.AX] * row[P.RADIUS]
    for wheel in range(4):
        if not math.isnan(now[S.DELTA + wheel]):
            use[S.DELTA + wheel] = now[S.DELTA + wheel]
        use[S.OMEGA + wheel] = now[S.OMEGA + wheel]
        torque = now[S.TORQUE + wheel]
        use[S.TORQUE + wheel] = share if math.isnan(torque) else torque


@compiled
def _excitation(track: Track, row: FloatArray, n: int, time: float) -> None:
    """Grip used by the hardest-working wheel now: hypot of torque over radius and load, and lateral g."""
    use = track.use[n]
    loads = wheel_loads(body(row), use[S.AX], use[S.AY])
    used = 0.0
    for wheel in range(4):
        along = use[S.TORQUE + wheel] / (row[P.RADIUS] * loads[wheel])
        used = max(used, math.hypot(along, use[S.AY] / GRAVITY))
    place = track.ring_next[n]
    if not time - track.ring_time[n, place] < SLOT_S:
        place = (place + 1) % RING
        track.ring_next[n], track.ring_time[n, place], track.ring_used[n, place] = place, time, used
    else:
        track.ring_used[n, place] = max(track.ring_used[n, place], used)


@compiled
def grip_used(track: Track, n: int) -> float:
    """Largest grip that any wheel of vehicle n used in the last second [1]."""
    used = 0.0
    for k in range(RING):
        if track.ring_time[n, k] > track.time[n] - EXCITED_S:
            used = max(used, track.ring_used[n, k])
    return used


@compiled
def wheel_force(row: FloatArray, before: FloatArray, use: FloatArray, wheel: int, step: float) -> float:
    """F_x = (T - J*omega')/R [N] of a wheel from inputs `step` [s] apart (paper 000, equation 10)."""
    gain = use[S.OMEGA + wheel] - before[S.OMEGA + wheel]
    turning = 0.0 if math.isnan(gain) or step <= 0.0 else gain / step
    return float((use[S.TORQUE + wheel] - row[P.WHEEL_INERTIA] * turning) / row[P.RADIUS])
