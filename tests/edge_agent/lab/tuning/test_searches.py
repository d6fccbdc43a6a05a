"""Tests of the tuning searches over continuous parameters, and of the comparison of these searches.
In the comparison each search has the same number of trials.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from edge_agent.lab.tuning import colony, continuous_colony, evolution_strategy, search_comparison
from edge_agent.lab.tuning.continuous_colony import ArchiveHabits
from edge_agent.lab.tuning.search import Problem, Result
from edge_agent.lab.tuning.search_comparison import SEARCHES, compare_searches, comparison_markdown
from schemas.errors import InputError
from schemas.numeric import FloatArray

RANGE = np.array([-1.0, 0.0, 1.0])
PEAK = np.array([0.31, -0.47, 0.83, 0.05])
CONTINUOUS = {"aco_r": continuous_colony.optimise, "evolution": evolution_strategy.optimise}
Search = Callable[..., Result]


def hill(vector: FloatArray) -> float:
    return -float(((vector - PEAK) ** 2).sum())


def run(
    search: Search, *, evaluations: int, seed: int = 1, start: FloatArray | None = None
) -> Result:
    problem = Problem(hill, [RANGE] * 4, start)
    return search(problem, ants=10, iterations=evaluations // 10, rng=np.random.default_rng(seed))


@pytest.mark.parametrize("name", CONTINUOUS)
def test_continuous_search_finds_a_peak_between_positions(name: str) -> None:
    found = run(CONTINUOUS[name], evaluations=600)
    assert np.abs(found.best - PEAK).max() < 0.2
    assert found.value > run(colony.optimise, evaluations=600).value


@pytest.mark.parametrize("name", SEARCHES)
def test_budget_is_kept_and_the_start_is_never_lost(name: str) -> None:
    start = np.array([0.0, 0.0, 1.0, 0.0])
    found = run(SEARCHES[name], evaluations=40, start=start)
    assert found.evaluations <= 40
    assert found.value >= hill(start)
    assert len(found.history) == 4


@pytest.mark.parametrize("name", CONTINUOUS)
def test_same_seed_gives_the_same_vector(name: str) -> None:
    first, again, other = (
        run(CONTINUOUS[name], evaluations=50, seed=seed).best for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize("name", CONTINUOUS)
def test_vectors_stay_in_range_and_admissible(name: str) -> None:
    seen = []

    def objective(vector: FloatArray) -> float:
        seen.append(vector)
        return float(vector.sum())

    problem = Problem(
        objective, [RANGE] * 2, admissible=lambda vector: bool(vector[0] <= vector[1])
    )
    CONTINUOUS[name](problem, ants=5, iterations=10, rng=np.random.default_rng(0))
    vectors = np.array(seen)
    assert np.abs(vectors).max() <= 1.0
    assert (vectors[:, 0] <= vectors[:, 1]).all()


def test_archive_without_spread_is_refused() -> None:
    with pytest.raises(InputError, match="archive"):
        ArchiveHabits(archive=1)
    with pytest.raises(InputError, match="greed"):
        ArchiveHabits(greed=0.0)


def test_colony_reports_its_pheromone_after_each_iteration() -> None:
    laid: list[FloatArray] = []
    habits = colony.Habits(trace=laid.append)
    problem = Problem(hill, [RANGE] * 4)
    colony.optimise(problem, ants=4, iterations=3, rng=np.random.default_rng(0), habits=habits)
    assert len(laid) == 3
    assert laid[0].shape == (4, 3)
    assert not np.array_equal(laid[0], laid[2])


def test_comparison_has_a_mean_and_an_error_of_every_search() -> None:
    figures = compare_searches((20000, 20001), quick=True)
    values = {figure.name: figure.value for figure in figures}
    for name in (*search_comparison.GIVEN, *SEARCHES):
        assert np.isfinite(values[f"searches.held_out.{name}"])
        assert np.isfinite(values[f"searches.held_out.{name}.se"])
    text = comparison_markdown(figures)
    assert "| colony over random |" in text
