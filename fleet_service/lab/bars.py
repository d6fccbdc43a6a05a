"""Targets (required limits) for the figures of the evaluation. A figure that was not measured
misses its target.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final, Literal, NamedTuple

from schemas.runtime.figures import Figure

Side = Literal["less", "more", "within"]


class MapBar(NamedTuple):
    """Target (limit) for a figure of the map's evaluation.

    Attributes:
        bar: the limit, or two limits; None if the figure is listed but not judged.
        better: side of the limit on which the figure meets the target, or `within` two limits.
        unit: unit of the figure.
    """

    bar: float | tuple[float, float] | None
    better: Side
    unit: str


# classes of cells by their number of excited vehicles; each extends to the next number
COUNTS: Final = (1, 2, 3, 5, 10, 30)
ATTACKS: Final = ("replayed", "random", "shifted_pose", "flood_one_cell", "newcomers")
# Percentages of excited visits, on the changing road of another maker's fleet.
EXCITED: Final = (10, 30, 100)
_ICE: Final = "excited passes over new ice"
_SHARE: Final = "of cells and snapshots"
_MINUTES: Final = "of cell-minutes"

BARS: Final[dict[str, MapBar]] = {
    "fusion.clean.rmse": MapBar(0.05, "less", "cells with 3 or more excited vehicles"),
    "fusion.clean.coverage90": MapBar((0.87, 0.95), "within", _SHARE),
    **{f"fusion.clean.coverage90.n{n}": MapBar((0.87, 0.95), "within", _SHARE) for n in COUNTS},
    "fusion.clean.width.n1": MapBar(
        0.45, "less", "of the interval, one excited vehicle with a record"
    ),
    "fusion.clean.width.n3": MapBar(0.28, "less", "of the interval, three or four"),
    **{
        f"fusion.clean.vs_best_rule.n{n}": MapBar(1, "less", "ratio of interval scores")
        for n in COUNTS
    },
    "fusion.resampled.coverage90": MapBar((0.87, 0.95), "within", _SHARE),
    **{f"fusion.resampled.coverage90.n{n}": MapBar((0.87, 0.95), "within", _SHARE) for n in COUNTS},
    **{
        f"fusion.resampled.vs_best_rule.n{n}": MapBar(1, "less", "ratio of interval scores")
        for n in COUNTS
    },
    "fusion.shared10.coverage90.n30": MapBar(0.85, "more", _SHARE),
    "fusion.moderate.coverage90.n30": MapBar(0.85, "more", _SHARE),
    "fusion.winter.coverage90.n10": MapBar(0.85, "more", _SHARE),
    "fusion.reliability.ece": MapBar(
        0.045, "less", "calibration error of P(slippery), worst fleet"
    ),
    "fusion.third_party.coverage90": MapBar(0.90, "more", "of cells, a fleet of another maker"),
    "fusion.third_party.false_grip": MapBar(0.03, "less", "of cells: truth below the interval"),
    "fusion.third_party.rmse": MapBar(0.05, "less", "all cells"),
    "fusion.third_party.missed_ice": MapBar(0.03, "less", "of icy cells: no alert"),
    "fusion.third_party.false_ice": MapBar(0.002, "less", "of cells above .45: an alert"),
    "fusion.third_party.gain_common.coverage90": MapBar(
        0.88, "more", "of cells, gain errors of 10 %"
    ),
    "fusion.third_party.gain_common.false_grip": MapBar(
        0.05, "less", "of cells, gain errors of 10 %"
    ),
    **{
        f"fusion.third_party.raise.excited_passes.median.e{e}": MapBar(4, "less", _ICE)
        for e in EXCITED
    },
    **{
        f"fusion.third_party.raise.excited_passes.p95.e{e}": MapBar(8, "less", _ICE)
        for e in EXCITED
    },
    **{
        f"fusion.third_party.raise.never.e{e}": MapBar(0, "less", "cells without an alert")
        for e in EXCITED
    },
    "fusion.cold.ice_passes.median": MapBar(
        2, "less", "passes, a service that knows no vehicle yet"
    ),
    "fusion.cold.ice_passes.p90": MapBar(4, "less", "passes, a service that knows no vehicle yet"),
    "fusion.value.known.r20": MapBar(
        0.50, "more", "of road-hours: 90 % interval below .3, 20 cars an hour"
    ),
    "fusion.value.alert.precision.r20": MapBar(0.90, "more", "of cell-minutes under alert"),
    "fusion.value.alert.recall.r20": MapBar(0.95, "more", "of slippery cell-minutes"),
    "fusion.value.alert.recall.ice.r20": MapBar(0.95, "more", "of icy cell-minutes"),
    "fusion.value.unnoticed.r5": MapBar(20, "less", "min, median, 5 cars an hour"),
    "fusion.value.unnoticed.ice.r5": MapBar(20, "less", "min of ice, median, 5 cars an hour"),
    "fusion.demand.slippery.grip_raised": MapBar(
        0.05, "less", "of cells with grip on gentle roads: P(slippery) > .5"
    ),
    "fusion.same_manoeuvre.false_alerts": MapBar(1, "less", "of 20 fleets on a wet curve"),
    "fusion.bounds.lower_excess": MapBar(0.05, "less", "lower end above the grip used"),
    "fusion.backlog.fused": MapBar(0.95, "more", "of an hour's rows"),
    "fusion.gentle_after_dry.safe_excess": MapBar(0, "less", "m/s^2 above the true limit"),
    "fusion.ice_onset.passes.median": MapBar(2, "less", "excited passes"),
    "fusion.ice_onset.passes.p95": MapBar(4, "less", "excited passes"),
    "fusion.ice_end.passes.median": MapBar(8, "less", "excited passes"),
    "fusion.ice_end.passes.p95": MapBar(15, "less", "excited passes"),
    "fusion.false_ice.clean": MapBar(0.001, "less", _MINUTES),
    "fusion.false_ice.mis05": MapBar(0.005, "less", _MINUTES),
    "fusion.false_ice.mis15": MapBar(0.01, "less", _MINUTES),
    "fusion.missed_ice.mis15": MapBar(0.02, "less", _MINUTES),
    "fusion.mis15.rmse": MapBar(0.07, "less", "cells with 3 or more excited vehicles"),
    "fusion.mis15.coverage90": MapBar(0.85, "more", _SHARE),
    "fusion.mis30_colluding.coverage90": MapBar(0.85, "more", _SHARE),
    **{
        f"fusion.attack.{name}": MapBar(0, "less", "alerts raised or suppressed")
        for name in ATTACKS
    },
    "fusion.unexcited.upper_shift": MapBar(0.02, "less", ""),
    "fusion.order.max_difference": MapBar(1e-6, "less", "probability"),
    "fusion.replay.max_difference": MapBar(1e-6, "less", "probability"),
    "fusion.whole_way.ways": MapBar(10, "more", "independent ways"),
    **{
        f"fusion.whole_way.rmse.after{m}": MapBar(0.085, "less", "measured cells, mean of ways")
        for m in (6, 30)
    },
    **{
        f"fusion.whole_way.rmse.after{m}.worst": MapBar(0.095, "less", "measured cells, worst way")
        for m in (6, 30)
    },
    **{
        f"fusion.whole_way.coverage90.measured.after{m}": MapBar(
            (0.88, 0.95), "within", "measured cells, mean"
        )
        for m in (1, 6, 30)
    },
    "fusion.whole_way.crps": MapBar(0.058, "less", "all cells, 30 minutes"),
    "fusion.whole_way.slippery.brier": MapBar(0.047, "less", "P(slippery), all cells, 30 minutes"),
    "fusion.whole_way.slippery.ece": MapBar(0.045, "less", "P(slippery), ten bins, all ways"),
    "fusion.whole_way.slippery.missed": MapBar(0.08, "less", "of slippery cells: P(slippery) < .3"),
    "fusion.whole_way.slippery.grip_raised": MapBar(
        0.05, "less", "of cells with grip: P(slippery) > .5"
    ),
    "fusion.resampled.coverage90.ice": MapBar(0.82, "more", _SHARE),
    "fusion.whole_way.level.coverage90": MapBar((0.85, 0.97), "within", _SHARE),
    "fusion.whole_way.level.rmse": MapBar(0.08, "less", "measured cells"),
    "fusion.whole_way.hills.coverage90": MapBar((0.85, 0.97), "within", _SHARE),
    "fusion.whole_way.hills.false_ice": MapBar(0, "less", "alerts on wet and dry road"),
    "fusion.mis15.vs_best_rule": MapBar(0.5, "less", "ratio of interval scores"),
}


def judge_figures(measured: Mapping[str, float]) -> list[Figure]:
    """Return all figures that have an entry in BARS, with NaN if not measured, followed by all
    other measured figures.
    """
    named = [
        Figure(name, measured.get(name, math.nan), bar.unit, bar.bar, bar.better)
        for name, bar in BARS.items()
    ]
    return named + [Figure(name, value, "") for name, value in measured.items() if name not in BARS]
