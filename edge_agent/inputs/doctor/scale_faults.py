"""Findings of the signal doctor about wrong units and signs, from the identities of a drive."""

from __future__ import annotations

from typing import Final

import numpy as np

from edge_agent.inputs.doctor.diagnosis import Diagnosis, Finding
from edge_agent.inputs.doctor.drive import EvenDrive
from edge_agent.inputs.doctor.identities import PARTS, Fit
from edge_agent.inputs.doctor.scales import LAWS, REVERSING, UNSIGNED, Law, Verdict
from edge_agent.inputs.doctor.slip import (
    STEADY,
    STEADY_SHARE,
    TURNS_LIKE,
    is_same_when_coasting,
    is_steady,
    share_of_parts,
)

# |ln factor| up to which slip may explain a wrong wheel speed. Slip is not larger for long.
NEAR_ONE: Final = 0.35
# Largest |ln| of the ratio between the receiver's speed and the corrected wheel speed.
CONFIRMED: Final = 0.1
WHOLE: Final = 0.35  # largest difference between ln gain of the whole drive and of the fault
NOISIEST: Final = 1.0  # largest difference of ln gain between parts that may come from noise
# Channel in which a fault of a quantity is reported.
CHANNELS_OF: Final = {"ax": "ax", "ay": "ay", "r": "yaw_rate", "delta": "delta", "v": "omega"}
# Description of a fault, and the identity whose gain it states, by quantity.
WORDS: Final = {
    "ax": "a_x is {gain:.3g} of the wheels' acceleration",
    "ay": "a_y is {gain:.3g} of v·r",
    "r": "a_y is {lateral:.3g} of v·r, the wheels' yaw rate {axle:.3g} of it",
    "delta": "steering is {gain:.3g} of L·r/v",
    "v": "the wheel speed is {wheels:.3g} times the speed from the other signals",
    "sides": "left and right wheels differ by {gain:.3g} of track·r",
}
IDENTITY_OF: Final = {
    "ax": "longitudinal",
    "ay": "lateral",
    "delta": "steering",
    "sides": "axle",
}


def find_scales(verdict: Verdict, diagnosis: Diagnosis) -> None:
    """Add a finding to the diagnosis for each settled fault in `verdict` that holds throughout the
    drive. If the fault does not, add its quantity to the doubts.
    """
    found = diagnosis.fits
    for quantity, fault in verdict.faults.items():
        if fault is None or quantity == "place" or not verdict.is_settled(quantity):
            continue
        if not _holds_throughout(quantity, verdict, found, diagnosis.drive):
            diagnosis.doubts.add(quantity)
            continue
        gain = found[IDENTITY_OF[quantity]].gain if quantity in IDENTITY_OF else np.nan
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
                scale=1.0 if fault is REVERSING else 1.0 / fault.factor,
                confidence=verdict.margins[quantity],
            )
        )


def find_receiver_scale(channel: str, verdict: Verdict, ground: Fit) -> list[Finding]:
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
    if fault is None:
        return False
    if quantity == "ay" and "g" in fault.name and not _turns_as_steered(verdict, found):
        return False
    may_be_slip = (
        quantity == "v"
        and fault is not REVERSING
        and drive is not None
        and _may_be_slip(fault.factor, found["ground"], drive)
    )
    if may_be_slip:
        return False
    shares = [
        _share_explained(name, law, found[name], verdict)
        for name, law in LAWS.items()
        if found[name].is_known and quantity in {member.quantity for member in law.members}
    ]
    return bool(shares) and min(shares) >= STEADY_SHARE


def _may_be_slip(factor: float, ground: Fit, drive: EvenDrive) -> bool:
    """Return True if slip explains the wrong wheel speed as well as the fault `factor` does. The
    receiver's speed then confirms the factor, but only while the wheels are driven or braked.
    """
    if not ground.is_known or abs(np.log(factor)) >= NEAR_ONE:
        return False
    is_confirmed = abs(np.log(abs(ground.gain * factor))) < CONFIRMED
    return is_confirmed and not is_same_when_coasting(drive, ground.gain)


def _share_explained(name: str, law: Law, fit: Fit, verdict: Verdict) -> float:
    """Return the share of the parts of a drive in which the identity `name` has the gain that the
    faults in `verdict` predict; 0 if the gain of the whole drive differs.
    """
    gain = _gain_with_faults(law.centre, law, verdict)
    if name in UNSIGNED:
        gain = abs(gain)
    off = abs(np.log(abs(gain / law.centre)))
    # Noise of ln gain in one part of the drive.
    noise = min(1.5 * fit.error * np.sqrt(PARTS), NOISIEST)
    within = max(STEADY, noise if off == 0.0 else min(noise, 0.4 * off))
    if name == "ground" and off > 0.0:
        within = min(STEADY, max(0.04, 0.4 * off))
    is_near = fit.gain * gain > 0.0 and abs(np.log(fit.gain / gain)) < WHOLE
    return share_of_parts(fit, gain, within) if is_near else 0.0


def _gain_with_faults(gain: float, law: Law, verdict: Verdict) -> float:
    """Return the gain of an identity, `gain` without faults, with the faults in `verdict`."""
    for member in law.members:
        fault = verdict.faults[member.quantity]
        if fault is not None:
            gain *= fault.factor**member.power
    return gain


def _turns_as_steered(verdict: Verdict, found: dict[str, Fit]) -> bool:
    """Return True if the car turns as its steering or its course over ground predicts, in most
    parts of the drive. Otherwise the car may slide. In a slide the lateral acceleration differs
    from v·r (speed times yaw rate), so that the caller must not compare the two.
    """
    for name in ("steering", "turning"):
        fit = found[name]
        gain = _gain_with_faults(1.0, LAWS[name], verdict)
        if (
            fit.is_known
            and abs(fit.correlation) > TURNS_LIKE
            and share_of_parts(fit, gain) >= STEADY_SHARE
        ):
            return True
    return False
