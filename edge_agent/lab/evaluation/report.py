"""Markdown report of the evaluation, generated only from its figures (named numbers)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from edge_agent.lab.evaluation.faults import CASES
from edge_agent.lab.evaluation.printed import DEFAULT, PRINTED, WHY_NOT, compared_names
from edge_agent.lab.evaluation.reliability import LEVELS
from schemas.runtime.figures import Figure, format_table

PAPERS_HEAD: Final = """\
## The papers' figures

Columns. Printed: the number in the paper. Ours: the paper's estimator with error-free sensors; 004
with the paper's noise on a matched plant, the others on the simulator's own plant. Realistic: the
same estimator with ordinary sensors, vehicle parameters known to a few per cent, and μ unknown at
the start. Default, realistic: the default estimator on the same drives. Values are mean ± standard
deviation over seeds. `edge-agent evaluate --paper` has the papers' own conditions."""
VEHICLES_HEAD: Final = """\
## The default on other vehicles

A front-wheel-drive hatchback, a van on soft tyres and a loaded car. Manoeuvres: stops with
anti-lock braking, split friction, jumps of friction, J-turn, ice."""
FAULTS_HEAD: Final = """\
## Sensor faults

Each fault lasts from 2 s on, mostly to 5 s. Drives: a slalom on snow, a double lane change on dry
road, and braking from dry to wet. "Reported": every estimator sets the health flag of the fault in
every drive. "Finite": no number of any estimator is NaN or infinite. Coverage, width and errors are
those of the default from 2 s on. The last column is the coverage of the papers' estimators that
estimate friction."""
CONSISTENCY_HEAD: Final = """\
## Consistency and reliability

First table: NEES of (v_x, v_y) and NIS per component, mean over all scenarios, and the share of
instants at which the mean over the drives lies within the 95 % bounds of a consistent filter. R
includes slowly varying model error. Therefore NIS is below 1 by design, and NEES can leave its
bounds for seconds. Second table: share of true frictions below each stated quantile. The frictions
are those of the scenarios and not drawn from the prior of any estimator."""
ALL_HEAD: Final = """\
## Every estimator in every scenario

Ordinary sensors. The expected NEES of (v_x, v_y) and NIS are 1; where R includes model error, NIS
is lower."""
WORLD_HEAD: Final = """\
## Realistic cars in hilly towns

Every estimator in cars with realistic sensor errors, in hilly towns that were not used for tuning
(`real_world.py`). Half of the cars send no torque. Every second town is a winter town. Columns:

- *Missed ice*: on ice where grip is used, the upper end of the interval is not below .4.
- *False grip*: the lower end lies at least .05 above the friction of ice.
- *False ice*: the whole interval lies below .4 on a road above .6. *Of all*: share of the samples
  on wet and dry road (from .45). *Settled*: share of the samples whose car left snow and ice at
  least 3 s ago or never met any.
- *Below*: the upper end lies below the grip in use, which is certainly wrong.
- *Width, excited*: width of the interval where grip is used, divided by the prior's.
- *Coverage of v_x and v_y*: of the 90 % interval that follows from the stated standard deviation.
- *Lost*: the error of v_x is more than 1 m/s. *Standing*: the largest estimated speed of a car that
  stands on a 5 % slope.

The baseline is the mean of the wheels' speeds for v_x and the prior for friction."""
OWN_HEAD: Final = """\
## Paper 004's bars on plants that are not its filter's model

The bars above are for a plant that equals the filter's model in tyres, drag and loads. The paper
used CarSim, which does not. This table has the same experiments on the simulator's own sedan and
van (rounder tyres, drag, lagging loads):"""
ORACLE_HEAD: Final = """\
## Limit of the sensors

Two difficult bars of the papers, compared with an oracle on the same sensors (`oracle.py`). The
oracle is a Bayesian estimator that knows friction, motion and everything else that vehicle file and
data sheet specify."""
DETECTION_HEAD: Final = """\
# Detection

Towns are drawn by seeds that were not used for tuning. Cars with realistic sensor errors ("rough")
and cars with ordinary sensors ("plain") are reported separately. Short drives last 120 s; long
drives last 900 s, because faults that silence a car appear only there. Half of the towns are winter
towns (`scenarios.winter`; all cars have winter equipment); their figure is in brackets. Definitions
are in `edge_agent/lab/evaluation/detection.py`. ± is the standard error over towns. `flag`:
ordinary ABS and ESC logic on the same signals (`slip_flag.py`). `oracle`: an observer that knows
motion and forces (`slide_oracle.py`). `roc`: the estimator's belief at other thresholds. If ice
appears under a car that stands, it is counted as `stood` and nowhere else."""
# Estimators of the papers that estimate friction.
FRICTION: Final = (
    "paper-aco-fckf",
    "federated-ckf",
    "sr-ukf",
)
SHOWN_LEVELS: Final = LEVELS[::2]


