"""The evaluation campaign, which runs every scenario with every suitable estimator. The reported
numbers and plots are computed from its results.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators import (
    ESTIMATORS,
    Estimates,
    EstimatorBank,
    adaptive_federated_ckf,
    compensated_wckf,
)
from edge_agent.lab.evaluation import faults, oracle, real_world, worth
from edge_agent.lab.evaluation.batch import (
    DriveSet,
    repeat_drive,
    run_estimator,
    simulate_ideal,
    simulate_realistic,
)
from edge_agent.lab.evaluation.measures import (
    arrival_time,
    common_measures,
    consistency_shares,
    false_changes,
    side_measures,
)
from edge_agent.lab.evaluation.paper_004 import run_experiments
from edge_agent.lab.evaluation.real_world import RealWorldResults
from edge_agent.lab.evaluation.reliability import estimate_with_ranks
from edge_agent.lab.evaluation.scenarios import (
    FOREIGN,
    OTHERS,
    PAPERS,
    VEHICLES,
    with_foreign_tyres,
)
from schemas.numeric import FloatArray

DEFAULT = "aco-fckf"
QUICK_ESTIMATORS = (DEFAULT, "paper-aco-fckf")
# Drives with separate targets, because the friction differs between wheels or wheels exceed the
# slip of the largest force.
HARD = ("split", "abs", "spin")
QUICK_SCENARIOS = ("004.dlc", "003.split", "default.jump.accel")
# Drives per manoeuvre and sensor fault. There are three manoeuvres and thirteen faults, and all
# estimators are evaluated.
FAULTY_SEEDS = 4


@dataclass(frozen=True)
class PlottedDrive:
    """Simulated drives of a scenario and one estimator's estimates of them, stored so that the
    first drive can be plotted.
    """

    batch: DriveSet
    reported: Estimates


@dataclass
class Results:
    """Results of the evaluation campaign. `real` (with ordinary sensors) and `ideal` (with
    error-free sensors) map (scenario, estimator) to measures such as errors, with one value per
    drive.
    """

    real: dict[tuple[str, str], dict[str, FloatArray]] = field(default_factory=dict)
    ideal: dict[tuple[str, str], dict[str, FloatArray]] = field(default_factory=dict)
    # experiments of paper 004, by (experiment, estimator)
    noise: dict[tuple[str, str], dict[str, FloatArray]] = field(default_factory=dict)
    # coverage of the default estimator, by kind of tyre
    foreign: dict[str, FloatArray] = field(default_factory=dict)
    # drives with sensor faults, by (fault, estimator)
    faults: dict[tuple[str, str], dict[str, FloatArray]] = field(default_factory=dict)
    # towns with inaccurate cars ("rough"): by estimator and "baseline"
    world: dict[str, dict[str, float]] = field(default_factory=dict)
    # errors of an oracle (ideal observer), by figure
    oracle: dict[str, FloatArray] = field(default_factory=dict)
    # benefit of fuzzy inference and the ant colony
    worth: worth.Scores = field(default_factory=dict)
    rough: RealWorldResults | None = None  # first town with inaccurate cars, stored for plots
    # ranks of the true friction in the posterior, by estimator
    ranks: dict[str, list[FloatArray]] = field(default_factory=dict)
    seeds: int = 0
    drives: dict[tuple[str, str], PlottedDrive] = field(default_factory=dict)


def run_campaign(seeds: Sequence[int], *, quick: bool, log_line: Callable[[str], None]) -> Results:
    """Run every scenario of the evaluation and return all measures (such as errors). `log_line` is
    a function that receives each line of text about the progress.
    """
    results = Results(seeds=len(seeds))
    names = QUICK_ESTIMATORS if quick else tuple(ESTIMATORS)
    results.noise, plotted = run_experiments(seeds)
    for key, (batch, reported) in plotted.items():
        results.drives[key, "paper-aco-fckf"] = PlottedDrive(batch, reported)
    log_line("both noise experiments of paper 004")
    for name, scenario in (PAPERS | OTHERS | VEHICLES).items():
        if quick and name not in QUICK_SCENARIOS:
            continue
        batch = simulate_realistic(scenario, seeds)
        exact = repeat_drive(simulate_ideal(scenario), 1) if name in PAPERS and not quick else None
        for estimator in names if name in PAPERS else (DEFAULT,):
            reported, ranks = estimate_with_ranks(bank_of(estimator, batch.vehicles), batch)
            shares = consistency_shares(batch, reported)
            results.real[name, estimator] = _all_measures(name, batch, reported) | shares
            results.ranks.setdefault(estimator, []).append(ranks.ravel())
            results.drives[name, estimator] = PlottedDrive(batch, reported)
            if exact is not None:
                results.ideal[name, estimator] = _all_measures(
                    name, exact, run_estimator(_as_in_paper(estimator, exact), exact)
                )
        log_line(f"{name}: {scenario.about or scenario.manoeuvre}, {len(seeds)} drives")
    manoeuvres = tuple(faults.DRIVES)[: 1 if quick else None]
    results.faults = faults.run_fault_campaign(seeds[:FAULTY_SEEDS], names, manoeuvres)
    log_line(f"{len(faults.CASES) - 1} sensor faults")
    results.rough = real_world.run_real_world_campaign(seeds, names, quick=quick)
    results.world = results.rough.measures
    log_line(
        f"rough cars in {1 if quick else real_world.TOWNS} hilly towns, and standing on slopes"
    )
    results.worth = worth.compare_variants(seeds, quick=quick)
    log_line("gain from fuzzy inference and from the ant colony")
    if not quick:
        results.oracle = {
            "002.sine.rmse_vx": oracle.speed_rmse(seeds),
            "003.accel.mu_error": oracle.friction_errors(seeds)[0],
        }
        log_line("an oracle on two manoeuvres of the papers")
        results.foreign = _foreign_tyres(seeds, log_line)
    return results


def _as_in_paper(estimator: str, batch: DriveSet) -> EstimatorBank:
    """Return an estimator bank (one filter per drive) for drives under a paper's own conditions.
    Estimators that need a friction value get the true one at the start of the drives.
    """
    friction = float(batch.mu[0, 0])
    if estimator == "adaptive-federated-ckf":
        return adaptive_federated_ckf.make_bank(batch.vehicles, friction)
    if estimator == "compensated-wckf":
        return compensated_wckf.make_bank(batch.vehicles, friction)
    return bank_of(estimator, batch.vehicles)


def _all_measures(name: str, batch: DriveSet, reported: Estimates) -> dict[str, FloatArray]:
    found = common_measures(batch, reported)
    if "split" in name:
        found |= side_measures(batch, reported)
    if "jump" in name:
        found["arrival_s"] = arrival_time(batch, reported)
    elif not any(word in name for word in HARD):
        found["false_changes"] = false_changes(batch, reported)
        found["hours"] = (batch.t[-1] - batch.t[0]) / 3600.0
    return found


def _foreign_tyres(seeds: Sequence[int], log_line: Callable[[str], None]) -> dict[str, FloatArray]:
    """Return the coverage of the default estimator's friction interval on tyres that differ from
    its tyre model. Coverage is the share of the samples whose interval contains the true friction.

    The key of the result is the kind of tyre. The value is an array with one coverage per simulated
    drive; the drives of all scenarios follow one another.
    """
    found: dict[str, list[float]] = {kind: [] for kind in FOREIGN}
    kinds = list(FOREIGN)
    for scenario in (PAPERS | OTHERS).values():
        for place, kind in enumerate(kinds):
            batch = simulate_realistic(
                with_foreign_tyres(scenario, kind), seeds[place :: len(kinds)] or seeds[:1]
            )
            reported = run_estimator(bank_of(DEFAULT, batch.vehicles), batch)
            found[kind].extend(common_measures(batch, reported)["coverage90"])
    log_line("all scenarios on tyres that the filter does not model")
    return {kind: np.array(values) for kind, values in found.items()}
