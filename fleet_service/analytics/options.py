"""Options of the predefined questions (such as `vehicles` or `replay`) that can be asked about an
archive. The time range and the area of the question are given separately.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Options:
    """Options of the predefined questions about an archive; each question uses some of them.

    Attributes:
        at: time of a road treatment, or of a replayed map [ns].
        stations: path of a table of weather station readings, CSV or Parquet.
        least_vehicles: minimum number of vehicles that must have measured a slippery stretch, a
            slippery period, or a road link, for it to be listed or judged.
        step_s: time between the frames of an animated replay [s]; None for one map.
        lateness_s: allowed delay of observations in a replayed map [s]. Observations with a longer
            delay count less. The value must equal the setting `lateness_s` of the service;
            otherwise the replayed map differs from the service's map.
        roads: table made by `fleet-service roads`.
        level: minimum friction that a maintenance contract requires.
        within_s: time within which this friction must be restored [s].
        report: called with lines about the progress.
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