def evaluation_report(figures: Sequence[Figure], *, seeds: int) -> str:
    """Return the complete evaluation report as Markdown."""
    by_name = {figure.name: figure.value for figure in figures}
    barred = [figure for figure in figures if figure.bar is not None]
    held = sum(figure.holds for figure in barred)
    parts = (
        f"# Evaluation\n\n{held} of {len(barred)} bars hold; mean over {seeds} seeds.",
        format_table(barred),
        PAPERS_HEAD,
        paper_table(by_name),
        WHY_NOT.rstrip(),
        OWN_HEAD,
        own_plants_table(barred, by_name),
        ORACLE_HEAD,
        oracle_table(barred, by_name),
        WORLD_HEAD,
        world_table(by_name),
        VEHICLES_HEAD,
        scenario_table(
            by_name, "real.default.", ("coverage90", "width", "mae_mu", "rmse_vx", "rmse_vy")
        ),
        FAULTS_HEAD,
        fault_table(by_name),
        CONSISTENCY_HEAD,
        consistency_table(by_name),
        reliability_table(by_name),
        ALL_HEAD,
        scenario_table(
            by_name, "real.", ("rmse_vx", "rmse_vy", "mae_mu", "coverage90", "width", "nees", "nis")
        ),
    )
    return "\n\n".join(parts) + "\n"


