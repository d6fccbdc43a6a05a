"""Test of the signal doctor, a check of recorded signals: recording faults are added to simulated
drives, and the doctor must find and name them.

The sizes of the faults are those seen in imported third-party logs: units, signs, offsets, a clock
0.4 s off, status bits in a wheel speed, exchanged columns, and a vehicle file with another tyre
radius.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from edge_agent.inputs.doctor.diagnosis import Diagnosis
from edge_agent.inputs.doctor.findings import diagnose
from edge_agent.inputs.units import DEG, SPEED
from edge_agent.lab.simulation import SimulatedFleet
from schemas.numeric import FloatArray
from schemas.runtime.figures import Figure
from schemas.signals import S
from schemas.thresholds import GRAVITY
from schemas.vehicle import Vehicle

RATE_HZ: Final = 100.0
DRIVE_S: Final = 150
LATE: Final = 40  # [samples] delay of the delayed channels
RATIO: Final = 16.0  # steering ratio: steering wheel angle over road wheel angle
# [m/s] error of the wheel speed when a status bit is read as part of the value.
STATUS: Final = 512.0 / 3.6
OMEGA = list(range(S.OMEGA, S.OMEGA + 4))
DELTA = list(range(S.DELTA, S.DELTA + 4))
IMU = [S.AX, S.AY, S.YAW_RATE]
PLACE = [S.LATITUDE, S.LONGITUDE, S.YAW]


class Recorded(NamedTuple):
    """A recorded drive: times t (T,) [s], signals (T, 18) in the order of the channels, and the
    parameters of the vehicle.
    """

    t: FloatArray
    signals: FloatArray
    vehicle: Vehicle


Spoil: TypeAlias = Callable[[Recorded], Recorded]


class Planted(NamedTuple):
    """A recording fault that can be added to a drive by the function `spoil`. The signal doctor
    (check of recorded signals) must report it with this channel and this kind of fault.
    """

    spoil: Spoil
    channel: str
    kind: str


def scale_columns(columns: Sequence[int], factor: float | Callable[[float], float]) -> Spoil:
    """Return a function that multiplies the signal columns `columns` of a drive by `factor`: a
    number, or a function that computes it from the wheel radius [m].
    """

    def scale_drive(drive: Recorded) -> Recorded:
        signals = drive.signals.copy()
        signals[:, columns] *= factor(drive.vehicle.wheel_radius) if callable(factor) else factor
        return drive._replace(signals=signals)

    return scale_drive


def offset_columns(columns: Sequence[int], offset: float) -> Spoil:
    """Return a function that adds `offset` to the signal columns `columns` of a drive."""

    def offset_drive(drive: Recorded) -> Recorded:
        signals = drive.signals.copy()
        signals[:, columns] += offset
        return drive._replace(signals=signals)

    return offset_drive


def delay_columns(columns: Sequence[int]) -> Spoil:
    """Return a function that delays the signal columns `columns` of a drive by LATE samples."""

    def delay_drive(drive: Recorded) -> Recorded:
        signals = drive.signals.copy()
        signals[LATE:, columns] = drive.signals[:-LATE, columns]
        signals[:LATE, columns] = drive.signals[0, columns]
        return drive._replace(signals=signals)

    return delay_drive


def swap_columns(one: Sequence[int], other: Sequence[int]) -> Spoil:
    """Return a function that exchanges the signal columns `one` of a drive with the columns
    `other`.
    """

    def swap_drive(drive: Recorded) -> Recorded:
        signals = drive.signals.copy()
        signals[:, [*one, *other]] = drive.signals[:, [*other, *one]]
        return drive._replace(signals=signals)

    return swap_drive


def status_bits(drive: Recorded) -> Recorded:
    """Return the drive with the fault of a wrongly decoded CAN message: a status bit is read as an
    upper bit of a wheel speed. The bit is set in two of seven readings of one wheel.
    """
    signals = drive.signals.copy()
    signals[np.arange(len(signals)) % 7 < 2, S.OMEGA] += STATUS / drive.vehicle.wheel_radius
    return drive._replace(signals=signals)


def turn_yaw_clockwise(drive: Recorded) -> Recorded:
    """Return the drive with yaw measured clockwise from north."""
    signals = drive.signals.copy()
    signals[:, S.YAW] = math.pi / 2.0 - signals[:, S.YAW]
    return drive._replace(signals=signals)


def other_tyre(drive: Recorded) -> Recorded:
    """Return the drive with another vehicle file, whose wheel radius is 10 % too small."""
    radius = 0.9 * drive.vehicle.wheel_radius
    return drive._replace(vehicle=drive.vehicle.model_copy(update={"wheel_radius": radius}))


def rim_speed_factor(unit: str) -> Callable[[float], float]:
    """Return the function that converts a wheel radius [m] into a factor. A wheel speed [rad/s]
    times this factor is the speed of the wheel's rim in `unit`.
    """
    return lambda radius: radius / SPEED[unit]


PLANTED: Final = {
    "a_x in g": Planted(scale_columns([S.AX], 1.0 / GRAVITY), "ax", "g"),
    "a_y in g": Planted(scale_columns([S.AY], 1.0 / GRAVITY), "ay", "g"),
    "both in g": Planted(scale_columns([S.AX, S.AY], 1.0 / GRAVITY), "ax", "g"),
    "yaw rate in deg/s": Planted(scale_columns([S.YAW_RATE], 1.0 / DEG), "yaw_rate", "deg/s"),
    "steering in deg": Planted(scale_columns(DELTA, 1.0 / DEG), "delta", "deg"),
    "steering wheel": Planted(scale_columns(DELTA, RATIO), "delta", "steering wheel"),
    "steering wheel in deg": Planted(
        scale_columns(DELTA, RATIO / DEG), "delta", "steering wheel, deg"
    ),
    "wheels in km/h": Planted(scale_columns(OMEGA, rim_speed_factor("km/h")), "omega", "km/h"),
    "wheels in m/s": Planted(scale_columns(OMEGA, rim_speed_factor("m/s")), "omega", "m/s"),
    "wheels in mph": Planted(scale_columns(OMEGA, rim_speed_factor("mph")), "omega", "mph"),
    "wheels in rpm": Planted(scale_columns(OMEGA, 30.0 / math.pi), "omega", "rpm"),
    "wheels in deg/s": Planted(scale_columns(OMEGA, 1.0 / DEG), "omega", "deg/s"),
    "time in ms": Planted(lambda drive: drive._replace(t=1000.0 * drive.t), "t", "ms"),
    "a_x flipped": Planted(scale_columns([S.AX], -1.0), "ax", "sign"),
    "a_y flipped": Planted(scale_columns([S.AY], -1.0), "ay", "sign"),
    "yaw rate flipped": Planted(scale_columns([S.YAW_RATE], -1.0), "yaw_rate", "sign"),
    "steering flipped": Planted(scale_columns(DELTA, -1.0), "delta", "sign"),
    "a_y and yaw rate flipped": Planted(scale_columns([S.AY, S.YAW_RATE], -1.0), "ay", "sign"),
    "a_x and a_y exchanged": Planted(swap_columns([S.AX], [S.AY]), "ax", "exchanged with ay"),
    "a_x offset": Planted(offset_columns([S.AX], 2.0), "ax", "offset"),
    "a_y offset": Planted(offset_columns([S.AY], 1.2), "ay", "offset"),
    "yaw rate offset": Planted(offset_columns([S.YAW_RATE], 0.04), "yaw_rate", "offset"),
    "steering offset": Planted(offset_columns(DELTA, 0.035), "delta", "offset"),
    "one wheel smaller": Planted(scale_columns([S.OMEGA], 1.05), "omega_fl", "radius"),
    "radius of the file": Planted(other_tyre, "omega", "radius"),
    "inertial unit late": Planted(delay_columns(IMU), "imu", "clock"),
    "steering late": Planted(delay_columns(DELTA), "steering", "clock"),
    "receiver late": Planted(delay_columns(PLACE), "receiver", "clock"),
    "wheels late": Planted(delay_columns(OMEGA), "wheels", "clock"),
    "status bits": Planted(status_bits, "omega_fl", "status bits"),
    "left and right": Planted(
        swap_columns(OMEGA[::2], OMEGA[1::2]), "omega", "left and right exchanged"
    ),
    "front left and right": Planted(
        swap_columns(OMEGA[:1], OMEGA[1:2]), "omega", "front left and right exchanged"
    ),
    "rear left and right": Planted(
        swap_columns(OMEGA[2:3], OMEGA[3:]), "omega", "rear left and right exchanged"
    ),
    "front and rear": Planted(
        swap_columns(OMEGA[:2], OMEGA[2:]), "omega", "front and rear exchanged"
    ),
    "latitude and longitude": Planted(
        swap_columns([S.LATITUDE], [S.LONGITUDE]), "latitude", "exchanged with longitude"
    ),
    "compass for yaw": Planted(turn_yaw_clockwise, "yaw", "compass"),
    "yaw in deg": Planted(scale_columns([S.YAW], 1.0 / DEG), "yaw", "deg"),
}
# Errors with a factor close to one. A drive cannot distinguish such a wrong unit from another tyre
# radius.
RADII_ALIKE: Final = ({"km/h", "radius", "mph", "kn"},)


def drives(
    count: int, seed: int, *, rough: bool, winter: bool = False, seconds: int = DRIVE_S
) -> list[Recorded]:
    """Return simulated drives through the demonstration town. If `rough` is True, the town has
    hills and the cars have inaccurate sensors.

    If `winter` is True, the drives are in a random winter town that `seed` determines, and the cars
    have winter equipment.
    """
    scenario = "hills" if rough else "demo"
    if winter:
        scenario = f"winter-{seed}"
    fleet = SimulatedFleet(scenario, count, seed, RATE_HZ, rough=float(rough), winter=float(winter))
    parts = [fleet.step(round(RATE_HZ)) for _ in range(seconds)]
    t, signals = (np.concatenate([part[k] for part in parts]) for k in range(2))
    return [Recorded(t[:, n], signals[:, n], fleet.vehicles[n]) for n in range(count)]


def doctor_verdict(planted: Planted, drive: Recorded) -> tuple[bool, bool]:
    """Add the fault `planted` to a drive, and let the signal doctor (a check of recorded signals)
    examine it. Return two booleans: True if the doctor names this fault, and True if it reports no
    fault at all.
    """
    diagnosis = diagnose(*planted.spoil(drive))
    found = {(finding.channel, finding.kind) for finding in diagnosis.findings}
    same = next((kinds for kinds in RADII_ALIKE if planted.kind in kinds), {planted.kind})
    return any((planted.channel, kind) in found for kind in same), diagnosis.is_passed


def figures(count: int, seed: int) -> list[Figure]:
    """Return figures of the signal doctor (a check of recorded signals), measured on simulated
    drives. The drives are in the demonstration town and in a winter town, `count` with accurate
    cars and `count` with inaccurate cars each.

    Drives with an added fault give the share of faults that the doctor names, and the number of
    drives that it passes wrongly. Drives without a fault give the share of channels with a false
    report, and the share of drives that pass.
    """
    cars = [*drives(count, seed, rough=False), *drives(count, seed + 1, rough=True)]
    cold = [
        *drives(count, seed + 2, rough=False, winter=True),
        *drives(count, seed + 3, rough=True, winter=True),
    ]
    tries = [doctor_verdict(planted, drive) for planted in PLANTED.values() for drive in cars]
    cold_tries = [doctor_verdict(planted, drive) for planted in PLANTED.values() for drive in cold]
    clean = [diagnose(*drive) for drive in cars]
    cold_clean = [diagnose(*drive) for drive in cold]
    return [
        Figure("doctor.faults_named", _share_of(hit for hit, _ in tries), "1", 0.95, "more"),
        Figure(
            "doctor.faults_named.winter", _share_of(hit for hit, _ in cold_tries), "1", 0.95, "more"
        ),
        Figure("doctor.false_accusations", _accused_share(clean), "1", 0.01),
        Figure("doctor.false_accusations.winter", _accused_share(cold_clean), "1", 0.0),
        Figure("doctor.clean_passed", _share_of(diagnosis.is_passed for diagnosis in clean), "1"),
        Figure(
            "doctor.clean_passed.winter",
            _share_of(diagnosis.is_passed for diagnosis in cold_clean),
            "1",
        ),
        Figure("doctor.published_wrong", float(sum(passed for _, passed in tries)), "drives", 0.0),
        Figure(
            "doctor.published_wrong.winter",
            float(sum(passed for _, passed in cold_tries)),
            "drives",
            0.0,
        ),
        Figure("doctor.tries", float(len(tries)), "drives", 150.0, "more"),
    ]


def _share_of(held: Iterable[bool]) -> float:
    every = list(held)
    return sum(every) / len(every)


def _accused_share(clean: Sequence[Diagnosis]) -> float:
    """Let the signal doctor (a check of recorded signals) report on drives without faults. Return
    the share of all their channels in which it nevertheless reports a fault.
    """
    channels = sum(
        len(diagnosis.sound) + len(diagnosis.unknown) + len(diagnosis.findings)
        for diagnosis in clean
    )
    return sum(len(diagnosis.findings) for diagnosis in clean) / channels
