"""Records of the signal doctor (automatic check of the signals): one fault (`Finding`), and the
complete result for a log (`Diagnosis`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from edge_agent.inputs.doctor.drive import EvenDrive
from edge_agent.inputs.doctor.identities import Fit
from edge_agent.inputs.doctor.scales import SETTLED


@dataclass(frozen=True)
class Finding:
    """One fault of a signal log: its channel, its kind, its description, and its correction.

    Attributes:
        channel: channel or device that has the fault.
        kind: short name of the fault.
        words: description for a person.
        scale: factor by which the recorded value must be multiplied.
        offset: correction that is added after the factor.
        delay_s: delay of the channel's time stamps [s].
        confidence: log odds of this explanation against the next best one, if there is another one.
    """

    channel: str
    kind: str
    words: str
    scale: float = 1.0
    offset: float = 0.0
    delay_s: float = 0.0
    confidence: float = SETTLED

    def __str__(self) -> str:
        return f"{self.channel} {self.kind}: {self.words}"


@dataclass
class Diagnosis:
    """Result of the check of a log: its faults (`findings`), the channels without fault (`sound`),
    the channels about which the drive shows nothing (`unknown`), and the fitted physical relations
    between signals (`fits`).
    """

    findings: list[Finding] = field(default_factory=list)
    sound: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    fits: dict[str, Fit] = field(default_factory=dict)
    drive: EvenDrive | None = None
    # [s] delay of each device behind the gyroscope, by quantity, if turns show it
    lags: dict[str, float] = field(default_factory=dict)
    # axles ("front", "rear") whose two wheels always turn at the same speed
    locked: list[str] = field(default_factory=list)
    # quantities for which a fault appears only in some parts of the drive
    doubts: set[str] = field(default_factory=set)

    @property
    def is_passed(self) -> bool:
        """Return True if the check found every channel to be free of faults."""
        return not self.findings and not self.unknown

    def faulty_channels(self) -> set[str]:
        """Return the channels and devices that have a fault."""
        return {finding.channel for finding in self.findings}

    def list_channel(self, channel: str, *, is_sound: bool) -> None:
        """Add a channel to `sound`, or to `unknown` if `is_sound` is False."""
        listed = self.sound if is_sound else self.unknown
        listed.append(channel)