def paper_table(values: dict[str, float]) -> str:
    """Return a Markdown table that compares the numbers printed in the papers with the results of
    this evaluation, `values` by name.
    """
    rows = []
    for row in PRINTED:
        cells = [format_value(values, name) for name in compared_names(row)]
        rows.append([row.paper, row.what, row.value, *cells])
    return markdown_table(
        ("paper", "figure", "printed", "ours", "realistic", "default, realistic"), rows
    )


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table with the column titles `head` and the given rows of cells."""
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows))


def format_value(values: dict[str, float], name: str, *, spread: bool = True) -> str:
    """Return the mean of the figure `name` as text for the report. With `spread`, "± standard
    deviation" is added if the standard deviation is known. If the figure was not measured, return a
    dash.
    """
    value = values.get(name, math.nan)
    sd = values.get(f"{name}.sd")
    if math.isnan(value):
        return "–"
    return f"{value:.3g}" + (f" ± {sd:.2g}" if spread and sd is not None else "")


def own_plants_table(barred: Sequence[Figure], values: dict[str, float]) -> str:
    """Return a Markdown table of the results for paper 004 that have a target: the value under the
    paper's conditions, and the values with the simulator's own vehicle models ("plants").
    """
    rows = []
    for bar in (figure for figure in barred if figure.name.startswith("papers.004.")):
        _, _, noise, measure = bar.name.split(".")
        cells = []
        for plant in ("sedan", "van"):
            experiment = plant if noise == "constant" else f"{plant}.{noise}"
            name = f"noise.004.{experiment}.paper-aco-fckf.{measure}"
            own = replace(bar, value=values.get(name, math.nan))
            cells.append(
                format_value(values, name, spread=False) + ("" if own.holds else " (missed)")
            )
        rows.append([f"{noise} noise, {measure}", f"{bar.bar}", f"{bar.value:.3g}", *cells])
    return markdown_table(("figure", "bar", "matched plant", "sedan", "van"), rows)


def oracle_table(barred: Sequence[Figure], values: dict[str, float]) -> str:
    """Return a Markdown table of those results with a target for which an oracle (an ideal
    observer) was run. It shows the target, the value of the default estimator, and that of the
    oracle.
    """
    rows = []
    for bar in barred:
        name = f"oracle.{bar.name.removeprefix('papers.')}"
        if name in values:
            rows.append([bar.name, f"{bar.bar}", f"{bar.value:.3g}", format_value(values, name)])
    return markdown_table(("figure", "bar", "default", "oracle"), rows)


def world_table(values: dict[str, float]) -> str:
    """Return a Markdown table of the results in towns whose cars have large sensor errors, as real
    cars have; one row per estimator.
    """
    shown = {
        "coverage90": "coverage",
        "coverage90.ice": "on ice",
        "missed_ice": "missed ice",
        "false_grip": "false grip",
        "false_ice": "false ice",
        "false_ice.off_ice": "off ice",
        "false_ice.of_all": "of all",
        "false_ice.settled": "settled",
        "below": "below",
        "width": "width, excited",
        "score": "score",
        "rmse_vx": "rmse_vx",
        "coverage90.vx": "coverage of v_x",
        "rmse_vy": "rmse_vy",
        "coverage90.vy": "coverage of v_y",
        "lost": "lost",
        "standing_5pct.v_max": "standing [m/s]",
    }
    names = [*list_estimators(values, "world.", ".coverage90"), "baseline"]
    rows = [
        [name, *(format_value(values, f"world.{name}.{key}") for key in shown)] for name in names
    ]
    return markdown_table(("estimator", *shown.values()), rows)


def list_estimators(values: dict[str, float], prefix: str, suffix: str) -> list[str]:
    """Return the names of the estimators that occur in the keys of `values` between `prefix` and
    `suffix`, each once, in the order of their first occurrence.
    """
    found = [
        name[len(prefix) : -len(suffix)]
        for name in values
        if name.startswith(prefix) and name.endswith(suffix)
    ]
    return list(dict.fromkeys(found))


def scenario_table(values: dict[str, float], prefix: str, measures: Sequence[str]) -> str:
    """Return a Markdown table with one row per scenario and estimator and one column per given
    measure.
    """
    rows = []
    for found in list_estimators(values, prefix, ".rmse_vx"):
        scenario, _, estimator = found.rpartition(".")
        cells = (
            format_value(values, f"{prefix}{found}.{measure}", spread=False) for measure in measures
        )
        rows.append([scenario, estimator, *cells])
    return markdown_table(("scenario", "estimator", *measures), rows)


def fault_table(values: dict[str, float]) -> str:
    """Return a Markdown table of the results with sensor faults, one row per fault."""
    shown = ("coverage90", "width", "rmse_vx", "rmse_vy")
    rows = []
    for name, case in CASES.items():
        recognised = [
            value
            for key, value in values.items()
            if key.startswith(f"faults.{name}.") and key.endswith(".told")
        ]
        whole = [
            value
            for key, value in values.items()
            if key.startswith(f"faults.{name}.") and key.endswith(".finite")
        ]
        rows.append(
            [
                name,
                case.expected,
                "–" if not case.flag else format_verdict(recognised),
                format_verdict(whole),
                *(
                    format_value(values, f"faults.{name}.{DEFAULT}.{measure}", spread=False)
                    for measure in shown
                ),
                ", ".join(
                    format_value(values, f"faults.{name}.{paper}.coverage90", spread=False)
                    for paper in FRICTION
                ),
            ]
        )
    head = (
        "fault",
        "expected behaviour",
        "reported",
        "finite",
        *shown,
        "coverage of 004, 000, 003",
    )
    return markdown_table(head, rows)


def format_verdict(shares: Sequence[float]) -> str:
    """Return the cell of the report for a check of several estimators. `shares` has, for each
    estimator, the share of drives that passed the check. The cell is "yes" if all shares are 1,
    otherwise "NO" with the smallest share; a dash if there are no shares.
    """
    if not shares:
        return "–"
    return "yes" if min(shares) == 1.0 else f"NO ({min(shares):.2g})"


def consistency_table(values: dict[str, float]) -> str:
    """Return a Markdown table with one row per estimator: NEES and NIS (normalised squared errors
    and innovations) over all scenarios, and the share of instants at which their means lie within
    the bounds for a consistent filter.
    """
    names = list_estimators(values, "reliability.", ".below_05")
    rows = []
    for name in names:
        cells = []
        for measure in ("nees", "nees_within", "nis", "nis_within"):
            found = [
                v
                for key, v in values.items()
                if key.startswith("real.") and key.endswith(f".{name}.{measure}")
            ]
            cells.append(f"{sum(found) / len(found):.3g}" if found else "–")
        rows.append([name, *cells])
    ends = {
        m: " to ".join(format_value(values, f"bounds.{m}.{end}") for end in ("lower", "upper"))
        for m in ("nees", "nis")
    }
    head = (
        "estimator",
        f"NEES (bounds {ends['nees']})",
        "within",
        f"NIS (bounds {ends['nis']})",
        "within",
    )
    return markdown_table(head, rows)


def reliability_table(values: dict[str, float]) -> str:
    """Return a Markdown table with one row per estimator: the share of true frictions below each
    stated quantile.
    """
    rows = [
        [
            name,
            *(
                format_value(values, f"reliability.{name}.below_{100 * level:02.0f}")
                for level in SHOWN_LEVELS
            ),
        ]
        for name in list_estimators(values, "reliability.", ".below_05")
    ]
    return markdown_table(("estimator", *(f"{100 * level:.0f} %" for level in SHOWN_LEVELS)), rows)


def detection_report(figures: Sequence[Figure]) -> str:
    """Return the Markdown report of the detection evaluation."""
    return f"{DETECTION_HEAD}\n\n{detection_table(figures)}\n"


def detection_table(figures: Sequence[Figure]) -> str:
    """Return a Markdown table of the detection evaluation with one row per result: its values with
    standard errors, and the targets.

    Separate columns are for "rough" cars (large sensor errors, as in real cars) and "plain" cars
    (small sensor errors).
    """
    by_name = {figure.name: figure for figure in figures}
    names = dict.fromkeys(
        name.rpartition(".")[0] for name in by_name if name.endswith((".rough", ".plain"))
    )
    rows = []
    for name in names:
        cells = []
        limits = []
        held = []
        for kind in ("rough", "plain"):
            figure = by_name.get(f"{name}.{kind}")
            shown = figure is not None and not math.isnan(figure.value)
            cells.append(_detection_cell(by_name, f"{name}.{kind}") if shown else "–")
            if figure is not None and figure.bar is not None:
                limits.append(f"{figure.bar:g}")
                held += [figure.holds] if shown else []
        sign = ""
        if limits:
            sign = "≤ " if by_name[f"{name}.rough"].better == "less" else "≥ "
        verdict = ""
        if held:
            verdict = "holds" if all(held) else "✗"
        rows.append([f"`{name}`", *cells, sign + "; ".join(dict.fromkeys(limits)), verdict])
    return markdown_table(("figure", "rough", "plain", "bar", ""), rows)


def _detection_cell(figures: dict[str, Figure], name: str) -> str:
    """Return the value of the figure `name` as text, with its standard error and, in parentheses,
    its value in winter, if they are known.
    """
    error = figures.get(f"{name}.se")
    winter = figures.get(f"{name}.winter")
    text = f"{figures[name].value:.3g}"
    if error:
        text += f" ± {error.value:.1g}"
    if winter and math.isfinite(winter.value):
        text += f" ({winter.value:.3g})"
    return text
