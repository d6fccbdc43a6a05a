"""Options of questions, apart from the selection of the archive's part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Options:
    """Options of all questions; each question uses some of them.

    Attributes:
        at: moment of a treatment, or of a replay [ns].
        stations: table of station readings, CSV or Parquet.
        least_vehicles: minimum number of vehicles of a slippery stretch or spell.
        step_s: time between the frames of an animated replay; None for one map.
        lateness_s: of the service whose map is replayed.
        roads: table of `fleet-service roads`.
        level: agreed grip.
        within_s: time within which it must be restored.
        report: called with lines of progress.
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
