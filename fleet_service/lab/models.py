"""Fleets that err otherwise than the fusion assumes, and the sharpness of one that does not. Pure.

Each fleet gets to know itself on half of the roads and is judged on the other half, which nobody knew: so that the
number of excited vehicles of a cell is what the map had to go by. Towns, ways and errors are drawn by judging seeds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from fleet_service.lab import rules, town
from fleet_service.lab.agent import CLEAN, ErrorModel, Errors
from fleet_service.lab.bars import COUNTS
from fleet_service.lab.drive import watch
from fleet_service.lab.score import Scores, calibration, coverage, joined, of_class, snapshots, worst_bin
from schemas.numeric import FloatArray

VEHICLES: Final = 60
ACQUAINTED: Final = 60  # minutes
MINUTES: Final = 80
AT: Final = (62, 64, 68, 72, 80)

MODELS: Final[dict[str, ErrorModel]] = {
    "clean": CLEAN,
    "heavy_tails": CLEAN._replace(tails=3.0),
    "shared10": CLEAN._replace(common=0.10, by_manoeuvre=0.0),
    "moderate": CLEAN._replace(share=(0.4, 0.7), low=0.6),
    "winter": CLEAN._replace(share=(0.3, 0.8), low=0.5, tyres=-0.05),
    "narrow15": CLEAN._replace(stated=1 / 1.5),
    "narrow30": CLEAN._replace(stated=1 / 3.0),
    "wide15": CLEAN._replace(stated=1.5),
    "half_biased": CLEAN._replace(half=-0.15),
    "same_manoeuvre": CLEAN._replace(alike=1.0),
}


def one(model: ErrorModel, seed: int) -> tuple[Scores, list[Scores]]:
    """Scores of the map, and of the rules, on one town."""
    rng = np.random.default_rng([seed, 11])
    place, errors = town.build(rng, MINUTES, 0.0, model), Errors.draw(rng, VEHICLES, model)
    visits = town.drive(rng, place, errors, MINUTES, ACQUAINTED)
    watched = watch(rng, visits, MINUTES, AT)
    here = np.arange(town.CELLS) >= town.CELLS // 2
    return (
        snapshots(watched.beliefs, place, visits, AT, VEHICLES, here),
        rules.scores(visits, place, AT, VEHICLES, here),
    )


def measure(seeds: range, log_line: Callable[[str], None]) -> dict[str, float]:
    """All fleets; `log_line` hears the progress."""
    out: dict[str, float] = {}
    worst = 0.0
    for name, model in MODELS.items():
        ours, theirs = zip(*(one(model, seed) for seed in seeds), strict=True)
        whole, others = joined(list(ours)), [joined(list(of)) for of in zip(*theirs, strict=True)]
        found = worst_bin(calibration([whole]))
        worst = max(worst, found)
        prefix = f"fusion.{name}"
        out |= {f"{prefix}.coverage90": coverage(whole), f"{prefix}.worst_bin": found}
        out[f"{prefix}.coverage90.spread"] = float(np.std([coverage(s) for s in ours]))
        for n in COUNTS:
            here = of_class(whole, n)
            out[f"{prefix}.coverage90.n{n}"] = coverage(here)
            out[f"{prefix}.rmse.n{n}"] = _root(here.error)
            out[f"{prefix}.width.n{n}"] = _mean(here.width)
            best = min((_mean(of_class(s, n).interval), label) for s, label in zip(others, rules.RULES, strict=True))
            out[f"{prefix}.vs_best_rule.n{n}"] = _mean(here.interval) / best[0] if here.error.size else float("nan")
        log_line(f"{name}: {len(whole.error)} answers")
    return out | {"fusion.reliability.worst_bin": worst}


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _root(error: FloatArray) -> float:
    return float(np.sqrt(_mean(error**2)))
