"""Comparison of search methods that may each evaluate the objective equally often, on the filter of
paper 004.

    random       uniform over the graph's possible values       (`random_search`)
    uniform      uniform over the whole range of each variable
    colony       ants over the graph's possible values          (`colony`)
    aco_r        ants over continuous variables                 (`continuous_colony`)
    evolution    (1+1) evolution strategy                       (`evolution_strategy`)

The objective is the mean log-likelihood of the innovations (measurement minus prediction) [nat/s],
over four drives and four conditions of the measurement noise R (right, ten times too small, ten
times too large, or with noise that varies; see `study`). Each seed gives one search by each method,
and one set of held-out drives with its own noise. The results of all searches are scored on the
held-out drives. For comparison, the untuned fuzzy sets and a filter with constant R are scored too.
Differences are paired by seed; the suffix `.se` marks the standard error over seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from edge_agent.adaptation.memberships import SETS, Memberships
from edge_agent.lab.tuning import (
    colony,
    continuous_colony,
    evolution_strategy,
    random_search,
    study,
)
from edge_agent.lab.tuning.continuous_colony import SearchTally
from edge_agent.lab.tuning.objectives import candidate_values
from edge_agent.lab.tuning.search import Problem, Progress, Result
from schemas.numeric import FloatArray
from schemas.runtime.figures import Figure

ANTS: Final = 10
ITERATIONS: Final = 12
POSITIONS: Final = 7  # positions per vertex of the graph
GIVEN: Final = {"fixed": Memberships(outputs=(0.0,) * SETS), "untuned": Memberships()}
PAIRS: Final = (
    ("colony", "untuned"),
    ("colony", "random"),
    ("colony", "aco_r"),
    ("colony", "evolution"),
    ("aco_r", "untuned"),
    ("aco_r", "random"),
    ("untuned", "fixed"),
)


def uniform_search(
    problem: Problem,
    *,
    ants: int,
    iterations: int,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> Result:
    """Search at random: draw ants·iterations vectors of variables uniformly from their whole range,
    evaluate each, and return the best. If the problem has a start vector, it replaces the first
    draw.
    """
    tally = SearchTally(problem)
    for _ in range(iterations):
        found = []
        for _ant in range(ants):
            first = tally.count == 0 and problem.start is not None
            vector = tally.fit(np.asarray(problem.start, float)) if first else tally.uniform(rng)
            found.append(tally.evaluate(vector))
        tally.record(found, progress)
    return tally.result()


SEARCHES: Final[dict[str, Callable[..., Result]]] = {
    "random": random_search.optimise,
    "uniform": uniform_search,
    "colony": colony.optimise,
    "aco_r": continuous_colony.optimise,
    "evolution": evolution_strategy.optimise,
}


def compare_searches(
    seeds: Sequence[int],
    *,
    quick: bool = False,
    log_line: Callable[[str], None] = lambda _line: None,
) -> list[Figure]:
    """Run every search method in SEARCHES once per seed. Score the fuzzy sets that each search
    finds on held-out drives. Return the figures (named numbers): means over the seeds with standard
    errors.
    """
    ants, iterations, duration = (3, 2, 1.0) if quick else (ANTS, ITERATIONS, study.DURATION_S)
    train = study.record_noisy_drives(study.TRAIN, duration)
    searched: dict[str, list[float]] = {}
    judged: dict[str, list[float]] = {}
    for seed in seeds:
        drives = [drive._replace(seed=100 * seed + k) for k, drive in enumerate(study.HELD_OUT)]
        held_out = study.record_noisy_drives(drives, duration)
        for name, sets in GIVEN.items():
            searched.setdefault(name, []).append(study.mean_log_likelihood(sets, train))
            judged.setdefault(name, []).append(study.mean_log_likelihood(sets, held_out))
        for place, (name, search) in enumerate(SEARCHES.items()):
            result = search(
                _problem(train),
                ants=ants,
                iterations=iterations,
                rng=np.random.default_rng([seed, place]),
            )
            searched.setdefault(name, []).append(result.value)
            judged.setdefault(name, []).append(
                study.mean_log_likelihood(study.memberships_of(result.best), held_out)
            )
        log_line(
            f"seed {seed}: "
            + ", ".join(f"{name} {values[-1]:.2f}" for name, values in judged.items())
        )
    return _comparison_figures(searched, judged)


def _problem(train: study.StudySet) -> Problem:
    start = Memberships().to_vector()[: study.VERTICES]
    return Problem(study.objective_on(train), candidate_values(POSITIONS)[: study.VERTICES], start)


def _comparison_figures(
    searched: dict[str, list[float]], judged: dict[str, list[float]]
) -> list[Figure]:
    listed = []
    for name, values in judged.items():
        listed += _mean("searches.train." + name, searched[name])
        listed += _mean("searches.held_out." + name, values)
    for over, under in PAIRS:
        gain = np.array(judged[over]) - np.array(judged[under])
        listed += _mean(f"searches.{over}_over_{under}", list(gain))
        listed.append(Figure(f"searches.{over}_over_{under}.wins", float((gain > 0.0).mean()), "1"))
    return listed


def _mean(name: str, values: Sequence[float]) -> list[Figure]:
    spread: FloatArray = np.asarray(values)
    error = (
        float(np.std(spread, ddof=1) / np.sqrt(len(spread))) if len(spread) > 1 else float("nan")
    )
    return [Figure(name, float(spread.mean()), "nat/s"), Figure(f"{name}.se", error, "nat/s")]


def comparison_markdown(figures: Sequence[Figure]) -> str:
    """Return the report of the comparison of search methods as Markdown, computed only from its
    figures.
    """
    return (
        "# Search methods with equal budgets on the filter of paper 004\n\n"
        "Mean log-likelihood of the innovations [nat/s] ± standard error over seeds; more is "
        f"better.\n\n{comparison_tables(figures)}\n"
    )


def comparison_tables(figures: Sequence[Figure]) -> str:
    """Return the two Markdown tables of the comparison of search methods: means, and differences
    paired by seed.
    """
    values = {figure.name: figure.value for figure in figures}

    def cell(name: str) -> str:
        return f"{values[name]:.2f} ± {values[f'{name}.se']:.2f}"

    lines = [
        "| sets | drives searched on | held out |",
        "|---|---|---|",
    ]
    lines += [
        f"| {name} | {cell(f'searches.train.{name}')} | {cell(f'searches.held_out.{name}')} |"
        for name in (*GIVEN, *SEARCHES)
    ]
    lines += [
        "",
        "| paired difference, held out | mean ± standard error | share of seeds |",
        "|---|---|---|",
    ]
    for over, under in PAIRS:
        name = f"searches.{over}_over_{under}"
        lines.append(f"| {over} over {under} | {cell(name)} | {values[f'{name}.wins']:.2f} |")
    return "\n".join(lines)
