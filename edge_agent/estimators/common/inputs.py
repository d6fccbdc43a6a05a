"""Readings of one vehicle, prepared for a filter that steps once per sample.

This module refuses implausible readings, detects gaps in time, replaces missing inputs and computes
the grip in use. A reading that is missing, infinite or implausible is NaN in `InputTrack.now`. The
filter then leaves out the measurement equation that needs the reading. Where the filter needs a
reading as an input, `InputTrack.inputs` has a replacement. For the accelerations it is zero (a_x)
and r*v_x (a_y), for yaw rate and steering the last value, and for torque the wheel's share of the
force m*a_x. A missing wheel speed stays NaN, and that wheel is assumed to roll freely.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Annotated

from edge_agent.dynamics.loads import wheel_loads
from edge_agent.dynamics.parameters import Parameter, body_of
from edge_agent.estimators import flags
from edge_agent.estimators.common.excitation import Excitation, begin_excitation, note_excitation
from edge_agent.estimators.common.readings import (
    GAP_S,
    INPUTS,
    position_health,
    position_time,
    read_plausible,
    rolling_speed,
)
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import S
from schemas.thresholds import GRAVITY


class SampleUse(IntEnum):
    """Use that a filter makes of a sample: it skips the sample, begins at it or advances to it."""

    REFUSED = 0
    BEGUN = 1
    STEPPED = 2


class InputTrack:
    """Input signals of one vehicle that are kept from one sample to the next, with their times."""

    started: bool
    time: float  # [s] time of the last sample
    position_time: float  # [s] time of the last position
    now: Annotated[FloatArray, INPUTS]  # readings, NaN where missing
    inputs: Annotated[FloatArray, INPUTS]  # readings, with replacements where missing
    inputs_before: Annotated[FloatArray, INPUTS]  # `inputs` of the previous sample
    steering: Annotated[FloatArray, 2, 4]  # cosine and sine of the steering in `inputs`
    steering_before: Annotated[FloatArray, 2, 4]
    excitation: Excitation


@compiled
def take_sample_in(
    track: InputTrack, row: FloatArray, time: float, sample: FloatArray
) -> tuple[int, int, float]:
    """Check a sample (18,) of a vehicle at `time` [s], and store its readings in `track`. `row` are
    the vehicle's parameters.

    Return three items: the health flags, the use of the sample (`SampleUse`), and the time [s]
    since the previous sample.
    """
    begins = not track.started
    dt = time - track.time
    if not math.isfinite(time) or not (begins or dt > 0.0):
        return flags.TIME_GAP, SampleUse.REFUSED, 0.0
    silent = not begins and dt > GAP_S
    if begins:
        _reset_track(track)
    health = read_plausible(sample, track.now)
    track.position_time = position_time(sample, time, track.position_time)
    health |= position_health(time, track.position_time)
    _store_inputs(track)
    _fill_inputs(track, row, begins or silent)
    track.time = time
    note_excitation(track.excitation, time, _grip_used(track, row))
    if begins or silent:
        _store_inputs(track)
        return health | flags.RESET | (flags.TIME_GAP if silent else 0), SampleUse.BEGUN, 0.0
    return health, SampleUse.STEPPED, dt


@compiled
def _reset_track(track: InputTrack) -> None:
    """Reset the stored input signals of a vehicle to the state before the first sample, with the
    wheels straight ahead.
    """
    track.started = True
    track.position_time = -math.inf
    for wheel in range(4):
        track.steering[0, wheel] = 1.0
        track.steering[1, wheel] = 0.0
    begin_excitation(track.excitation)


@compiled
def _store_inputs(track: InputTrack) -> None:
    """Store the input signals of this sample as the previous inputs for the next sample."""
    for k in range(INPUTS):
        track.inputs_before[k] = track.inputs[k]
    for wheel in range(4):
        track.steering_before[0, wheel] = track.steering[0, wheel]
        track.steering_before[1, wheel] = track.steering[1, wheel]


@compiled
def _fill_inputs(track: InputTrack, row: FloatArray, anew: bool) -> None:
    """Fill the inputs of the vehicle model, `track.inputs`, from the readings, and replace missing
    values. If the last argument is True, the filter begins at this sample. Values of earlier
    samples are then not used as replacements.
    """
    now = track.now
    use = track.inputs
    for k in range(S.YAW_RATE, S.OMEGA):
        value = now[k] if now[k] == now[k] else 0.0 if anew else use[k]
        if k >= S.DELTA and value != use[k]:
            track.steering[0, k - S.DELTA] = math.cos(value)
            track.steering[1, k - S.DELTA] = math.sin(value)
        use[k] = value
    speed = rolling_speed(row, now)
    use[S.AX] = 0.0 if math.isnan(now[S.AX]) else now[S.AX]
    turning = 0.0 if math.isnan(speed) else use[S.YAW_RATE] * speed
    use[S.AY] = turning if math.isnan(now[S.AY]) else now[S.AY]
    share = 0.25 * row[Parameter.MASS] * use[S.AX] * row[Parameter.RADIUS]
    for wheel in range(4):
        torque = now[S.TORQUE + wheel]
        use[S.OMEGA + wheel] = now[S.OMEGA + wheel]
        use[S.TORQUE + wheel] = share if math.isnan(torque) else torque


@compiled
def _grip_used(track: InputTrack, row: FloatArray) -> float:
    """Return the grip in use at this sample, sqrt(x^2 + y^2) [1], of the wheel that uses most.

    x is the longitudinal force over load, torque/(radius*load), of this wheel. y is the lateral
    acceleration in g.
    """
    use = track.inputs
    loads = wheel_loads(body_of(row), use[S.AX], use[S.AY])
    most = 0.0
    for wheel in range(4):
        most = max(most, abs(use[S.TORQUE + wheel]) / loads[wheel])
    return math.sqrt((most / row[Parameter.RADIUS]) ** 2 + (use[S.AY] / GRAVITY) ** 2)


@compiled
def wheel_force(row: FloatArray, track: InputTrack, wheel: int, step: float) -> float:
    """Return the longitudinal force F_x = (T - J*omega')/R [N] of a wheel (paper 000, equation 10),
    from torque T, inertia J and radius R.

    omega' is the change of the wheel speed between two samples, divided by `step`, the time [s]
    between them.
    """
    gain = track.inputs[S.OMEGA + wheel] - track.inputs_before[S.OMEGA + wheel]
    turning = 0.0 if math.isnan(gain) or step <= 0.0 else gain / step
    return float(
        (track.inputs[S.TORQUE + wheel] - row[Parameter.WHEEL_INERTIA] * turning)
        / row[Parameter.RADIUS]
    )
