"""What is wrong with a log: one finding a fault, with its evidence; and what was found to be in order.

A channel is sound when an identity that was excited enough holds it and no fault explains the drive nearly as well;
it is unknown when nothing was said of it. Only a log whose channels are all sound has passed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from edge_agent.inputs.doctor.drive import RATE_HZ, EvenDrive, even, prepare
from edge_agent.inputs.doctor.identities import Fit, fits, robust
from edge_agent.inputs.doctor.places import exchanged, yaw_findings
from edge_agent.inputs.doctor.scales import CLOCK_SETTLED, SETTLED, Verdict, clocks, explain
from schemas.numeric import FloatArray
from schemas.signals import WHEELS, S
from schemas.vehicle import Vehicle

# beyond these a constant error is a fault and not the ordinary tilt or zero of a device (std met: .35, .15 m/s^2,
# .003 rad/s, .003 to .015 rad; radii .15 to 1.6 % apart)
LARGEST_AX, LARGEST_AY = 1.3, 0.75  # [m/s^2]
LARGEST_RATE = 0.02  # [rad/s]
LARGEST_STEER = 0.02  # [rad]
LARGEST_RADIUS = 0.025
JUMPS = 0.01  # share of readings that may jump off the other wheels
SLOWEST_HZ, FASTEST_HZ = 5.0, 2000.0
CHANNELS_OF: Final = {"ax": "ax", "ay": "ay", "r": "yaw_rate", "delta": "delta", "v": "omega"}


@dataclass(frozen=True)
class Finding:
    """One fault: the channel, what it is called, the words for it, and what mends it.

    Attributes:
        scale: to multiply the channel by; offset: to add after that; delay_s: that its stamps are late.
        confidence: log odds over the next best explanation, where there is one.
    """

    channel: str
    kind: str
    words: str
    scale: float = 1.0
    offset: float = 0.0
    delay_s: float = 0.0
    confidence: float = SETTLED


@dataclass
class Diagnosis:
    """Faults, channels that are in order, channels that nothing was learned of, and the identities' fits."""

    findings: list[Finding] = field(default_factory=list)
    sound: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    fits: dict[str, Fit] = field(default_factory=dict)
    drive: EvenDrive | None = None

    @property
    def passed(self) -> bool:
        """Whether every channel was found to be in order."""
        return not self.findings and not self.unknown


def diagnose(t: FloatArray, signals: FloatArray, vehicle: Vehicle, ground: FloatArray | None = None) -> Diagnosis:
    """Examine a log: times t (T,) [s], signals (T, 18), and the receiver's speed (T,) [m/s] where it was recorded."""
    diagnosis = Diagnosis()
    t, slow = _seconds(t, diagnosis)
    if slow:
        return diagnosis
    signals = signals.copy()
    _jumps(signals, diagnosis)
    drive = prepare(t, signals, vehicle, ground)
    if _axes_exchanged(drive):
        words = "a_x follows v·r and a_y the wheels' acceleration"
        diagnosis.findings.append(Finding("ax", "exchanged with ay", words))
        signals[:, [S.AX, S.AY]] = signals[:, [S.AY, S.AX]]
        drive = prepare(t, signals, vehicle, ground)
    if exchanged(t, signals, drive):
        words = "the fixes go as fast as the wheels only when latitude and longitude are exchanged"
        diagnosis.findings.append(Finding("latitude", "exchanged with longitude", words))
        signals[:, [S.LATITUDE, S.LONGITUDE]] = signals[:, [S.LONGITUDE, S.LATITUDE]]
        drive = prepare(t, signals, vehicle, ground)
    found = fits(drive)
    verdict = explain(found, vehicle)
    diagnosis.fits, diagnosis.drive = found, drive
    _scales(verdict, found, diagnosis)
    scaled = any(fault is not None for fault in verdict.faults.values())  # offsets and radii in wrong units say nothing
    late = clocks(found)
    for device, (seconds, margin) in late.items():
        if margin < CLOCK_SETTLED:
            diagnosis.unknown.append(f"clock of the {device}")
        else:
            words = f"the clock of the {device} is {seconds:+.2f} s late"
            diagnosis.findings.append(Finding(device, "clock", words, delay_s=seconds, confidence=margin))
    diagnosis.findings += yaw_findings(signals, drive)
    if not scaled:
        diagnosis.findings += _radii(drive, vehicle) + _offsets(drive, found)
    for quantity, channel in CHANNELS_OF.items():
        if any(finding.channel == channel for finding in diagnosis.findings):
            continue
        (diagnosis.sound if verdict.settled(quantity) else diagnosis.unknown).append(channel)
    found_wrong = {finding.channel for finding in diagnosis.findings}
    if np.isfinite(signals[:, S.LATITUDE]).any() and not found_wrong & {"latitude", "yaw"}:
        (diagnosis.sound if found["ground"].known else diagnosis.unknown).append("latitude")
    return diagnosis


