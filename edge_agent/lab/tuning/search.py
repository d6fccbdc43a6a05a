"""Parts that all search methods share: the graph of possible values, the record of evaluations, and
the result with its history.

A search looks for the best vector, with one value per vertex (variable). Each vertex has its own
short list of possible values, its positions. A path is an array of V indices that selects one
position per vertex; the selected positions form a vector. The search methods know nothing about
filters: the objective is any function of the vector, and larger is better.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from schemas.errors import InputError
from schemas.numeric import BoolArray, FloatArray, IntArray

Objective = Callable[[FloatArray], float]
Admissible = Callable[[FloatArray], bool]


def is_always_allowed(_vector: FloatArray) -> bool:
    """Return True for any vector of a search. This function is the default of `Problem.admissible`,
    with which no vector is excluded.
    """
    return True


# Number of draws after which an ant accepts a path that was already used. Without this limit, a
# converged colony would never stop drawing.
REDRAWS = 32


@dataclass(frozen=True)
class Iteration:
    """Progress of a search after one iteration: the objective's best value so far and its mean in
    this iteration (larger is better), and the number of evaluations.
    """

    iteration: int
    best: float  # best value so far
    mean: float  # mean of the finite values of this iteration
    evaluations: int  # distinct vectors evaluated so far


Progress = Callable[[Iteration], None]


@dataclass(frozen=True)
class Problem:
    """The objective to maximise, and the vectors to search. A vector (V,) has one number per
    variable ("vertex").

    `objective` returns the value of a vector. `choices` are the possible values ("positions") of
    each vertex, in ascending order. `start` (V,) is the vector that is evaluated first, so that the
    result is never worse than the start vector. `admissible` returns True for vectors that may be
    evaluated; others are replaced by new draws. `visibility` is the preference η > 0 of each
    position, which the ant colony uses; None: all are equally preferred.
    """

    objective: Objective
    choices: Sequence[FloatArray]
    start: FloatArray | None = None
    admissible: Admissible = is_always_allowed
    visibility: Sequence[FloatArray] | None = None


@dataclass(frozen=True)
class Result:
    """Result of a search: the best vector (V,) that was found, the objective's value for it, and
    the values of the objective in each iteration.
    """

    best: FloatArray
    value: float
    history: tuple[Iteration, ...]

    @property
    def evaluations(self) -> int:
        """Return the number of distinct vectors for which the objective was evaluated."""
        return self.history[-1].evaluations


@dataclass(frozen=True)
class Graph:
    """V vertices (variables) with up to K positions (possible values) each, as arrays: `positions`
    (V, K), and `reachable` (V, K), which is True where a position exists.
    """

    positions: FloatArray
    reachable: BoolArray

    @classmethod
    def from_choices(cls, choices: Sequence[FloatArray]) -> "Graph":
        """Return the graph for `choices`, a list with one array per vertex (variable): the vertex's
        positions (possible values).

        Raises:
            InputError: a vertex has no position.
        """
        if not choices or any(len(choice) == 0 for choice in choices):
            raise InputError(
                "choices", "a vertex has no position", "give every vertex at least one"
            )
        widest = max(len(choice) for choice in choices)
        positions = np.full((len(choices), widest), np.nan)
        for row, choice in zip(positions, choices, strict=True):
            row[: len(choice)] = choice
        return cls(positions, np.isfinite(positions))

    def vector(self, path: IntArray) -> FloatArray:
        """Return the vector of values (V,) that a path (V,) selects. A path has one index per
        vertex (variable).
        """
        return self.positions[np.arange(len(path)), path]


@dataclass
class Ledger:
    """Record of a search: all evaluated paths with their objectives, the best path, and the
    iterations. A path is an array of V indices that selects one possible value per variable. The
    record computes the objective of each path only once.
    """

    objective: Objective
    graph: Graph
    admissible: Admissible
    values: dict[bytes, float] = field(default_factory=dict)
    best_path: IntArray | None = None
    best_value: float = -np.inf
    history: list[Iteration] = field(default_factory=list)

    def draw(self, sample: Callable[[], IntArray]) -> IntArray:
        """Draw random paths (V,) with `sample` until one is new (not evaluated before) and its
        vector is admissible, at most REDRAWS times; return this path. If no drawn path is new,
        return a drawn path that was evaluated before.

        Raises:
            InputError: no drawn path is admissible.
        """
        fallback: IntArray | None = None
        for _ in range(REDRAWS):
            path = sample()
            if path.tobytes() in self.values:
                fallback = path
            elif self.admissible(self.graph.vector(path)):
                return path
        if fallback is None:
            raise InputError(
                "choices", f"none of {REDRAWS} drawn vectors is admissible", "narrow the choices"
            )
        return fallback

    def evaluate(self, path: IntArray) -> float:
        """Return the objective of a path (V,), from the record if it was evaluated before. An
        objective that is not finite counts as -infinity, the worst.
        """
        key = path.tobytes()
        if key not in self.values:
            value = float(self.objective(self.graph.vector(path)))
            self.values[key] = value if np.isfinite(value) else -np.inf
            if self.best_path is None or self.values[key] > self.best_value:
                self.best_path = path
                self.best_value = self.values[key]
        return self.values[key]

    def record(self, values: Sequence[float], progress: Progress | None) -> None:
        """Append the objective `values` of an iteration to the record, and report the iteration to
        `progress`.
        """
        finite = [value for value in values if np.isfinite(value)]
        mean = float(np.mean(finite)) if finite else -np.inf
        self.history.append(
            Iteration(len(self.history) + 1, self.best_value, mean, len(self.values))
        )
        if progress is not None:
            progress(self.history[-1])

    def result(self) -> Result:
        """Return the best vector found, its value, and the objective's values over the iterations.

        Raises:
            InputError: nothing was evaluated.
        """
        if self.best_path is None:
            raise InputError(
                "ants, iterations", "nothing was evaluated", "use at least one of each"
            )
        return Result(self.graph.vector(self.best_path), self.best_value, tuple(self.history))


def nearest_path(graph: Graph, vector: FloatArray) -> IntArray:
    """Return the path (V,) nearest to a `vector` (V,): for each vertex (variable), the index of the
    position (possible value) that is nearest to the vector's value.
    """
    distance = np.abs(graph.positions - np.asarray(vector)[:, None])
    indices: IntArray = np.argmin(np.where(graph.reachable, distance, np.inf), axis=1)
    return indices
