"""Sensor errors of real cars: tilted mounts, steering offset, unequal wheels, coarse wheel speed
counters, clock delays.

The errors are drawn once per vehicle. Each random number is a hash of (seed, vehicle, index of the
number), so it depends on no other random number.

Legend
    θ, φ, ψ  pitch, roll and yaw of the inertial unit's mount [rad], to first order:
             a_x' = a_x + g θ + ψ a_y,  a_y' = a_y + g φ − ψ a_x
    δ        front wheel angle: δ' = δ_0 + δ (1 + γ + β |δ|/WIDE), with offset, gain, and a gain
             error that depends on the angle
    ε        of each wheel: ω' = ω (1 + ε), as if the radius were smaller by the share ε
    Δω       step width of wheel speed readings; a wheel that stands reads exactly zero
    τ        delay of a device: it reports the state at a time τ earlier

Eleven public logs of real cars contain errors of these sizes
    offsets of a_x          .22 to .96 m/s^2
    offsets of a_y          .07 to .54 m/s^2
    steering offset         1 to 17 mrad
    steering gain error     3 % at speed, 5 to 15 % at .3 to .5 rad
    differences of radii    .15 to 1.6 %
    wheel speed steps       up to 1 km/h
    clock differences       .02 to .4 s
Hardly any of these logs contains torque.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Final

import numpy as np

from edge_agent.lab.simulation.counter_rng import key_of, normal, uniform
from edge_agent.lab.simulation.record import RecordColumn
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import S
from schemas.thresholds import GRAVITY

# [rad] steering angle of a wheel near its end stop, where the steering ratio is most wrong
WIDE: Final = 0.4
KMH: Final = 1.0 / 3.6 / 0.33  # [rad/s] wheel speed of a wheel with 0.33 m radius at one km/h
MOUNT_STREAM: Final = 4

DEVICES: Final = 5  # inertial unit, steering, wheels, torque, receiver
DEVICE_OF: Final = np.array([0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4])


@dataclass(frozen=True)
class Misalignment:
    """Sizes of the sensor errors of a fleet: tilted mounts, steering, wheel radii, steps of wheel
    speeds, delays, and the share of cars without torque signal. The comment of each size states
    whether it is a standard deviation or a largest value.
    """

    tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)  # standard deviations of θ, φ, ψ [rad]
    steering: tuple[float, float, float] = (0.0, 0.0, 0.0)  # standard deviations of δ_0 [rad], γ, β
    radius: float = 0.0  # standard deviation of ε
    step: float = 0.0  # largest Δω [rad/s]; uniformly distributed
    lag_s: float = 0.0  # largest τ [s]; uniformly distributed
    torqueless: float = 0.0  # share of the vehicles without wheel torque


ALIGNED: Final = Misalignment()
ROUGH: Final = Misalignment(
    tilt=(0.035, 0.015, 0.01), steering=(0.003, 0.03, 0.05), radius=0.004, step=0.1, lag_s=0.06
)
MISALIGNED: Final = {
    "rough": ROUGH,
    "rough-coarse": replace(ROUGH, step=KMH),
    "rough-late": replace(ROUGH, lag_s=0.4),
}


class Misaligned(IntEnum):
    """Index of a column in a vehicle's row of sensor errors."""

    ROUGH = 0  # 1 if the vehicle has any of the errors below
    AX = 1  # g θ [m/s^2]
    AY = 2
    TURN = 3  # ψ [rad]
    ZERO = 4  # δ_0 [rad]
    GAIN = 5  # γ
    BEND = 6  # β
    RADIUS = 7  # ε of the four wheels
    STEP = 11  # Δω [rad/s]
    LAG = 12  # τ [s] of the DEVICES
    TORQUELESS = 17


def misalignment_row(size: Misalignment, seed: int, index: int) -> FloatArray:
    """Draw the sensor errors of vehicle `index` at random from `seed`; return them as an array
    (COLUMNS,) with the columns of `Misaligned`.
    """
    key = key_of(seed, index, MOUNT_STREAM)
    row = np.zeros(COLUMNS)
    row[Misaligned.ROUGH] = float(size != ALIGNED)
    stds = (
        *(GRAVITY * tilt for tilt in size.tilt[:2]),
        size.tilt[2],
        *size.steering,
        *[size.radius] * 4,
    )
    for k, std in enumerate(stds):
        row[Misaligned.AX + k] = std * normal(key, k)
    row[Misaligned.STEP] = size.step * uniform(key, 100)
    for device in range(DEVICES):
        row[Misaligned.LAG + device] = size.lag_s * uniform(key, 101 + device)
    row[Misaligned.TORQUELESS] = float(uniform(key, 110) < size.torqueless)
    return row


COLUMNS: Final = int(Misaligned.TORQUELESS) + 1


def memory_of(rows: FloatArray, rate_hz: float) -> int:
    """Return the number of past samples that the sensor model must store for the largest clock
    delay in the rows (N, COLUMNS): this delay in samples, rounded up, plus one. Return 0 without a
    delay.
    """
    lag = float(rows[:, Misaligned.LAG : Misaligned.LAG + DEVICES].max())
    return math.ceil(lag * rate_hz) + 1 if lag > 0.0 else 0


@compiled
def delayed_record(records: FloatArray, now: int, samples: float, record: FloatArray) -> None:
    """Fill `record` (RECORD,) with the true values `samples` samples before row `now` of `records`
    (T, RECORD). If `samples` is not an integer, the values are interpolated linearly.

    For times before the first record, the first record is used.
    """
    whole = math.floor(samples)
    share = samples - whole
    near = max(now - whole, 0)
    far = max(now - whole - 1, 0)
    for c in range(record.size):
        record[c] = (1.0 - share) * records[near, c] + share * records[far, c]


@compiled
def misalign(mounted: FloatArray, signals: FloatArray) -> None:
    """Convert the true readings (18,) in `signals` to those of misaligned sensors, in place.
    `mounted` is the vehicle's row of sensor errors.
    """
    ax = signals[S.AX]
    ay = signals[S.AY]
    signals[S.AX] = ax + mounted[Misaligned.AX] + mounted[Misaligned.TURN] * ay
    signals[S.AY] = ay + mounted[Misaligned.AY] - mounted[Misaligned.TURN] * ax
    for i in range(2):
        angle = signals[S.DELTA + i]
        signals[S.DELTA + i] = mounted[Misaligned.ZERO] + angle * (
            1.0 + mounted[Misaligned.GAIN] + mounted[Misaligned.BEND] * abs(angle) / WIDE
        )
    for i in range(4):
        signals[S.OMEGA + i] *= 1.0 + mounted[Misaligned.RADIUS + i]


@compiled
def quantise_speeds(record: FloatArray, mounted: FloatArray, signals: FloatArray) -> None:
    """Round the wheel speeds in `signals` (18,) to the sensor's steps; the speed of a wheel that
    stands becomes zero. Replace the torque readings with NaN if the car has no torque signal.
    `mounted` is the vehicle's row of sensor errors.
    """
    step = mounted[Misaligned.STEP]
    for i in range(4):
        if record[RecordColumn.OMEGA + i] == 0.0:
            signals[S.OMEGA + i] = 0.0
        elif step > 0.0:
            signals[S.OMEGA + i] = math.floor(signals[S.OMEGA + i] / step + 0.5) * step
        if mounted[Misaligned.TORQUELESS] > 0.0:
            signals[S.TORQUE + i] = math.nan
