"""Columns of the papers' tables: results for the same manoeuvre under the paper's conditions
("matched"), with the simulator's own vehicle model ("own plant"), and with realistic sensors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, TypeAlias

import numpy as np

from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators import Estimates, EstimatorBank
from edge_agent.lab.evaluation.batch import (
    DriveSet,
    DriveSpec,
    run_estimator,
    simulate_ideal,
    simulate_realistic,
)
from edge_agent.lab.evaluation.measures import common_measures
from edge_agent.lab.evaluation.papers.outcome import Values
from edge_agent.lab.evaluation.scenarios import PAPERS
from schemas.vehicle import Vehicle

DEFAULT: Final = "aco-fckf"
BankMaker: TypeAlias = Callable[[Sequence[Vehicle]], EstimatorBank]


def mean_measures(batch: DriveSet, reported: Estimates) -> Values:
    """Return all measures of an estimator's results by name (errors, coverage and others), averaged
    over the drives.
    """
    return {name: float(np.mean(value)) for name, value in common_measures(batch, reported).items()}


def without_noise(spec: DriveSpec, make: BankMaker) -> tuple[DriveSet, Estimates]:
    """Simulate a drive with error-free sensors, and estimate its motion and friction with the
    estimators that `make` builds for its vehicles. Return the drive and the estimates.
    """
    batch = simulate_ideal(spec)
    return batch, run_estimator(make(batch.vehicles), batch)


def with_sensors(name: str, estimator: str, seeds: Sequence[int]) -> tuple[Values, Values]:
    """Simulate the scenario `name` with ordinary sensors, once per seed. Return two sets of
    measures (such as errors): those of the paper's estimator, called `estimator`, and those of the
    default estimator.
    """
    batch = simulate_realistic(PAPERS[name], seeds)
    found = [
        mean_measures(batch, run_estimator(bank_of(each, batch.vehicles), batch))
        for each in (estimator, DEFAULT)
    ]
    return found[0], found[1]
