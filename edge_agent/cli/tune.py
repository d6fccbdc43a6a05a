"""`edge-agent tune`: search for the best memberships (fuzzy sets) by ant colony optimisation and by
random search with equal budget; write the best result.

With --study: tune the published filter on which the default estimator is based (paper 004: Xiong et
al., 2019; see deploy/docs/reference/bibliography.md). Run several searches with a correct
measurement noise R, and several with a wrong one; write figures, a table and a plot.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Final

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app.backfill import vehicle_file_of
from edge_agent.app.output_path import prepare_path
from edge_agent.app.tuned_memberships import (
    WAYS,
    Budget,
    Document,
    Provenance,
    Score,
    SplitScores,
    save_tuned,
)
from edge_agent.cli.common import warn_about_faults
from edge_agent.inputs.doctor.findings import diagnose
from edge_agent.inputs.driving_direction import sign_wheels
from edge_agent.inputs.signal_log import read_log
from edge_agent.lab.tuning.objectives import (
    OBJECTIVES,
    TuningScores,
    TuningSet,
    candidate_values,
    detection_cost,
    objective_on,
    record_all,
    scores_of,
)
from edge_agent.lab.tuning.own_logs import own_drives, sample_step
from edge_agent.lab.tuning.search import Iteration, Objective, Problem, Progress, Result
from edge_agent.lab.tuning.study import run_search
from schemas.errors import InputError
from schemas.runtime import figures
from schemas.runtime.installing import install_command
from schemas.vehicle import load_vehicle

ESTIMATOR: Final = "aco-fckf"
ANTS = 12
ITERATIONS = 8
DURATION_S = 30.0
QUICK_ANTS = 3
QUICK_ITERATIONS = 2
QUICK_DURATION_S = 2.0
STUDY_DURATION_S: Final = 6.0
REPEATS = 8  # number of searches of each kind in the study
QUICK_REPEATS = 2
POSITIONS: Final = 7  # values per vertex in the study: the default and three on each side of it


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command-line arguments of `edge-agent tune`."""
    parser.add_argument(
        "log", type=Path, nargs="*", help="your own signal logs instead of simulated drives"
    )
    parser.add_argument(
        "--vehicle",
        type=Path,
        help="vehicle file of the logs (default: LOG.json next to LOG.parquet)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of both searches (default 0)")
    parser.add_argument("--ants", type=int, help=f"paths per iteration (default {ANTS})")
    parser.add_argument(
        "--iterations", type=int, help=f"iterations of each search (default {ITERATIONS})"
    )
    parser.add_argument(
        "--objective",
        choices=tuple(OBJECTIVES),
        help="interval score of friction (needs the truth: simulated drives' default), "
        "log-likelihood of the innovations, or that with a price on wrong calibration (default "
        "with logs: predictive)",
    )
    parser.add_argument(
        "--repeats",
        type=int,
        default=1,
        help="number of searches of each kind (default %(default)s)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(f"{ESTIMATOR}.json"),
        help="file for the fuzzy sets found (default %(default)s)",
    )
    parser.add_argument(
        "--study",
        type=Path,
        metavar="DIR",
        help="run the study of paper 004's filter instead: figures.json, study.md, "
        "convergence.png, paper-aco-fckf.json",
    )
    parser.add_argument(
        "--quick", action="store_true", help="a few ants on short drives, as a smoke test"
    )


def run(args: argparse.Namespace) -> int:
    """Search for the best memberships, print the comparison on held-out drives, and write the best
    ones to a file.

    Raises:
        InputError: an option is out of range.
    """
    ants = args.ants
    if ants is None:
        ants = QUICK_ANTS if args.quick else ANTS
    iterations = args.iterations
    if iterations is None:
        iterations = QUICK_ITERATIONS if args.quick else ITERATIONS
    for name, value, least in (
        ("--ants", ants, 1),
        ("--iterations", iterations, 1),
        ("--seed", args.seed, 0),
        ("--repeats", args.repeats, 1),
    ):
        if value < least:
            raise InputError(name, f"{value} is below {least}", f"use {least} or more")
    if args.study is not None:
        return _run_study(args, ants, iterations)
    return _run_comparison(args, ants, iterations)


