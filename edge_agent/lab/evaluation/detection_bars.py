"""Figures (named numbers) of the detection evaluation: how each figure is computed from a tally
(sums and counts), its unit, and its targets ("bars").

There are two kinds of cars, and two targets per figure: "rough" cars have large sensor errors, as
real cars have; "plain" cars have small sensor errors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product
from typing import Final, Literal, NamedTuple

import numpy as np

from edge_agent.lab.evaluation.detection import (
    ACTIVITIES,
    KINDS,
    LENGTHS,
    ROC_FLAG_MU,
    ROC_NATS,
    DetectionResults,
    DetectionTally,
)
from schemas.runtime.figures import Figure
from schemas.thresholds import SURFACES

SHARE: Final = "1"


class DetectionBar(NamedTuple):
    """Definition of one figure of the detection evaluation: the drives that the figure covers, the
    function that computes it from a tally (sums and counts), and its unit.

    `length` is the class of drives, "short" or "long"; "" means both together. `bars` are the
    targets for "rough" cars (large sensor errors, as in real cars) and "plain" cars (small errors).
    """

    name: str
    length: str
    read: Callable[[DetectionTally], float]
    unit: str
    bars: tuple[float, float] | None = None
    better: Literal["less", "more"] = "more"


def mean_of(name: str) -> Callable[[DetectionTally], float]:
    """Return a function that computes a mean from a tally (sums and counts of the evaluation): the
    mean of the values stored under `name`.
    """
    return lambda tally: tally.mean(name)


def seconds_of(name: str, share: float) -> Callable[[DetectionTally], float]:
    """Return a function that computes a quantile of detection times [s] from a tally (sums, counts
    and detection times of the evaluation). `name` selects the times, and `share` (0 to 1) the
    quantile.
    """
    return lambda tally: tally.quantile(name, share)


def rate_of(numerator: str, denominator: str) -> Callable[[DetectionTally], float]:
    """Return a function that computes a rate from a tally (sums of the evaluation by name): 1000
    times the sum named `numerator`, divided by the sum named `denominator`.

    If `denominator` is a distance [km] or a time [s], the unit of the rate is "per 1000 km" or "per
    1000 s".
    """
    return lambda tally: 1e3 * tally.rate(numerator, denominator)


PER_1000_KM = "per 1000 km"
PER_1000_S = "per 1000 s"
SHARES: Final = (
    *(
        f"{road}.{what}{among}"
        for road, what, among in product(
            ("ice", "snow"), ("yield", "favoured"), ("", ".slide", ".calm")
        )
    ),
    "warned",
    "passes.ice",
    "passes.snow",
    "passes.ice.stood",
    "coverage90.ice.stood",
    "ice.yield.stood",
    "flag.passes.ice",
    "flag.passes.snow",
    "either.passes.ice",
    "controller.passes.ice",
    "contradiction_share.ice.excited",
    "contradiction_share",
    "coverage90.snow",
    "coverage90.wet",
    "coverage90.dry",
    *(f"passes.ice.{activity}" for activity in ("slide", *ACTIVITIES)),
)
WITH_TARGET: Final = {
    "short": {"ice.favoured.slide", *(f"coverage90.{surface}" for surface in SURFACES)},
    "long": {"ice.yield", "ice.yield.slide", "passes.ice"},
}
QUANTILES: Final = (("median", 0.5), ("p90", 0.9))


def _list_shares(length: str) -> list[DetectionBar]:
    """Return the figures of one class of drives that are shares without a target."""
    return [
        DetectionBar(f"{name}.{length}", length, mean_of(name), SHARE)
        for name in SHARES
        if name not in WITH_TARGET[length]
    ]


def _list_comparisons() -> list[DetectionBar]:
    """Return the shares found by the oracle and by the slip flag, for comparison."""
    names = [
        f"oracle.ice.{what}{among}"
        for what, among in product(("yield", "favoured"), ("", ".slide", ".calm"))
    ]
    names += [f"flag.passes.ice.{activity}" for activity in ("slide", *ACTIVITIES)]
    return [DetectionBar(f"{name}.short", "short", mean_of(name), SHARE) for name in names]


def _list_times() -> list[DetectionBar]:
    """Return the quantiles of the detection times of the estimator and of the slip flag."""
    listed = [
        DetectionBar(
            f"ice.seconds.{activity}.{end}",
            "short",
            seconds_of(f"seconds.ice.{activity}", share),
            "s",
        )
        for activity, (end, share) in product(ACTIVITIES, QUANTILES)
    ]
    for end, share in QUANTILES:
        read = seconds_of("flag.seconds.ice.braking", share)
        listed.append(DetectionBar(f"flag.seconds.{end}", "short", read, "s"))
    return listed


def _list_operating_points() -> list[DetectionBar]:
    """Return the passes found and the false events at each threshold of the estimator (`roc`) and
    of the slip flag (`flag`).
    """
    listed = []
    for way, limits in (("roc", ROC_NATS), ("flag", ROC_FLAG_MU)):
        for limit in limits:
            name = f"{way}.{limit:g}"
            false_events = rate_of(f"{name}.false_events", "km")
            listed += [
                DetectionBar(f"{name}.ice", "", mean_of(f"{name}.ice"), SHARE),
                DetectionBar(f"{name}.snow", "", mean_of(f"{name}.snow"), SHARE),
                DetectionBar(f"{name}.false_events", "", false_events, PER_1000_KM),
            ]
    return listed


DETECTION: Final = (
    DetectionBar("ice.yield.long", "long", mean_of("ice.yield"), SHARE, (0.60, 0.58)),
    DetectionBar("ice.yield.slide.long", "long", mean_of("ice.yield.slide"), SHARE, (0.80, 0.90)),
    DetectionBar(
        "ice.favoured.slide.short", "short", mean_of("ice.favoured.slide"), SHARE, (0.86, 0.90)
    ),
    DetectionBar("ice.passes.long", "long", mean_of("passes.ice"), SHARE, (0.80, 0.80)),
    DetectionBar(
        "ice.seconds.median",
        "short",
        seconds_of("seconds.ice.braking", 0.5),
        "s",
        (0.20, 0.20),
        "less",
    ),
    DetectionBar(
        "ice.seconds.p90", "short", seconds_of("seconds.ice.braking", 0.9), "s", (0.6, 0.6), "less"
    ),
    DetectionBar(
        "slide.told.short.all_wheels",
        "short",
        mean_of("slide.told.all_wheels"),
        SHARE,
        (0.92, 0.92),
    ),
    DetectionBar(
        "slide.told.short.some_wheels",
        "short",
        mean_of("slide.told.some_wheels"),
        SHARE,
        (0.72, 0.72),
    ),
    DetectionBar(
        "contradiction.per_1000s_slide",
        "",
        rate_of("contradictions.slide", "s.slide"),
        PER_1000_S,
        (10, 10),
        "less",
    ),
    DetectionBar(
        "contradiction.elsewhere",
        "",
        rate_of("contradictions.elsewhere", "s.elsewhere"),
        PER_1000_S,
        (0.3, 0.3),
        "less",
    ),
    DetectionBar("coverage90.ice.short", "short", mean_of("coverage90.ice"), SHARE, (0.86, 0.86)),
    DetectionBar("coverage90.ice.long", "long", mean_of("coverage90.ice"), SHARE, (0.85, 0.85)),
    DetectionBar("coverage90.snow.short", "short", mean_of("coverage90.snow"), SHARE, (0.94, 0.94)),
    DetectionBar("coverage90.wet.short", "short", mean_of("coverage90.wet"), SHARE, (0.92, 0.92)),
    DetectionBar("coverage90.dry.short", "short", mean_of("coverage90.dry"), SHARE, (0.87, 0.87)),
    DetectionBar("false_ice.short", "short", mean_of("false_ice"), SHARE, (0.0015, 0.0015), "less"),
    DetectionBar("false_ice.long", "long", mean_of("false_ice"), SHARE),
    # `off_ice`: only while all wheels are on wet or dry road. The figures without it also count
    # the moments when one axle is on ice and the mean friction of the wheels is high.
    DetectionBar(
        "false_ice.off_ice.short",
        "short",
        mean_of("false_ice.off_ice"),
        SHARE,
        (0.0015, 0.0015),
        "less",
    ),
    DetectionBar("false_ice.off_ice.long", "long", mean_of("false_ice.off_ice"), SHARE),
    DetectionBar(
        "false_events.short", "short", rate_of("false_events", "km"), PER_1000_KM, (70, 70), "less"
    ),
    DetectionBar("false_events.long", "long", rate_of("false_events", "km"), PER_1000_KM),
    DetectionBar(
        "false_events.off_ice.short",
        "short",
        rate_of("false_events.off_ice", "km"),
        PER_1000_KM,
        (70, 70),
        "less",
    ),
    DetectionBar(
        "false_events.off_ice.long", "long", rate_of("false_events.off_ice", "km"), PER_1000_KM
    ),
    DetectionBar("false_grip.short", "short", mean_of("false_grip"), SHARE, (0.05, 0.05), "less"),
    DetectionBar("false_grip.long", "long", mean_of("false_grip"), SHARE, (0.05, 0.05), "less"),
    DetectionBar("false_grip.sure.short", "short", mean_of("false_grip.sure"), SHARE),
    DetectionBar("false_grip.sure.long", "long", mean_of("false_grip.sure"), SHARE),
    DetectionBar("score.ice.long", "long", mean_of("score.ice"), SHARE, (0.62, 0.62), "less"),
    DetectionBar("score.ice.short", "short", mean_of("score.ice"), SHARE),
    DetectionBar("false_visits", "", mean_of("false_visits"), SHARE),
    *_list_shares("short"),
    *_list_shares("long"),
    *_list_comparisons(),
    *_list_times(),
    DetectionBar("flag.false_events", "", rate_of("flag.false_events", "km"), PER_1000_KM),
    *_list_operating_points(),
)


def detection_figures(results: DetectionResults) -> list[Figure]:
    """Return the figures of the detection evaluation, for every entry of the list DETECTION.
    Figures with a target come first, each with its standard error over towns.

    A figure is called `NAME.KIND`, and its standard error `NAME.KIND.se`. NAME is the name in
    DETECTION. KIND is the kind of cars: "rough" (large sensor errors, as in real cars) or "plain"
    (small sensor errors). `NAME.KIND.winter` and `NAME.KIND.other` are the same figure for the
    winter towns and the other towns, if there are both.
    """
    listed = []
    for bar in sorted(DETECTION, key=lambda bar: bar.bars is None):
        for k, kind in enumerate(KINDS):
            lengths = [length for length in LENGTHS if bar.length in ("", length)]
            towns = [town for length in lengths for town in results.towns.get((length, kind), [])]
            if not towns:
                continue
            limit = None if bar.bars is None else bar.bars[k]
            value = bar.read(results.pool_towns(lengths, kind))
            listed.append(Figure(f"{bar.name}.{kind}", value, bar.unit, limit, bar.better))
            if limit is None:
                continue
            each = np.array([bar.read(town.tally) for town in towns])
            each = each[np.isfinite(each)]
            if len(each) > 1:
                error = float(np.std(each, ddof=1) / math.sqrt(len(each)))
                listed.append(Figure(f"{bar.name}.{kind}.se", error, bar.unit))
            if len({town.winter for town in towns}) > 1:
                for name, winter in (("winter", True), ("other", False)):
                    part = bar.read(results.pool_towns(lengths, kind, winter=winter))
                    listed.append(Figure(f"{bar.name}.{kind}.{name}", part, bar.unit))
    return listed
