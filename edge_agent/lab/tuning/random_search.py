"""Random search, for comparison with the ant colony: uniform draws from the same possible values
with the same number of evaluations.
"""

import numpy as np

from edge_agent.lab.tuning.search import Graph, Ledger, Problem, Progress, Result, nearest_path
from schemas.numeric import IntArray


def optimise(
    problem: Problem,
    *,
    ants: int,
    iterations: int,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> Result:
    """Return the best of `ants`·`iterations` vectors whose values are drawn uniformly from the
    possible values of each variable. `progress` is called after each iteration.
    """
    graph = Graph.from_choices(problem.choices)
    ledger = Ledger(problem.objective, graph, problem.admissible)
    counts = graph.reachable.sum(axis=1)

    def sample() -> IntArray:
        path: IntArray = rng.integers(counts)
        return path

    for iteration in range(iterations):
        paths = [ledger.draw(sample) for _ in range(ants)]
        if iteration == 0 and problem.start is not None:
            paths[0] = nearest_path(graph, problem.start)
        ledger.record([ledger.evaluate(path) for path in paths], progress)
    return ledger.result()
