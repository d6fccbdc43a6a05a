"""List of the figures (named numbers) that the evaluation campaign reports. Figures with a target
("bar") come first; all other measures follow for information.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final, Literal, NamedTuple

import numpy as np

from edge_agent.lab.evaluation import worth
from edge_agent.lab.evaluation.campaign import DEFAULT, Results
from edge_agent.lab.evaluation.measures import COMPONENTS, mean_bounds
from edge_agent.lab.evaluation.reliability import LEVELS, rank_shares
from schemas.numeric import FloatArray
from schemas.runtime.figures import Figure
from schemas.thresholds import SURFACES

PRIOR_WIDTH: Final = 0.9 * 1.15  # width of the 90 % interval of the uniform prior


class EstimatorBar(NamedTuple):
    """A figure with a target: its name, the function that reads it from the results (NaN if not
    measured), its unit and its target.
    """

    name: str
    read: Callable[[Results], float]
    unit: str
    bar: float
    better: Literal["less", "more"]


def mean_of(scenario: str, measure: str, estimator: str = DEFAULT) -> Callable[[Results], float]:
    """Return a function that takes the campaign's results and returns the mean of one measure over
    all drives of a scenario with ordinary sensors. `measure` is for example "rmse_vx", a root mean
    square error.
    """

    def read_mean(results: Results) -> float:
        return mean(results.real.get((scenario, estimator), {}).get(measure))

    return read_mean


def noise_mean(experiment: str, measure: str) -> Callable[[Results], float]:
    """Return a function that takes the campaign's results and returns the mean of one measure over
    all drives of a noise experiment of paper 004.

    The estimator is the filter of the paper, with fuzzy sets tuned by the ant colony. `measure` is
    for example "mae_vx", a mean absolute error. `experiment` is "constant" or "variable", which
    describes the variance of the sensor noise over time.
    """
    return lambda results: mean(results.noise.get((experiment, "paper-aco-fckf"), {}).get(measure))


def in_the_world(name: str) -> Callable[[Results], float]:
    """Return a function that takes the campaign's results and returns one number, called `name`. It
    is a result of the default estimator under realistic conditions (`real_world`).
    """
    return lambda results: results.world.get(DEFAULT, {}).get(name, math.nan)


def worth_of(name: str) -> Callable[[Results], float]:
    """Return a function that takes the campaign's results and returns the ratio called `name`: one
    filter variant's interval score of friction divided by that of another. For example, the score
    with fuzzy sets is divided by the score without them.
    """
    return lambda results: worth.score_ratio(results.worth, name)


def mean(values: FloatArray | None) -> float:
    """Return the mean of a measure over drives (`values` has one value per drive); NaN if there are
    no values.
    """
    return math.nan if values is None or not len(values) else float(np.mean(values))


def false_per_hour(results: Results) -> float:
    """Return how many false changes of friction the default estimator reports per hour, in
    scenarios with constant friction. `measures.false_changes` defines a false change.
    """
    counted = [m for (_, name), m in results.real.items() if name == DEFAULT and "hours" in m]
    hours = sum(float(m["hours"].sum()) for m in counted)
    return sum(float(m["false_changes"].sum()) for m in counted) / hours if hours else math.nan


def mean_over(scenarios: Sequence[str], measure: str) -> Callable[[Results], float]:
    """Return a function that takes the campaign's results and returns the mean of one measure over
    the drives of several scenarios, with the default estimator.
    """
    means = [mean_of(scenario, measure) for scenario in scenarios]
    return lambda results: sum(of_one(results) for of_one in means) / len(means)


def on_foreign_tyres(results: Results) -> float:
    """Return how often the default estimator's friction interval contains the true value
    (coverage): the mean over all scenarios with tyres that differ from the filter's tyre model.
    """
    return mean(np.concatenate(list(results.foreign.values()))) if results.foreign else math.nan


def width_ratio(results: Results) -> float:
    """Return the width of the default estimator's friction interval divided by the prior's width,
    when driving straight at constant speed.
    """
    return mean_of("default.straight", "width")(results) / PRIOR_WIDTH


M_S = "m/s"
RAD_S = "rad/s"
SHARE = "1"
# Targets of drives on two circles and at street corners: road, measure, target. The measure
# slippery is the share of the time for which the road is reported as slippery.
TURNS: Final[tuple[tuple[str, str, float, Literal["less", "more"]], ...]] = (
    ("dry", "coverage90", 0.85, "more"),
    ("dry", "slippery", 0.002, "less"),
    ("ice", "slippery", 0.8, "more"),
)
BARS: Final = (
    *(
        EstimatorBar(
            f"papers.004.{kind}.mae_{name}", noise_mean(kind, f"mae_{name}"), unit, bar, "less"
        )
        for kind in ("constant", "variable")
        for name, unit, bar in (("vx", M_S, 0.002), ("vy", M_S, 0.007), ("yaw_rate", RAD_S, 0.002))
    ),
    EstimatorBar("default.dlc.mu_error", mean_of("default.dlc", "mu_error"), SHARE, 0.05, "less"),
    EstimatorBar(
        "default.dlc.coverage90", mean_of("default.dlc", "end_coverage90"), SHARE, 0.85, "more"
    ),
    EstimatorBar("papers.001.rmse_vx", mean_of("001.dlc", "rmse_vx"), M_S, 0.02, "less"),
    EstimatorBar("papers.001.rmse_vy", mean_of("001.dlc", "rmse_vy"), M_S, 0.01, "less"),
    EstimatorBar("papers.001.rmse_beta", mean_of("001.dlc", "rmse_beta"), "rad", 0.001, "less"),
    EstimatorBar("papers.002.sine.rmse_vx", mean_of("002.sine", "rmse_vx"), M_S, 0.03, "less"),
    EstimatorBar("papers.002.sine.rmse_vy", mean_of("002.sine", "rmse_vy"), M_S, 0.03, "less"),
    EstimatorBar("papers.002.jturn.rmse_vx", mean_of("002.jturn", "rmse_vx"), M_S, 0.03, "less"),
    EstimatorBar("papers.002.jturn.rmse_vy", mean_of("002.jturn", "rmse_vy"), M_S, 0.03, "less"),
    EstimatorBar(
        "papers.003.accel.mu_error", mean_of("003.accel", "mu_error"), SHARE, 0.08, "less"
    ),
    EstimatorBar("papers.003.turn.mu_error", mean_of("003.turn", "mu_error"), SHARE, 0.05, "less"),
    EstimatorBar(
        "papers.003.split.low_error", mean_of("003.split", "low_error"), SHARE, 0.07, "less"
    ),
    EstimatorBar(
        "papers.003.split.high_coverage90",
        mean_of("003.split", "high_coverage90"),
        SHARE,
        0.85,
        "more",
    ),
    EstimatorBar("papers.000.coverage90", mean_of("000.jump", "coverage90"), SHARE, 0.87, "more"),
    EstimatorBar(
        "default.jump.accel_s", mean_of("default.jump.accel", "arrival_s"), "s", 0.1, "less"
    ),
    EstimatorBar(
        "default.jump.brake_s", mean_of("default.jump.brake", "arrival_s"), "s", 0.25, "less"
    ),
    EstimatorBar("default.jump.false_per_hour", false_per_hour, "1/h", 1.0, "less"),
    EstimatorBar("default.straight.width_ratio", width_ratio, SHARE, 0.8, "more"),
    EstimatorBar(
        "default.straight.coverage90", mean_of("default.straight", "coverage90"), SHARE, 0.9, "more"
    ),
    EstimatorBar("default.foreign_tyres.coverage90", on_foreign_tyres, SHARE, 0.85, "more"),
    EstimatorBar(
        "default.abs.coverage90",
        mean_over(("default.abs.dry", "default.abs.snow"), "coverage90"),
        SHARE,
        0.80,
        "more",
    ),
    *(
        EstimatorBar(
            f"default.turns.{road}.{measure}",
            mean_over(
                [f"default.{turn}.{road}" for turn in ("circle", "corners", "ramp")], measure
            ),
            SHARE,
            bar,
            better,
        )
        for road, measure, bar, better in TURNS
    ),
    EstimatorBar(
        "default.spin.coverage90", mean_of("default.spin", "coverage90"), SHARE, 0.80, "more"
    ),
    EstimatorBar(
        "real_world.standing_5pct.v_max", in_the_world("standing_5pct.v_max"), M_S, 0.2, "less"
    ),
    EstimatorBar("real_world.false_ice", in_the_world("false_ice"), SHARE, 0.002, "less"),
    EstimatorBar(
        "real_world.false_ice.off_ice", in_the_world("false_ice.off_ice"), SHARE, 0.002, "less"
    ),
    EstimatorBar(
        "real_world.false_ice.of_all", in_the_world("false_ice.of_all"), SHARE, 0.002, "less"
    ),
    EstimatorBar("real_world.below", in_the_world("below"), SHARE, 0.002, "less"),
    EstimatorBar("real_world.coverage90", in_the_world("coverage90"), SHARE, 0.88, "more"),
    *(
        EstimatorBar(
            f"real_world.coverage90.{name}", in_the_world(f"coverage90.{name}"), SHARE, 0.80, "more"
        )
        for name in (*SURFACES, "excited")
    ),
    EstimatorBar("real_world.width", in_the_world("width"), SHARE, 0.5, "less"),
    *(
        EstimatorBar(
            f"real_world.contradiction_share.{name}.excited",
            in_the_world(f"contradiction_share.{name}.excited"),
            SHARE,
            0.2,
            "less",
        )
        for name in SURFACES
    ),
    *(EstimatorBar(name, worth_of(name), SHARE, bar, "less") for name, bar in worth.BARS.items()),
)

UNITS: Final = {
    "vx": M_S,
    "vy": M_S,
    "yaw_rate": RAD_S,
    "beta": "rad",
    "s": "s",
    "hours": "h",
    "changes": "per drive",
    "rmse_vx": M_S,
    "rmse_vy": M_S,
    "v_max": M_S,
}


def unit_of(measure: str) -> str:
    """Return the unit of a measure as text, for example m/s, derived from the end of the measure's
    name.
    """
    if measure.startswith("coverage90"):
        return SHARE
    whole = (
        unit
        for end, unit in UNITS.items()
        if measure == end or measure.endswith((f"_{end}", f".{end}"))
    )
    return next(whole, SHARE)


def evaluation_figures(results: Results, *, quick: bool) -> list[Figure]:
    """Return all figures of the evaluation. Figures with a target come first. With `quick`, figures
    with a target are left out if they were not measured.

    Most other figures are named `KIND.SCENARIO.ESTIMATOR.MEASURE` and are means over several
    drives. A figure with the suffix `.sd` is the standard deviation over these drives.
    """
    barred = [Figure(bar.name, bar.read(results), bar.unit, bar.bar, bar.better) for bar in BARS]
    listed = [figure for figure in barred if not (quick and math.isnan(figure.value))]
    listed += worth.comparison_figures(results.worth)
    for kind, table in (("ideal", results.ideal), ("real", results.real)):
        for (scenario, estimator), found in table.items():
            listed += _context_figures(f"{kind}.{scenario}.{estimator}", found)
    for (experiment, estimator), found in results.noise.items():
        listed += _context_figures(f"noise.004.{experiment}.{estimator}", found)
    for (case, estimator), found in results.faults.items():
        listed += _context_figures(f"faults.{case}.{estimator}", found)
    for name, errors in results.oracle.items():
        listed.append(Figure(f"oracle.{name}", mean(errors), unit_of(name)))
    for estimator, values in results.world.items():
        listed += [
            Figure(f"world.{estimator}.{name}", value, unit_of(name))
            for name, value in values.items()
        ]
    listed += _consistency_figures(results)
    return listed + [
        Figure(f"foreign.{kind}.coverage90", mean(value), SHARE)
        for kind, value in results.foreign.items()
    ]


def _consistency_figures(results: Results) -> list[Figure]:
    """Return the figures on filter consistency: the bounds within which the means of NEES and NIS
    (normalised squared errors and innovations) should lie, and for every estimator the share of
    true frictions below each stated quantile.
    """
    listed = []
    for measure in COMPONENTS if results.seeds else ():
        for end, value in zip(("lower", "upper"), mean_bounds(measure, results.seeds), strict=True):
            listed.append(Figure(f"bounds.{measure}.{end}", value, SHARE))
    for estimator, parts in results.ranks.items():
        for level, share in zip(LEVELS, rank_shares(np.concatenate(parts)), strict=True):
            listed.append(
                Figure(f"reliability.{estimator}.below_{100 * level:02.0f}", float(share), SHARE)
            )
    return listed


def _context_figures(prefix: str, found: dict[str, FloatArray]) -> list[Figure]:
    listed = []
    for measure, values in found.items():
        listed.append(Figure(f"{prefix}.{measure}", mean(values), unit_of(measure)))
        if len(values) > 1:
            listed.append(
                Figure(f"{prefix}.{measure}.sd", float(np.std(values, ddof=1)), unit_of(measure))
            )
    return listed
