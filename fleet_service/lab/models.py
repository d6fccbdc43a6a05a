"""Evaluation of the map with simulated fleets. Pure (no I/O).

The fleets differ in the measurement errors of their vehicles. Those of the fleet "clean" follow the
assumptions of the fusion (the map's computation). Those of the other fleets in MODELS deviate from
these assumptions. One more fleet has no error model: its vehicles have the errors that the real
estimator made on simulated drives (`measure_real`, `resampled`).

Each fleet first drives on half of the roads, so that the service can compare its vehicles and give
them trust. Then it drives on the other half, which no vehicle visited before, and the map of these
roads is judged. Towns, drives and errors are drawn with random seeds that are used only for
judging, not for tuning.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from fleet_service.lab import resampled, rules, town
from fleet_service.lab.agent import CLEAN, ErrorModel, Errors
from fleet_service.lab.bars import COUNTS
from fleet_service.lab.drive import watch_drive
from fleet_service.lab.resampled import DrivenVisits
from fleet_service.lab.score import (
    Scores,
    by_surface,
    coverage,
    false_grip,
    false_ice,
    join_scores,
    mean_or_nan,
    of_class,
    score_snapshots,
    slippery_scores,
)
from schemas.numeric import FloatArray

VEHICLES: Final = 60
ACQUAINTED: Final = 60  # [min] part of the drive on other roads, in which vehicles gain trust
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
    "same_manoeuvre": CLEAN._replace(usual_share=1.0),
}


def score_town(
    model: ErrorModel, seed: int, ways: DrivenVisits | None = None
) -> tuple[Scores, list[Scores]]:
    """Return the scores of the map, and of the simple rules, in one town drawn by the seed. `model`
    describes the errors of the fleet. If `ways` (visits of simulated drives with the real
    estimator) is given, the vehicles' reports are drawn from these visits instead.
    """
    rng = np.random.default_rng([seed, 11])
    place = town.draw_town(rng, MINUTES, 0.0, model)
    errors = Errors.draw(rng, VEHICLES, model)
    visits = town.drive_fleet(rng, place, errors, MINUTES, ACQUAINTED)
    if ways is not None:
        visits = resampled.resample_visits(rng, visits, ways, VEHICLES)
    watched = watch_drive(rng, visits, MINUTES, AT)
    here = np.arange(town.CELLS) >= town.CELLS // 2
    return (
        score_snapshots(watched.beliefs, place, visits, AT, VEHICLES, here),
        rules.score_rules(visits, place, AT, VEHICLES, here),
    )


def measure(seeds: range, log_line: Callable[[str], None]) -> dict[str, float]:
    """Simulate all fleets of this module in towns with the given seeds, and return the figures of
    the map by name. `log_line` is called with a line about the progress after each fleet.
    """
    out: dict[str, float] = {}
    for name, model in MODELS.items():
        out |= _town_figures(f"fusion.{name}", [score_town(model, seed) for seed in seeds])
        log_line(f"{name}: {len(seeds)} towns")
    return out | {
        "fusion.reliability.ece": max(out[f"fusion.{name}.slippery.ece"] for name in MODELS)
    }


def measure_real(ways: DrivenVisits, seeds: range) -> dict[str, float]:
    """Return the figures of a fleet whose errors are those of the real estimator; `ways` are the
    simulated drives from which its reports are drawn. Return an empty dictionary unless the drives
    contain visits (passages of cells) both with and without enough grip used to measure the
    friction.
    """
    if not ways.excited.any() or ways.excited.all():
        return {}
    return _town_figures("fusion.resampled", [score_town(CLEAN, seed, ways) for seed in seeds])


def _town_figures(prefix: str, towns: Sequence[tuple[Scores, list[Scores]]]) -> dict[str, float]:
    ours, theirs = zip(*towns, strict=True)
    whole = join_scores(list(ours))
    others = [join_scores(list(of)) for of in zip(*theirs, strict=True)]
    out = {
        f"{prefix}.coverage90": coverage(whole),
        f"{prefix}.interval_score": mean_or_nan(whole.interval),
    }
    out |= {f"{prefix}.false_grip": false_grip(whole), f"{prefix}.false_ice": false_ice(whole)}
    out |= {f"{prefix}.slippery.{name}": value for name, value in slippery_scores([whole]).items()}
    out[f"{prefix}.coverage90.spread"] = float(np.std([coverage(s) for s in ours]))
    out |= {f"{prefix}.coverage90.{surface}": share for surface, share in by_surface(whole).items()}
    for n in COUNTS:
        here = of_class(whole, n)
        out[f"{prefix}.coverage90.n{n}"] = coverage(here)
        out[f"{prefix}.rmse.n{n}"] = _root_mean_square(here.error)
        out[f"{prefix}.width.n{n}"] = mean_or_nan(here.width)
        best = min(
            (mean_or_nan(of_class(s, n).interval), label)
            for s, label in zip(others, rules.RULES, strict=True)
        )
        out[f"{prefix}.vs_best_rule.n{n}"] = (
            mean_or_nan(here.interval) / best[0] if here.error.size else float("nan")
        )
    return out


def _root_mean_square(error: FloatArray) -> float:
    return float(np.sqrt(mean_or_nan(error**2)))
