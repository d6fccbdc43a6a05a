"""Sensor model that computes readings from a record of true values, with white noise, constant
offsets, gains, a slowly varying position error and missing readings.

Sensor sets whose name begins with "rough" have the errors of real cars; `misaligned.py` describes
these further errors and their sources. Every random number is a hash of (vehicle key, sample
number, channel). Therefore a reading depends neither on the division of a drive into blocks nor on
the other vehicles. Only the slow error of the position receiver is kept between blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from edge_agent.lab.simulation.counter_rng import key_of, normal, uniform
from edge_agent.lab.simulation.misaligned import (
    ALIGNED,
    COLUMNS,
    DEVICE_OF,
    DEVICES,
    MISALIGNED,
    Misaligned,
    Misalignment,
    delayed_record,
    misalign,
    misalignment_row,
    quantise_speeds,
)
from edge_agent.lab.simulation.place import Origin
from edge_agent.lab.simulation.record import RecordColumn
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import CHANNELS, S

KeyArray: TypeAlias = NDArray[np.uint64]


@dataclass(frozen=True)
class Sensors:
    """Errors of a set of sensors: standard deviations of white noise, standard deviations of
    offsets and gain errors that are drawn once per drive, and further errors.
    """

    acceleration: tuple[float, float] = (0.0, 0.0)  # [m/s^2] white noise, offset
    yaw_rate: tuple[float, float] = (0.0, 0.0)  # [rad/s] white noise, offset
    steering: tuple[float, float] = (0.0, 0.0)  # [rad] white noise, offset
    wheel_speed: float = 0.0  # [rad/s] white noise
    # [N·m] white noise; relative error of the gain, which is common to all wheels
    torque: tuple[float, float] = (
        0.0,
        0.0,
    )
    # [m] white noise and slowly varying error, each to the north and to the east
    position: tuple[float, float] = (0.0, 0.0)
    yaw: tuple[float, float] = (0.0, 0.0)  # [rad] white noise and slowly varying error
    # True for accelerometers fixed to the rolling body, which measure a part of gravity
    leak: bool = False
    # Probability that a group of channels is silent in a given half second.
    dropouts: float = 0.0
    mounted: Misalignment = ALIGNED  # errors of the mounting of the devices, and of their clocks


ORDINARY: Final = {
    "ideal": Sensors(),
    "mems": Sensors(
        acceleration=(0.05, 0.03),
        yaw_rate=(0.002, 0.001),
        steering=(0.001, 0.0005),
        wheel_speed=0.03,
        torque=(2.0, 0.03),
        position=(0.3, 1.5),
        yaw=(0.01, 0.01),
    ),
    "mems-leak": Sensors(
        acceleration=(0.05, 0.03),
        yaw_rate=(0.002, 0.001),
        steering=(0.001, 0.0005),
        wheel_speed=0.03,
        torque=(2.0, 0.03),
        position=(0.3, 1.5),
        yaw=(0.01, 0.01),
        leak=True,
    ),
    "mems-patchy": Sensors(
        acceleration=(0.05, 0.03),
        yaw_rate=(0.002, 0.001),
        steering=(0.001, 0.0005),
        wheel_speed=0.03,
        torque=(2.0, 0.03),
        position=(0.3, 1.5),
        yaw=(0.01, 0.01),
        leak=True,
        dropouts=0.002,
    ),
}
SENSORS: Final = ORDINARY | {
    name: replace(ORDINARY["mems-leak"], yaw_rate=(0.002, 0.003), mounted=mounted)
    for name, mounted in MISALIGNED.items()
}
# Sensors of inaccurate vehicles in a live fleet. Half of the cars record torque, and channels are
# sometimes silent.
ROUGH_FLEET: Final = replace(
    SENSORS["rough"], dropouts=0.002, mounted=replace(SENSORS["rough"].mounted, torqueless=0.5)
)

FIX_S: Final = 0.1  # [s] period of positions; the samples in between have none
WANDER_S: Final = 60.0  # [s] correlation time of the slowly varying error of a receiver
SILENCE_S: Final = 0.5  # [s] length of one dropout

# Number of counters per sample in a random stream. Those below len(CHANNELS) are for the white
# noise of the channels.
DRAWS: Final = 32
WANDER_DRAW: Final = 24  # first of three counters for the slowly varying errors
OFFSET_STREAM: Final = 1
WHITE_STREAM: Final = 2
SILENCE_STREAM: Final = 3

# Groups of channels that fall silent together.
GROUPS: Final = (
    "inertial",
    "steering",
    "wheel_fl",
    "wheel_fr",
    "wheel_rl",
    "wheel_rr",
    "torque",
    "receiver",
)
GROUP_OF: Final = np.array([0, 0, 0, 1, 1, 1, 1, 2, 3, 4, 5, 6, 6, 6, 6, 7, 7, 7])


class ErrorColumn(IntEnum):
    """Index of a column in a vehicle's row of sensor errors: white noise std, offset and gain of
    every channel, then the other errors.
    """

    WHITE = 0
    OFFSET = len(CHANNELS)
    GAIN = 2 * len(CHANNELS)
    # standard deviations of the three slowly varying errors: latitude, longitude, yaw
    WANDER = 3 * len(CHANNELS)
    LEAK = 3 * len(CHANNELS) + 3
    DROPOUTS = 3 * len(CHANNELS) + 4
    MOUNTED = 3 * len(CHANNELS) + 5  # first of the columns of `misaligned.Misaligned`


ERRORS: Final = int(ErrorColumn.MOUNTED) + COLUMNS


def sensors_named(name: str | Sensors) -> Sensors:
    """Return the sensor set called `name`, or the given sensor set itself.

    Raises:
        InputError: there is no such set.
    """
    if isinstance(name, Sensors):
        return name
    if name not in SENSORS:
        raise InputError(
            "sensors", f"there is no sensor set {name!r}", f"choose one of {', '.join(SENSORS)}"
        )
    return SENSORS[name]


def error_row(sensors: Sensors, origin: Origin, seed: int, index: int) -> FloatArray:
    """Return the sensor errors of vehicle `index`, shape (ERRORS,), with the columns of
    ErrorColumn. Offsets and gains are drawn randomly.
    """
    north, east = origin.per_metre
    white = np.zeros(len(CHANNELS))
    offset = np.zeros(len(CHANNELS))
    for first, count, (std, bias) in (
        (S.AX, 2, sensors.acceleration),
        (S.YAW_RATE, 1, sensors.yaw_rate),
        (S.DELTA, 4, sensors.steering),
        (S.OMEGA, 4, (sensors.wheel_speed, 0.0)),
        (S.TORQUE, 4, (sensors.torque[0], 0.0)),
        (S.LATITUDE, 1, (sensors.position[0] * north, 0.0)),
        (S.LONGITUDE, 1, (sensors.position[0] * east, 0.0)),
        (S.YAW, 1, (sensors.yaw[0], 0.0)),
    ):
        white[first : first + count] = std
        offset[first : first + count] = bias
    rng = np.random.default_rng([seed, index, OFFSET_STREAM])
    gain = np.ones(len(CHANNELS))
    gain[S.TORQUE : S.TORQUE + 4] += rng.normal(0.0, sensors.torque[1])
    offset *= rng.standard_normal(len(CHANNELS))
    offset[S.DELTA : S.DELTA + 4] = offset[S.DELTA]  # one steering sensor gives all four angles
    wander = (sensors.position[1] * north, sensors.position[1] * east, sensors.yaw[1])
    mounted = misalignment_row(sensors.mounted, seed, index)
    return np.array(
        [*white, *offset, *gain, *wander, float(sensors.leak), sensors.dropouts, *mounted]
    )


def noise_keys(seed: int, index: int) -> tuple[np.uint64, np.uint64]:
    """Return the random keys of the white noise and of the dropouts of vehicle `index`."""
    return key_of(seed, index, WHITE_STREAM), key_of(seed, index, SILENCE_STREAM)


@compiled
def read_out(record: FloatArray, error: FloatArray, place: FloatArray, signals: FloatArray) -> None:
    """Fill `signals` (18,) with the readings of sensors without noise, computed from the true
    values in `record`. `error` is the vehicle's row of sensor errors.

    `place` is (latitude and longitude of the origin [deg], degrees per metre north, degrees per
    metre east).
    """
    has_leak = error[ErrorColumn.LEAK] > 0.0
    signals[S.AX] = record[RecordColumn.AX_FELT] if has_leak else record[RecordColumn.AX]
    signals[S.AY] = record[RecordColumn.AY_FELT] if has_leak else record[RecordColumn.AY]
    signals[S.YAW_RATE] = record[RecordColumn.YAW_RATE]
    for i in range(4):
        signals[S.DELTA + i] = record[RecordColumn.DELTA + i]
        signals[S.OMEGA + i] = record[RecordColumn.OMEGA + i]
        signals[S.TORQUE + i] = record[RecordColumn.TORQUE + i]
    signals[S.LATITUDE] = place[0] + place[2] * record[RecordColumn.Y]
    signals[S.LONGITUDE] = place[1] + place[3] * record[RecordColumn.X]
    signals[S.YAW] = record[RecordColumn.YAW]


@compiled
def read_late(
    records: FloatArray,
    lead: int,
    error: FloatArray,
    place: FloatArray,
    rate_hz: float,
    signals: FloatArray,
) -> None:
    """Fill `signals` (18,) with the readings of each device, delayed by the device's own delay.
    `records` (T, RECORD) are true values; row `lead` is the present sample, and the rows before it
    are past samples.
    """
    record = np.empty(records.shape[1])
    readings = np.empty(signals.size)
    for device in range(DEVICES):
        delayed_record(
            records, lead, error[ErrorColumn.MOUNTED + Misaligned.LAG + device] * rate_hz, record
        )
        read_out(record, error, place, readings)
        for c in range(signals.size):
            if DEVICE_OF[c] == device:
                signals[c] = readings[c]
    misalign(error[ErrorColumn.MOUNTED :], signals)


@compiled
def wander_on(error: FloatArray, wander: FloatArray, key: np.uint64, sample: int) -> None:
    """Advance the slow errors `wander` (3,) of the position receiver to its next reading. For the
    first reading they are drawn at random. Their standard deviation is the same for all readings.
    """
    keep = 0.0 if sample == 0 else math.exp(-FIX_S / WANDER_S)
    for i in range(3):
        kick = error[ErrorColumn.WANDER + i] * math.sqrt(1.0 - keep * keep)
        wander[i] = keep * wander[i] + kick * normal(key, sample * DRAWS + WANDER_DRAW + i)


@compiled
def drop_out(share: float, key: np.uint64, window: int, row: FloatArray) -> None:
    """For each device, replace its readings in `row` (18,) with NaN with probability `share`. The
    random choice is made once per time window, so a device is silent in all samples of that window.
    """
    for c in range(len(CHANNELS)):
        if uniform(key, window * len(GROUPS) + GROUP_OF[c]) < share:
            row[c] = math.nan


@compiled
def sense(
    records: FloatArray,
    errors: FloatArray,
    wander: FloatArray,
    place: FloatArray,
    keys: tuple[KeyArray, KeyArray],
    clock: tuple[int, float, int],
) -> FloatArray:
    """Return the sensor readings (T, N, 18) for the records with true values (lead + T, N, RECORD).
    The first `lead` records only serve delayed readings.

    `wander` (N, 3), the slow errors of the position receivers, is advanced. `keys` are two uint64
    arrays (N,), for the noise and for the dropouts; `clock` is (number of the first sample, rate
    [Hz], `lead`).
    """
    white, silence = keys
    first, rate_hz, lead = clock
    steps = records.shape[0] - lead
    vehicles = records.shape[1]
    signals = np.empty((steps, vehicles, len(CHANNELS)))
    per_fix = max(1, round(rate_hz * FIX_S))
    per_silence = max(1, round(rate_hz * SILENCE_S))
    for n in range(vehicles):
        error = errors[n]
        for k in range(steps):
            sample = first + k
            row = signals[k, n]
            rough = error[ErrorColumn.MOUNTED + Misaligned.ROUGH] > 0.0
            if rough:
                read_late(records[:, n], lead + k, error, place, rate_hz, row)
            else:
                read_out(records[k + lead, n], error, place, row)
            fix = sample % per_fix == 0
            if fix:
                wander_on(error, wander[n], white[n], sample)
            for c in range(len(CHANNELS)):
                if c >= S.LATITUDE and not fix:
                    row[c] = math.nan
                    continue
                if error[ErrorColumn.WHITE + c] > 0.0:
                    row[c] = row[c] * error[ErrorColumn.GAIN + c] + error[ErrorColumn.OFFSET + c]
                    row[c] += error[ErrorColumn.WHITE + c] * normal(white[n], sample * DRAWS + c)
                if c >= S.LATITUDE:
                    row[c] += wander[n, c - S.LATITUDE]
            if rough:
                quantise_speeds(records[lead + k, n], error[ErrorColumn.MOUNTED :], row)
            if error[ErrorColumn.DROPOUTS] > 0.0:
                drop_out(error[ErrorColumn.DROPOUTS], silence[n], sample // per_silence, row)
    return signals
