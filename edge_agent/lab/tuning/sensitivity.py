"""Sensitivity analysis: how much the default estimator's results change if one of its constants
changes.

Each number of `Constants` and of the shipped memberships (fuzzy sets) is multiplied by .7 and by
1.4, one at a time. The filter then runs on simulated towns, half of them in winter, and on
manoeuvres, with cars that have large sensor errors, as real cars have. Their seeds belong to tuning
and are not used for published results.

Legend of the columns; each states the change compared with the unchanged filter
    score      mean interval score of friction over the drives [%]; less is better
    false ice  share of the samples above a friction of .6 that are called slippery [percentage
               points]
    found      share of the excited samples (a wheel uses much of its grip) on slippery road that
               are called slippery [percentage points]
    time       time of the filter [%]; the changed and the usual filter are measured alternately, so
               that other load on the computer cancels

A number can be merged with another one or deleted if both factors change score, false ice and found
by less than 1 each. Chance alone can change the score by about 1 %: after a small change of one
constant, the filter may notice a slide that it missed before, or miss one.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from edge_agent.adaptation.memberships import LENGTHS, Memberships
from edge_agent.app.tuned_memberships import shipped_memberships
from edge_agent.estimators.friction_mixture.state.constants import Constants
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign, design_of
from edge_agent.lab.evaluation.batch import DriveSet
from edge_agent.lab.evaluation.real_world import SURE_GRIP, simulate_town
from edge_agent.lab.evaluation.worth import ESTIMATOR, run_filter, simulate_manoeuvres
from schemas.errors import InputError
from schemas.numeric import BoolArray
from schemas.thresholds import CALLED_SHARE, EXCITED_SHARE, SLIPPERY_MU

SEEDS: Final = range(8001, 8009)
CARS: Final = 6
TOWN_S: Final = 30.0
DRIVE_S: Final = 6.0
FACTORS: Final = (0.7, 1.4)
# If all changes are smaller than this, the constant has no effect [%, percentage points].
SMALL: Final = 1.0


class ScoredDrives(NamedTuple):
    """Simulated drives, and a mask (T, N) of the samples in which a wheel uses much of its grip."""

    batch: DriveSet
    excited: BoolArray


class FilterMeasures(NamedTuple):
    """Measures of one filter on all drives.

    Attributes:
        score: mean interval score of friction.
        false_ice: share of the samples with high friction that the filter calls slippery.
        found: share of the samples on slippery road, with a wheel that uses much of its grip, that
            the filter calls slippery.
    """

    score: float
    false_ice: float
    found: float


class ConstantChange(NamedTuple):
    """Change of the filter's measures (score, false ice, found, computing time) when the constant
    `name` is multiplied by `factor`.
    """

    name: str
    factor: float
    score: float  # [%]
    false_ice: float  # [percentage points]
    found: float  # [percentage points]
    time: float  # [%]

    @property
    def effect(self) -> float:
        """Return the largest absolute value of the three changes of score, false ice and found. The
        computing time is not included.
        """
        return max(abs(self.score), abs(self.false_ice), abs(self.found))


def simulate_drives(
    seeds: Sequence[int], *, cars: int = CARS, town_s: float = TOWN_S, drive_s: float = DRIVE_S
) -> list[ScoredDrives]:
    """Simulate, for each seed, `cars` cars in one town for `town_s` [s], and one drive of each
    manoeuvre for `drive_s` [s].
    """
    drives = []
    for seed in seeds:
        batch, used = simulate_town(seed, cars, town_s)
        drives.append(ScoredDrives(batch, used >= EXCITED_SHARE))
        other = simulate_manoeuvres(seed, drive_s)
        drives.append(ScoredDrives(other, np.zeros(other.mu.shape, bool)))
    return drives


def measure(design: MixtureDesign, drives: Sequence[ScoredDrives]) -> FilterMeasures:
    """Run the default filter with the parameter tables `design` on all drives, and return its
    measures.

    The measure `found` only counts samples on slippery road in which a wheel uses much of its grip.
    Only drives in the simulated towns record the grip in use. Therefore the simulated manoeuvres do
    not count for `found`.
    """
    scores = []
    false_ice = 0
    high_count = 0
    found = 0
    low_count = 0
    for batch, excited in drives:
        estimates, score = run_filter(batch, design)
        scores.append(score.mean(axis=0))
        called = estimates.p_slippery > CALLED_SHARE
        high = batch.mu > SURE_GRIP
        low = excited & (batch.mu < SLIPPERY_MU)
        false_ice += int((called & high).sum())
        high_count += int(high.sum())
        found += int((called & low).sum())
        low_count += int(low.sum())
    return FilterMeasures(
        float(np.concatenate(scores).mean()),
        false_ice / max(high_count, 1),
        found / max(low_count, 1),
    )


def vary_numbers(memberships: Memberships) -> Iterator[tuple[str, float, MixtureDesign]]:
    """Yield, for each constant and each factor of FACTORS, the constant's name, the factor, and the
    parameter tables of a filter in which the constant is multiplied by the factor. Zeros, and
    values that would make the fuzzy sets invalid, are left out.
    """
    usual = Constants()
    for name, value in usual.by_name().items():
        for factor in FACTORS:
            changed = usual.replace_values(**{name: value * factor})
            yield name, factor, design_of(memberships, adaptive=True, constants=changed)
    for field in LENGTHS:
        values = getattr(memberships, field)
        for place, value in enumerate(values):
            for factor in FACTORS if value else ():
                document = memberships.to_json()
                document[field][place] = value * factor
                try:
                    sets = Memberships.from_json(document)
                except InputError:
                    continue
                yield f"{field}[{place}]", factor, design_of(sets, adaptive=True)


def vary_constants(
    drives: Sequence[ScoredDrives],
    *,
    only: str = "",
    log_line: Callable[[str], None] = lambda _line: None,
) -> list[ConstantChange]:
    """Run the filter with one constant changed at a time, and return the changes of the filter's
    measures. The list begins with the constant of the largest effect. Only constants whose name
    contains `only` are changed.
    """
    memberships = shipped_memberships(ESTIMATOR)
    usual = design_of(memberships, adaptive=True)
    base = measure(usual, drives)
    changes = []
    for name, factor, design in vary_numbers(memberships):
        if only not in name:
            continue
        started = time.perf_counter()
        found = measure(design, drives)
        middle = time.perf_counter()
        measure(usual, drives[:2])
        unit = time.perf_counter() - middle
        changes.append(
            ConstantChange(
                name,
                factor,
                100.0 * (found.score / base.score - 1.0),
                100.0 * (found.false_ice - base.false_ice),
                100.0 * (found.found - base.found),
                (middle - started) / unit,
            )
        )
        log_line(f"{name} x {factor}: score {changes[-1].score:+.2f} %")
    usual_time = float(np.median([change.time for change in changes])) if changes else 1.0
    changes = [change._replace(time=100.0 * (change.time / usual_time - 1.0)) for change in changes]
    return sorted(changes, key=lambda change: -change.effect)


def list_without_effect(changes: Sequence[ConstantChange]) -> list[str]:
    """Return the names of the constants whose effect (largest change of score, false ice or found)
    is below SMALL for all factors.
    """
    largest: dict[str, float] = {}
    for change in changes:
        largest[change.name] = max(change.effect, largest.get(change.name, 0.0))
    return sorted(name for name, effect in largest.items() if effect < SMALL)


def to_markdown(changes: Sequence[ConstantChange]) -> str:
    """Return the results of the sensitivity analysis as Markdown. The table has a row per constant
    and factor: the changes of the filter's measures if the constant is multiplied by the factor.
    The names of the constants without effect follow.
    """
    lines = [
        "| number | factor | score [%] | false ice [pp] | found [pp] | time [%] |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| `{name}` | {factor} | {score:+.2f} | {false_ice:+.3f} | {found:+.2f} | {spent:+.0f} |"
        for name, factor, score, false_ice, found, spent in changes
    ]
    idle = list_without_effect(changes)
    listed = ", ".join(f"`{name}`" for name in idle)
    return "\n".join([*lines, "", f"No effect of 1 or more ({len(idle)}): {listed}", ""])


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the sensitivity analysis, print its table, and write the table and the numbers to the
    folder given by the option `--out`.
    """
    parser = argparse.ArgumentParser(description="Sensitivity of the estimator to its constants")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(".evaluation/sensitivity"),
        help="folder for the table and the figures (default %(default)s)",
    )
    parser.add_argument(
        "--only", default="", help="vary only numbers whose name contains this text"
    )
    options = parser.parse_args(arguments)
    changes = vary_constants(
        simulate_drives(SEEDS), only=options.only, log_line=lambda line: print(line, flush=True)
    )
    options.out.mkdir(parents=True, exist_ok=True)
    table = to_markdown(changes)
    (options.out / "sensitivity.md").write_text(table, encoding="utf-8")
    rows = [change._asdict() for change in changes]
    (options.out / "sensitivity.json").write_text(json.dumps(rows, indent=1), encoding="utf-8")
    print(table)


if __name__ == "__main__":
    main()
