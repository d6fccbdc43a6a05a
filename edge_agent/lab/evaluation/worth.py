"""What fuzzy inference and the ant colony bring: interval scores on rough drives that nobody tuned
on.

Legend, all scores less is better
    fuzzy        the default as it comes, with all of its rules and the shipped vertices
    none         the same filter without any rule, and with untuned noise (`ckf`)
    same_scales  without any rule, with the shipped noise scales
    default      all rules with untuned vertices
    random       what each random search found, mean over the searches; colony: the same of the
                 colony, equal budget

Each seed is a town of rough cars and a set of rough manoeuvres on hills, with friction and vehicles
of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app.tuned_memberships import search_results, shipped
from edge_agent.dynamics.parameters import parameter_table
from edge_agent.estimators.friction_mixture.bank import mixture_bank
from edge_agent.estimators.friction_mixture.design import design_of
from edge_agent.lab.evaluation.batch import DriveSet, joined
from edge_agent.lab.evaluation.real_world import interval_score, town
from edge_agent.lab.simulation import PRESETS, simulate_manoeuvre
from edge_agent.lab.simulation.relief import ROADS
from schemas.numeric import FloatArray
from schemas.runtime.figures import Figure
from schemas.thresholds import SURFACES

ESTIMATOR: Final = "aco-fckf"
CARS = 8
TOWN_S = 60.0
DRIVE_S = 8.0
SEEDS = 5
RATE_HZ: Final = 100.0
SETTLED_S: Final = 1.0  # before, the score is that of the prior
RATIOS: Final = {"fuzzy.worth": ("fuzzy", "none"), "ants.worth": ("colony", "random")}
MANOEUVRES: Final = (
    "double-lane-change",
    "slalom",
    "sine",
    "acceleration",
    "braking",
    "constant-radius",
    "pulses",
    "j-turn",
)

Scores = dict[str, dict[str, FloatArray]]  # by way, then by surface and "all": one number per seed


def campaign(seeds: Sequence[int], *, quick: bool) -> Scores:
    """Interval scores by way, surface and seed."""
    cars, seconds, count = (2, 5.0, 1) if quick else (CARS, TOWN_S, SEEDS)
    chosen = [seeds[0]] if quick else list(seeds[:count])
    found = ways()
    scores: dict[str, dict[str, list[float]]] = {way: {} for way in found}
    for seed in chosen:
        batches = [town(seed, cars, seconds)[0], manoeuvres(seed, 2.0 if quick else DRIVE_S)]
        for way, sets in found.items():
            parts = [
                _scored(batches, memberships, adaptive=adaptive) for memberships, adaptive in sets
            ]
            for name in parts[0]:
                scores[way].setdefault(name, []).append(
                    float(np.mean([part[name] for part in parts]))
                )
    return {
        way: {name: np.array(values) for name, values in each.items()}
        for way, each in scores.items()
    }


def ways() -> dict[str, list[tuple[Memberships, bool]]]:
    """Memberships, and whether rules are applied, by way."""
    searched = {
        way: [(one, True) for one in sets] for way, sets in search_results(ESTIMATOR).items()
    }
    tuned = shipped(ESTIMATOR)
    untuned = Memberships()
    given = {
        "fuzzy": (tuned, True),
        "none": (untuned, False),
        "same_scales": (tuned, False),
        "default": (untuned, True),
    }
    return {way: [one] for way, one in given.items()} | searched


def manoeuvres(seed: int, seconds: float) -> DriveSet:
    """One drive of each manoeuvre with misaligned devices: vehicle, friction and road drawn by
    the seed.
    """
    rng = np.random.default_rng([seed, 17])
    drives = []
    for k, manoeuvre in enumerate(MANOEUVRES):
        drives.append(
            simulate_manoeuvre(
                manoeuvre,
                mu=float(rng.uniform(0.15, 1.0)),
                seed=1000 * seed + k,
                rate_hz=RATE_HZ,
                duration_s=seconds,
                vehicle=list(PRESETS)[int(rng.integers(len(PRESETS)))],
                sensors="rough",
                road=list(ROADS)[int(rng.integers(1, len(ROADS)))],
            )
        )
    return joined(drives)


def _scored(
    batches: Sequence[DriveSet], memberships: Memberships, *, adaptive: bool
) -> dict[str, float]:
    """Mean interval score over the drives, and over all samples of each surface (NaN where none
    is met).
    """
    drives = []
    samples = []
    for batch in batches:
        bank = mixture_bank(
            parameter_table(batch.vehicles), design_of(memberships, adaptive=adaptive)
        )
        estimates = bank.advance(batch.t, batch.signals)
        settled = batch.t[:, 0] >= SETTLED_S
        score = interval_score(estimates.mu_lower, estimates.mu_upper, batch.mu)[settled]
        drives.append(score.mean(axis=0))
        samples.append((score.ravel(), batch.mu[settled].ravel()))
    score, mu = (np.concatenate([pair[k] for pair in samples]) for k in range(2))
    found = {"all": float(np.concatenate(drives).mean())}
    for name, (above, most) in SURFACES.items():
        met = (mu > above) & (mu <= most)
        found[name] = float(score[met].mean()) if met.any() else np.nan
    return found


def ratio(scores: Scores, name: str) -> float:
    """Mean interval score of a way over that of another, over all seeds; NaN where one of them
    was not measured.
    """
    over, under = (scores.get(way) for way in RATIOS[name])
    return float(over["all"].mean() / under["all"].mean()) if over and under else math.nan


def figures(scores: Scores) -> list[Figure]:
    """The spread of each ratio over the seeds, and the ratios per surface; then every score."""
    listed = []
    for name, (over, under) in RATIOS.items():
        if not {over, under} <= set(scores):
            continue
        ratios = {key: scores[over][key] / scores[under][key] for key in scores[over]}
        if len(ratios["all"]) > 1:
            listed.append(Figure(f"{name}.sd", float(np.std(ratios["all"], ddof=1)), "1"))
        listed += [
            Figure(f"{name}.{key}", float(np.nanmean(found)), "1")
            for key, found in ratios.items()
            if key != "all" and _met(found)
        ]
    for way, found in scores.items():
        listed += [
            Figure(f"worth.{way}.{key}", float(np.nanmean(v)), "1")
            for key, v in found.items()
            if _met(v)
        ]
    return listed


def _met(values: FloatArray) -> bool:
    return bool(np.isfinite(values).any())
