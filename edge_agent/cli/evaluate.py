"""`edge-agent evaluate`: run the evaluation, and write figures.json, a Markdown table and plots."""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from schemas.errors import InputError
from schemas.runtime.installing import install_command

if TYPE_CHECKING:
    from schemas.runtime.figures import Figure

LEAST_SEEDS: Final = 20  # a campaign with fewer seeds does not count for the bars (targets)
QUICK_SEEDS: Final = 2
ONLY: Final = ("detection", "searches", "worth", "real")
PAPERS: Final = ("000", "001", "002", "003", "004")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command-line arguments of `edge-agent evaluate`."""
    parser.add_argument(
        "--out", type=Path, required=True, help="folder for figures.json, report.md and the plots"
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="three scenarios, two estimators and two seeds, as a smoke test",
    )
    parser.add_argument(
        "--seeds", type=int, help=f"number of drives per scenario (default {LEAST_SEEDS})"
    )
    parser.add_argument(
        "--only",
        choices=ONLY,
        help="run one other campaign instead: detection: slippery road found, missed and falsely "
        "reported, in short and long drives; "
        "searches: ant colony, ACO_R, (1+1)-ES and random search with equal budgets; "
        "worth: fuzzy sets against none, the colony's vertices against untuned and random ones; "
        "real: recorded drives of real cars in the folder --logs",
    )
    parser.add_argument(
        "--paper",
        choices=PAPERS,
        help="one paper under its own conditions: its figures and tables next to ours, as "
        "index.html and report.md; "
        "ends with 1 if a matched number misses the printed one",
    )
    parser.add_argument(
        "--logs", type=Path, help="folder of LOG.parquet with LOG.json (--only real)"
    )
    parser.add_argument(
        "--plots",
        choices=("png", "svg", "pdf"),
        default="png",
        help="format of the plots (default %(default)s)",
    )
    parser.add_argument(
        "--no-plots", action="store_true", help="figures and table only; needs no matplotlib"
    )


def run(args: argparse.Namespace) -> int:
    """Run the evaluation of the estimators; return 0 if every measured figure meets its target,
    else 1.

    Raises:
        InputError: there are too few seeds, the folder cannot be created, or matplotlib is not
            installed.
    """
    count = args.seeds
    if count is None:
        count = QUICK_SEEDS if args.quick else LEAST_SEEDS
    if count < 2:
        raise InputError("seeds", f"{count} drives have no spread", "give at least 2")
    if args.paper and args.only:
        raise InputError("paper", f"not with --only {args.only}", "leave one of them out")
    if (args.logs is not None) != (args.only == "real"):
        fix = "give --logs DIR, a folder of logs, each next to its vehicle file"
        raise InputError("logs", "is needed by --only real, and only by it", fix)
    draws = args.only in (None, "detection") and not args.no_plots
    if draws and importlib.util.find_spec("matplotlib") is None:
        raise InputError(
            "plots",
            "matplotlib is not installed",
            f"{install_command('analytics')}, or give --no-plots",
        )
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            "out", f"cannot make {args.out} ({error.strerror})", "name another folder"
        ) from error
    if args.paper:
        return _evaluate_paper(args, count)
    if args.only == "real":
        return _evaluate_real_logs(args)
    evaluations = {
        None: _evaluate_estimators,
        "searches": _evaluate_searches,
        "worth": _evaluate_worth,
        "detection": _evaluate_detection,
    }
    return evaluations[args.only](args, count)


def _evaluate_estimators(args: argparse.Namespace, count: int) -> int:
    from edge_agent.lab.evaluation.bars import evaluation_figures as figures_of
    from edge_agent.lab.evaluation.campaign import run_campaign
    from edge_agent.lab.evaluation.report import evaluation_report
    from edge_agent.lab.seeds import FIGURES
    from schemas.runtime.figures import write_figures

    seeds = range(FIGURES, FIGURES + count)
    results = run_campaign(seeds, quick=args.quick, log_line=_timed_printer())
    figures = figures_of(results, quick=args.quick)
    name = "edge-agent evaluate" + (" --quick" if args.quick else "")
    write_figures(args.out / "figures.json", name, list(seeds), figures)
    text = evaluation_report(figures, seeds=count)
    (args.out / "report.md").write_text(text, encoding="utf-8")
    if not args.no_plots:
        from edge_agent.lab.evaluation.plots import draw_plots

        draw_plots(results, figures, args.out, seed=seeds[0], form=args.plots)
    print(text.partition("## The papers' figures")[0].rstrip())
    return 0 if _all_hold(figures) else 1


def _evaluate_paper(args: argparse.Namespace, count: int) -> int:
    from edge_agent.lab.evaluation.papers.page import markdown_tables, summary_sentence
    from edge_agent.lab.evaluation.papers.reproductions import write_paper
    from edge_agent.lab.seeds import FIGURES

    done = write_paper(
        args.paper, range(FIGURES, FIGURES + count), args.out, plots=not args.no_plots
    )
    print(f"{markdown_tables(done.tables)}\n\n{summary_sentence(done)}")
    return 1 if done.missed_rows else 0


def _evaluate_searches(args: argparse.Namespace, count: int) -> int:
    from edge_agent.lab.seeds import FIGURES
    from edge_agent.lab.tuning.search_comparison import compare_searches, comparison_markdown
    from schemas.runtime.figures import write_figures

    seeds = range(FIGURES, FIGURES + count)
    figures = compare_searches(seeds, quick=args.quick, log_line=_print_progress)
    write_figures(
        args.out / "figures.json", "edge-agent evaluate --only searches", list(seeds), figures
    )
    text = comparison_markdown(figures)
    (args.out / "report.md").write_text(text, encoding="utf-8")
    print(text)
    return 0 if _all_hold(figures) else 1


def _evaluate_worth(args: argparse.Namespace, count: int) -> int:
    from edge_agent.lab.evaluation import worth
    from edge_agent.lab.seeds import FIGURES
    from schemas.runtime.figures import format_table, write_figures

    seeds = range(FIGURES, FIGURES + count)
    scores = worth.compare_variants(seeds, quick=args.quick, log_line=_print_progress)
    figures = worth.barred_figures(scores)
    part = " --quick" if args.quick else ""
    measured = list(seeds)[: len(scores["fuzzy"]["all"])]
    write_figures(
        args.out / "figures.json", f"edge-agent evaluate --only worth{part}", measured, figures
    )
    table = worth.comparison_table({figure.name: figure.value for figure in figures})
    text = (
        f"# Benefit of the fuzzy sets and of the ant colony\n\n{table}\n\n{format_table(figures)}\n"
    )
    (args.out / "report.md").write_text(text, encoding="utf-8")
    print(text)
    return 0 if _all_hold(figures) else 1


def _evaluate_real_logs(args: argparse.Namespace) -> int:
    from edge_agent.lab.evaluation.real_logs import judge_folder, results_table, summary_figures
    from schemas.runtime.figures import format_table, write_figures

    found = judge_folder(args.logs, _print_progress)
    figures = summary_figures(found)
    write_figures(args.out / "figures.json", "edge-agent evaluate --only real", [], figures)
    text = f"# Real cars\n\n{results_table(found)}\n\n{format_table(figures)}\n"
    (args.out / "report.md").write_text(text, encoding="utf-8")
    print(text)
    return 0 if _all_hold(figures) else 1


def _evaluate_detection(args: argparse.Namespace, count: int) -> int:
    from edge_agent.lab.evaluation.detection_bars import detection_figures
    from edge_agent.lab.evaluation.detection_campaign import run_detection_campaign
    from edge_agent.lab.evaluation.report import detection_report
    from edge_agent.lab.seeds import FIGURES
    from schemas.runtime.figures import write_figures

    seeds = range(FIGURES, FIGURES + count)
    results = run_detection_campaign(seeds, _timed_printer(), quick=args.quick)
    figures = detection_figures(results)
    part = " --quick" if args.quick else ""
    write_figures(
        args.out / "figures.json",
        f"edge-agent evaluate --only detection{part}",
        list(seeds),
        figures,
    )
    text = detection_report(figures)
    (args.out / "report.md").write_text(text, encoding="utf-8")
    if not args.no_plots:
        from edge_agent.lab.evaluation.plots import draw_detection

        draw_detection(figures, args.out / f"detection.{args.plots}")
    print(text)
    return 0 if _all_hold(figures) else 1


def _all_hold(figures: Sequence[Figure]) -> bool:
    return all(figure.holds for figure in figures if figure.bar is not None)


def _print_progress(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _timed_printer() -> Callable[[str], None]:
    """Return a function that prints a line of progress with the time since now [s]."""
    began = time.monotonic()
    return lambda line: _print_progress(f"{time.monotonic() - began:6.1f} s  {line}")
