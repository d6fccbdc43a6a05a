"""(1+1) evolution strategy with the one-fifth rule (Rechenberg 1973), for comparison with the ant
colonies. The search changes one vector at random and keeps the better one.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from edge_agent.lab.tuning.continuous_colony import REDRAWS, SearchTally
from edge_agent.lab.tuning.search import Problem, Progress, Result
from schemas.numeric import FloatArray

FIRST_STEP: Final = 0.2  # initial standard deviation, as a share of a variable's range
GROWTH: Final = 1.5  # factor on the step after a success; after a failure 1 / GROWTH^(1/4)


def optimise(
    problem: Problem,
    *,
    ants: int,
    iterations: int,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> Result:
    """Search for the vector with the largest objective, and return the best one found.

    The search evaluates ants·iterations vectors one after the other. This method has no ants: the
    arguments `ants` and `iterations` only set the total, and have these names so that all search
    methods can be called in the same way.
    """
    tally = SearchTally(problem)
    begin = tally.uniform(rng) if problem.start is None else np.asarray(problem.start, float)
    parent = tally.fit(begin)
    value = -np.inf
    step = FIRST_STEP
    for _ in range(iterations):
        found = []
        for _one in range(ants):
            child = parent if tally.count == 0 else _mutate_vector(tally, parent, step, rng)
            score = tally.evaluate(child)
            found.append(score)
            success = score >= value
            if success:
                parent = child
                value = score
            step *= GROWTH if success else GROWTH**-0.25
            step = min(step, 1.0)
        tally.record(found, progress)
    return tally.result()


def _mutate_vector(
    tally: SearchTally, parent: FloatArray, step: float, rng: np.random.Generator
) -> FloatArray:
    """Return a random variation of the vector `parent` (V,) that the problem admits; `step` is the
    size of the variation. Return `parent` itself if no admissible variation is found.
    """
    for _ in range(REDRAWS):
        child = tally.fit(rng.normal(parent, step * (tally.upper - tally.lower)))
        if tally.problem.admissible(child):
            return child
    return parent
