"""Report of the tuning study as figures (named numbers), a table, a plot and a file of tuned
memberships (parameters of the fuzzy sets). Each kind of search runs several times, and all results
are scored on held-out drives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from edge_agent.adaptation.memberships import SETS, Memberships
from edge_agent.app.tuned_memberships import Score
from edge_agent.lab.tuning import study
from edge_agent.lab.tuning.search import Progress, Result
from edge_agent.lab.tuning.study import (
    CONDITIONS,
    WAYS,
    StudyScores,
    StudySet,
    mean_log_likelihood,
    memberships_of,
    scores_of,
)
from schemas.runtime.figures import Figure

UNITS: Final = {
    "log_likelihood": "nat/s",
    "nis": "1",
    "rmse_vx": "m/s",
    "rmse_vy": "m/s",
    "rmse_yaw_rate": "rad/s",
}
TITLES: Final = {
    "right": "R right",
    "too-small": "ten times too small",
    "too-large": "ten times too large",
    "schedule": "noise by schedule",
}


# Memberships without tuning: fixed sets, which leave R unchanged, and the default sets.
GIVEN: Final = {
    "fixed": Memberships(outputs=(0.0,) * SETS),
    "untuned": Memberships(),
}
SHOWN: Final = (*GIVEN, *WAYS)


@dataclass
class Study:
    """Results of all searches of each kind (ant colony, random search), and the drives used for
    search and scoring.
    """

    train: StudySet
    held_out: StudySet
    results: dict[str, list[Result]] = field(default_factory=dict)

    def memberships(self, way: str) -> list[Memberships]:
        """Return the memberships found by each search of the kind `way`.

        `way` may also be a name in GIVEN, the table of fuzzy sets that need no search. The list
        then contains only the sets with this name.
        """
        if way in GIVEN:
            return [GIVEN[way]]
        return [memberships_of(result.best) for result in self.results[way]]

    def best(self, way: str) -> Memberships:
        """Return the best memberships found by the searches of the kind `way`, judged by the
        objective on the drives of the search.

        `way` may also be a name in GIVEN, the table of fuzzy sets that need no search. The result
        is then the sets with this name.
        """
        if way in GIVEN:
            return GIVEN[way]
        return memberships_of(max(self.results[way], key=lambda result: result.value).best)


def run(
    *,
    ants: int,
    iterations: int,
    positions: int,
    seeds: Sequence[int],
    duration_s: float,
    reporter: Callable[[str], Progress],
) -> Study:
    """Run every kind of search with every seed, and return the study with all results. `reporter`
    receives the name of a search and returns the function to which this search reports its
    progress.
    """
    done = Study(
        study.record_noisy_drives(study.TRAIN, duration_s),
        study.record_noisy_drives(study.HELD_OUT, duration_s),
    )
    problem = study.problem_on(done.train, positions)
    for seed in seeds:
        for way in WAYS:
            result = study.run_search(
                way,
                problem,
                ants=ants,
                iterations=iterations,
                seed=seed,
                progress=reporter(f"{way} {seed}"),
            )
            done.results.setdefault(way, []).append(result)
    return done


def study_figures(done: Study) -> list[Figure]:
    """Return the figures of the study for each kind of search. These are the scores on held-out
    drives under each condition of the study (right or wrong measurement noise R), the objective on
    search and held-out drives, and the progress of the searches.
    """
    listed = []
    overalls: dict[str, list[float]] = {}
    for way in SHOWN:
        sets = done.memberships(way)
        for name in CONDITIONS:
            listed += _spread(
                f"tuning.{name}.{way}", [scores_of(one, done.held_out, name) for one in sets]
            )
        for drives, recorded in (("train", done.train), ("held_out", done.held_out)):
            values = [mean_log_likelihood(one, recorded) for one in sets]
            listed += _mean_sd(f"tuning.overall.{way}.{drives}", values, "nat/s")
            overalls[f"{way}.{drives}"] = values
    for drives in ("train", "held_out"):
        gain = np.array(overalls[f"colony.{drives}"]) - np.array(overalls[f"random.{drives}"])
        listed += _mean_sd(f"tuning.colony_over_random.{drives}", list(gain), "nat/s")
        listed.append(
            Figure(f"tuning.colony_over_random.{drives}.wins", float((gain > 0.0).mean()), "1")
        )
    for way, results in done.results.items():
        for lines in zip(*(result.history for result in results), strict=True):
            best = [line.best for line in lines]
            listed += _mean_sd(f"tuning.convergence.{way}.{lines[0].iteration:03d}", best, "nat/s")
    return listed


def _spread(prefix: str, per_condition: Sequence[StudyScores]) -> list[Figure]:
    listed = []
    for name, unit in UNITS.items():
        values = [getattr(scores, name) for scores in per_condition]
        listed += _mean_sd(f"{prefix}.{name}", values, unit)
    return listed


def _mean_sd(name: str, values: Sequence[float], unit: str) -> list[Figure]:
    listed = [Figure(name, float(np.mean(values)), unit)]
    if len(values) > 1:
        listed.append(Figure(f"{name}.sd", float(np.std(values, ddof=1)), unit))
    return listed


def results_table(listed: Sequence[Figure]) -> str:
    """Return a Markdown table of the study's results `listed`, with a row per condition and measure
    and a column per kind of search.
    """
    values = {figure.name: figure.value for figure in listed}

    def cell(name: str) -> str:
        sd = values.get(f"{name}.sd")
        return f"{values[name]:.3g}" + ("" if sd is None else f" ± {sd:.2g}")

    rows = ["| held out | | " + " | ".join(SHOWN) + " |", "|---" * (len(SHOWN) + 2) + "|"]
    for name, title in TITLES.items():
        for measure, unit in UNITS.items():
            cells = " | ".join(cell(f"tuning.{name}.{way}.{measure}") for way in SHOWN)
            rows.append(f"| {title} | {measure.replace('_', ' ')} [{unit}] | {cells} |")
    for drives, title in (("held_out", "all conditions"), ("train", "all, drives searched on")):
        cells = " | ".join(cell(f"tuning.overall.{way}.{drives}") for way in SHOWN)
        rows.append(f"| {title} | log likelihood [nat/s] | {cells} |")
    gain = "tuning.colony_over_random.held_out"
    summary = (
        f"Colony over random search of the same seed and budget, held out: {cell(gain)} nat/s, "
        f"better in {100 * values[f'{gain}.wins']:.0f} % of the searches."
    )
    return "\n".join(rows) + f"\n\n{summary}\n"


def stored_scores(done: Study, way: str) -> dict[str, Score]:
    """Return the scores that are stored in the file of tuned memberships: one `Score` for the
    drives of the search ("train"), and one for the held-out drives ("held_out").

    The scores belong to the best memberships found by the kind of search `way`. Each score is the
    mean over all conditions of the study (CONDITIONS), for example a measurement noise R that is
    ten times too small.
    """
    found = {}
    for drives, recorded in (("train", done.train), ("held_out", done.held_out)):
        intervals = [study.score_interval(done.best(way), recorded, name) for name in CONDITIONS]
        per_condition = [scores_of(done.best(way), recorded, name) for name in CONDITIONS]
        found[drives] = Score(
            interval_score=float(np.mean([score for score, _ in intervals])),
            coverage=float(np.mean([coverage for _, coverage in intervals])),
            log_likelihood=float(np.mean([one.log_likelihood for one in per_condition])),
            nis_ratio=float(np.mean([one.nis for one in per_condition])),
        )
    return found


def draw_convergence(listed: Sequence[Figure], per_iteration: int, path: Path) -> None:
    """Plot, for each kind of search, the best objective found so far as a function of the number of
    evaluations: mean and one standard deviation over the searches. The plot is written to `path`.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    values = {figure.name: figure.value for figure in listed}
    drawn, axis = plt.subplots(figsize=(7, 4), layout="constrained")
    for way in WAYS:
        prefix = f"tuning.convergence.{way}."
        names = [name for name in values if name.startswith(prefix) and not name.endswith(".sd")]
        evaluations = per_iteration * np.arange(1, len(names) + 1)
        best = np.array([values.get(name, 0.0) for name in names])
        sd = np.array([values.get(name + ".sd", 0.0) for name in names])
        line = axis.plot(evaluations, best, "o-", ms=3, label=way)[0]
        axis.fill_between(
            evaluations, best - sd, best + sd, color=line.get_color(), alpha=0.2, lw=0
        )
    axis.axhline(values["tuning.overall.untuned.train"], color="k", ls=":", label="untuned")
    axis.set(
        xlabel="evaluations",
        ylabel="log likelihood of the innovations [nat/s]",
        title="drives searched on",
    )
    axis.legend()
    drawn.savefig(path, dpi=80)
    plt.close(drawn)
