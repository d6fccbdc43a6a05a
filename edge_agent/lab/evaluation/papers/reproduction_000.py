"""Reproduction of paper 000: federated filters for motion and friction, on two lane changes during
which friction changes from .5 to .3. The friction filter is implemented as printed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from edge_agent.estimators import Estimates, federated_ckf
from edge_agent.estimators.common.tyre_option import PROPORTIONAL
from edge_agent.estimators.literal.federated_friction import AS_PRINTED, FederatedSetting, estimate
from edge_agent.lab.evaluation.batch import DriveSet, DriveSpec, simulate_ideal
from edge_agent.lab.evaluation.papers.columns import mean_measures, with_sensors, without_noise
from edge_agent.lab.evaluation.papers.conditions import MATCHED, given_motion
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
from schemas.numeric import FloatArray
from schemas.signals import S, per_wheel

SCENARIO: Final = "000.jump"
ESTIMATOR: Final = "federated-ckf"
NEAR: Final = 0.1


def seconds_near(batch: DriveSet, mu: FloatArray) -> tuple[float, float]:
    """Return two durations [s] until the estimated mean friction `mu` (T,) is within NEAR of the
    true friction, which changes once during the drive.

    The first duration counts from the start of the drive. If the estimate does not come so near
    before the change, it is the time from the start to the change. The second duration counts from
    the change. If the estimate does not come so near, it is the time from the change to the end.
    """
    t = batch.t[:, 0]
    truth = batch.mu[:, 0]
    near = np.abs(mu - truth) <= NEAR
    change = int(np.argmax(truth == truth[-1]))
    found = []
    for first, last in ((0, change), (change, len(t))):
        part = near[first:last]
        at = int(np.argmax(part)) if part.any() else len(part) - 1
        found.append(float(t[first + at] - t[first]))
    return found[0], found[1]


def _run_friction(spec: DriveSpec, setting: FederatedSetting) -> tuple[DriveSet, FloatArray]:
    """Simulate a drive, and run the printed friction filter on it with the true motion as input.
    Return the drive and the estimated friction of the wheels (T, 4).
    """
    batch = simulate_ideal(spec)
    return batch, estimate(given_motion(batch, spec.vehicle), setting).mu


def reproduce(seeds: Sequence[int]) -> Reproduction:
    """Run the experiment of paper 000, and return the tables and plots of the reproduction. `seeds`
    are the seeds of the drives with ordinary sensors.
    """
    done = Reproduction(
        "000", "Joint federated cubature filters for motion and friction", federated_ckf.ELEMENTS
    )
    batch, mu = _run_friction(MATCHED[SCENARIO], AS_PRINTED)
    joint_batch, joint = without_noise(
        MATCHED[SCENARIO], lambda vehicles: federated_ckf.make_bank(vehicles, PROPORTIONAL)
    )
    done.tables = [
        _printed_filter_table(batch, mu),
        _joint_filter_table(mean_measures(joint_batch, joint), seeds),
    ]
    done.plots = [_state_plot(batch, mu, joint), _signal_plot(batch), _path_plot(batch)]
    done.notes = list(NOTES)
    return done


def _printed_filter_table(batch: DriveSet, mu: FloatArray) -> PaperTable:
    """Return the table about the friction filter as printed. `mu` (T, 4) is its estimate for the
    drive with matched conditions, `batch`.
    """
    first, after = seconds_near(batch, mu.mean(axis=1))
    own_batch, own_mu = _run_friction(PAPERS[SCENARIO], AS_PRINTED)
    own_first, own_after = seconds_near(own_batch, own_mu.mean(axis=1))
    similar_batch, similar_mu = _run_friction(
        MATCHED["000.jump.similarity"], AS_PRINTED._replace(proportional=False)
    )
    _, similar_after = seconds_near(similar_batch, similar_mu.mean(axis=1))
    return PaperTable(
        "Figure 5(d): friction filter as printed, motion given",
        (
            PaperRow(
                "seconds_to_within_0.1",
                "from the start to μ within .1 [s]",
                3.0,
                first,
                own_first,
                bar=3.2,
                shown="about 3",
            ),
            PaperRow(
                "seconds_after_the_change",
                "from the change to μ within .1 [s]",
                NONE,
                after,
                own_after,
                bar=3.0,
                shown="a short time",
            ),
            PaperRow(
                "similarity.mae_mu",
                "stiffness does not depend on μ, in plant and filter: MAE μ",
                NONE,
                float(np.abs(similar_mu.mean(axis=1) - similar_batch.mu[:, 0]).mean()),
            ),
            PaperRow(
                "similarity.seconds_after_the_change",
                "stiffness does not depend on μ, from the change to μ within .1 [s]",
                NONE,
                similar_after,
            ),
        ),
    )


def _joint_filter_table(matched: Values, seeds: Sequence[int]) -> PaperTable:
    """Return the table about the project's joint filter. `matched` has its mean errors under
    matched conditions; `seeds` are the seeds of the drives with ordinary sensors.
    """
    own = mean_measures(*without_noise(PAPERS[SCENARIO], federated_ckf.make_bank))
    real, default = with_sensors(SCENARIO, ESTIMATOR, seeds)
    return PaperTable(
        "Joint filter of the project with the printed tyre",
        (
            PaperRow(
                "coverage90",
                "coverage of the 90 % interval of μ",
                NONE,
                matched["coverage90"],
                own["coverage90"],
                real["coverage90"],
                default["coverage90"],
                bar=0.88,
                better="more",
            ),
            *(
                PaperRow(
                    f"mae_{key}",
                    f"MAE {name}",
                    NONE,
                    matched[f"mae_{key}"],
                    own[f"mae_{key}"],
                    real[f"mae_{key}"],
                    default[f"mae_{key}"],
                )
                for name, key in (
                    ("μ", "mu"),
                    ("v_x [m/s]", "vx"),
                    ("v_y [m/s]", "vy"),
                    ("β [rad]", "beta"),
                )
            ),
        ),
    )


def _state_plot(batch: DriveSet, mu: FloatArray, joint: Estimates) -> PaperPlot:
    """Return the plot of the motion estimated by the joint filter, and of the friction `mu` (T, 4)
    estimated by the printed filter.
    """
    truth = batch.truth
    t = batch.t[:, 0]
    beta = np.arctan2(truth["true_vy"], truth["true_vx"])[:, 0]
    states = (
        ("(a)", "v_x [m/s]", truth["true_vx"][:, 0], joint.vx[:, 0]),
        ("(b)", "v_y [m/s]", truth["true_vy"][:, 0], joint.vy[:, 0]),
        ("(c)", "sideslip β [rad]", beta, joint.sideslip[:, 0]),
    )
    panels = [
        PlotPanel(
            part,
            "t [s]",
            label,
            (Curve("true", t, true, "truth"), Curve("joint filter", t, found, "improved")),
        )
        for part, label, true, found in states
    ]
    wheels = tuple(
        Curve(f"wheel {place.removeprefix('_')}", t, mu[:, wheel])
        for wheel, place in enumerate(per_wheel(""))
    )
    true_mu = Curve("true, mean", t, batch.mu[:, 0], "truth")
    panels.append(PlotPanel("(d) as printed", "t [s]", "μ", (true_mu, *wheels), (0.0, 1.2)))
    return PaperPlot(
        "states",
        "Figure 5: motion by the joint filter, friction by the printed filter",
        tuple(panels),
        2,
    )


NOTES: Final = (
    (
        "With slip stiffness proportional to μ the printed Q = I, R = 10⁴·diag(.009, 1, 1) "
        'and μ₀ = 1 are a sensible tuning: "about 3 s" is the moment at which the first lane '
        "change begins."
    ),
    (
        "With stiffness that does not depend on μ the same numbers give no information about μ: "
        "at 30 km/h about half of the grip is used, and a calibrated interval stays wide."
    ),
    (
        "The printed friction filter is given the true motion. Together with the printed motion "
        "filter (P = Q = 100·I) the speed diverges, so the joint row uses the project's motion "
        "filter."
    ),
    ("The paper prints no error. Its rows without a printed number are shown for comparison."),
)


def _signal_plot(batch: DriveSet) -> PaperPlot:
    t = batch.t[:, 0]
    signals = batch.signals[:, 0]
    groups = (
        ("(a)", "a_x [m/s²]", S.AX, 1),
        ("(b)", "a_y [m/s²]", S.AY, 1),
        ("(c)", "yaw rate [rad/s]", S.YAW_RATE, 1),
        ("(d)", "wheel angle [rad]", S.DELTA, 4),
        ("(e)", "wheel speed [rad/s]", S.OMEGA, 4),
        ("(f)", "torque [N·m]", S.TORQUE, 4),
    )
    places = [place.removeprefix("_") for place in per_wheel("")]
    panels = tuple(
        PlotPanel(
            part,
            "t [s]",
            label,
            tuple(
                Curve(places[k] if count > 1 else "", t, signals[:, first + k])
                for k in range(count)
            ),
        )
        for part, label, first, count in groups
    )
    return PaperPlot("signals", "Figure 4: signals of the sensors", panels, 2)


def _path_plot(batch: DriveSet) -> PaperPlot:
    line = Curve("", batch.truth["true_x"][:, 0], batch.truth["true_y"][:, 0], "truth")
    return PaperPlot("path", "Path of the car", (PlotPanel("", "x [m]", "y [m]", (line,)),))