def _run_comparison(args: argparse.Namespace, ants: int, iterations: int) -> int:
    """Compare the default fuzzy sets with those that the searches find, and write the best ones;
    return 0.
    """
    duration = QUICK_DURATION_S if args.quick else DURATION_S
    chosen = args.objective or ("predictive" if args.log else "interval")
    prepare_path("out", args.out, [*args.log, *map(_vehicle_file(args), args.log)])
    train, held_out = _tuning_drives(args, chosen, duration)
    print_flushed(
        f"{len(train.vehicles)} drives for the search, {len(held_out.vehicles)} held out, "
        f"{duration:g} s each"
    )
    objective = objective_on(train, ESTIMATOR, chosen)
    # Load the compiled filter now, so that the first iteration takes as long as the others.
    objective(Memberships().to_vector())
    repeats = [
        _run_searches(objective, ants, iterations, args.seed + k) for k in range(args.repeats)
    ]
    results = {way: [repeat[way] for repeat in repeats] for way in WAYS[1:]}
    best = {"default": Memberships()} | {
        way: Memberships.from_vector(max(found, key=lambda result: result.value).best)
        for way, found in results.items()
    }
    scores = {
        way: SplitScores(
            train=_score_memberships(best[way], train),
            held_out=_score_memberships(best[way], held_out),
        )
        for way in WAYS
    }
    print(comparison_table(scores))
    winner = max(WAYS, key=lambda way: _search_worth(scores[way].held_out, chosen))
    budget = Budget(ants=ants, iterations=iterations, evaluations=_count_evaluations(results))
    document = Document(
        estimator=ESTIMATOR,
        memberships=best[winner].to_json(),
        objective=chosen,
        winner=winner,
        scores=scores,
        candidates={
            way: [Memberships.from_vector(result.best).to_json() for result in found]
            for way, found in results.items()
        },
        provenance=_make_provenance(_comparison_command(args, budget, chosen), args.seed, budget),
    )
    save_tuned(args.out, document)
    print(f"wrote {args.out}: the sets found by {winner}")
    return 0


def _comparison_command(args: argparse.Namespace, budget: Budget, objective: str) -> str:
    """Return the command line that repeats the comparison of searches."""
    return " ".join(
        [
            f"edge-agent tune --seed {args.seed} --ants {budget.ants}",
            f"--iterations {budget.iterations} --repeats {args.repeats} --objective {objective}",
            *(["--quick"] if args.quick else []),
            *(log.name for log in args.log),
        ]
    )


def _count_evaluations(results: Mapping[str, Sequence[Result]]) -> dict[str, int]:
    """Return the number of evaluations of the objective by all searches of each kind."""
    return {way: sum(result.evaluations for result in found) for way, found in results.items()}


def _tuning_drives(
    args: argparse.Namespace, objective: str, duration_s: float
) -> tuple[TuningSet, TuningSet]:
    """Return two sets of drives. The search for fuzzy sets uses the first set. The second set is
    held out from the search; the fuzzy sets found by different searches are compared on it.

    The drives are simulated, or parts of the recorded logs that the options name.
    """
    if not args.log:
        return record_all("train", duration_s), record_all("held_out", duration_s)
    if objective == "interval":
        raise InputError(
            "objective",
            "interval needs the true friction, which a log does not contain",
            "use predictive",
        )
    logs = []
    for path in args.log:
        vehicle = load_vehicle(_vehicle_file(args)(path))
        log = read_log(path)
        if not sample_step(log) > 0.0:
            fix = "correct its time (edge-agent check)"
            raise InputError("log", f"{path}: most samples have the same time", fix)
        signed = replace(log, signals=sign_wheels(log.t, log.signals, vehicle))
        logs.append((signed, vehicle))
        for note in warn_about_faults(diagnose(log.t, log.signals, vehicle, log.ground), path):
            print(note, file=sys.stderr)
    return own_drives(logs, duration_s)


def _vehicle_file(args: argparse.Namespace) -> Callable[[Path], Path]:
    """Return the function that gives the path of a log's vehicle file."""
    return vehicle_file_of if args.vehicle is None else lambda _: Path(args.vehicle)


def _search_worth(score: Score, objective: str) -> float:
    """Return the value by which the results of searches are compared; larger is better.

    If the true friction is known, the value is minus the cost of falsely reported and of missed
    ice. Otherwise it is the value of `objective`, the function that the search maximised.
    """
    known = {name: value for name, value in score.model_dump().items() if value is not None}
    unknown = {"interval_score": math.nan, "coverage": math.nan}
    scores = TuningScores(**(unknown | known))
    return (
        -detection_cost(scores)
        if score.interval_score is not None
        else OBJECTIVES[objective](scores)
    )


