"""Findings of the signal doctor (automatic check of the signals). A finding is one reported fault
with the reason for it. The module also lists the channels without fault.

A channel is free of faults under two conditions. A physical relation with enough excitation (change
of the signals) confirms it, and no fault would explain the drive nearly as well. A channel is
unknown if it is neither confirmed nor faulty. A log passes only if all its channels are free of
faults.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from edge_agent.inputs.doctor.bumps import leading_axle
from edge_agent.inputs.doctor.clocks import measure_clocks, wheels_speak_late
from edge_agent.inputs.doctor.diagnosis import Diagnosis, Finding
from edge_agent.inputs.doctor.drive import (
    RATE_HZ,
    EvenDrive,
    correlate_series,
    interpolate_near,
    median_of_others,
    prepare_drive,
)
from edge_agent.inputs.doctor.identities import PARTS, Fit, fit_identities, fit_robustly
from edge_agent.inputs.doctor.lift import is_on_lift
from edge_agent.inputs.doctor.places import has_exchanged_position, yaw_findings
from edge_agent.inputs.doctor.scales import (
    CLOCK_SETTLED,
    LAWS,
    REVERSING,
    UNSIGNED,
    Verdict,
    explain_fits,
    late_clocks,
)
from edge_agent.inputs.doctor.slip import (
    RADIUS_PARTS,
    STEADY,
    STEADY_SHARE,
    TURNS_LIKE,
    find_exchanged_axles,
    find_locked_axles,
    has_equal_steps,
    is_foreign,
    is_same_when_coasting,
    is_steady,
    share_of_parts,
    spread_of_parts,
)
from edge_agent.inputs.log_columns import GROUND
from schemas.numeric import FloatArray
from schemas.signals import WHEELS, S
from schemas.vehicle import Vehicle

# Largest constant errors that come from the ordinary tilt or zero error of a device; larger ones
# are faults. In usual cars the standard deviations are 0.35 m/s^2 (a_x), 0.15 m/s^2 (a_y),
# 0.003 rad/s (yaw rate) and 0.003 to 0.015 rad (steering). Wheel radii differ by 0.15 to 1.6 %.
LARGEST_AX = 1.3  # [m/s^2]
LARGEST_AY = 0.75  # [m/s^2]
LARGEST_RATE = 0.02  # [rad/s]
LARGEST_STEER = 0.02  # [rad]
LARGEST_RADIUS = 0.025  # [1] relative difference from the other wheels
JUMPS = 0.01  # share of a wheel's readings that may differ strongly from the other wheels
SLOWEST_HZ = 5.0
FASTEST_HZ = 2000.0
# Limit of a_x for drives of at least AVERAGED_M, over which the mean slope is below 8 %.
LARGEST_AX_FAR = 0.9  # [m/s^2]
AVERAGED_M = 300.0
# Accelerations up to which wheels hardly slip, even on ice.
CALM = 0.5  # [m/s^2] along the car
CALM_ACROSS = 0.5  # [m/s^2] across the car
# [m/s^2] largest lateral acceleration of turns in which the speeds of the two axles are compared
GENTLE_ACROSS: Final = 3.5
# (L r / v)^2 on a circle with a radius of eight wheelbases. On larger circles, slip hides the
# difference between the axles.
TIGHT = 0.015
TIGHT_S = 1.5  # [s] minimum duration of tight turns
FEWEST_OFFSET_S: Final = 8.0  # [s] minimum duration of the readings for an offset
# |ln factor| up to which slip may explain a wrong wheel speed. Slip is not larger for long.
NEAR_ONE: Final = 0.35
SURE: Final = 2.0  # number of standard deviations by which an offset must exceed its limit
WHOLE: Final = 0.35  # largest difference between ln gain of the whole drive and of the fault
NOISIEST: Final = 1.0  # largest difference of ln gain between parts that may come from noise
CHANNELS_OF: Final = {"ax": "ax", "ay": "ay", "r": "yaw_rate", "delta": "delta", "v": "omega"}


def diagnose(
    t: FloatArray, signals: FloatArray, vehicle: Vehicle, ground: FloatArray | None = None
) -> Diagnosis:
    """Examine a signal log for faults of its sensors, and return the diagnosis.

    Args:
        t: times (T,) [s].
        signals: readings (T, 18).
        vehicle: nominal data of the vehicle that was driven.
        ground: speed measured by the position receiver (T,) [m/s], if it was recorded.
    """
    diagnosis = Diagnosis()
    t, slow = _in_seconds(t, diagnosis)
    if slow:
        return diagnosis
    if is_on_lift(t, signals, vehicle):
        words = "wheels turn while accelerometers and yaw rate rest: on a lift or rollers?"
        diagnosis.findings.append(Finding("omega", "lift", words))
        return diagnosis
    signals = signals.copy()
    _find_jumps(signals, diagnosis)
    drive = prepare_drive(t, signals, vehicle, ground)
    if _axes_exchanged(drive):
        words = "a_x follows v·r and a_y the wheels' acceleration"
        diagnosis.findings.append(Finding("ax", "exchanged with ay", words))
        signals[:, [S.AX, S.AY]] = signals[:, [S.AY, S.AX]]
        drive = prepare_drive(t, signals, vehicle, ground)
    if has_exchanged_position(t, signals, drive):
        words = "the fixes match the wheels' speed only if latitude and longitude are exchanged"
        diagnosis.findings.append(Finding("latitude", "exchanged with longitude", words))
        signals[:, [S.LATITUDE, S.LONGITUDE]] = signals[:, [S.LONGITUDE, S.LATITUDE]]
        drive = prepare_drive(t, signals, vehicle, ground)
    for axle, (left, right) in find_exchanged_axles(drive):
        words = (
            f"the {axle} wheels turn against the yaw rate, the others with it: left and right "
            "exchanged?"
        )
        diagnosis.findings.append(Finding("omega", f"{axle} left and right exchanged", words))
        signals[:, [S.OMEGA + left, S.OMEGA + right]] = signals[
            :, [S.OMEGA + right, S.OMEGA + left]
        ]
        drive = prepare_drive(t, signals, vehicle, ground)
    diagnosis.locked = find_locked_axles(drive)
    if diagnosis.locked == ["rear"]:
        drive = replace(drive, r_wheels=drive.yaw_front)
    found = fit_identities(drive)
    verdict = explain_fits(found, vehicle, drive.fast)
    diagnosis.fits = found
    diagnosis.drive = drive
    _find_scales(verdict, found, diagnosis)
    # Offsets and radii are not evaluated for quantities in a wrong unit.
    scaled = any(fault is not None for fault in verdict.faults.values())
    late = late_clocks(found)
    if "wheels" in late and not wheels_speak_late(found["axle"], late["wheels"][0]):
        # In a slide, the wheels slow down before the car does. A late speed without a late yaw rate
        # of the wheels is therefore no fault of their clock.
        late = {}
    for device, (seconds, margin) in late.items():
        if margin < CLOCK_SETTLED:
            diagnosis.unknown.append(f"clock of the {device}")
        else:
            way = "late" if seconds > 0.0 else "early"
            words = f"the clock of the {device} is {abs(seconds):.2f} s {way}"
            diagnosis.findings.append(
                Finding(device, "clock", words, delay_s=seconds, confidence=margin)
            )
    if not late and not scaled:
        measure_clocks(t, signals, vehicle, diagnosis)
    diagnosis.findings += yaw_findings(signals, drive)
    if not scaled:
        diagnosis.findings += _find_radii(drive, vehicle, diagnosis.doubts) + _find_offsets(
            drive, found
        )
        exchanged_axles = any(
            finding.kind == "front and rear exchanged" for finding in diagnosis.findings
        )
        if not exchanged_axles and leading_axle(t, signals, vehicle) < 0:
            words = "bumps reach the rear wheels first: front and rear exchanged?"
            diagnosis.findings.append(Finding("omega", "front and rear exchanged", words))
    for quantity, channel in CHANNELS_OF.items():
        if any(finding.channel == channel for finding in diagnosis.findings):
            continue
        told = verdict.is_settled(quantity) and quantity not in diagnosis.doubts
        (diagnosis.sound if told else diagnosis.unknown).append(channel)
    received = ground is not None and np.isfinite(ground).any()
    diagnosis.findings += _find_receiver_scale(
        GROUND if received else "latitude", verdict, found["ground"]
    )
    found_wrong = {finding.channel for finding in diagnosis.findings}
    if np.isfinite(signals[:, S.LATITUDE]).any() and not found_wrong & {"latitude", "yaw", GROUND}:
        (diagnosis.sound if found["ground"].is_known else diagnosis.unknown).append("latitude")
    return diagnosis


def _in_seconds(t: FloatArray, diagnosis: Diagnosis) -> tuple[FloatArray, bool]:
    """Return the times of the samples (n,) in seconds, and True if the sampling rate is unusable.

    Times `t` (n,) in another unit are converted. A wrong unit and an unusable rate are added to the
    diagnosis as faults.
    """
    step = float(np.median(np.diff(t))) if len(t) > 1 else np.inf
    if len(t) > 1 and np.percentile(np.diff(t), 60) == 0.0:
        words = "most samples repeat a time: does the column lack the fraction of a second?"
        diagnosis.findings.append(Finding("t", "repeats", words))
        return t, True
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


def _find_jumps(signals: FloatArray, diagnosis: Diagnosis) -> None:
    """Add a finding (fault) to the diagnosis for each wheel speed that seems to contain status
    bits, and set its wrong readings to NaN.

    A status bit makes the reading jump away from the other three wheels and later back, each time
    by the same amount. A wheel that spins or locks also differs from the others, but gradually and
    by any amount.
    """
    wheels = signals[:, S.OMEGA : S.OMEGA + 4]
    good = np.isfinite(wheels).all(axis=1)
    if good.sum() < 100:
        return
    rows = np.flatnonzero(good)
    wheels = wheels[rows]
    medians = median_of_others(wheels)
    for i, wheel in enumerate(WHEELS):
        others = medians[:, i]
        fast = float(np.percentile(np.abs(others), 95))
        above = wheels[:, i] - others
        off = np.abs(above) > 0.3 * np.abs(others) + 0.3 * fast
        if off.mean() <= JUMPS or not (
            has_equal_steps(above, off)
            or is_foreign(np.delete(wheels, i, axis=1), others, off, fast)
        ):
            continue
        sizes = np.unique(np.round(above[off] / max(fast, 1e-9), 1))
        words = (
            f"{off.mean():.0%} of its readings lie far off the other wheels, {len(sizes)} steps: "
            "status bits?"
        )
        diagnosis.findings.append(Finding(f"omega_{wheel}", "status bits", words))
        signals[rows[off], S.OMEGA + i] = np.nan


def _axes_exchanged(drive: EvenDrive) -> bool:
    """Return True if the longitudinal and lateral axes of the accelerometer are exchanged in the
    recorded drive. Then a_x follows the turns and a_y follows the wheels' acceleration.
    """

    def axis_likeness(x: FloatArray, y: FloatArray) -> float:
        good = np.isfinite(x) & np.isfinite(y) & (drive.moving > 0)
        return abs(correlate_series(x[good], y[good])) if good.sum() >= 10 * RATE_HZ else 0.0

    along = drive.v_dot
    across = drive.v * drive.r
    right = axis_likeness(drive.ax, along) + axis_likeness(drive.ay, across)
    return axis_likeness(drive.ax, across) + axis_likeness(drive.ay, along) > right + 0.5


WORDS: Final = {
    "ax": "a_x is {gain:.3g} of the wheels' acceleration",
    "ay": "a_y is {gain:.3g} of v·r",
    "r": "a_y is {lateral:.3g} of v·r, the wheels' yaw rate {axle:.3g} of it",
    "delta": "steering is {gain:.3g} of L·r/v",
    "v": "the wheel speed is {wheels:.3g} times the speed from the other signals",
    "sides": "left and right wheels differ by {gain:.3g} of track·r",
    "place": "the turn rate of the course is {gain:.3g} of r",
}
ASKED: Final = {
    "ax": "longitudinal",
    "ay": "lateral",
    "delta": "steering",
    "sides": "axle",
    "place": "turning",
}


def _find_scales(verdict: Verdict, found: dict[str, Fit], diagnosis: Diagnosis) -> None:
    for quantity, fault in verdict.faults.items():
        if fault is None or quantity == "place" or not verdict.is_settled(quantity):
            continue
        if not _holds_throughout(quantity, verdict, found, diagnosis.drive):
            diagnosis.doubts.add(quantity)
            continue
        gain = found[ASKED[quantity]].gain if quantity in ASKED else np.nan
        words = WORDS[quantity].format(
            gain=gain, wheels=fault.factor, lateral=found["lateral"].gain, axle=found["axle"].gain
        )
        channel = CHANNELS_OF.get(quantity, "omega")
        diagnosis.findings.append(
            Finding(
                channel,
                fault.name,
                f"{words}: {fault.name}?",
                # No factor corrects both directions of travel.
                1.0 if fault is REVERSING else 1.0 / fault.factor,
                confidence=verdict.margins[quantity],
            )
        )


def _find_receiver_scale(channel: str, verdict: Verdict, ground: Fit) -> list[Finding]:
    """Return a finding if the receiver's speed, from the signal `channel`, differs throughout the
    drive from that of the wheels by more than slip explains. A fault of the wheel speeds in
    `verdict` is taken into account. `ground` is the fit of both speeds.
    """
    fault = verdict.faults["v"]
    share = abs(ground.gain) * (1.0 if fault is None else abs(fault.factor))
    if not ground.is_known or not is_steady(ground) or abs(np.log(share)) < STEADY:
        return []
    words = f"the receiver is {share:.3g} times as fast as the wheels: its unit?"
    return [Finding(channel, "scale", words)]


def _holds_throughout(
    quantity: str, verdict: Verdict, found: dict[str, Fit], drive: EvenDrive | None
) -> bool:
    """Return True if the fault of `quantity` in `verdict`, the result of the search for faults,
    explains the signals in most parts of the drive.

    In such a part, the gain of an identity (ratio of two quantities that are equal by physics) has
    the value that the fault predicts. In a slide the gain varies, so a slide is not reported as a
    fault.
    """
    fault = verdict.faults[quantity]
    if (
        quantity == "ay"
        and fault is not None
        and "g" in fault.name
        and not _turns_as_steered(verdict, found)
    ):
        return False
    ground = found["ground"]
    if quantity == "v" and fault is not None and drive is not None and ground.is_known:
        like_slip = fault is not REVERSING and abs(np.log(fault.factor)) < NEAR_ONE
        if (
            like_slip
            and abs(np.log(abs(ground.gain * fault.factor))) < 0.1
            and not is_same_when_coasting(drive, ground.gain)
        ):
            return False
    shares = []
    for name, law in LAWS.items():
        if not found[name].is_known or quantity not in {member.quantity for member in law.members}:
            continue
        gain = law.centre
        for member in law.members:
            other = verdict.faults[member.quantity]
            if other is not None:
                gain *= other.factor**member.power
        if name in UNSIGNED:
            gain = abs(gain)
        off = abs(np.log(abs(gain / law.centre)))
        # Noise of ln gain in one part of the drive.
        noise = min(1.5 * found[name].error * np.sqrt(PARTS), NOISIEST)
        within = max(STEADY, noise if off == 0.0 else min(noise, 0.4 * off))
        if name == "ground" and off > 0.0:
            within = min(STEADY, max(0.04, 0.4 * off))
        whole = found[name].gain
        near = whole * gain > 0.0 and abs(np.log(whole / gain)) < WHOLE
        shares.append(share_of_parts(found[name], gain, within) if near else 0.0)
    return bool(shares) and min(shares) >= STEADY_SHARE


def _turns_as_steered(verdict: Verdict, found: dict[str, Fit]) -> bool:
    """Return True if the car turns as its steering or its course over ground predicts, in most
    parts of the drive. Otherwise the car may slide. In a slide the lateral acceleration differs
    from v·r (speed times yaw rate), so that the caller must not compare the two.
    """
    for name in ("steering", "turning"):
        gain = 1.0
        for member in LAWS[name].members:
            fault = verdict.faults[member.quantity]
            if fault is not None:
                gain *= fault.factor**member.power
        fit = found[name]
        if (
            fit.is_known
            and abs(fit.correlation) > TURNS_LIKE
            and share_of_parts(fit, gain) >= STEADY_SHARE
        ):
            return True
    return False


def _find_radii(drive: EvenDrive, vehicle: Vehicle, doubts: set[str]) -> list[Finding]:
    """Return findings about wheels that turn faster or slower than the others while the car drives
    straight and calmly, and about exchanged axles.

    A tyre force changes the speed of a wheel by slip, so only moments with hardly any force count.
    An error of a wheel must also appear while the car coasts. If it does not, it is not reported,
    and the wheel speeds are added to `doubts`, the channels that are neither confirmed nor faulty.
    """
    findings = []
    tracks = (vehicle.track_front, vehicle.track_front, vehicle.track_rear, vehicle.track_rear)
    half = np.array([(-0.5 if i % 2 == 0 else 0.5) * tracks[i] for i in range(4)])
    calm = (
        (drive.moving > 0)
        & (np.abs(drive.v_dot) < CALM)
        & np.isfinite(drive.r)
        & drive.follows_steering
    )
    calm &= np.abs(drive.v * drive.r) < CALM_ACROSS
    rims = drive.wheels - half * drive.r[:, None]
    good = np.flatnonzero(calm & np.isfinite(rims).all(axis=1))
    medians = median_of_others(rims[good])
    for i, wheel in enumerate(WHEELS):
        if len(good) < 10 * RATE_HZ:
            continue
        others = medians[:, i]
        ratio = rims[good, i] / np.where(others == 0, np.nan, others) - 1.0
        parts = np.array(
            [float(np.nanmedian(part)) for part in np.array_split(ratio, RADIUS_PARTS)]
        )
        off = float(np.median(parts))
        # A wheel can spin only while it is driven, so check its error while the car coasts.
        rolls = drive.v_dot[good] < -0.1
        if rolls.sum() < 2 * RATE_HZ or abs(float(np.nanmedian(ratio[rolls])) - off) > 0.3 * abs(
            off
        ):
            if abs(off) > LARGEST_RADIUS:
                doubts.add("v")
            continue
        if abs(off) > LARGEST_RADIUS and np.all(np.abs(parts - off) < 0.3 * abs(off)):
            words = f"turns {off:+.1%} faster than the other wheels: another tyre, or its own scale"
            findings.append(Finding(f"omega_{wheel}", "radius", words, 1.0 / (1.0 + off)))
    # Three wheels cannot all differ from the median of the others. Such a result means common slip,
    # or an axle with other tyres.
    if len(findings) > 1:
        findings = findings if len(findings) == 2 else []
    return findings + _compare_axles(drive)


def _compare_axles(drive: EvenDrive) -> list[Finding]:
    """Return a finding (fault) if the front and rear wheel speeds are exchanged; else an empty
    list.

    In a turn the front wheels travel further than the rear wheels: v_f² = v_r² + (L r)², with the
    speeds v_f and v_r of the axles, the wheelbase L and the yaw rate r.
    """
    front = drive.wheels[:, :2].mean(axis=1)
    rear = drive.wheels[:, 2:].mean(axis=1)
    good = (
        (drive.moving > 0)
        & np.isfinite(front)
        & np.isfinite(rear)
        & (np.abs(drive.v_dot) < 1.0)
        & (rear > 1.0)
    )
    turn = np.square(drive.wheelbase * drive.r / np.where(good, rear, 1.0))
    good &= np.isfinite(turn) & drive.follows_steering & (np.abs(drive.v * drive.r) < GENTLE_ACROSS)
    tight = good & (turn > TIGHT)
    if tight.sum() < TIGHT_S * RATE_HZ:
        return []
    x = 0.5 * turn[good]
    y = front[good] / rear[good] - 1.0
    table = np.stack([x, np.ones(len(x))], axis=1)
    solution = fit_robustly(table, y)
    spread = 1.4826 * float(np.median(np.abs(y - table @ solution)))
    count = max(len(x) / RATE_HZ, 1.0)
    error = spread / max(float(x.std()) * np.sqrt(count), 1e-12)
    if abs(solution[0] + 1.0) < 0.4 and error < 0.45:
        words = "the rear wheels travel farther in turns: front and rear exchanged?"
        return [Finding("omega", "front and rear exchanged", words)]
    return []


def _find_offsets(drive: EvenDrive, found: dict[str, Fit]) -> list[Finding]:
    """Return findings (faults) about constant errors (offsets) of sensors. An offset is a fault if
    it exceeds the largest usual offset by SURE standard deviations.
    """
    moving = drive.moving > 0
    lateral = found["lateral"]
    axle = found["axle"]
    steering = found["steering"]
    # Items: channel, measured offset, its standard deviation, largest usual offset, unit.
    listed: list[tuple[str, float, float, float, str]] = []
    beside = (drive.ax - drive.v_dot)[moving]
    if np.isfinite(beside).sum() > FEWEST_OFFSET_S * RATE_HZ:
        driven = float(np.nansum(np.abs(drive.v))) / RATE_HZ
        largest = LARGEST_AX if driven < AVERAGED_M else LARGEST_AX_FAR
        listed.append(
            ("ax", float(np.nanmedian(beside)), spread_of_parts(beside), largest, "m/s^2")
        )
    straight = moving & (np.abs(drive.v * drive.r) < 1.0)
    if np.isfinite(drive.delta).any():
        straight &= drive.follows_steering
    beside = (drive.ay - drive.v * drive.r)[straight]
    if np.isfinite(beside).sum() > FEWEST_OFFSET_S * RATE_HZ:
        listed.append(
            ("ay", float(np.nanmedian(beside)), spread_of_parts(beside), LARGEST_AY, "m/s^2")
        )
    if axle.is_known and abs(abs(axle.gain) - 1.0) < 0.2 and axle.correlation > 0.9:
        error = float(
            np.hypot(axle.offset_error, spread_of_parts((drive.r_wheels - drive.r)[moving]))
        )
        # If the car always turns the same way, an offset cannot be separated from a gain.
        if np.sum(straight & np.isfinite(drive.r)) < 2 * RATE_HZ:
            error = np.inf
        listed.append(("yaw_rate", -axle.offset / axle.gain, error, LARGEST_RATE, "rad/s"))
    elif lateral.is_known and np.isfinite(drive.r).any():
        still = (drive.moving == 0) & (np.abs(drive.v) < 0.05)
        if still.sum() > RATE_HZ:
            listed.append(
                ("yaw_rate", float(np.nanmedian(drive.r[still])), 0.0, LARGEST_RATE, "rad/s")
            )
    if (
        steering.is_known
        and abs(steering.correlation) > 0.9
        and 0.7 < steering.gain < 1.6
        and is_steady(steering)
    ):
        listed.append(("delta", steering.offset, steering.offset_error, LARGEST_STEER, "rad"))
    return [
        Finding(channel, "offset", f"{value:+.3g} {unit}; expected about 0", offset=-value)
        for channel, value, error, largest, unit in listed
        if np.isfinite(value) and abs(value) > largest + SURE * error
    ]


__all__ = ["Diagnosis", "Finding", "diagnose", "interpolate_near"]
