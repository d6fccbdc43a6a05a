"""The complete evaluation of the map: runs every part, then writes figures, table and plots."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from fleet_service.lab import (
    attacks,
    bars,
    changes,
    end_to_end,
    exact,
    fading,
    fleets,
    models,
    moments,
    plots,
    resampled,
    situations,
    third_party,
    value,
)
from schemas.runtime import figures
from schemas.runtime.figures import Figure

# Figures use seeds from this one on. Constants are chosen on smaller seeds.
JUDGING: Final = 20_000
SEEDS = 10
QUICK_SEEDS = 1
# number of vehicles and duration [s] of each drive
LENGTHS: Final = {end_to_end.LEVEL: (200, 60.0), end_to_end.HILLS: (120, 180.0)} | dict.fromkeys(
    end_to_end.WAYS, (20, 1800.0)
)
# prefixes of the names of end-to-end figures
END_TO_END: Final = ("fusion.whole_way", "fusion.resampled")
# Number of seeds (drives of 20 minutes). The largest difference counts, not a mean, so few suffice.
EXACT_SEEDS: Final = 8
END_TO_END_PART: Final = "end-to-end"

LogLine = Callable[[str], None]
Part = Callable[[], dict[str, float]]
Drives = Mapping[end_to_end.World, end_to_end.Drive]


def run(
    folder: Path, quick: bool, drives: Drives, log_line: LogLine, *, only: str | None = None
) -> list[Figure]:
    """Run all parts and write `figures.json` and `figures.md` into `folder`.

    Args:
        folder: output folder, which is created.
        quick: True to run one seed, which checks that everything runs but is too little to judge
            the targets.
        drives: end-to-end drives; without them, their figures are missing.
        log_line: called with lines about the progress.
        only: name of the only part to run; figures that it does not measure are not listed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    seeds = range(JUDGING, JUDGING + (QUICK_SEEDS if quick else SEEDS))
    parts = parts_of(seeds, log_line)
    listed = [(name, part) for name, part in parts.items() if only in (None, name)]
    if only in (None, END_TO_END_PART):
        listed += _way_parts(drives, folder, seeds)
    found: dict[str, float] = {}
    for name, part in listed:
        began = time.perf_counter()
        found |= part()
        log_line(f"{name}: {time.perf_counter() - began:.0f} s")
    judged = [
        figure for figure in bars.judge_figures(found) if _is_listed(figure.name, only, found)
    ]
    figures.write_figures(
        folder / "figures.json", "fusion" + (" --quick" if quick else ""), list(seeds), judged
    )
    barred = [figure for figure in judged if figure.bar is not None]
    shown = [figure for figure in judged if figure.bar is None and not _is_curve(figure.name)]
    (folder / "figures.md").write_text(
        f"{figures.format_table(barred)}\n\n{figures.format_table(shown)}\n"
    )
    for path in plots.draw_plots(judged, folder) if only is None else []:
        log_line(f"plot {path}")
    return judged


def _is_listed(name: str, only: str | None, found: Mapping[str, float]) -> bool:
    """Return True if the figure `name` must appear in the table of a run. A complete run lists all
    figures. A run of one part, `only`, lists the figures that it measured (`found`); the end-to-end
    part lists all end-to-end figures, measured or not.
    """
    if only == END_TO_END_PART:
        return name.startswith(END_TO_END)
    return only is None or name in found


def drives_end_to_end(quick: bool) -> Drives:
    """Return one function per simulated world (terrain, sensor errors and seed). Each function
    simulates an end-to-end drive in its world; if `quick`, the drive lasts only a few seconds.
    """
    return {
        world: end_to_end.drive_command(*((4, 3.0) if quick else length), world)
        for world, length in LENGTHS.items()
    }


def all_hold(found: Sequence[Figure]) -> bool:
    """Return True if every figure meets its target; a figure that was not measured misses it."""
    return all(figure.holds for figure in found if figure.bar is not None)


def _is_curve(name: str) -> bool:
    return "reliability" in name or "share_after" in name


def _way_parts(drives: Drives, folder: Path, seeds: range) -> list[tuple[str, Part]]:
    ways = {world: drive for world, drive in drives.items() if world in end_to_end.WAYS}
    parts: list[tuple[str, Part]] = [
        (f"end to end, {world.scenario}", partial(end_to_end.measure, drive, folder, world))
        for world, drive in drives.items()
        if world not in ways
    ]
    rough = [
        (f"end to end, {len(ways)} rough ways", partial(_measure_rough_ways, ways, folder)),
        ("towns with the errors of these ways", partial(_measure_resampled, ways, folder, seeds)),
    ]
    return [*parts, *rough] if ways else parts


def _measure_rough_ways(ways: Drives, folder: Path) -> dict[str, float]:
    found = []
    for world, drive in ways.items():
        drive(folder / world.scenario)
        found.append(moments.ask_moments(folder / world.scenario))
    return moments.moment_figures(found, end_to_end.WHOLE_WAY)


def _measure_resampled(ways: Drives, folder: Path, seeds: range) -> dict[str, float]:
    visits = resampled.join_ways([end_to_end.driven_in(folder / world.scenario) for world in ways])
    return models.measure_real(visits, seeds)


def parts_of(seeds: range, log_line: LogLine) -> dict[str, Part]:
    """Return the parts of the evaluation that need no end-to-end drive, as functions by name; the
    option `--only` accepts these names.
    """
    few = seeds[:EXACT_SEEDS]
    return {
        "exact": lambda: _measure_exact(few),
        "ice": lambda: changes.measure(seeds),
        "fleets": lambda: fleets.measure(seeds, log_line),
        "attacks": lambda: attacks.measure(seeds),
        "models": lambda: models.measure(seeds, log_line),
        "fading": lambda: fading.measure(seeds),
        "third-party": lambda: third_party.measure(seeds, log_line),
        "value": lambda: value.measure(seeds, log_line),
        "situations": lambda: situations.measure(seeds),
    }


def _measure_exact(seeds: range) -> dict[str, float]:
    measures = {
        "fusion.order.max_difference": exact.order_difference,
        "fusion.replay.max_difference": exact.replay_difference,
        "fusion.unexcited.upper_shift": exact.upper_shift,
    }
    return {
        name: max(measure(np.random.default_rng([seed, 3])) for seed in seeds)
        for name, measure in measures.items()
    }
