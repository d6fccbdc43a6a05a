"""Simulated fleets with and without misbehaving vehicles: coverage, error and alerts of the map,
compared with the simple rules of the module `rules`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from fleet_service.lab import rules, town
from fleet_service.lab.agent import Errors
from fleet_service.lab.drive import watch_drive
from fleet_service.lab.score import (
    LEVELS,
    Scores,
    coverage,
    earlier_visits,
    excited_vehicles,
    join_scores,
    reliability,
    rmse,
    safe_share,
    score_snapshots,
)
from schemas.numeric import BoolArray

VEHICLES: Final = 60
CHANGING: Final = 0.1  # share of roads whose surface changes during the drive
# true friction from which a road counts as dry, and up to which as ice
DRY = 0.7
ICY = 0.25
# Smallest number of excited vehicles of an evaluated cell and minute, and of earlier visits of a
# vehicle.
ENOUGH = 5
EARLIER = 20


class Fleet(NamedTuple):
    """Simulation of a fleet for `minutes` [min], in which the share `share` of the vehicles always
    reports the friction `claim`.

    The service judges vehicles by their earlier reports, so the results depend on the time at which
    the evaluation begins:

    - Coverage and error of the map are measured from minute `begin` on. Every vehicle then has
      about 200 visits (passages of cells), as many as a car makes in a day.
    - The rates of false and missed ice alerts are measured as soon as each vehicle has made EARLIER
      visits, about two minutes after the start.
    - The same rates are measured again from minute `begin` on. The names of these figures contain
      `_settled`.
    """

    name: str
    share: float
    claim: float
    begin: int
    minutes: int


FLEETS: Final = (
    Fleet("clean", 0.0, 0.0, 0, 40),
    Fleet("mis05", 0.05, 0.25, 18, 40),
    Fleet("mis15", 0.15, 0.25, 18, 40),
    Fleet("mis15_dry", 0.15, 0.85, 18, 40),
    Fleet("mis30_colluding", 0.30, 0.25, 18, 40),
)
AT: Final = (5, 10, 20, 30, 40)


@dataclass
class Found:
    """Results of one fleet over all seeds.

    Attributes:
        ours: scores of GripMap's map.
        theirs: scores of each of the simple rules.
        false_ice, missed_ice: masks of false and of missed alerts.
        false_settled, missed_settled: the same, but only after minute `begin` of the fleet, when
            the service has many earlier reports of each vehicle.
    """

    ours: list[Scores] = field(default_factory=list)
    theirs: list[list[Scores]] = field(default_factory=lambda: [[] for _ in rules.RULES])
    false_ice: list[BoolArray] = field(default_factory=list)
    missed_ice: list[BoolArray] = field(default_factory=list)
    false_settled: list[BoolArray] = field(default_factory=list)
    missed_settled: list[BoolArray] = field(default_factory=list)


def drive_seed(fleet: Fleet, seed: int, found: Found) -> None:
    """Simulate the drive of a fleet with one seed, and add the scores and alerts to `found`."""
    rng = np.random.default_rng([seed, 1])
    place = town.draw_town(rng, fleet.minutes, CHANGING)
    errors = Errors.draw(rng, VEHICLES)
    visits = town.drive_fleet(rng, place, errors, fleet.minutes)
    if fleet.share:
        visits = town.claim_falsely(
            visits, np.arange(VEHICLES) < round(fleet.share * VEHICLES), fleet.claim
        )
    watched = watch_drive(rng, visits, fleet.minutes)
    at = tuple(minute for minute in AT if minute > fleet.begin)
    found.ours.append(score_snapshots(watched.beliefs, place, visits, at, VEHICLES))
    for scores, theirs in zip(
        rules.score_rules(visits, place, at, VEHICLES), found.theirs, strict=True
    ):
        theirs.append(scores)
    for minute in range(1, fleet.minutes + 1):
        if earlier_visits(visits, 60.0 * minute, VEHICLES).min() < EARLIER:
            continue
        counted = excited_vehicles(visits, place, minute, VEHICLES) >= ENOUGH
        mu = place.mu[minute]
        alerted = watched.alerted[minute - 1]
        dry = alerted[counted & (mu > DRY)]
        icy = ~alerted[counted & (mu < ICY)]
        found.false_ice.append(dry)
        found.missed_ice.append(icy)
        if minute > fleet.begin:
            found.false_settled.append(dry)
            found.missed_settled.append(icy)


def measure(seeds: range, log_line: Callable[[str], None]) -> dict[str, float]:
    """Simulate all fleets with and without misbehaving vehicles, and return the figures of the map
    by name. `log_line` is called with a line about the progress after each fleet.
    """
    out: dict[str, float] = {}
    for fleet in FLEETS:
        found = Found()
        for seed in seeds:
            drive_seed(fleet, seed, found)
        log_line(f"{fleet.name}: {len(join_scores(found.ours).error)} answers")
        out |= _fleet_figures(fleet, found)
    return out


def _fleet_figures(fleet: Fleet, found: Found) -> dict[str, float]:
    ours = join_scores(found.ours)
    out = {}
    name = f"fusion.{fleet.name}"
    out[f"{name}.rmse"] = rmse(ours)
    out[f"{name}.coverage90"] = coverage(ours)
    out[f"{name}.safe95"] = safe_share(ours)
    out[f"{name}.interval_score"] = float(ours.interval.mean())
    out[f"fusion.false_ice.{fleet.name}"] = _share_of_minutes(found.false_ice)
    out[f"fusion.missed_ice.{fleet.name}"] = _share_of_minutes(found.missed_ice)
    out[f"fusion.false_ice_settled.{fleet.name}"] = _share_of_minutes(found.false_settled)
    out[f"fusion.missed_ice_settled.{fleet.name}"] = _share_of_minutes(found.missed_settled)
    best = np.inf
    for rule, scores in zip(rules.RULES, map(join_scores, found.theirs), strict=True):
        label = f"rule.{fleet.name}.{rule.replace(' ', '_')}"
        out |= {f"{label}.rmse": rmse(scores), f"{label}.coverage90": coverage(scores)}
        out[f"{label}.interval_score"] = float(scores.interval.mean())
        best = min(best, float(scores.interval.mean()))
    out[f"{name}.vs_best_rule"] = float(ours.interval.mean()) / best
    if fleet.name == FLEETS[0].name:
        out |= _reliability_curve(ours)
    if fleet.name == "mis15_dry":
        out["fusion.missed_ice.mis15"] = out[f"fusion.missed_ice.{fleet.name}"]
    return out


def _reliability_curve(ours: Scores) -> dict[str, float]:
    """Return the points of the map's reliability diagram: for each quantile level, the share of
    true frictions that lie below this quantile of the map's belief.
    """
    return {
        f"fusion.clean.reliability.{level:.2f}": float(share)
        for level, share in zip(LEVELS, reliability(ours), strict=True)
    }


def _share_of_minutes(minutes: list[BoolArray]) -> float:
    return float(np.concatenate(minutes).mean()) if sum(map(len, minutes)) else float("nan")
