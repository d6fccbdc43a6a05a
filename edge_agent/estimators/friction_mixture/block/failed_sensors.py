"""Detection of wheel speed sensors that fail while the car drives: their readings stay at the last
speed, or fall to zero at once.

A wheel with a failed sensor looks like one that slides on ice. Its readings are therefore left out
until they change again. A locked wheel reads zero too. Zero means a failed sensor only if no brake
could have stopped the wheel so fast, or if the wheel has not turned since the drive began.

Two sensors may fail at once, because a bus sends the wheels of an axle together. At least two other
wheels must show that the car drives.
"""

from __future__ import annotations

import math

from edge_agent.dynamics.parameters import Parameter
from edge_agent.estimators import flags
from edge_agent.estimators.common.readings import GAP_S
from edge_agent.estimators.friction_mixture.block.wheel_readings import STEP_LEAST, STEP_MOST
from edge_agent.estimators.friction_mixture.state.gap import SLOW_M_S, SLOWEST_M_S
from edge_agent.estimators.friction_mixture.state.memory import LastInputs, WheelSensors
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import S
from schemas.thresholds import GRAVITY, UTILISED_WINDOW_S

# A reading may stay the same for INTERVALS usual intervals between changes, at most GAP_S, while
# the other wheels change their speed by more than FOLLOWS times its last change.
INTERVALS = 3.0
FOLLOWS = 2.0
FINEST = 0.25  # [rad/s] smallest resolution step that is assumed
# [1] largest force of a brake over a quarter of the car's weight. While the car brakes on dry road,
# a front wheel carries this load, and its brake is just able to lock it.
STRONGEST_BRAKE = 1.5


@compiled
def leave_out_failed(row: FloatArray, last: LastInputs, time: float) -> int:
    """Set the readings of failed wheel speed sensors to NaN in the readings of the sample at `time`
    [s], last.now. Return the health flags.

    `row` contains the vehicle's parameters. The function updates the history of the readings,
    last.wheel_sensors.
    """
    sensors = last.wheel_sensors
    health = 0
    for wheel in range(4):
        if not math.isnan(last.now[S.OMEGA + wheel]):
            note_reading(row, sensors, wheel, last.now[S.OMEGA + wheel], time)
    for wheel in range(4):
        if sensors.changed[wheel] == time:
            for other in range(4):
                sensors.others[wheel, other] = sensors.reading[other]
        if is_frozen(row, sensors, wheel, time) or is_dead(row, sensors, wheel):
            last.now[S.OMEGA + wheel] = math.nan
            health = flags.NO_WHEEL_SPEED
    return health


@compiled
def note_reading(
    row: FloatArray, sensors: WheelSensors, wheel: int, omega: float, time: float
) -> None:
    """Update the history of a wheel's readings, in `sensors`, with the reading `omega` [rad/s] at
    `time` [s]. `row` contains the vehicle's parameters.
    """
    before = sensors.reading[wheel]
    if omega != before:
        age = time - sensors.changed[wheel]
        kept = sensors.interval[wheel] * math.exp(-age / UTILISED_WINDOW_S)
        sensors.interval[wheel] = max(min(age, GAP_S), kept)
        sensors.changed[wheel] = time
        sensors.step[wheel] = min(max(abs(omega - before), FINEST), STEP_MOST)
    if omega * row[Parameter.RADIUS] > SLOWEST_M_S:
        sensors.turned[wheel] = 1
        sensors.fell[wheel] = 0
    elif before - omega > strongest_fall(row) * (time - sensors.time[wheel]):
        sensors.fell[wheel] = 1
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
def is_frozen(row: FloatArray, sensors: WheelSensors, wheel: int, time: float) -> bool:
    """Return True if a wheel's readings have stayed the same for too long at `time` [s], while the
    other wheels have changed their speed by FOLLOWS steps of this wheel. `row` contains the
    vehicle's parameters.

    The other wheels of a car with a locked wheel may slow down and recover. If this wheel reads
    zero, the car must therefore have gained speed. Wheels whose fine readings stopped changing at
    the same time as this wheel's do not count.
    """
    usual = sensors.interval[wheel]
    if time - sensors.changed[wheel] <= min(INTERVALS * usual, GAP_S):
        return False
    turns = sensors.reading[wheel] * row[Parameter.RADIUS] > SLOWEST_M_S
    fine = sensors.step[wheel] <= FINEST
    smallest_change = math.inf
    slowest = math.inf
    fastest_before = 0.0
    count = 0
    for other in range(4):
        together = abs(sensors.changed[other] - sensors.changed[wheel]) <= usual
        if other == wheel or (turns and fine and together):
            continue
        now = sensors.reading[other]
        before = sensors.others[wheel, other]
        count += 1
        smallest_change = min(smallest_change, abs(now - before))
        slowest = min(slowest, now)
        fastest_before = max(fastest_before, before)
    change = FOLLOWS * sensors.step[wheel]
    follows = smallest_change > change if turns else slowest > fastest_before + change
    return bool(count >= 2 and follows)


@compiled
def is_dead(row: FloatArray, sensors: WheelSensors, wheel: int) -> bool:
    """Return True if a wheel that cannot have been stopped by its brake reads zero, while at least
    two other wheels turn. If the wheel has not turned since the drive began, all others must turn,
    because the driven wheels may spin on ice. `row` contains the vehicle's parameters.
    """
    braked = sensors.turned[wheel] == 1 and sensors.fell[wheel] == 0
    if braked or abs(sensors.reading[wheel]) > STEP_LEAST:
        return False
    count = 0
    for other in range(4):
        if sensors.reading[other] * row[Parameter.RADIUS] > SLOW_M_S:
            count += 1
    return bool(count >= (2 if sensors.fell[wheel] == 1 else 3))