def _seconds(t: FloatArray, diagnosis: Diagnosis) -> tuple[FloatArray, bool]:
    """Times in seconds, and whether they are too few to say anything."""
    step = float(np.median(np.diff(t))) if len(t) > 1 else np.inf
    if step > 0.0 and not 1.0 / FASTEST_HZ <= step <= 1.0 / SLOWEST_HZ:
        for unit, factor in (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9), ("minutes", 60.0)):
            if 1.0 / FASTEST_HZ <= step * factor <= 1.0 / SLOWEST_HZ:
                words = f"a sample every {step:g}: are these {unit}?"
                diagnosis.findings.append(Finding("t", unit, words, scale=factor))
                return t * factor, False
        words = f"a sample every {step:g} s; friction needs {SLOWEST_HZ:g} a second"
        diagnosis.findings.append(Finding("t", "rate", words))
        return t, True
    return t, False


def _jumps(signals: FloatArray, diagnosis: Diagnosis) -> None:
    """Status bits above a wheel's number: readings far off the other three, and back."""
    wheels = signals[:, S.OMEGA : S.OMEGA + 4]
    good = np.isfinite(wheels).all(axis=1)
    if good.sum() < 100:
        return
    rows = np.flatnonzero(good)
    for i, wheel in enumerate(WHEELS):
        others = np.median(np.delete(wheels[rows], i, axis=1), axis=1)
        fast = float(np.percentile(np.abs(others), 95))
        above = wheels[rows, i] - others
        off = np.abs(above) > 0.3 * np.abs(others) + 0.3 * fast
        if off.mean() > JUMPS:
            sizes = np.unique(np.round(above[off] / max(fast, 1e-9), 1))
            words = f"{off.mean():.0%} of its readings lie far off the other wheels, {len(sizes)} steps: status bits?"
            diagnosis.findings.append(Finding(f"omega_{wheel}", "status bits", words))
            signals[rows[off], S.OMEGA + i] = np.nan


def _axes_exchanged(drive: EvenDrive) -> bool:
    """Whether the axes of the accelerometer are exchanged."""

    def alike(x: FloatArray, y: FloatArray) -> float:
        good = np.isfinite(x) & np.isfinite(y) & (drive.moving > 0)
        if good.sum() < 10 * RATE_HZ or x[good].std() == 0 or y[good].std() == 0:
            return 0.0
        return abs(float(np.corrcoef(x[good], y[good])[0, 1]))

    along, across = drive.v_dot, drive.v * drive.r
    right = alike(drive.ax, along) + alike(drive.ay, across)
    return alike(drive.ax, across) + alike(drive.ay, along) > right + 0.5


WORDS: Final = {
    "ax": "a_x is {gain:.3g} of the wheels' acceleration", "ay": "a_y is {gain:.3g} of v·r",
    "r": "a_y is {lateral:.3g} of v·r, the wheels' yaw rate {axle:.3g} of it",
    "delta": "steering is {gain:.3g} of L·r/v",
    "v": "the wheels go {wheels:.3g} times the speed that everything else tells",
    "sides": "left and right wheels differ by {gain:.3g} of track·r", "place": "the course turns by {gain:.3g} of r",
}  # fmt: skip
ASKED: Final = {"ax": "longitudinal", "ay": "lateral", "delta": "steering", "sides": "axle", "place": "turning"}


