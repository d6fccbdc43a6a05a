"""Ant colony optimisation for continuous variables, ACO_R (Socha and Dorigo, European J. of
Operational Research 2008). The functions have no side effects except on the record of the search.

In the module `colony`, each variable has a short list of possible values. However, the corners of
fuzzy sets are continuous quantities. Therefore this colony stores the k best vectors so far (its
archive) in place of pheromone. An ant chooses vector l of the archive with a probability that
decreases with the vector's rank. It then draws each variable from a normal distribution around that
vector.

Legend
    l           rank in the archive, 1 is best
    w_l         weight exp(-(l - 1)^2/(2*q^2*k^2))
    sigma_v     standard deviation of variable v: xi times the mean distance between the archive's
                vectors and the chosen vector
    q, xi       q: the smaller, the more often an ant chooses the best vectors; xi: the larger, the
                longer the vectors stay spread out
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from edge_agent.lab.tuning.search import Iteration, Problem, Progress, Result
from schemas.errors import InputError
from schemas.numeric import FloatArray

# Minimum spread of the draws, as a share of a variable's range. An archive of equal vectors would
# otherwise produce only itself.
LEAST_SPREAD: Final = 1e-3
REDRAWS: Final = 32  # number of attempts to draw an admissible vector


@dataclass(frozen=True)
class ArchiveHabits:
    """Constants of the ant colony for continuous variables: number of best vectors that it stores
    (its archive), preference for the best of them, and width of the random draws.

    Raises:
        InputError: a constant is out of range.
    """

    archive: int = 10  # number of stored vectors, k
    greed: float = 0.3  # preference for the best vectors, q; smaller is greedier
    spread: float = 0.85  # width of the draws, ξ

    def __post_init__(self) -> None:
        if self.archive < 2:
            raise InputError(
                "archive", f"{self.archive} has no spread", "keep at least two vectors"
            )
        for name in ("greed", "spread"):
            if not getattr(self, name) > 0.0:
                raise InputError(name, "not positive", "use a positive number")


class SearchTally:
    """Record of a search over continuous variables: number of evaluations, best vector, and the
    objective's values over the iterations.
    """

    def __init__(self, problem: Problem) -> None:
        """Create the record of a search before the first evaluation.

        Raises:
            InputError: a variable has no choices.
        """
        if not problem.choices or any(len(choice) == 0 for choice in problem.choices):
            raise InputError(
                "choices", "a vertex has no position", "give every vertex at least one"
            )
        self.problem = problem
        self.lower = np.array([float(np.min(choice)) for choice in problem.choices])
        self.upper = np.array([float(np.max(choice)) for choice in problem.choices])
        self.best = self.lower
        self.value = -np.inf
        self.count = 0
        self.history: list[Iteration] = []

    def evaluate(self, vector: FloatArray) -> float:
        """Return the objective's value for a vector (V,), count the evaluation, and store the
        vector if it is the best so far. An objective that is not finite counts as the worst,
        -infinity.
        """
        value = float(self.problem.objective(vector))
        value = value if np.isfinite(value) else -np.inf
        self.count += 1
        if value > self.value or self.count == 1:
            self.best = vector.copy()
            self.value = value
        return value

    def fit(self, vector: FloatArray) -> FloatArray:
        """Return a vector (V,) with each value limited to the range of its variable."""
        return np.asarray(np.clip(vector, self.lower, self.upper))

    def uniform(self, rng: np.random.Generator) -> FloatArray:
        """Return a random vector (V,) that is admissible for the problem, drawn uniformly over the
        whole range of every variable.

        Raises:
            InputError: no vector out of REDRAWS draws is admissible.
        """
        for _ in range(REDRAWS):
            vector = np.asarray(rng.uniform(self.lower, self.upper))
            if self.problem.admissible(vector):
                return vector
        raise InputError(
            "choices", f"none of {REDRAWS} drawn vectors is admissible", "narrow the choices"
        )

    def record(self, values: list[float], progress: Progress | None) -> None:
        """Append the objective `values` of an iteration to the record, and report the iteration to
        `progress`.
        """
        finite = [value for value in values if np.isfinite(value)]
        mean = float(np.mean(finite)) if finite else -np.inf
        self.history.append(Iteration(len(self.history) + 1, self.value, mean, self.count))
        if progress is not None:
            progress(self.history[-1])

    def result(self) -> Result:
        """Return the best vector, its value, and the objective's values over the iterations.

        Raises:
            InputError: nothing was evaluated.
        """
        if self.count == 0:
            raise InputError(
                "ants, iterations", "nothing was evaluated", "use at least one of each"
            )
        return Result(self.best, self.value, tuple(self.history))


def optimise(
    problem: Problem,
    *,
    ants: int,
    iterations: int,
    rng: np.random.Generator,
    progress: Progress | None = None,
    habits: ArchiveHabits | None = None,
) -> Result:
    """Search for the vector with the largest objective, with ants·iterations evaluations.

    The search first fills the archive (the stored best vectors) with the start vector and with
    random vectors from the whole range. The range of a variable extends from its smallest to its
    largest possible value in `problem.choices`.
    """
    habits = habits or ArchiveHabits()
    tally = SearchTally(problem)
    vectors: list[FloatArray] = []
    values: list[float] = []
    for _ in range(iterations):
        found = []
        for _ant in range(ants):
            vector = _next_vector(tally, vectors, values, rng, habits)
            value = tally.evaluate(vector)
            found.append(value)
            vectors.append(vector)
            values.append(value)
            if len(values) > habits.archive:
                keep = np.argsort(-np.array(values), kind="stable")[: habits.archive]
                vectors = [vectors[k] for k in keep]
                values = [values[k] for k in keep]
        tally.record(found, progress)
    return tally.result()


def _next_vector(
    tally: SearchTally,
    vectors: list[FloatArray],
    values: list[float],
    rng: np.random.Generator,
    habits: ArchiveHabits,
) -> FloatArray:
    """Return the next vector (V,) to evaluate. `vectors` and `values` are the archive: the best
    vectors so far, and their objectives. First comes the start vector, then random vectors until
    the archive is full. After that, vectors are drawn near a vector of the archive.
    """
    if tally.count == 0 and tally.problem.start is not None:
        return tally.fit(np.asarray(tally.problem.start, float))
    if len(vectors) < habits.archive:
        return tally.uniform(rng)
    order = np.argsort(-np.array(values), kind="stable")
    ranked = np.array([vectors[k] for k in order])
    scale = habits.greed * habits.archive
    weight = np.exp(-0.5 * (np.arange(len(ranked)) / scale) ** 2)
    chosen = int(rng.choice(len(ranked), p=weight / weight.sum()))
    mean_distance = np.abs(ranked - ranked[chosen]).sum(axis=0) / (len(ranked) - 1)
    sigma = np.maximum(habits.spread * mean_distance, LEAST_SPREAD * (tally.upper - tally.lower))
    for _ in range(REDRAWS):
        vector = tally.fit(rng.normal(ranked[chosen], sigma))
        if tally.problem.admissible(vector):
            return vector
    return np.asarray(ranked[chosen], float)
