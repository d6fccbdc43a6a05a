"""The two experiments of paper 004 (constant and variable measurement noise) under the conditions
of the paper: noise only on the accelerations a_x, a_y and the yaw rate r, inputs of the filter
without error, and a start at the true state.

The experiments check that the filter is implemented correctly. They do not test whether it can
estimate friction, because the filter starts with the true friction. Therefore the targets and the
printed tables are for v_x, v_y and the yaw rate. Here the simulated car has Magic Formula tyres,
and the variable noise is on a_x, a_y and r. In `papers.reproduction_004` the car has Dugoff tyres,
as in the paper, and the variable noise is on a_y only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app.tuned_memberships import shipped_memberships
from edge_agent.estimators import TUNED, Estimates
from edge_agent.estimators.paper_aco_fckf import AT_THE_TRUTH, make_bank
from edge_agent.lab.evaluation.batch import DriveSet, repeat_drive, run_estimator, simulate_ideal
from edge_agent.lab.evaluation.measures import common_measures
from edge_agent.lab.evaluation.scenarios import MATCHED, PAPERS, SEDAN
from edge_agent.lab.simulation import PRESETS
from edge_agent.lab.simulation.white import add_white, scheduled_variance
from schemas.numeric import FloatArray

CONSTANT = 0.05  # variance of the noise of each of the three measurements [SI]
EXPERIMENTS = {
    "constant": MATCHED,
    "variable": MATCHED,
    "sedan": SEDAN,
    "sedan.variable": SEDAN,
    "van": PRESETS["van"],
    "van.variable": PRESETS["van"],
}
STILL = Memberships(outputs=(0.0,) * 5)  # fuzzy sets that leave R unchanged


def add_noise(batch: DriveSet, variance: FloatArray, seeds: Sequence[int]) -> DriveSet:
    """Return one copy of the drive per seed, with white noise added to a_x, a_y and yaw rate r.
    `variance` (T,) is the variance of the noise over time [SI units squared].
    """
    copies = repeat_drive(batch, len(seeds))
    for n, seed in enumerate(seeds):
        add_white(copies.signals[:, n], variance, np.random.default_rng([seed, 4]))
    return copies


def noise_variances(t: FloatArray, experiment: str) -> FloatArray:
    """Return the noise variance at the times t (T,) [s] in the experiment "constant" or "variable"
    of paper 004.
    """
    return np.full(len(t), CONSTANT) if experiment == "constant" else scheduled_variance(t)


def run_experiments(
    seeds: Sequence[int],
) -> tuple[dict[tuple[str, str], dict[str, FloatArray]], dict[str, tuple[DriveSet, Estimates]]]:
    """Run the experiments of paper 004. Return the error measures of each drive by (experiment,
    filter), and for plots the drives and estimates of the paper's filter by experiment.

    Each experiment is a double lane change, with noise only on a_x, a_y and the yaw rate. The
    experiments differ in noise and vehicle:

    - "constant", "variable": noise of constant variance, or of a variance that changes over time.
      The vehicle has the equations of the filter's model.
    - "sedan", "van": noise of constant variance, with the simulator's own vehicle of that name.
    - "sedan.variable", "van.variable": the same vehicles with the variable noise.

    Each experiment is run with three filters: the paper's (paper-aco-fckf), the same with untuned
    fuzzy sets (paper-fckf), and the same without adaptation of R (paper-ckf).
    """
    found = {}
    drives = {}
    for name, vehicle in EXPERIMENTS.items():
        exact = simulate_ideal(replace(PAPERS["004.dlc"], vehicle=vehicle))
        batch = add_noise(
            exact,
            noise_variances(exact.t[:, 0], "variable" if name.endswith("variable") else "constant"),
            seeds,
        )
        for estimator, sets in (
            ("paper-ckf", STILL),
            ("paper-fckf", Memberships()),
            ("paper-aco-fckf", shipped_memberships(TUNED["paper-aco-fckf"])),
        ):
            reported = run_estimator(make_bank(batch.vehicles, sets, AT_THE_TRUTH), batch)
            found[name, estimator] = common_measures(batch, reported)
        drives[f"004.{name}"] = (batch, reported)
    return found, drives
