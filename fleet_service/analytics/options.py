"""What questions may be asked with, beside the part of the archive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Options:
    """Options of all questions; a question takes those that it knows.

    Attributes:
        at: moment of a treatment, or of a replay [ns].
        stations: table of station readings, CSV or Parquet.
        least_vehicles: distinct vehicles behind a slippery stretch or spell.
        step_s: time between the frames of an animated replay; None for one map.
        lateness_s: of the service whose map is replayed.
        roads: table of `fleet-service roads`.
        level: of grip that was agreed.
        within_s: in which it is to be restored.
        report: takes lines of progress.
    """

    at: int | None = None
    stations: Path | None = None
    least_vehicles: int = 2
    step_s: float | None = None
    lateness_s: float = 120.0
    roads: Path | None = None
    level: float | None = None
    within_s: float | None = None
    report: Callable[[str], None] = print
