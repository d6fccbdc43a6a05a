"""Tests of the search by an ant colony. It must follow its equations, stay within its bounds, and
find better results than random search.
"""

from collections.abc import Callable

import numpy as np
import pytest

from edge_agent.lab.tuning import colony, random_search
from edge_agent.lab.tuning.colony import (
    Habits,
    deposit_pheromone,
    lowest_pheromone,
    renew_pheromone,
    transition_probabilities,
)
from edge_agent.lab.tuning.search import Graph, Iteration, Objective, Problem, Result
from schemas.errors import InputError
from schemas.numeric import FloatArray

VERTICES = 8
POSITIONS = 6
ANTS = 12
ITERATIONS = 14
TRIALS = 24
CHOICES = [np.linspace(0.0, 1.0, POSITIONS)] * VERTICES


def bowl(seed: int) -> Objective:
    """Return an objective for the search in which the vertices (tuned parameters) do not interact.
    It is a sum of parabolas, one per vertex, each with its maximum at a random value of this
    vertex. The maximum is 0.
    """
    top = np.random.default_rng(seed).integers(POSITIONS, size=VERTICES) / (POSITIONS - 1)
    return lambda vector: -float(np.sum((vector - top) ** 2))


def decoy(seed: int) -> Objective:
    """Return a deceptive objective for the search. For every vertex (tuned parameter) the slope
    leads away from the best value. The maximum is VERTICES.
    """
    top = np.random.default_rng(seed).integers(POSITIONS, size=VERTICES) / (POSITIONS - 1)

    def value(vector: FloatArray) -> float:
        distance = np.abs(vector - top)
        return float(np.sum(np.where(distance < 1e-9, 1.0, 0.6 * distance)))

    return value


def run(search: object, objective: Objective, seed: int, **options: object) -> Result:
    of_the_problem = {
        name: options.pop(name) for name in ("start", "admissible", "visibility") if name in options
    }
    problem = Problem(objective, CHOICES, **of_the_problem)  # type: ignore[arg-type]
    return search.optimise(  # type: ignore[attr-defined, no-any-return]
        problem, ants=ANTS, iterations=ITERATIONS, rng=np.random.default_rng(seed), **options
    )


@pytest.mark.parametrize("family", [bowl, decoy])
def test_colony_beats_random_search_in_at_least_21_of_24_trials(
    family: Callable[[int], Objective],
) -> None:
    """The ant colony must win at least 21 of 24 trials against random search. Between equally good
    searches this has a probability of 1 in 7 000.
    """
    wins = 0
    for trial in range(TRIALS):
        ours = run(colony, family(trial), 1000 + trial)
        control = run(random_search, family(trial), 2000 + trial)
        assert ours.evaluations <= ANTS * ITERATIONS
        wins += ours.value > control.value
    assert wins >= 21


def test_colony_reaches_the_optimum_where_random_search_does_not() -> None:
    found = {"colony": 0, "random": 0}
    for trial in range(TRIALS):
        for name, search in (("colony", colony), ("random", random_search)):
            result = search.optimise(
                Problem(decoy(trial), CHOICES),
                ants=20,
                iterations=40,
                rng=np.random.default_rng(3000 + trial),
            )
            found[name] += result.value > VERTICES - 1e-9
    assert found["colony"] >= 18
    assert found["random"] == 0


def test_transition_probabilities_sum_to_one_over_valid_positions() -> None:
    reachable = Graph.from_choices([np.arange(3.0), np.arange(5.0), np.arange(1.0)]).reachable
    rng = np.random.default_rng(4)
    pheromone, visibility = rng.random((2, 3, 5)) + 0.01
    odds = transition_probabilities(pheromone, visibility, reachable, alpha=1.3, theta=0.7)
    np.testing.assert_allclose(odds.sum(axis=1), 1.0, atol=1e-15)
    assert np.all(odds[~reachable] == 0.0)
    np.testing.assert_allclose(
        odds[0, 0] / odds[0, 1],
        (pheromone[0, 0] / pheromone[0, 1]) ** 1.3 * (visibility[0, 0] / visibility[0, 1]) ** 0.7,
    )


def test_every_vertex_receives_the_whole_deposit() -> None:
    reachable = np.ones((2, 4), dtype=np.bool_)
    laid = deposit_pheromone(np.array([[0, 3], [0, 1]]), np.array([0.5, 0.25]), reachable)
    np.testing.assert_array_equal(laid, [[0.75, 0, 0, 0], [0, 0.25, 0, 0.5]])


def test_evaporation_takes_its_share_and_the_deposit_is_added() -> None:
    reachable = np.ones((1, 2), dtype=np.bool_)
    renewed = renew_pheromone(
        np.array([[0.8, 0.8]]), np.array([[0.1, 0.0]]), reachable, evaporation=0.25, retrace=0.9
    )
    np.testing.assert_allclose(renewed, [[0.7, 0.6]])


