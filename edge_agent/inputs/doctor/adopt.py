"""Correction of a recorded drive by the measurements of the signal doctor (automatic check of the
signals). Three faults are corrected before the estimator reads the log:

- Delayed device: the doctor reports a delay between devices that is too large for the filter. If
  the drive shows the size of the delay, the device's readings are moved in time. A delay of unknown
  size remains a finding (reported fault), and the records of the log are not published.
- Locked rear axle: both rear wheels turn at the same speed. The slip that this causes in turns is
  removed from the wheel speeds.
- Car on a lift or rollers: the wheels are treated as standing.

Smaller delays are not corrected here, because the filter itself estimates them. Therefore a log
without these faults is replayed unchanged. The estimates are then those that a car would compute
during the drive, without knowledge of later samples.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from edge_agent.inputs.correct import correct_log, free_rear_wheels
from edge_agent.inputs.doctor.diagnosis import Diagnosis
from edge_agent.inputs.doctor.findings import diagnose
from edge_agent.inputs.doctor.fix import OF_DEVICE, apply_findings
from edge_agent.inputs.driving_direction import sign_wheels
from edge_agent.inputs.log_columns import fill_steering, split_front_angle
from edge_agent.inputs.merge import Merged
from edge_agent.inputs.profile import Profile
from edge_agent.inputs.signal_log import SignalLog
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, S
from schemas.vehicle import Vehicle


class Adopted(NamedTuple):
    """A signal log after correction, with its vehicle, its diagnosis by the signal doctor, and
    notes that describe the changes.
    """

    log: SignalLog
    vehicle: Vehicle
    diagnosis: Diagnosis
    notes: list[str]


def prepare_log(log: SignalLog, vehicle: Vehicle) -> Adopted:
    """Return `log`, corrected for use by the estimator: first by the vehicle's calibration, then by
    the measurements of the signal doctor. Wheel speeds without sign become negative where the car
    drives backwards. If only one front angle was measured, the angles of the two wheels are
    computed from it.
    """
    corrected = correct_log(log.t, log.signals, vehicle)
    adopted = adopt_measured(replace(log, signals=corrected), vehicle)
    signals = sign_wheels(adopted.log.t, adopted.log.signals, vehicle)
    if log.has_one_front_angle:
        signals = signals.copy()
        split_front_angle(signals, vehicle)
    return adopted._replace(log=replace(adopted.log, signals=signals, has_one_front_angle=False))


def adopt_measured(log: SignalLog, vehicle: Vehicle) -> Adopted:
    """Examine a log with the signal doctor, correct the faults whose size the drive shows, and
    examine the corrected log. Return the corrected log with the result of this second examination.
    """
    diagnosis = diagnose(log.t, log.signals, vehicle, log.ground)
    delays = {
        finding.channel: finding.delay_s
        for finding in diagnosis.findings
        if finding.kind == "clock"
    }
    delays = {
        device: seconds for device, seconds in delays.items() if seconds and device in OF_DEVICE
    }
    if any(finding.channel == "t" for finding in diagnosis.findings):
        # The time is in another unit, so delays cannot be corrected.
        return Adopted(log, vehicle, diagnosis, [])
    notes = [
        f"note: the data of {device} are {abs(seconds):.3f} s "
        f"{'late' if seconds > 0.0 else 'early'}; "
        "corrected for this replay"
        for device, seconds in delays.items()
    ]
    if any(finding.kind == "lift" for finding in diagnosis.findings):
        standing = log.signals.copy()
        standing[:, S.OMEGA : S.OMEGA + 4] = 0.0
        notes.append(
            "note: the car stands on a lift or rollers; its wheels are treated as standing"
        )
        return Adopted(replace(log, signals=standing), vehicle, diagnosis, notes)
    signals = align_devices(log.t, log.signals, delays) if delays else log.signals
    if diagnosis.locked == ["rear"] and not vehicle.rear_axle_locked:
        vehicle = vehicle.model_copy(update={"rear_axle_locked": True})
        notes.append(
            "note: the rear wheels turn as one; treated as a locked differential (rear_axle_locked)"
        )
        signals = free_rear_wheels(signals, vehicle)
    if signals is log.signals:
        return Adopted(log, vehicle, diagnosis, notes)
    log = replace(log, signals=signals)
    return Adopted(
        log, vehicle, diagnose(log.t, signals, vehicle, log.ground) if delays else diagnosis, notes
    )


def align_import(
    merged: Merged, profile: Profile, vehicle: Vehicle, merge_with: Callable[[Profile], Merged]
) -> tuple[Merged, Profile]:
    """Correct the delays of devices in merged recordings. Return the merged recordings, and a
    profile (assignment of signals to channels) that contains the delays.

    The signal doctor measures the delays. `merge_with` is a function that merges the same
    recordings with a given profile. If no device is delayed, `merged` and `profile` are returned
    unchanged.
    """
    signals = np.full((len(merged.t), len(CHANNELS)), np.nan)
    for index, name in enumerate(CHANNELS):
        if name in merged.columns:
            signals[:, index] = merged.columns[name]
    fill_steering(signals, merged.columns)
    found = [
        fault for fault in diagnose(merged.t, signals, vehicle).findings if fault.kind == "clock"
    ]
    late = [fault for fault in found if fault.delay_s and fault.channel in OF_DEVICE]
    if not late:
        return merged, profile
    profile, *_ = apply_findings(late, profile, vehicle)
    aligned = merge_with(profile)
    aligned.notes += [
        f"{fault.channel} {fault.words}; corrected by delay_s of the profile" for fault in late
    ]
    return aligned, profile


def align_devices(t: FloatArray, signals: FloatArray, delays: Mapping[str, float]) -> FloatArray:
    """Return signals (T, 18) with times t (T,) [s], in which the readings of delayed devices are
    moved earlier, with linear interpolation between samples. `delays` has the delay [s] of each
    device by its name.
    """
    signals = signals.copy()
    for device, seconds in delays.items():
        for name in OF_DEVICE[device]:
            column = CHANNELS.index(name)
            signals[:, column] = _shift_channel(
                t, signals[:, column], seconds, angle=column == S.YAW
            )
    return signals


def _shift_channel(t: FloatArray, values: FloatArray, seconds: float, *, angle: bool) -> FloatArray:
    """Return the readings (T,) of one channel moved earlier by `seconds`, interpolated between the
    times t (T,) [s]. Missing readings stay missing. If `angle` is True, the nearest reading is
    used, because averages of angles near ±π would be wrong.
    """
    at = t + seconds
    after = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
    share = np.clip((at - t[after - 1]) / (t[after] - t[after - 1]), 0.0, 1.0)
    before = values[after - 1]
    following = values[after]
    nearest = np.where(share < 0.5, before, following)
    between = before + share * (following - before)
    return np.where(np.isfinite(between) & (not angle), between, nearest)
