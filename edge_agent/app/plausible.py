"""Plausibility check of the estimates of a recorded drive. A command prints the resulting summary
line, and exits with the code IMPLAUSIBLE if the estimates are implausible.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from schemas.numeric import FloatArray
from schemas.signals import Health, S
from schemas.thresholds import EXCITED_SHARE, GRAVITY

if TYPE_CHECKING:
    from edge_agent.estimators import Estimates

IMPLAUSIBLE: Final = 3  # exit code
MOST_SPEED_ERROR: Final = 0.15  # largest median of |v_x − wheel speed| / wheel speed
LEAST_SPEED: Final = 3.0  # [m/s] speeds are compared only above this value
MOST_VIOLATION: Final = 0.05  # largest share of samples with an upper bound below the grip in use
# Tolerance of the comparison of upper bound and grip in use. A tilted mount changes the
# acceleration by 0.5 m/s^2.
SLACK: Final = 0.05
# [s] window over which the grip in use is averaged: the time in which a tyre builds up its force.
SMOOTHED_S: Final = 0.2
MOST_RESETS_PER_S: Final = 0.2  # [1/s] maximum rate of filter resets
MOST_RESETS_PER_SAMPLE: Final = 0.1  # the same, if times are in a wrong unit


def grip_in_use(t: FloatArray, signals: FloatArray) -> FloatArray:
    """Return the grip in use, (T,) [1]: the horizontal acceleration divided by g, smoothed over
    SMOOTHED_S seconds. A missing reading counts as 0.

    The estimate `mu_utilised` is not suitable here. It is the maximum of the last second, and just
    after the road has become slippery it may exceed the available grip.
    """
    used = np.nan_to_num(np.hypot(signals[:, S.AX], signals[:, S.AY])) / GRAVITY
    step = float(np.median(np.diff(t))) if len(t) > 1 else SMOOTHED_S
    width = min(max(round(SMOOTHED_S / max(step, 1e-3)), 1), len(used))
    return np.convolve(used, np.full(width, 1.0 / width), mode="same")


@dataclass
class Plausibility:
    """Counts and errors of the samples of one recorded drive, from which this class judges the
    plausibility of the estimates. `radius` is that of the wheels [m]. Estimates from signals in
    which the signal doctor found faults are implausible.
    """

    radius: float
    has_faulty_signals: bool = False
    first_s: float = np.inf
    last_s: float = -np.inf
    samples: int = 0
    sliding: int = 0
    resets: int = 0
    violations: int = 0
    excited: int = 0
    speed_errors: list[FloatArray] = field(default_factory=list)

    def add(self, t: FloatArray, signals: FloatArray, estimates: Estimates) -> None:
        """Add a block of samples of the replayed log: t (T, 1), signals (T, 1, 18) and the
        estimates of these samples.
        """
        wheels = signals[:, 0, S.OMEGA : S.OMEGA + 4]
        some = np.isfinite(wheels).any(axis=1)
        speed = np.full(len(wheels), np.nan)
        speed[some] = np.nanmedian(wheels[some], axis=1) * self.radius
        fast = speed > LEAST_SPEED
        self.speed_errors.append(np.abs(estimates.vx[fast, 0] - speed[fast]) / speed[fast])
        health = np.asarray(estimates.health[:, 0], dtype=np.int64)
        self.sliding += int(np.sum(health & Health.SLIDING != 0))
        self.resets += int(np.sum(health & Health.RESET != 0))
        upper = estimates.mu_upper[:, 0]
        used = estimates.mu_utilised[:, 0]
        mu = estimates.mu[:, 0]
        self.violations += int(np.sum(upper < grip_in_use(t[:, 0], signals[:, 0]) - SLACK))
        self.excited += int(np.sum(used > EXCITED_SHARE * mu))
        self.samples += len(health)
        self.first_s = min(self.first_s, float(t[0, 0]))
        self.last_s = float(t[-1, 0])

    @property
    def seconds(self) -> float:
        """Return the duration of the replayed drive [s]."""
        return max(self.last_s - self.first_s, 0.0)

    @property
    def median_speed_error(self) -> float:
        """Return the median relative difference [1] between the estimated forward speed and the
        wheels' speed; 0 if the car never drove fast enough for a comparison.
        """
        speed_errors = np.concatenate(self.speed_errors) if self.speed_errors else np.zeros(0)
        return float(np.median(speed_errors)) if len(speed_errors) else 0.0

    def problems(self) -> list[str]:
        """Return one message per reason for which the estimates are implausible; an empty list
        means plausible.
        """
        n = max(self.samples, 1)
        most_resets = 1 + min(MOST_RESETS_PER_S * self.seconds, MOST_RESETS_PER_SAMPLE * n)
        found = []
        if self.has_faulty_signals:
            found.append("signals have faults")
        if self.median_speed_error > MOST_SPEED_ERROR:
            found.append("speed differs much from that of the wheels")
        if self.violations / n > MOST_VIOLATION:
            found.append("the upper bound lies below the grip in use")
        if self.resets > most_resets:
            found.append("the filter was reset repeatedly")
        return found

    def summary_line(self) -> str:
        """Return one line that summarises the plausibility of the replayed log's estimates."""
        n = max(self.samples, 1)
        summary = (
            f"{self.samples} samples, {self.seconds:.1f} s; speed {self.median_speed_error:.1%} "
            f"from the wheels', excited {self.excited / n:.0%}, sliding {self.sliding / n:.0%}, "
            f"upper bound below the grip in use {self.violations / n:.1%}, resets {self.resets}; "
        )
        bad = self.problems()
        return summary + (
            f"NOT PLAUSIBLE: {', '.join(bad)}; run edge-agent check" if bad else "plausible"
        )