def _scales(verdict: Verdict, found: dict[str, Fit], diagnosis: Diagnosis) -> None:
    for quantity, fault in verdict.faults.items():
        if fault is None or quantity == "place" or not verdict.settled(quantity):
            continue
        gain = found[ASKED[quantity]].gain if quantity in ASKED else np.nan
        words = WORDS[quantity].format(
            gain=gain, wheels=fault.factor, lateral=found["lateral"].gain, axle=found["axle"].gain
        )
        channel = CHANNELS_OF.get(quantity, "omega")
        diagnosis.findings.append(
            Finding(
                channel, fault.name, f"{words}: {fault.name}?", 1.0 / fault.factor, confidence=verdict.margins[quantity]
            )
        )


def _radii(drive: EvenDrive, vehicle: Vehicle) -> list[Finding]:
    """Wheels that turn faster or slower than the others, straight on and in turns; front and rear exchanged."""
    findings, tracks = [], (vehicle.track_front, vehicle.track_front, vehicle.track_rear, vehicle.track_rear)
    calm = (drive.moving > 0) & (np.abs(drive.v_dot) < 1.0) & np.isfinite(drive.r)
    for i, wheel in enumerate(WHEELS):
        good = calm & np.isfinite(drive.wheels[:, i])
        if good.sum() < 10 * RATE_HZ:
            continue
        side = (-0.5 if i % 2 == 0 else 0.5) * tracks[i] * drive.r[good]
        others = np.nanmedian(np.delete(drive.wheels[good], i, axis=1), axis=1)
        off = float(np.median((drive.wheels[good, i] - side) / np.where(others == 0, np.nan, others)) - 1.0)
        if abs(off) > LARGEST_RADIUS:
            words = f"turns {off:+.1%} faster than the other wheels: another tyre, or its own scale"
            findings.append(Finding(f"omega_{wheel}", "radius", words, 1.0 / (1.0 + off)))
    return findings + _axles(drive)


def _axles(drive: EvenDrive) -> list[Finding]:
    """Front wheels go the longer way in a turn: v_f² = v_r² + (L r)²."""
    front, rear = drive.wheels[:, :2].mean(axis=1), drive.wheels[:, 2:].mean(axis=1)
    good = (drive.moving > 0) & np.isfinite(front) & np.isfinite(rear) & (np.abs(drive.v_dot) < 1.5) & (rear > 1.0)
    turn = np.square(drive.wheelbase * drive.r / np.where(good, rear, 1.0))
    good &= np.isfinite(turn)
    tight = good & (turn > 0.015)
    if tight.sum() < 3 * RATE_HZ:
        return []
    x, y = 0.5 * turn[good], front[good] / rear[good] - 1.0
    slope = float(robust(np.stack([x, np.ones(len(x))], axis=1), y)[0])
    if slope < -0.4:
        words = "in turns the rear wheels go the longer way: front and rear exchanged?"
        return [Finding("omega", "front and rear exchanged", words)]
    return []


def _offsets(drive: EvenDrive, found: dict[str, Fit]) -> list[Finding]:
    moving = drive.moving > 0
    lateral, axle, steering = found["lateral"], found["axle"], found["steering"]
    along = np.nanmedian((drive.ax - drive.v_dot)[moving]) if np.isfinite(drive.ax[moving]).any() else 0.0
    straight = moving & (np.abs(drive.v * drive.r) < 1.0)
    across = np.nanmedian((drive.ay - drive.v * drive.r)[straight]) if straight.any() else 0.0
    listed = [("ax", float(along), LARGEST_AX, "m/s^2"), ("ay", float(across), LARGEST_AY, "m/s^2")]
    if axle.known:
        listed.append(("yaw_rate", -axle.offset / axle.gain, LARGEST_RATE, "rad/s"))
    elif lateral.known and np.isfinite(drive.r).any():
        still = ~moving & (np.abs(drive.v) < 0.05)
        listed.append(
            ("yaw_rate", float(np.nanmedian(drive.r[still])) if still.sum() > RATE_HZ else 0.0, LARGEST_RATE, "rad/s")
        )
    if steering.known:
        listed.append(("delta", steering.offset, LARGEST_STEER, "rad"))
    return [
        Finding(channel, "offset", f"{value:+.3g} {unit} when it should be none", offset=-value)
        for channel, value, largest, unit in listed
        if np.isfinite(value) and abs(value) > largest
    ]


__all__ = ["Diagnosis", "Finding", "diagnose", "even"]
