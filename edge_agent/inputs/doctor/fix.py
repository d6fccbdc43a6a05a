"""Corrections of faults that the signal doctor (automatic check of the signals) has found. They are
written into the profile (assignment of signals to channels) and into the vehicle file.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from edge_agent.inputs.doctor.clocks import FILTER_BEARS_S, late_devices
from edge_agent.inputs.doctor.diagnosis import Diagnosis, Finding
from edge_agent.inputs.profile import Channel, Profile
from edge_agent.inputs.units import SPEED
from schemas.signals import per_wheel
from schemas.vehicle import Vehicle

OF_DEVICE: Final = {
    "imu": ("ax", "ay", "yaw_rate"),
    "gyro": ("yaw_rate",),
    "steering": per_wheel("delta"),
    "wheels": per_wheel("omega"),
    "receiver": ("latitude", "longitude", "yaw"),
    "delta": per_wheel("delta"),
    "omega": per_wheel("omega"),
}
LEFT_RIGHT: Final = (("omega_fl", "omega_fr"), ("omega_rl", "omega_rr"))
FRONT_REAR: Final = (("omega_fl", "omega_rl"), ("omega_fr", "omega_rr"))
EXCHANGED: Final = {
    "exchanged with ay": (("ax", "ay"),),
    "exchanged with longitude": (("latitude", "longitude"),),
    "left and right exchanged": LEFT_RIGHT,
    "front left and right exchanged": LEFT_RIGHT[:1],
    "rear left and right exchanged": LEFT_RIGHT[1:],
    "front and rear exchanged": FRONT_REAR,
}


def small_lags(diagnosis: Diagnosis) -> dict[str, float]:
    """Return the delay [s] of each device (wheels, steering, inertial unit) whose delay is too
    small to be reported as a fault, but too large for the estimator.
    """
    if any(finding.kind == "clock" for finding in diagnosis.findings):
        return {}
    return {name: lag for name, lag in late_devices(diagnosis).items() if abs(lag) > FILTER_BEARS_S}


def list_corrections(diagnosis: Diagnosis) -> list[Finding]:
    """Return all corrections that must be written into a profile. These are the faults that the
    signal doctor has found, and the delays that are too small to count as faults (`small_lags`).
    The delays are returned as findings of the kind "clock".
    """
    lags = small_lags(diagnosis)
    return [
        *diagnosis.findings,
        *(Finding(name, "clock", "", delay_s=lag) for name, lag in lags.items()),
    ]


def apply_findings(
    findings: Sequence[Finding], profile: Profile, vehicle: Vehicle
) -> tuple[Profile, Vehicle, list[Finding]]:
    """Correct the faults `findings` in the profile and in the vehicle file. Return the corrected
    profile, the corrected vehicle file, and those faults that cannot be corrected in either of
    them.
    """
    channels = dict(profile.channels)
    left = list[Finding]()
    update: dict[str, object] = {}
    # The radius of the vehicle file has no effect on wheel speeds that are recorded at the rim.
    at_rim = any(channels[name].unit in SPEED for name in per_wheel("omega") if name in channels)
    for finding in findings:
        names = [
            name for name in OF_DEVICE.get(finding.channel, (finding.channel,)) if name in channels
        ]
        if finding.kind in EXCHANGED and names:
            _exchange_channels(channels, EXCHANGED[finding.kind])
        elif finding.channel == "t" and finding.kind in ("ms", "us", "ns"):
            update["time_unit"] = finding.kind
        elif (finding.channel, finding.kind) == ("omega", "radius") and not at_rim:
            vehicle = vehicle.model_copy(
                update={"wheel_radius": vehicle.wheel_radius * finding.scale}
            )
        elif finding.channel == "yaw" and names:
            channels["yaw"] = _correct_yaw(channels["yaw"], finding.kind)
        elif names and (finding.scale != 1.0 or finding.offset or finding.delay_s):
            for name in names:
                channels[name] = _correct_channel(channels[name], finding)
        else:
            left.append(finding)
    if profile.wheel_radius not in (None, vehicle.wheel_radius) and not at_rim:
        update["wheel_radius"] = vehicle.wheel_radius
    return profile.model_copy(update=update | {"channels": channels}), vehicle, left


def _exchange_channels(channels: dict[str, Channel], pairs: Iterable[tuple[str, str]]) -> None:
    """Exchange the rules of the channels of each pair, in place, if the profile has both."""
    for one, other in pairs:
        if one in channels and other in channels:
            channels[one], channels[other] = channels[other], channels[one]


def _correct_channel(channel: Channel, finding: Finding) -> Channel:
    return channel.model_copy(
        update={
            "scale": channel.scale * finding.scale,
            "offset": channel.offset * finding.scale + finding.offset,
            "delay_s": channel.delay_s + finding.delay_s,
        }
    )


def _correct_yaw(channel: Channel, kind: str) -> Channel:
    update: dict[str, object] = {}
    if "deg" in kind:
        update["unit"] = "deg"
    if "compass" in kind:
        update["course"] = not channel.course
    if kind == "sign":
        update["scale"] = -channel.scale
    return channel.model_copy(update=update)
