"""Evaluation of the estimator on recorded drives of real cars. Owners of recordings run it on their
own files.

A folder contains LOG.parquet with its vehicle file LOG.json. Optional files are LOG.truth.parquet
(columns t, vx, vy, mu, as far as they were measured) and LOG.meta.json (`mu_known`: known friction
of the surface). The figures cover the time in which the car moves, from the third second on:

    informative    share of the time in which the friction interval is clearly narrower than the
                   prior's: less than INFORMATIVE (.6) of its width
    right          share of the informative time in which the friction interval is correct. If the
                   true friction was measured, the interval must contain the true friction.
                   Otherwise the upper end of the interval must not be below a lower limit of the
                   road's friction, which follows from the grip that the car used and `mu_known`.
    ice            share of the time in which the estimator reports ice (P(slippery) above
                   CALLED_SHARE, .9) although the road was not slippery
    contradicted   share of the time with the health flag CONTRADICTION (no friction explains the
                   data)
    urgent         number of friction observations per hour that the agent would send immediately;
                   only for logs with a position
    used           99th percentile of the friction in use (mu_utilised)
    vx, vy, slip   root mean square errors of v_x, v_y [m/s] and sideslip [deg], where the true
                   values were measured
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow.parquet as pq

from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators.estimates import Column
from edge_agent.inputs.doctor.adopt import Adopted, prepare_log
from edge_agent.inputs.doctor.drive import RATE_HZ, interpolate_near, smooth_twice
from edge_agent.inputs.signal_log import SignalLog, read_log
from edge_agent.observe.pipeline import Pipeline
from schemas.config import AgentConfig
from schemas.errors import InputError
from schemas.numeric import BoolArray, FloatArray
from schemas.runtime.figures import Figure
from schemas.signals import Health, S
from schemas.thresholds import CALLED_SHARE, GRAVITY
from schemas.vehicle import Vehicle, load_vehicle

ESTIMATOR: Final = "aco-fckf"
BEGIN_S: Final = 3.0  # [s] beginning of a log that is not evaluated
MOVING_M_S: Final = 1.5
FAST_M_S: Final = 3.0  # [m/s] minimum speed at which sideslip is evaluated
INFORMATIVE: Final = 0.6
GRIPS: Final = 0.6  # minimum friction of a road that is not slippery
CERTAIN: Final = 0.9  # share of `mu_known` that the surface had at least
MARGIN: Final = 0.03  # tolerance for the noise of the grip in use
USED_SHARE: Final = 99.5  # percentile of the grip in use that the surface certainly had
SMOOTH_S: Final = 0.25
TRUTH: Final = ("vx", "vy", "mu")
HEAD: Final = (
    "informative",
    "right",
    "ice",
    "contradicted",
    "urgent_per_hour",
    "used",
    "vx",
    "vy",
    "sideslip",
)


@dataclass(frozen=True)
class LogFigures:
    """Results of the estimator on one log: shares of the time (informative, right, ice,
    contradicted), urgent observations per hour, friction in use, and errors of the motion. A result
    is NaN if it cannot be computed from the log.
    """

    name: str
    seconds: float
    passed: bool
    informative: float
    right: float
    ice: float
    contradicted: float
    urgent_per_hour: float
    used: float
    vx: float
    vy: float
    sideslip: float


def judge_folder(
    folder: Path, log_line: Callable[[str], None] = lambda _: None
) -> list[LogFigures]:
    """Evaluate every log in a folder for which there is a vehicle file. `log_line` is a function
    that receives each line of text about the progress.

    Raises:
        InputError: the folder has no log with a vehicle file, or a log cannot be read.
    """
    paths = [
        path
        for path in sorted(folder.glob("*.parquet"))
        if not path.name.endswith(".truth.parquet") and path.with_suffix(".json").exists()
    ]
    if not paths:
        raise InputError(
            "logs",
            f"{folder} has no LOG.parquet with a LOG.json next to it",
            "put each log next to its vehicle file",
        )
    found = []
    for path in paths:
        found.append(judge_log(path))
        log_line(table_row(found[-1]))
    return found


def judge_log(path: Path) -> LogFigures:
    """Estimate motion and friction from one recorded log, and return the evaluation results for
    it.
    """
    adopted = prepare_log(read_log(path), load_vehicle(path.with_suffix(".json")))
    values, urgent = replay_log(adopted.log, adopted.vehicle)
    truth = read_truth(path, adopted.log.t)
    meta = path.with_suffix(".meta.json")
    known = json.loads(meta.read_text(encoding="utf-8")).get("mu_known") if meta.exists() else None
    return judge_estimates(path.stem, adopted, values, truth, known, urgent)


def replay_log(log: SignalLog, vehicle: Vehicle) -> tuple[FloatArray, int | None]:
    """Run the estimator on a log. Return the estimates (T, columns), and the number of urgent
    observations (those that the agent would send immediately).

    The number of urgent observations is None if the log has no position.
    """
    pipeline = Pipeline(bank_of(ESTIMATOR, [vehicle]), 1, AgentConfig())
    parts = []
    urgent = 0
    for block in log.blocks(0):
        estimates, observations, _ = pipeline.step(block)
        urgent += int(observations.urgent.sum())
        parts.append(estimates.values[:, 0])
    last = pipeline.finish()
    urgent += 0 if last is None else int(last.urgent.sum())
    located = bool(np.isfinite(log.signals[:, S.LATITUDE]).any())
    return np.concatenate(parts), urgent if located else None


def read_truth(path: Path, t: FloatArray) -> dict[str, FloatArray]:
    """Return the measured true values by name, at the times `t` (T,) of the log; NaN where they
    were not measured.
    """
    file = path.with_suffix(".truth.parquet")
    if not file.exists():
        return {name: np.full(len(t), np.nan) for name in TRUTH}
    table = pq.read_table(file)
    at = (
        np.asarray(table["t"].to_numpy(zero_copy_only=False), float)
        if "t" in table.column_names
        else t
    )
    found: dict[str, FloatArray] = {}
    for name in TRUTH:
        if name in table.column_names:
            found[name] = interpolate_near(
                at, np.asarray(table[name].to_numpy(zero_copy_only=False), float), t
            )
        else:
            found[name] = np.full(len(t), np.nan)
    return found


def judge_estimates(
    name: str,
    adopted: Adopted,
    values: FloatArray,
    truth: dict[str, FloatArray],
    known: float | None,
    urgent: int | None,
) -> LogFigures:
    """Return the evaluation results for one log, computed from its estimates `values` (T, columns)
    and the measured true values `truth`. `known` is the friction of the surface and `urgent` the
    number of urgent observations, if known.
    """
    t = adopted.log.t
    signals = adopted.log.signals
    wheels = np.where(
        np.isfinite(signals[:, S.OMEGA : S.OMEGA + 4]), signals[:, S.OMEGA : S.OMEGA + 4], 0.0
    )
    moving = (t - t[0] > BEGIN_S) & (
        adopted.vehicle.wheel_radius * np.median(wheels, axis=1) > MOVING_M_S
    )
    width = values[:, Column.MU_UPPER] - values[:, Column.MU_LOWER]
    is_informative = moving & (width < INFORMATIVE * float(width[0]))
    least = known_friction(t, signals, moving, known)
    is_above_least = values[:, Column.MU_UPPER] >= least - MARGIN
    exact = np.isfinite(truth["mu"])
    inside = (values[:, Column.MU_LOWER] <= truth["mu"]) & (
        truth["mu"] <= values[:, Column.MU_UPPER]
    )
    right = np.where(exact, inside, is_above_least)
    grips = np.where(exact, truth["mu"] >= GRIPS, known is None or known >= GRIPS)
    contradicted = (values[:, Column.HEALTH].astype(int) & int(Health.CONTRADICTION)) != 0
    fast = (t - t[0] > BEGIN_S) & (truth["vx"] > FAST_M_S)
    hours = float(moving.sum()) * float(np.median(np.diff(t))) / 3600.0
    slip = np.degrees(
        np.arctan2(values[:, Column.VY], values[:, Column.VX])
        - np.arctan2(truth["vy"], truth["vx"])
    )
    return LogFigures(
        name=name,
        seconds=float(t[-1] - t[0]),
        passed=adopted.diagnosis.is_passed,
        informative=share_of(is_informative, moving),
        right=share_of(right, is_informative),
        ice=share_of(values[:, Column.P_SLIPPERY] > CALLED_SHARE, moving & grips),
        contradicted=share_of(contradicted, moving),
        urgent_per_hour=math.nan if urgent is None or hours == 0.0 else urgent / hours,
        used=float(np.percentile(values[moving, Column.MU_UTILISED], 99))
        if moving.any()
        else math.nan,
        vx=root_mean_square(
            values[:, Column.VX] - truth["vx"], (t - t[0] > BEGIN_S) & (truth["vx"] > 1.0)
        ),
        vy=root_mean_square(values[:, Column.VY] - truth["vy"], fast),
        sideslip=root_mean_square(slip, fast),
    )


def known_friction(
    t: FloatArray, signals: FloatArray, moving: BoolArray, known: float | None
) -> float:
    """Return a lower limit of the friction of the surface on which a log was recorded. It is the
    larger of two numbers: the grip that the car used while `moving`, and CERTAIN times the `known`
    friction, if there is one.
    """
    at = np.arange(t[0], t[-1], 1.0 / RATE_HZ)
    along = smooth_twice(interpolate_near(t, signals[:, S.AX], at), SMOOTH_S)
    across = smooth_twice(interpolate_near(t, signals[:, S.AY], at), SMOOTH_S)
    used = np.hypot(along, across)[np.interp(at, t, moving.astype(float)) > 0.5] / GRAVITY
    used = used[np.isfinite(used)]
    used_friction = float(np.percentile(used, USED_SHARE)) if len(used) else 0.0
    return max(used_friction, CERTAIN * known if known is not None else 0.0)


def share_of(mask: BoolArray, among: BoolArray) -> float:
    """Return the share of samples in which `mask` (T,) is True, among those that the mask `among`
    (T,) selects; NaN if no sample is selected.
    """
    return float(np.mean(mask[among])) if among.any() else math.nan


def root_mean_square(error: FloatArray, among: BoolArray) -> float:
    """Return the root mean square of errors (T,) over the samples where `among` (T,) is True; NaN
    if no error is known there.
    """
    some = among & np.isfinite(error)
    return float(np.sqrt(np.mean(np.square(error[some])))) if some.any() else math.nan


def summary_figures(found: Sequence[LogFigures]) -> list[Figure]:
    """Return the figures (named numbers) of the evaluation over all logs. Most are means weighted
    by the duration of each log. For false ice, urgent observations and friction in use, the figure
    is the value of the worst log.
    """
    seconds = np.array([log.seconds for log in found])

    def mean(name: str) -> float:
        column = np.array([getattr(log, name) for log in found])
        is_finite = np.isfinite(column)
        return (
            float(np.average(column[is_finite], weights=seconds[is_finite]))
            if is_finite.any()
            else math.nan
        )

    def worst(name: str) -> float:
        column = [getattr(log, name) for log in found if math.isfinite(getattr(log, name))]
        return max(column) if column else math.nan

    return [
        Figure("real.informative", mean("informative"), "1", 0.25, "more"),
        Figure("real.right", mean("right"), "1", 0.90, "more"),
        Figure("real.ice.worst", worst("ice"), "1", 0.01),
        Figure("real.contradicted", mean("contradicted"), "1", 0.10),
        Figure("real.urgent_per_hour.worst", worst("urgent_per_hour"), "1/h", 5.0),
        Figure("real.used.worst", worst("used"), "1", 1.3),
        Figure("real.sideslip", mean("sideslip"), "deg"),
        Figure("real.vy", mean("vy"), "m/s"),
        Figure("real.logs", float(len(found)), "logs"),
        Figure("real.logs_passed", float(sum(log.passed for log in found)), "logs"),
    ]


def table_row(log: LogFigures) -> str:
    """Return the evaluation results for one log as a row of a Markdown table."""
    cells = [
        f"{value:.3g}" if math.isfinite(value) else "–"
        for value in (asdict(log)[name] for name in HEAD)
    ]
    return (
        f"| {log.name} | {log.seconds:.0f} | {'yes' if log.passed else 'no'} | "
        f"{' | '.join(cells)} |"
    )


def results_table(found: Sequence[LogFigures]) -> str:
    """Return the evaluation results for all logs as a Markdown table."""
    head = ["log", "seconds", "doctor passed", *(name.replace("_", " ") for name in HEAD)]
    rows = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}", *(table_row(log) for log in found)]
    return "\n".join(rows)
