"""The two experiments of paper 004, as it did them: noise on a_x, a_y, r only, exact inputs, start at the truth.

They show that the filter is implemented as meant. They show nothing about estimating friction, which is known at the
start: the bars and the printed tables are for v_x, v_y and the yaw rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edge_agent.adaptation.memberships import load_memberships
from edge_agent.estimators import Estimates
from edge_agent.estimators.paper_aco_fckf import AT_THE_TRUTH, bank
from edge_agent.estimators.registry import TUNED
from edge_agent.evaluation.batch import Batch, estimates, ideal, repeated
from edge_agent.evaluation.measures import measures
from edge_agent.evaluation.scenarios import MATCHED, PAPERS, SEDAN
from schemas.numeric import FloatArray
from schemas.signals import S

CONSTANT = 0.05  # variance of all three noises [SI]
SCHEDULE = (0.04, 0.01, 0.05, 0.04, 0.01)  # table 2: each for two seconds
SCHEDULE_S = 2.0


def noisy(batch: Batch, variance: FloatArray, seeds: Sequence[int]) -> Batch:
    """One copy of the drive per seed, with white noise of variance (T,) on a_x, a_y and r."""
    copies = repeated(batch, len(seeds))
    for n, seed in enumerate(seeds):
        white = np.random.default_rng([seed, 4]).normal(size=(len(variance), 3))
        copies.signals[:, n, S.AX : S.AX + 3] += np.sqrt(variance)[:, None] * white
    return copies


def variances(t: FloatArray, experiment: str) -> FloatArray:
    """Noise variance at the times t (T,) [s] of the experiment "constant" or "variable"."""
    if experiment == "constant":
        return np.full(len(t), CONSTANT)
    return np.asarray(np.array(SCHEDULE)[np.minimum((t / SCHEDULE_S).astype(int), len(SCHEDULE) - 1)])


def experiments(
    seeds: Sequence[int],
) -> tuple[dict[str, dict[str, FloatArray]], dict[str, tuple[Batch, Estimates]]]:
    """(measures per drive, drives for plots), both by experiment; "sedan" is "constant" with the simulator's own plant.

    Only a_x, a_y and r are noisy; the names of S are in that order.
    """
    found, drives = {}, {}
    for name, vehicle in (("constant", MATCHED), ("variable", MATCHED), ("sedan", SEDAN)):
        exact = ideal(replace(PAPERS["004.dlc"], vehicle=vehicle))
        batch = noisy(exact, variances(exact.t[:, 0], "variable" if name == "variable" else "constant"), seeds)
        said = estimates(bank(batch.vehicles, load_memberships(TUNED), AT_THE_TRUTH), batch)
        found[name] = measures(batch, said)
        drives[f"004.{name}"] = (batch, said)
    return found, drives