def test_pheromone_stays_in_bounds_when_one_path_always_wins() -> None:
    reachable = Graph.from_choices([np.arange(4.0)] * 3).reachable
    lowest = lowest_pheromone(reachable, 0.3)
    pheromone = np.ones(reachable.shape)
    for _ in range(200):
        laid = deposit_pheromone(np.zeros((1, 3), dtype=np.int64), np.array([0.6]), reachable)
        pheromone = renew_pheromone(pheromone, laid, reachable, evaporation=0.6, retrace=0.3)
    np.testing.assert_allclose(pheromone[:, 0], 1.0)
    np.testing.assert_allclose(pheromone[:, 1:], np.broadcast_to(lowest, (3, 3)))
    odds = transition_probabilities(pheromone, np.ones((3, 4)), reachable, alpha=1.0, theta=1.0)
    assert np.prod(odds[:, 0]) == pytest.approx(0.3)


def test_a_converged_colony_still_finds_new_paths() -> None:
    result = run(colony, bowl(1), 5)
    late = [line.evaluations for line in result.history[-4:]]
    assert np.all(np.diff(late) > 0)


def test_result_depends_only_on_the_seed() -> None:
    first, again, other = (run(colony, decoy(7), seed) for seed in (11, 11, 12))
    np.testing.assert_array_equal(first.best, again.best)
    assert first.history == again.history
    assert first.history != other.history


@pytest.mark.parametrize("search", [colony, random_search])
def test_progress_lists_every_iteration_and_the_best_never_falls(search: object) -> None:
    reported: list[Iteration] = []
    result = run(search, bowl(2), 6, progress=reported.append)
    assert tuple(reported) == result.history
    assert [line.iteration for line in reported] == list(range(1, ITERATIONS + 1))
    assert np.all(np.diff([line.best for line in reported]) >= 0)
    assert all(line.mean <= line.best for line in reported)
    assert result.value == bowl(2)(result.best)


@pytest.mark.parametrize("search", [colony, random_search])
def test_result_is_never_worse_than_the_start_and_vectors_are_unique(
    search: object,
) -> None:
    start = CHOICES[0][np.random.default_rng(3).integers(POSITIONS, size=VERTICES)]
    asked: list[bytes] = []

    def only_the_start_is_good(vector: FloatArray) -> float:
        asked.append(vector.tobytes())
        return float(np.array_equal(vector, start))

    result = run(search, only_the_start_is_good, 8, start=start)
    np.testing.assert_array_equal(result.best, start)
    assert len(asked) == len(set(asked)) == result.evaluations


@pytest.mark.parametrize("search", [colony, random_search])
def test_objective_is_asked_only_for_admissible_vectors(search: object) -> None:
    def rising(vector: FloatArray) -> bool:
        return bool(vector[0] < vector[1])

    asked: list[FloatArray] = []

    def objective(vector: FloatArray) -> float:
        asked.append(vector)
        return -float(vector[1])

    run(search, objective, 9, admissible=rising)
    assert asked
    assert all(rising(vector) for vector in asked)


@pytest.mark.parametrize("search", [colony, random_search])
def test_values_that_are_not_numbers_count_as_worst(search: object) -> None:
    result = run(search, lambda vector: np.nan if vector[0] < 0.5 else float(vector[0]), 10)
    assert result.best[0] == 1.0
    assert np.isfinite(result.history[0].mean)


def test_visibility_draws_the_ants_to_the_positions_it_favours() -> None:
    favour_low = [np.linspace(1.0, 0.01, POSITIONS)] * VERTICES
    asked: dict[str, list[float]] = {"plain": [], "drawn": []}
    for name, visibility in (("plain", None), ("drawn", favour_low)):

        def flat(vector: FloatArray, name: str = name) -> float:
            asked[name].append(float(vector.mean()))
            return 0.0

        run(colony, flat, 13, visibility=visibility)
    assert np.mean(asked["drawn"]) < np.mean(asked["plain"]) - 0.1


@pytest.mark.parametrize(
    "habits",
    [
        Habits(alpha=2.0),
        Habits(evaporation=0.2),
        Habits(elite=0.8),
        Habits(memory=0.9),
        Habits(retrace=0.02),
    ],
)
def test_every_habit_changes_the_way_of_the_colony(habits: Habits) -> None:
    assert run(colony, decoy(3), 14, habits=habits).history != run(colony, decoy(3), 14).history


def test_weight_of_visibility_matters_where_visibility_is_given() -> None:
    favour_low = [np.linspace(1.0, 0.1, POSITIONS)] * VERTICES
    plain, strong = (
        run(colony, decoy(3), 15, visibility=favour_low, habits=Habits(theta=theta))
        for theta in (1.0, 3.0)
    )
    assert plain.history != strong.history


@pytest.mark.parametrize("name", ["evaporation", "elite", "memory", "retrace", "alpha", "theta"])
def test_habits_outside_their_range_are_refused_by_name(name: str) -> None:
    with pytest.raises(InputError, match=name):
        Habits(**{name: -0.1})  # type: ignore[arg-type]


@pytest.mark.parametrize("search", [colony, random_search])
def test_a_vertex_without_positions_and_an_empty_budget_are_refused(search: object) -> None:
    optimise = search.optimise  # type: ignore[attr-defined]
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="choices"):
        optimise(Problem(bowl(0), []), ants=1, iterations=1, rng=rng)
    problem = Problem(bowl(0), CHOICES)
    with pytest.raises(InputError, match="ants"):
        optimise(problem, ants=4, iterations=0, rng=rng)
    with pytest.raises(InputError, match="admissible"):
        run(search, bowl(0), 0, admissible=lambda _vector: False)
