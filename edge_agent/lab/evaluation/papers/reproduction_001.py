"""Reproduction of paper 001 on its five drives: the adaptive fuzzy federated filter, and the filter
FKF with which the paper compares it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from edge_agent.adaptation.rules import ALPHA, RATE
from edge_agent.estimators import Estimates, adaptive_federated_ckf
from edge_agent.estimators.adaptive_federated_ckf import AS_PRINTED, FKF, AdaptiveSetting
from edge_agent.estimators.common.tyre_option import TyreOption
from edge_agent.lab.evaluation.batch import DriveSet, DriveSpec, run_estimator, simulate_ideal
from edge_agent.lab.evaluation.papers.columns import mean_measures, with_sensors
from edge_agent.lab.evaluation.papers.conditions import MATCHED
from edge_agent.lab.evaluation.papers.outcome import (
    NONE,
    Curve,
    PaperPlot,
    PaperRow,
    PaperTable,
    PlotPanel,
    Reproduction,
    Values,
)
from edge_agent.lab.evaluation.scenarios import PAPERS

SCENARIO: Final = "001.dlc"
ESTIMATOR: Final = "adaptive-federated-ckf"
PRINTED: Final = {
    "mae": {"vx": (0.0009, 0.0050), "vy": (0.0024, 0.0274), "beta": (0.0002, 0.0025)},
    "rmse": {"vx": (0.0012, 0.0063), "vy": (0.0040, 0.0572), "beta": (0.0004, 0.0051)},
}
NAMES: Final = {"vx": "v_x [m/s]", "vy": "v_y [m/s]", "beta": "β [rad]"}
DRIVES: Final = {
    "001.dlc": "Figure 7: double lane change, 40 km/h, μ .85",
    "001.sine": "Figure 8: sine steering, 70 km/h, μ .5",
    "001.slalom": "Figure 9: slalom, 30 km/h, μ .3",
    "001.gaining.dlc": "Figure 10: lane changes while gaining speed, μ .9",
    "001.gaining.slalom": "Figure 11: slalom while gaining speed, μ .9",
}
# Coefficient e of the stiffness polynomial (14): as degressive as ordinary tyres.
QUADRATIC: Final = 0.15


@dataclass(frozen=True)
class MotionRun:
    """One drive with error-free sensors, and the estimates of the paper's improved filter and of
    FKF, the filter for comparison.
    """

    batch: DriveSet
    reported: dict[str, Estimates]

    def values(self, name: str) -> Values:
        """Return the measures (such as errors) of the estimates by the filter called `name`."""
        return mean_measures(self.batch, self.reported[name])


def run_drive(spec: DriveSpec, settings: dict[str, AdaptiveSetting]) -> MotionRun:
    """Simulate a drive with error-free sensors, and run the filters, one per entry of `settings`,
    on it. Each starts with the true friction.
    """
    batch = simulate_ideal(spec)
    friction = float(batch.mu[0, 0])
    reported = {
        name: run_estimator(
            adaptive_federated_ckf.make_bank(batch.vehicles, friction, setting), batch
        )
        for name, setting in settings.items()
    }
    return MotionRun(batch, reported)


BOTH: Final = {"improved": AdaptiveSetting(), "FKF": FKF}


def reproduce(seeds: Sequence[int]) -> Reproduction:
    """Run all drives of paper 001, and return the tables and plots of the reproduction. `seeds` are
    the seeds of the drives with ordinary sensors.
    """
    done = Reproduction(
        "001", "Adaptive fuzzy federated cubature filter", adaptive_federated_ckf.ELEMENTS
    )
    drives = {name: run_drive(MATCHED[name], BOTH) for name in DRIVES}
    own = run_drive(PAPERS[SCENARIO], BOTH)
    real, default = with_sensors(SCENARIO, ESTIMATOR, seeds)
    matched = drives[SCENARIO]
    done.tables = [
        PaperTable(
            "Table 3: double lane change, improved filter",
            _table_rows("improved", matched, own, real, default),
        ),
        PaperTable(
            "Table 3: double lane change, comparator FKF", _table_rows("FKF", matched, own, {}, {})
        ),
        PaperTable("Comparison of v_y with the estimate 0", _lateral_rows(matched)),
        PaperTable("Options of the filter", _option_rows()),
        PaperTable("The five drives, improved filter and FKF", _all_drives(drives)),
    ]
    done.plots = [*(_state_plot(name, drives[name]) for name in DRIVES), _set_plot()]
    done.notes = list(NOTES)
    return done


NOTES: Final = (
    (
        "With the rear wheels steered as (53) says, v_y is almost nothing: 'always zero' has an "
        "error of .0059, below that of the paper's FKF (.0274) and twice that of its improved "
        "filter. Only the rows on a car whose rear wheels do not steer test v_y."
    ),
    (
        "The paper's gap between FKF and improved filter in v_x comes from drag: on the "
        "simulator's own plant, which has drag, FKF is wrong by .0060 and the improved filter by "
        ".0012 (printed .0050 and .0009). On the matched plant R is correct, and both filters are "
        "equally good."
    ),
    "The gap in v_y and β is not reproduced.",
    (
        "Friction is set by hand in the paper and here. On realistic drives it is set to .85, the "
        "true value there."
    ),
    "β is printed in degrees; the β that follows from the printed v_y is in radians.",
)


def _table_rows(
    name: str, matched: MotionRun, own: MotionRun, real: Values, default: Values
) -> tuple[PaperRow, ...]:
    rows = []
    place = 0 if name == "improved" else 1
    prefix = "" if name == "improved" else "fkf."
    matched_values = matched.values(name)
    own_values = own.values(name)
    for measure, printed in PRINTED.items():
        for key, numbers in printed.items():
            full = f"{measure}_{key}"
            rows.append(
                PaperRow(
                    f"{prefix}{full}",
                    f"{measure.upper()} {NAMES[key]}",
                    numbers[place],
                    matched_values[full],
                    own_values[full],
                    real.get(full, NONE),
                    default.get(full, NONE),
                )
            )
    return tuple(rows)


def _lateral_rows(matched: MotionRun) -> tuple[PaperRow, ...]:
    front = run_drive(MATCHED["001.dlc.front"], BOTH)
    rows = []
    for name, what, run in (
        ("steered", "rear wheels steered by (53)", matched),
        ("front", "rear wheels do not steer", front),
    ):
        still = float(np.abs(run.batch.truth["true_vy"]).mean())
        rows.append(
            PaperRow(f"{name}.zero.mae_vy", f'{what}: "always zero", MAE v_y [m/s]', NONE, still)
        )
        for filter_name in BOTH:
            error = run.values(filter_name)["mae_vy"]
            bar = 0.0024 if name == "front" and filter_name == "improved" else None
            label = f"{what}: {filter_name}, MAE v_y [m/s]"
            rows.append(
                PaperRow(f"{name}.{filter_name.lower()}.mae_vy", label, NONE, error, bar=bar)
            )
    return tuple(rows)


def _option_rows() -> tuple[PaperRow, ...]:
    spec = MATCHED[SCENARIO]
    bent = replace(spec, vehicle=replace(spec.vehicle, degression=QUADRATIC))
    polynomial = AdaptiveSetting(tyre=TyreOption(quadratic=QUADRATIC))
    runs = {
        "printed": ("Q, R of section 4.3, no wheel speed", run_drive(spec, {"it": AS_PRINTED})),
        "polynomial": (
            "stiffness polynomial (14), in plant and filter",
            run_drive(bent, {"it": polynomial}),
        ),
        "proportional_to_load": (
            "polynomial in the plant alone",
            run_drive(bent, {"it": AdaptiveSetting()}),
        ),
    }
    return tuple(
        PaperRow(
            f"{name}.mae_{key}",
            f"{what}: MAE {NAMES[key]}",
            PRINTED["mae"][key][0],
            run.values("it")[f"mae_{key}"],
            bar=NONE,
        )
        for name, (what, run) in runs.items()
        for key in NAMES
    )


def _all_drives(drives: dict[str, MotionRun]) -> tuple[PaperRow, ...]:
    rows = []
    for name, run in drives.items():
        for filter_name in BOTH:
            found = run.values(filter_name)
            rows += [
                PaperRow(
                    f"{name.removeprefix('001.')}.{filter_name.lower()}.mae_{key}",
                    f"{PAPERS[name].about}, {filter_name}: MAE {NAMES[key]}",
                    NONE,
                    found[f"mae_{key}"],
                )
                for key in NAMES
            ]
    return tuple(rows)


def _state_plot(name: str, run: MotionRun) -> PaperPlot:
    truth = run.batch.truth
    t = run.batch.t[:, 0]
    beta = np.arctan2(truth["true_vy"], np.maximum(truth["true_vx"], 1.0))[:, 0]
    quantities = (
        ("v_x [m/s]", truth["true_vx"][:, 0], "vx"),
        ("v_y [m/s]", truth["true_vy"][:, 0], "vy"),
        ("sideslip β [rad]", beta, "sideslip"),
    )
    panels = []
    for label, true, column in quantities:
        lines = (
            Curve("FKF", t, getattr(run.reported["FKF"], column)[:, 0], "comparator"),
            Curve("improved", t, getattr(run.reported["improved"], column)[:, 0], "improved"),
        )
        panels.append(PlotPanel("", "t [s]", label, (Curve("true", t, true, "truth"), *lines)))
    off = run.batch.truth["true_vy"][:, 0]
    errors = tuple(
        Curve(f"v_y, {each}", t, run.reported[each].vy[:, 0] - off, kind)
        for each, kind in (("FKF", "comparator"), ("improved", "improved"))
    )
    panels.append(PlotPanel("", "t [s]", "error [m/s]", errors))
    return PaperPlot(f"states-{name.removeprefix('001.')}", DRIVES[name], tuple(panels))


def _set_plot() -> PaperPlot:
    panels = []
    for title, label, peaks in (
        ("Figure 3: sets of the mismatch", "α [1]", ALPHA),
        ("Figure 4: sets of its rate", "rate of α [1/s]", RATE),
    ):
        curves = tuple(
            Curve(f"{peak:g}", peaks, np.eye(len(peaks))[k]) for k, peak in enumerate(peaks)
        )
        panels.append(PlotPanel(title, label, "membership [1]", curves))
    return PaperPlot("memberships", "Fuzzy sets of the rules", tuple(panels), 2)
