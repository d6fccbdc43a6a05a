"""Limits of the readings that a car can reach.

The identities need half a minute with turns and braking. A value that no car reaches shows a wrong
unit in a shorter drive, too.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from edge_agent.inputs.doctor.diagnosis import Diagnosis, Finding
from schemas.numeric import FloatArray
from schemas.signals import S


class RangeLimit(NamedTuple):
    """Limit of a channel in SI units, with the usual reason why readings exceed it."""

    columns: slice
    value: float
    unit: str
    reason: str


# Share of the readings that may lie beyond a limit, for example spikes of a loose contact.
SPIKES: Final = 0.005
LIMITS: Final = {
    # The wheels of a London taxi turn by 1.05 rad.
    "delta": RangeLimit(
        slice(S.DELTA, S.DELTA + 4), 1.2, "rad", "degrees, or the angle of the steering wheel?"
    ),
    # A car that spins at 20 m/s on dry asphalt turns by less than 3 rad/s.
    "yaw_rate": RangeLimit(slice(S.YAW_RATE, S.YAW_RATE + 1), 4.0, "rad/s", "degrees per second?"),
    # Twice the grip of a racing car without downforce.
    "ax": RangeLimit(slice(S.AX, S.AX + 1), 30.0, "m/s^2", "another unit?"),
    "ay": RangeLimit(slice(S.AY, S.AY + 1), 30.0, "m/s^2", "another unit?"),
}


def find_impossible_values(signals: FloatArray, diagnosis: Diagnosis) -> None:
    """Add a finding to the diagnosis for each channel in `signals` (T, 18) that exceeds its limit
    more often than spikes do, unless the channel already has a finding.
    """
    for channel, limit in LIMITS.items():
        values = np.abs(signals[:, limit.columns])
        values = values[np.isfinite(values)]
        if not len(values) or channel in diagnosis.faulty_channels():
            continue
        reached = float(np.quantile(values, 1.0 - SPIKES))
        if reached > limit.value:
            words = (
                f"reaches {reached:.3g} {limit.unit}, a car at most {limit.value:g}: {limit.reason}"
            )
            diagnosis.findings.append(Finding(channel, "range", words))
