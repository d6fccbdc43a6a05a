"""The whole campaign: every part with progress, then figures, table and plots."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from fleet_service.lab import attacks, bars, changes, exact, fleets, plots, whole_way
from schemas.runtime import figures
from schemas.runtime.figures import Figure

SEEDS, QUICK_SEEDS = 40, 1
WHOLE_WAY_VEHICLES, WHOLE_WAY_S = 200, 60.0
EXACT_SEEDS: Final = 8  # drives of 20 minutes; nothing random is averaged there, the largest difference counts

Tell = Callable[[str], None]


def run(folder: Path, quick: bool, drive: whole_way.Drive | None, tell: Tell) -> list[Figure]:
    """Run all parts and write `figures.json` and `figures.md` into `folder`.

    Args:
        folder: is made.
        quick: one seed, to see that everything works; says nothing about the bars.
        drive: of the whole way, None to leave it out (its figures are then missing).
        tell: hears progress lines.
    """
    folder.mkdir(parents=True, exist_ok=True)
    seeds = range(QUICK_SEEDS if quick else SEEDS)
    found: dict[str, float] = {}
    for name, part in _parts(seeds, drive, folder, tell):
        began = time.perf_counter()
        found |= part()
        tell(f"{name}: {time.perf_counter() - began:.0f} s")
    judged = bars.judged(found)
    figures.write(folder / "figures.json", "fusion" + (" --quick" if quick else ""), list(seeds), judged)
    barred = [figure for figure in judged if figure.bar is not None]
    shown = [figure for figure in judged if figure.bar is None and not _curve(figure.name)]
    (folder / "figures.md").write_text(f"{figures.markdown(barred)}\n\n{figures.markdown(shown)}\n")
    for path in plots.draw(judged, folder):
        tell(f"plot {path}")
    return judged


def whole_way_of(quick: bool) -> whole_way.Drive:
    """The drive of the whole way, or a few seconds of it."""
    return whole_way.command(4, 3.0) if quick else whole_way.command(WHOLE_WAY_VEHICLES, WHOLE_WAY_S)


def holds(found: Sequence[Figure]) -> bool:
    """Whether every bar holds; a figure that is missing does not."""
    return all(figure.holds for figure in found if figure.bar is not None)


def _curve(name: str) -> bool:
    return "reliability" in name or "share_after" in name


def _parts(
    seeds: range, drive: whole_way.Drive | None, folder: Path, tell: Tell
) -> list[tuple[str, Callable[[], dict[str, float]]]]:  # fmt: skip
    few = range(min(EXACT_SEEDS, len(seeds)))
    parts: list[tuple[str, Callable[[], dict[str, float]]]] = [
        ("order, replay, unexcited", lambda: _exact(few)),
        ("ice comes and goes", lambda: changes.measure(seeds)),
        ("fleets and rules", lambda: fleets.measure(seeds, tell)),
        ("attacks", lambda: attacks.measure(seeds)),
    ]
    if drive is not None:
        parts.append(("the whole way", lambda: whole_way.measure(drive, folder)))
    return parts


def _exact(seeds: range) -> dict[str, float]:
    measures = {
        "fusion.order.max_difference": exact.order, "fusion.replay.max_difference": exact.replay,
        "fusion.unexcited.upper_shift": exact.upper_shift,
    }  # fmt: skip
    return {
        name: max(measure(np.random.default_rng([seed, 3])) for seed in seeds) for name, measure in measures.items()
    }  # fmt: skip
