"""Detection of wheel speed sensors that fail while the car drives: their readings stay at the last
speed, or fall to zero at once.

A wheel with a failed sensor looks like one that slides on ice. Its readings are therefore left out
until they change again. A locked wheel reads zero too. Zero means a failed sensor only if no brake
could have stopped the wheel so fast, or if the wheel has not turned since the drive began.
"""

from __future__ import annotations

import math

from edge_agent.dynamics.parameters import Parameter
from edge_agent.estimators import flags
from edge_agent.estimators.friction_mixture.block.wheel_readings import STEP_LEAST
from edge_agent.estimators.friction_mixture.state.gap import SLOW_M_S, SLOWEST_M_S
from edge_agent.estimators.friction_mixture.state.memory import LastInputs, WheelSensors
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import S
from schemas.thresholds import GRAVITY, UTILISED_WINDOW_S

# A reading may stay the same for INTERVALS usual intervals between changes, at most UNCHANGED_S
# [s], while all other wheels change their speed by more than FOLLOWS resolution steps.
INTERVALS = 3.0
UNCHANGED_S = 0.3
FOLLOWS = 2.0
FINEST = 0.25  # [rad/s] smallest resolution that is assumed
# [1] largest force of a brake over a quarter of the car's weight. While the car brakes on dry road,
# a front wheel carries this load, and its brake is just able to lock it.
STRONGEST_BRAKE = 1.5


@compiled
def leave_out_failed(row: FloatArray, last: LastInputs, time: float) -> int:
    """Set the readings of failed wheel speed sensors to NaN in the readings of the sample at `time`
    [s], last.now. Return the health flags.

    `row` contains the vehicle's parameters. The function updates the history of the readings.
    """
    sensors = last.wheel_sensors
    health = 0
    for wheel in range(4):
        if not math.isnan(last.now[S.OMEGA + wheel]):
            note_reading(row, last.now, sensors, wheel, time)
    for wheel in range(4):
        change = FOLLOWS * max(last.omega_step[wheel], FINEST)
        if is_frozen(row, sensors, wheel, change, time) or is_dead(row, sensors, wheel):
            last.now[S.OMEGA + wheel] = math.nan
            health = flags.NO_WHEEL_SPEED
    return health


@compiled
def note_reading(
    row: FloatArray, now: FloatArray, sensors: WheelSensors, wheel: int, time: float
) -> None:
    """Update the history of a wheel's readings, in `sensors`, with its reading in `now` (15,) at
    `time` [s]. `row` contains the vehicle's parameters.
    """
    omega = now[S.OMEGA + wheel]
    before = sensors.reading[wheel]
    if omega != before:
        age = time - sensors.changed[wheel]
        kept = sensors.interval[wheel] * math.exp(-age / UTILISED_WINDOW_S)
        sensors.interval[wheel] = max(min(age, UNCHANGED_S), kept)
        sensors.changed[wheel] = time
        for other in range(4):
            sensors.others[wheel, other] = now[S.OMEGA + other]
    if omega * row[Parameter.RADIUS] > SLOWEST_M_S:
        sensors.turned[wheel] = 1
    elif before - omega > strongest_fall(row) * (time - sensors.time[wheel]):
        sensors.turned[wheel] = 0
    sensors.reading[wheel] = omega
    sensors.time[wheel] = time


@compiled
def strongest_fall(row: FloatArray) -> float:
    """Return the largest deceleration of a wheel by its brake [rad/s^2]; `row` contains the
    vehicle's parameters.
    """
    load = 0.25 * row[Parameter.MASS] * GRAVITY
    return float(STRONGEST_BRAKE * load * row[Parameter.RADIUS] / row[Parameter.WHEEL_INERTIA])


@compiled
def is_frozen(
    row: FloatArray, sensors: WheelSensors, wheel: int, change: float, time: float
) -> bool:
    """Return True if a wheel's readings have stayed the same for too long at `time` [s], while all
    other wheels have changed their speed by more than `change` [rad/s]. `row` contains the
    vehicle's parameters.

    The other wheels of a car with a locked wheel may slow down and recover. If this wheel reads
    zero, the car must therefore have gained speed.
    """
    age = time - sensors.changed[wheel]
    if age <= min(INTERVALS * sensors.interval[wheel], UNCHANGED_S):
        return False
    turns = sensors.reading[wheel] * row[Parameter.RADIUS] > SLOWEST_M_S
    smallest_change = slowest = math.inf
    fastest_before = 0.0
    for other in range(4):
        if other != wheel:
            now = sensors.reading[other]
            before = sensors.others[wheel, other]
            if math.isnan(before):
                return False
            smallest_change = min(smallest_change, abs(now - before))
            slowest = min(slowest, now)
            fastest_before = max(fastest_before, before)
    return bool(smallest_change > change if turns else slowest > fastest_before + change)


@compiled
def is_dead(row: FloatArray, sensors: WheelSensors, wheel: int) -> bool:
    """Return True if a wheel that cannot have been stopped by its brake reads zero, while all other
    wheels turn. `row` contains the vehicle's parameters.
    """
    if sensors.turned[wheel] or abs(sensors.reading[wheel]) > STEP_LEAST:
        return False
    for other in range(4):
        if other != wheel and not sensors.reading[other] * row[Parameter.RADIUS] > SLOW_M_S:
            return False
    return True
