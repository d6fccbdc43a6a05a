"""Diagnosis of a signal log by the signal doctor (automatic check of the signals).

It consists of findings and of the channels without fault. A finding is one reported fault with the
reason for it.

A channel is free of faults under two conditions. A physical relation with enough excitation (change
of the signals) confirms it, and no fault would explain the drive nearly as well. A channel is
unknown if it is neither confirmed nor faulty. A log passes only if all its channels are free of
faults.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge_agent.inputs.doctor.bumps import leading_axle
from edge_agent.inputs.doctor.clocks import find_late_clocks, measure_clocks
from edge_agent.inputs.doctor.diagnosis import Diagnosis, Finding
from edge_agent.inputs.doctor.drive import (
    RATE_HZ,
    EvenDrive,
    correlate_series,
    median_of_others,
    prepare_drive,
)
from edge_agent.inputs.doctor.identities import fit_identities
from edge_agent.inputs.doctor.lift import is_on_lift
from edge_agent.inputs.doctor.offset_faults import find_offsets, find_radii
from edge_agent.inputs.doctor.places import (
    has_exchanged_position,
    position_findings,
    yaw_findings,
)
from edge_agent.inputs.doctor.ranges import find_impossible_values
from edge_agent.inputs.doctor.scale_faults import CHANNELS_OF, find_receiver_scale, find_scales
from edge_agent.inputs.doctor.scales import Verdict, explain_fits
from edge_agent.inputs.doctor.slip import (
    find_exchanged_axles,
    find_locked_axles,
    has_equal_steps,
    is_foreign,
)
from edge_agent.inputs.log_columns import GROUND
from schemas.numeric import FloatArray
from schemas.signals import WHEELS, S
from schemas.thresholds import SLOWEST_HZ
from schemas.vehicle import Vehicle

JUMPS = 0.01  # share of a wheel's readings that may differ strongly from the other wheels
CONSTANT_S = 10.0  # [s] no wheel turns at exactly the same speed, or stands, for that long
CHANGES = 0.2  # share of its largest value by which the speed of another wheel must change
FASTEST_HZ = 2000.0
# other units of time, in seconds; spreadsheets count days
WRONG_TIME_UNITS = (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9), ("minutes", 60.0), ("days", 86_400.0))


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
    _find_constant_wheels(t, signals, diagnosis)
    _find_jumps(signals, diagnosis)
    drive = _undo_exchanges(t, signals, vehicle, ground, diagnosis)
    diagnosis.locked = find_locked_axles(drive)
    if diagnosis.locked == ["rear"]:
        drive = replace(drive, r_wheels=drive.yaw_front)
    diagnosis.drive = drive
    diagnosis.fits = fit_identities(drive)
    verdict = explain_fits(diagnosis.fits, vehicle, drive.fast)
    find_scales(verdict, diagnosis)
    # Offsets and radii are not evaluated for quantities in a wrong unit.
    has_wrong_unit = any(fault is not None for fault in verdict.faults.values())
    if not find_late_clocks(diagnosis) and not has_wrong_unit:
        measure_clocks(t, signals, vehicle, diagnosis)
    diagnosis.findings += position_findings(signals, drive)
    diagnosis.findings += yaw_findings(signals, drive)
    if not has_wrong_unit:
        diagnosis.findings += find_radii(drive, vehicle, diagnosis.doubts)
        diagnosis.findings += find_offsets(drive, diagnosis.fits)
        _find_exchanged_ends(t, signals, vehicle, diagnosis)
    find_impossible_values(signals, diagnosis)
    _list_sound_channels(verdict, diagnosis)
    _judge_receiver(signals, ground, verdict, diagnosis)
    return diagnosis


def _undo_exchanges(
    t: FloatArray,
    signals: FloatArray,
    vehicle: Vehicle,
    ground: FloatArray | None,
    diagnosis: Diagnosis,
) -> EvenDrive:
    """Add a finding to the diagnosis for each pair of exchanged channels, exchange these channels
    in `signals` again, and return the corrected drive.
    """

    def exchange_columns(finding: Finding, one: int, other: int) -> EvenDrive:
        diagnosis.findings.append(finding)
        signals[:, [one, other]] = signals[:, [other, one]]
        return prepare_drive(t, signals, vehicle, ground)

    drive = prepare_drive(t, signals, vehicle, ground)
    if _axes_exchanged(drive):
        words = "a_x follows v·r and a_y the wheels' acceleration"
        drive = exchange_columns(Finding("ax", "exchanged with ay", words), S.AX, S.AY)
    if has_exchanged_position(t, signals, drive):
        words = "the fixes match the wheels' speed only if latitude and longitude are exchanged"
        finding = Finding("latitude", "exchanged with longitude", words)
        drive = exchange_columns(finding, S.LATITUDE, S.LONGITUDE)
    for axle, (left, right) in find_exchanged_axles(drive):
        words = (
            f"the {axle} wheels turn against the yaw rate, the others with it: left and right "
            "exchanged?"
        )
        finding = Finding("omega", f"{axle} left and right exchanged", words)
        drive = exchange_columns(finding, S.OMEGA + left, S.OMEGA + right)
    return drive


def _find_exchanged_ends(
    t: FloatArray, signals: FloatArray, vehicle: Vehicle, diagnosis: Diagnosis
) -> None:
    """Add a finding to the diagnosis if bumps reach the rear wheels first, unless the exchange of
    front and rear was found before.
    """
    kind = "front and rear exchanged"
    if any(finding.kind == kind for finding in diagnosis.findings):
        return
    if leading_axle(t, signals, vehicle) < 0:
        words = "bumps reach the rear wheels first: front and rear exchanged?"
        diagnosis.findings.append(Finding("omega", kind, words))


def _list_sound_channels(verdict: Verdict, diagnosis: Diagnosis) -> None:
    """List each channel without a finding as sound or as unknown in the diagnosis."""
    faulty = diagnosis.faulty_channels()
    for quantity, channel in CHANNELS_OF.items():
        if channel not in faulty:
            is_sound = verdict.is_settled(quantity) and quantity not in diagnosis.doubts
            diagnosis.list_channel(channel, is_sound=is_sound)


def _judge_receiver(
    signals: FloatArray, ground: FloatArray | None, verdict: Verdict, diagnosis: Diagnosis
) -> None:
    """Add a finding if the position receiver's speed is wrong; otherwise list the position as sound
    or as unknown, if it was recorded.
    """
    fit = diagnosis.fits["ground"]
    has_speed = ground is not None and np.isfinite(ground).any()
    if diagnosis.faulty_channels().isdisjoint(("latitude", "longitude")):
        diagnosis.findings += find_receiver_scale(GROUND if has_speed else "latitude", verdict, fit)
    is_faulty = diagnosis.faulty_channels() & {"latitude", "longitude", "yaw", GROUND}
    if np.isfinite(signals[:, S.LATITUDE]).any() and not is_faulty:
        diagnosis.list_channel("latitude", is_sound=fit.is_known)


def _in_seconds(t: FloatArray, diagnosis: Diagnosis) -> tuple[FloatArray, bool]:
    """Return the times of the samples (n,) in seconds, and True if the sampling rate is unusable.

    Times `t` (n,) in another unit are converted. A wrong unit and an unusable rate are added to the
    diagnosis as faults; the time of a single sample is unknown.
    """
    if len(t) < 2:
        diagnosis.list_channel("t", is_sound=False)
        return t, True
    step = float(np.median(np.diff(t)))
    if np.percentile(np.diff(t), 60) == 0.0:
        words = "most samples repeat a time: does the column lack the fraction of a second?"
        diagnosis.findings.append(Finding("t", "repeats", words))
        return t, True
    if step > 0.0 and not 1.0 / FASTEST_HZ <= step <= 1.0 / SLOWEST_HZ:
        for unit, factor in WRONG_TIME_UNITS:
            if 1.0 / FASTEST_HZ <= step * factor <= 1.0 / SLOWEST_HZ:
                words = f"a sample every {step:g}: are these {unit}?"
                diagnosis.findings.append(Finding("t", unit, words, scale=factor))
                return t * factor, False
        bound = f"least {SLOWEST_HZ:g}" if step * SLOWEST_HZ > 1.0 else f"most {FASTEST_HZ:g}"
        words = f"a sample every {step:g} s; friction needs at {bound} a second"
        diagnosis.findings.append(Finding("t", "rate", words))
        return t, True
    return t, False


def _find_constant_wheels(t: FloatArray, signals: FloatArray, diagnosis: Diagnosis) -> None:
    """Add a finding to the diagnosis for each wheel speed that never changes in a drive in which
    the speed of another wheel does, and set its readings to NaN. A bus sends a constant code for a
    sensor that has failed.
    """
    wheels = signals[:, S.OMEGA : S.OMEGA + 4]
    known = [wheel[np.isfinite(wheel)] for wheel in wheels.T]
    if t[-1] - t[0] < CONSTANT_S or not any(
        len(one) and np.ptp(one) > CHANGES * np.abs(one).max() for one in known
    ):
        return
    for i, wheel in enumerate(WHEELS):
        if len(known[i]) and np.ptp(known[i]) == 0.0:
            words = f"is always {known[i][0]:g} while other wheels change: sensor or wiring?"
            diagnosis.findings.append(Finding(f"omega_{wheel}", "constant", words))
            wheels[:, i] = np.nan


def _find_jumps(signals: FloatArray, diagnosis: Diagnosis) -> None:
    """Add a finding to the diagnosis for each wheel speed that seems to contain status bits, and
    set its wrong readings to NaN.

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
        other_wheels = medians[:, i]
        fast = float(np.percentile(np.abs(other_wheels), 95))
        above = wheels[:, i] - other_wheels
        off = np.abs(above) > 0.3 * np.abs(other_wheels) + 0.3 * fast
        if off.mean() <= JUMPS or not (
            has_equal_steps(above, off)
            or is_foreign(np.delete(wheels, i, axis=1), other_wheels, off, fast)
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
