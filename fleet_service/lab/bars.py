"""The figures of the campaign with their bars, and how measured values become figures. A missing name is a failure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final, Literal, NamedTuple

from schemas.runtime.figures import Figure

Side = Literal["less", "more", "within"]


class Bar(NamedTuple):
    """What a figure is held against; `bar` None is shown only."""

    bar: float | tuple[float, float] | None
    better: Side
    unit: str


COUNTS: Final = (1, 2, 3, 5, 10, 30)  # excited vehicles per cell; each class reaches to the next
ATTACKS: Final = ("replayed", "random", "shifted_pose", "flood_one_cell", "newcomers")
_SHARE: Final = "of cells and snapshots"
_MINUTES: Final = "of cell-minutes"

BARS: Final[dict[str, Bar]] = {
    "fusion.clean.rmse": Bar(0.05, "less", "cells with 3 or more excited vehicles"),
    "fusion.clean.coverage90": Bar((0.87, 0.95), "within", _SHARE),
    **{f"fusion.clean.coverage90.n{n}": Bar(0.86, "more", _SHARE) for n in COUNTS},
    "fusion.ice_onset.passes.median": Bar(3, "less", "excited passes"),
    "fusion.ice_onset.passes.p95": Bar(6, "less", "excited passes"),
    "fusion.ice_end.passes.median": Bar(8, "less", "excited passes"),
    "fusion.ice_end.passes.p95": Bar(15, "less", "excited passes"),
    "fusion.false_ice.clean": Bar(0.001, "less", _MINUTES),
    "fusion.false_ice.mis05": Bar(0.005, "less", _MINUTES),
    "fusion.false_ice.mis15": Bar(0.01, "less", _MINUTES),
    "fusion.missed_ice.mis15": Bar(0.02, "less", _MINUTES),
    "fusion.mis15.rmse": Bar(0.07, "less", "cells with 3 or more excited vehicles"),
    "fusion.mis15.coverage90": Bar(0.85, "more", _SHARE),
    "fusion.mis30_colluding.coverage90": Bar(0.80, "more", _SHARE),
    **{f"fusion.attack.{name}": Bar(0, "less", "alerts raised or suppressed") for name in ATTACKS},
    "fusion.unexcited.upper_shift": Bar(0.02, "less", ""),
    "fusion.order.max_difference": Bar(1e-6, "less", "probability"),
    "fusion.replay.max_difference": Bar(1e-6, "less", "probability"),
    "fusion.whole_way.coverage90": Bar((0.85, 0.97), "within", _SHARE),
    "fusion.whole_way.rmse": Bar(0.08, "less", "measured cells"),
    "fusion.whole_way.hills.coverage90": Bar((0.85, 0.97), "within", _SHARE),
    "fusion.whole_way.hills.false_ice": Bar(0, "less", "alerts on wet and dry road"),
    "fusion.vs_best_rule.clean": Bar(1, "less", "ratio of interval scores"),
    "fusion.vs_best_rule.mis15": Bar(1, "less", "ratio of interval scores"),
}


def judged(measured: Mapping[str, float]) -> list[Figure]:
    """Every figure that has a bar, NaN where it was not measured; then those that are only shown."""
    named = [
        Figure(name, measured.get(name, math.nan), bar.unit, bar.bar, bar.better) for name, bar in BARS.items()
    ]  # fmt: skip
    return named + [Figure(name, value, "") for name, value in measured.items() if name not in BARS]