def _run_study(args: argparse.Namespace, ants: int, iterations: int) -> int:
    """Run the study: compare searches for the fuzzy sets of the filter of paper 004 (Xiong et al.,
    2019), and write the results into a folder; return 0.
    """
    from edge_agent.lab.tuning import study_report

    if importlib.util.find_spec("matplotlib") is None:
        raise InputError("study", "its plot needs matplotlib", install_command("analytics"))
    try:
        args.study.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            "study", f"cannot make {args.study} ({error.strerror})", "name another folder"
        ) from error
    seeds = range(args.seed, args.seed + (QUICK_REPEATS if args.quick else REPEATS))
    done = study_report.run(
        ants=ants,
        iterations=iterations,
        positions=POSITIONS,
        seeds=seeds,
        duration_s=QUICK_DURATION_S if args.quick else STUDY_DURATION_S,
        reporter=lambda way: progress_printer(way, iterations, time.monotonic, print_flushed),
    )
    listed = study_report.study_figures(done)
    title = "edge-agent tune --study" + " --quick" * args.quick
    figures.write_figures(args.study / "figures.json", title, list(seeds), listed)
    text = study_report.results_table(listed)
    (args.study / "study.md").write_text(text, encoding="utf-8")
    study_report.draw_convergence(listed, ants, args.study / "convergence.png")
    names = dict(zip(WAYS, ("untuned", "random", "colony"), strict=True))
    scores = {
        way: SplitScores(**study_report.stored_scores(done, name)) for way, name in names.items()
    }
    command = (
        f"edge-agent tune --seed {args.seed} --ants {ants} --iterations {iterations} --study DIR"
    )
    budget = Budget(ants=ants, iterations=iterations, evaluations=_count_evaluations(done.results))
    document = Document(
        estimator="paper-aco-fckf",
        memberships=done.best("colony").to_json(),
        objective="innovation",
        scores=scores,
        provenance=_make_provenance(command + " --quick" * args.quick, args.seed, budget),
    )
    save_tuned(args.study / "paper-aco-fckf.json", document)
    print_flushed(text)
    return 0


def _run_searches(objective: Objective, ants: int, iterations: int, seed: int) -> dict[str, Result]:
    """Search for the best fuzzy sets twice, by random search and by an ant colony. Both searches
    have the same start vector, candidate values and budget. Return the result of each search by its
    name, "random" or "colony".
    """
    problem = Problem(objective, candidate_values(POSITIONS), Memberships().to_vector())
    return {
        way: run_search(
            way,
            problem,
            ants=ants,
            iterations=iterations,
            seed=seed,
            progress=progress_printer(way, iterations, time.monotonic, print_flushed),
        )
        for way in WAYS[1:]
    }


def print_flushed(line: str) -> None:
    """Print a line and flush it, so that it appears immediately in a pipe too."""
    print(line, flush=True)


def progress_printer(
    way: str, iterations: int, clock: Callable[[], float], write: Callable[[str], None]
) -> Progress:
    """Return a function that prints one line per iteration of a search: best and mean value of the
    objective, elapsed time and expected remaining time.

    `way` is the name of the search in the line, and `clock` returns the time [s].
    """
    began = clock()

    def log_line(line: Iteration) -> None:
        elapsed = clock() - began
        left = elapsed / line.iteration * (iterations - line.iteration)
        write(
            f"{way:<7} {line.iteration:>3}/{iterations}   best {line.best:.4f}   mean "
            f"{line.mean:.4f}   evaluations {line.evaluations:>4}   elapsed {elapsed:4.0f} s   "
            f"left {left:4.0f} s"
        )

    return log_line


def _score_memberships(memberships: Memberships, drives: TuningSet) -> Score:
    found = asdict(scores_of(memberships, drives, ESTIMATOR))
    return Score.model_validate(
        {name: None if math.isnan(value) else value for name, value in found.items()}
    )


def _make_provenance(command: str, seed: int, budget: Budget) -> Provenance:
    header = figures.make_header("tune", [seed])
    return Provenance.model_validate(
        {name: header[name] for name in ("date", "commit", "machine", "versions")}
        | {"command": command, "seed": seed, "budget": budget}
    )


def _format_number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def comparison_table(scores: dict[str, SplitScores]) -> str:
    """Return the scores of the fuzzy sets that each search found as a plain-text table. It has one
    row per search and set of drives.
    """
    lines = [
        (
            f"{'':<8} {'drives':<9} {'interval score':>15} {'coverage':>9} "
            f"{'innovations [nat/s]':>20} {'NIS':>6}"
        )
    ]
    for way, row in scores.items():
        for drives, score in (("train", row.train), ("held out", row.held_out)):
            lines.append(
                f"{way:<8} {drives:<9} {_format_number(score.interval_score, 4):>15} "
                f"{_format_number(score.coverage, 3):>9} {score.log_likelihood:>20.2f} "
                f"{score.nis_ratio:>6.2f}"
            )
    return "\n".join(lines)
