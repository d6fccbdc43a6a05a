"""Records of the signal doctor: one fault, and everything that is known of a log."""

from __future__ import annotations

from dataclasses import dataclass, field

from edge_agent.inputs.doctor.drive import EvenDrive
from edge_agent.inputs.doctor.identities import Fit
from edge_agent.inputs.doctor.scales import SETTLED


@dataclass(frozen=True)
class Finding:
    """One fault: its channel, its name, its description, and its correction.

    Attributes:
        scale: factor for the channel; offset: to add after that; delay_s: delay of its time
        stamps [s].
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
    """Faults, channels that are in order, channels that nothing was learned of, and the
    identities' fits.
    """

    findings: list[Finding] = field(default_factory=list)
    sound: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    fits: dict[str, Fit] = field(default_factory=dict)
    drive: EvenDrive | None = None
    lags: dict[str, float] = field(
        default_factory=dict
    )  # [s] behind the gyro, by quantity, where turns tell it
    locked: list[str] = field(
        default_factory=list
    )  # axles whose wheels turn as one: "front", "rear"
    doubts: set[str] = field(
        default_factory=set
    )  # quantities that only some parts of the drive speak against

    @property
    def is_passed(self) -> bool:
        """True if every channel was found to be in order."""
        return not self.findings and not self.unknown
