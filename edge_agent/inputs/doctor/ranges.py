"""Limits of the readings that a car can reach.

The identities need half a minute with turns and braking. A value that no car reaches shows a wrong
unit in a shorter drive, too.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from edge_agent.inputs.doctor.diagnosis import Diagnosis, Finding
from schemas.numeric import FloatArray
from schemas.signals import S

# Share of the readings that may lie beyond a limit, for example spikes of a loose contact.
SPIKES: Final = 0.005
# Channel -> its columns, limit in SI units, unit, and the usual reason.
LIMITS: Final = {
    # The wheels of a London taxi turn by 1.05 rad.
    "delta": (
        slice(S.DELTA, S.DELTA + 4),
        1.2,
        "rad",
        "degrees, or the angle of the steering wheel?",
    ),
    # A car that spins at 20 m/s on dry asphalt turns by less than 3 rad/s.
    "yaw_rate": (slice(S.YAW_RATE, S.YAW_RATE + 1), 4.0, "rad/s", "degrees per second?"),
    # Twice the grip of a racing car without downforce.
    "ax": (slice(S.AX, S.AX + 1), 30.0, "m/s^2", "another unit?"),
    "ay": (slice(S.AY, S.AY + 1), 30.0, "m/s^2", "another unit?"),
}


def find_impossible_values(signals: FloatArray, diagnosis: Diagnosis) -> None:
    """Add a finding to the diagnosis for each channel in `signals` (T, 18) that exceeds its limit
    more often than spikes do, unless the channel already has a finding.
    """
    for channel, (columns, limit, unit, reason) in LIMITS.items():
        values = np.abs(signals[:, columns])
        values = values[np.isfinite(values)]
        if not len(values) or channel in diagnosis.faulty_channels():
            continue
        reached = float(np.quantile(values, 1.0 - SPIKES))
        if reached > limit:
            words = f"reaches {reached:.3g} {unit}, a car at most {limit:g}: {reason}"
            diagnosis.findings.append(Finding(channel, "range", words))
