"""Figures (measured values) of a campaign (one run of an evaluation), each with its target, written
as the file `figures.json` and a Markdown table.
"""

from __future__ import annotations

import json
import math
import platform
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Literal

PACKAGES = ("eclipse-zenoh", "numba", "numpy", "protobuf", "pyarrow", "pydantic", "scipy")


@dataclass(frozen=True)
class Figure:
    """One measured value.

    Attributes:
        name, value, unit: name of the measured quantity, measured value, and its unit.
        bar: target, None if there is none: one limit for the value, or a pair of limits if `better`
            is "within".
        better: "less" if the value must not exceed the limit, "more" if it must reach the limit,
            "within" if it must lie between two limits.
    """

    name: str
    value: float
    unit: str
    bar: float | tuple[float, float] | None = None
    better: Literal["less", "more", "within"] = "less"

    @property
    def holds(self) -> bool:
        """Return True if the figure's value meets its target, or has no target; False for NaN (not
        measured).
        """
        if self.bar is None:
            return not math.isnan(self.value)
        if isinstance(self.bar, tuple):
            return bool(self.bar[0] <= self.value <= self.bar[1])  # json cannot write a NumPy bool
        return bool(self.value <= self.bar if self.better == "less" else self.value >= self.bar)


def make_header(campaign: str, seeds: Sequence[int]) -> dict[str, object]:
    """Return the header of a file of figures, with the conditions of the measurement: commit,
    machine, versions of packages, random seeds and date.
    """
    return {
        "campaign": campaign,
        "commit": find_commit(Path(__file__)),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}",
        "versions": _find_versions(),
        "seeds": list(seeds),
    }


def _find_versions() -> dict[str, str]:
    """Return, by name, the installed version of each package in the list PACKAGES."""
    found = {}
    for name in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def find_commit(source: Path) -> str:
    """Return the commit of the repository that contains a source file; `-dirty` is appended if a
    tracked file was changed.

    The repository is that of the source file, not that of the working directory. The result is
    "unknown" if the repository does not track the file, as for an installed copy.
    """
    git = ["git", "-C", str(source.parent)]
    describe = [*git, "describe", "--always", "--abbrev=7", "--exclude=*", "--dirty"]
    try:
        subprocess.run(
            [*git, "ls-files", "--error-unmatch", source.name], capture_output=True, check=True
        )
        return subprocess.run(describe, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def write_figures(
    path: Path, campaign: str, seeds: Sequence[int], figures: Sequence[Figure]
) -> None:
    """Write the figures of a campaign (one run of an evaluation) to a file as one JSON list. Its
    first item is the header with the conditions of the measurement.
    """
    rows = [{**asdict(figure), "holds": figure.holds} for figure in figures]
    for row in rows:
        row["value"] = row["value"] if math.isfinite(row["value"]) else None
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([make_header(campaign, seeds), *rows], indent=1) + "\n")


def format_table(figures: Sequence[Figure]) -> str:
    """Return the figures as a Markdown table; a missed target is marked."""
    lines = ["| figure | value | bar | |", "|---|---|---|---|"]
    for name, *rest in map(format_row, figures):
        lines.append(f"| `{name}` | {' | '.join(rest)} |")
    return "\n".join(lines)


def format_row(figure: Figure) -> list[str]:
    """Return the four table cells of a figure: name, value with unit, target, and "holds" or "DOES
    NOT HOLD".
    """
    signs = {"less": "≤ ", "more": "≥ "}
    bar = figure.bar
    value = f"{figure.value:.4g} {figure.unit}"
    if bar is None:
        return [figure.name, value, "", ""]
    text = (
        f"{bar[0]:g} – {bar[1]:g}" if isinstance(bar, tuple) else f"{signs[figure.better]}{bar:g}"
    )
    return [figure.name, value, text, "holds" if figure.holds else "DOES NOT HOLD"]
