"""The control of the ant colony: uniform draws from the same positions with the same budget."""

from collections.abc import Sequence

import numpy as np

from edge_agent.lab.tuning.search import Admissible, Graph, Ledger, Objective, Progress, Result, everything, nearest
from schemas.numeric import FloatArray, IntArray


def optimise(
    objective: Objective,
    choices: Sequence[FloatArray],
    *,
    ants: int,
    iterations: int,
    rng: np.random.Generator,
    progress: Progress | None = None,
    start: FloatArray | None = None,
    admissible: Admissible = everything,
) -> Result:
    """Best of `ants`·`iterations` uniform draws; arguments and result as those of the colony."""
    graph = Graph.of(choices)
    ledger = Ledger(objective, graph, admissible)
    counts = graph.reachable.sum(axis=1)

    def sample() -> IntArray:
        path: IntArray = rng.integers(counts)
        return path

    for iteration in range(iterations):
        paths = [ledger.draw(sample) for _ in range(ants)]
        if iteration == 0 and start is not None:
            paths[0] = nearest(graph, start)
        ledger.record([ledger.evaluate(path) for path in paths], progress)
    return ledger.result()
