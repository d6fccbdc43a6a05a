"""Benefit of the fuzzy sets and of the ant colony: interval scores on drives of cars with
large sensor errors, as real cars have. The drives were not used for tuning.

Three mechanisms of the default estimator are switched on or off. Fuzzy rules decide how much of the
evidence on friction is used, and adapt the axles' measurement noise R to the innovations
(measurement minus prediction). Strain, the deviation of the estimated vehicle and sensor states
from their prior, also scales this R. The consistency test detects measurements that contradict the
model.

Legend of the filter variants (for all scores, less is better)
    fuzzy        the default estimator with all its rules and the shipped vertices (corners of the
                 fuzzy sets)
    sets_off     the default estimator without fuzzy sets: a fixed formula (`plain_share`) decides
                 the share of the evidence that is used, and the innovations do not change R; strain
                 and consistency test are on
    none         no rules, no strain, no consistency test (`ckf`)
    default      all rules with untuned vertices
    random       all rules with the vertices found by random search, mean over the searches
    colony       all rules with the vertices found by the ant colony, mean over the searches; same
                 budget as the random search

Each seed gives a town and a set of manoeuvres, with its own friction and vehicles. Every second
town and some of the manoeuvres are on cobbles, where wheel speeds and loads swing. A ratio
compares two variants: the mean score of one over all seeds, divided by that of the other. The
figure `.difference` of a ratio is the mean over seeds of the difference of both scores, and
`.difference.se` the standard error of that mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from edge_agent.adaptation.memberships import SETS, Memberships
from edge_agent.adaptation.rule_base import plain_rules
from edge_agent.app.tuned_memberships import search_results, shipped_memberships
from edge_agent.dynamics.parameters import parameter_table
from edge_agent.estimators.estimates import Estimates
from edge_agent.estimators.friction_mixture.bank import mixture_bank
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign, design_of
from edge_agent.lab.evaluation.batch import DriveSet, join_drives
from edge_agent.lab.evaluation.real_world import interval_score, simulate_town
from edge_agent.lab.simulation import PRESETS, DriveSetup, simulate_manoeuvre
from edge_agent.lab.simulation.relief import ROADS
from schemas.numeric import FloatArray
from schemas.runtime.figures import Figure
from schemas.thresholds import SURFACES

ESTIMATOR: Final = "aco-fckf"
CARS = 8
TOWN_S = 60.0
DRIVE_S = 8.0
SEEDS = 15
RATE_HZ: Final = 100.0
# [s] evaluation begins after this time; before, the prior dominates the score
SETTLED_S: Final = 1.0
RATIOS: Final = {
    "fuzzy.worth": ("fuzzy", "sets_off"),
    "fuzzy.worth.all_rules": ("fuzzy", "none"),
    "ants.worth": ("colony", "default"),
    "ants.worth.random": ("colony", "random"),
}
BARS: Final = {"fuzzy.worth": 0.97, "ants.worth": 1.0, "ants.worth.random": 1.0}
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

# by filter variant, then by surface and "all": one number per seed
Scores = dict[str, dict[str, FloatArray]]


def compare_variants(
    seeds: Sequence[int],
    *,
    quick: bool,
    log_line: Callable[[str], None] = lambda _line: None,
) -> Scores:
    """Return the interval scores of friction by filter variant and surface, one number per seed.
    `log_line` is a function that receives each line of text about the progress.
    """
    cars, seconds, count = (2, 5.0, 1) if quick else (CARS, TOWN_S, SEEDS)
    chosen = [seeds[0]] if quick else list(seeds[:count])
    found = compared_designs()
    scores: dict[str, dict[str, list[float]]] = {way: {} for way in found}
    for seed in chosen:
        rides = simulate_town(seed, cars, seconds, cobbles=seed % 2 == 1)[0]
        batches = [rides, simulate_manoeuvres(seed, 2.0 if quick else DRIVE_S)]
        for way, designs in found.items():
            parts = [_score_drives(batches, design) for design in designs]
            for name in parts[0]:
                scores[way].setdefault(name, []).append(
                    float(np.mean([part[name] for part in parts]))
                )
        log_line(
            f"seed {seed}: "
            + ", ".join(f"{way} {each['all'][-1]:.3f}" for way, each in scores.items())
        )
    return {
        way: {name: np.array(values) for name, values in each.items()}
        for way, each in scores.items()
    }


def compared_designs() -> dict[str, list[MixtureDesign]]:
    """Return, by the name of each filter variant, the parameter tables (`MixtureDesign`) of its
    filters. A variant whose vertices (corners of fuzzy sets) come from several searches has one
    filter per search.
    """
    untuned = Memberships()
    found = {
        "fuzzy": [design_of(shipped_memberships(ESTIMATOR), adaptive=True)],
        "sets_off": [without_sets()],
        "none": [design_of(untuned, adaptive=False)],
        "default": [design_of(untuned, adaptive=True)],
    }
    for way, sets in search_results(ESTIMATOR).items():
        found[way] = [design_of(one, adaptive=True) for one in sets]
    return found


def without_sets() -> MixtureDesign:
    """Return the parameter tables of the default filter for the variant without fuzzy sets.

    This variant keeps two mechanisms. The measurement noise R depends on the strain: the distance
    of the estimated vehicle and sensor states from their prior values. The consistency test detects
    measurements that contradict the vehicle model.
    """
    design = design_of(Memberships(), adaptive=True)
    rules = plain_rules(design.constants.chosen.steady_share)
    return design._replace(fuzzy_outputs=np.zeros(SETS), rules=rules)


def simulate_manoeuvres(seed: int, seconds: float) -> DriveSet:
    """Simulate one drive of each manoeuvre, `seconds` [s] long, with misaligned sensors. The seed
    determines vehicle, friction and road.
    """
    rng = np.random.default_rng([seed, 17])
    drives = []
    for k, manoeuvre in enumerate(MANOEUVRES):
        drives.append(
            simulate_manoeuvre(
                manoeuvre,
                mu=float(rng.uniform(0.15, 1.0)),
                seed=1000 * seed + k,
                duration_s=seconds,
                setup=DriveSetup(
                    rate_hz=RATE_HZ,
                    vehicle=list(PRESETS)[int(rng.integers(len(PRESETS)))],
                    sensors="rough",
                    road=list(ROADS)[int(rng.integers(1, len(ROADS)))],
                ),
            )
        )
    return join_drives(drives)


def run_filter(batch: DriveSet, design: MixtureDesign) -> tuple[Estimates, FloatArray]:
    """Run the default filter with the parameter tables `design` on a set of N drives. Return its
    estimates, and the interval scores of friction (K, N) of the K samples from SETTLED_S on.
    """
    bank = mixture_bank(parameter_table(batch.vehicles), design)
    estimates = bank.advance(batch.t, batch.signals)
    score = interval_score(estimates.mu_lower, estimates.mu_upper, batch.mu)
    return estimates, score[batch.t[:, 0] >= SETTLED_S]


def _score_drives(batches: Sequence[DriveSet], design: MixtureDesign) -> dict[str, float]:
    """Run the default filter with the parameter tables `design` on the drives. Return the mean
    interval score of friction over all drives ("all"), and over the samples of each surface (NaN if
    a surface does not occur).
    """
    drives = []
    samples = []
    for batch in batches:
        _, score = run_filter(batch, design)
        drives.append(score.mean(axis=0))
        settled = batch.mu[batch.t[:, 0] >= SETTLED_S]
        samples.append((score.ravel(), settled.ravel()))
    score, mu = (np.concatenate([pair[k] for pair in samples]) for k in range(2))
    found = {"all": float(np.concatenate(drives).mean())}
    for name, (above, most) in SURFACES.items():
        on_surface = (mu > above) & (mu <= most)
        found[name] = float(score[on_surface].mean()) if on_surface.any() else np.nan
    return found


def score_ratio(scores: Scores, name: str) -> float:
    """Return the figure `name`: the mean interval score of one filter variant over all seeds,
    divided by that of another variant. RATIOS states the two variants; the result is NaN if either
    was not measured.
    """
    numerator, denominator = (scores.get(way) for way in RATIOS[name])
    return (
        float(numerator["all"].mean() / denominator["all"].mean())
        if numerator and denominator
        else math.nan
    )


def comparison_figures(scores: Scores) -> list[Figure]:
    """Return those figures (named numbers) of the comparison of filter variants that have no
    target: standard deviations of the ratios, paired differences of the scores, ratios per surface,
    and every interval score.
    """
    listed = []
    for name, (over, under) in RATIOS.items():
        if not {over, under} <= set(scores):
            continue
        ratios = {key: scores[over][key] / scores[under][key] for key in scores[over]}
        difference = scores[over]["all"] - scores[under]["all"]
        listed.append(Figure(f"{name}.difference", float(difference.mean()), "1"))
        if len(difference) > 1:
            error = float(np.std(difference, ddof=1) / math.sqrt(len(difference)))
            listed.append(Figure(f"{name}.difference.se", error, "1"))
            listed.append(Figure(f"{name}.sd", float(np.std(ratios["all"], ddof=1)), "1"))
            listed.append(Figure(f"{name}.wins", float((difference < 0.0).mean()), "1"))
        listed += [
            Figure(f"{name}.{key}", float(np.nanmean(found)), "1")
            for key, found in ratios.items()
            if key != "all" and _has_value(found)
        ]
    for way, found in scores.items():
        listed += [
            Figure(f"worth.{way}.{key}", float(np.nanmean(v)), "1")
            for key, v in found.items()
            if _has_value(v)
        ]
    return listed


def barred_figures(scores: Scores) -> list[Figure]:
    """Return all figures of the comparison of filter variants: first the ratios, which have
    targets, then all others.
    """
    barred = [
        Figure(name, score_ratio(scores, name), "1", bar, "less") for name, bar in BARS.items()
    ]
    plain = [
        Figure(name, score_ratio(scores, name), "1")
        for name in RATIOS
        if name not in BARS and not math.isnan(score_ratio(scores, name))
    ]
    return barred + plain + comparison_figures(scores)


def comparison_table(values: dict[str, float]) -> str:
    """Return a Markdown table of the ratios of interval scores between filter variants. `values`
    are the results of the comparison by name.
    """
    lines = [
        (
            "| figure | compares | ratio | paired difference ± standard error "
            "| share of seeds better |"
        ),
        "|---|---|---|---|---|",
    ]
    for name, (over, under) in RATIOS.items():
        if f"{name}.difference.se" not in values:
            continue
        error = values[f"{name}.difference.se"]
        difference = f"{values[f'{name}.difference']:.4f} ± {error:.4f}"
        cells = (f"`{name}`", f"{over}, {under}", f"{values[name]:.3f}", difference)
        lines.append(f"| {' | '.join(cells)} | {values[f'{name}.wins']:.2f} |")
    return "\n".join(lines)


def _has_value(values: FloatArray) -> bool:
    return bool(np.isfinite(values).any())
