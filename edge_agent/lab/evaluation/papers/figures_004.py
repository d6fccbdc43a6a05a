"""Plots for paper 004: path, motor torques, states estimated by both filters, fuzzy sets, progress
of the search, and pheromone of the ant colony.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edge_agent.adaptation.lower_vertices import LowerVertices
from edge_agent.adaptation.memberships import Memberships
from edge_agent.dynamics.dual_motor import EFFICIENCY, RATIO, motor_torque
from edge_agent.lab.evaluation.papers.conditions import MATCHED, given_motion
from edge_agent.lab.evaluation.papers.outcome import Curve, Heat, PaperPlot, PlotPanel
from edge_agent.lab.tuning.paper_004_tuning import POSITIONS, PaperTuning
from schemas.numeric import FloatArray
from schemas.signals import S

if TYPE_CHECKING:
    from edge_agent.lab.evaluation.papers.reproduction_004 import NoisyRun

FILTERS: Final = {"FCKF": "comparator", "ACOFCKF": "improved"}


def make_plots(
    constant: NoisyRun, variable: NoisyRun, tuned: Memberships, tuning: PaperTuning
) -> list[PaperPlot]:
    """Return all plots for paper 004 from its two experiments (`constant` and `variable` noise) and
    its tuning. Curves over time show the drive with the first noise seed.
    """
    return [
        _path_plot(constant),
        _torque_plot(constant),
        _state_plot(constant, "constant", "Figures 10 to 13: constant noise"),
        _noisy_ay(variable),
        _state_plot(variable, "variable", "Figures 15 to 18: variable noise on a_y"),
        _set_plot(tuned),
        _lower_vertices(tuning.sets),
        _search_plot(tuning),
        pheromone_plot(tuning),
    ]


def _path_plot(run: NoisyRun) -> PaperPlot:
    truth = run.batch.truth
    line = Curve("", truth["true_x"][:, 0], truth["true_y"][:, 0], "truth")
    return PaperPlot("path", "Figure 8: path", (PlotPanel("", "x [m]", "y [m]", (line,)),))


def _torque_plot(run: NoisyRun) -> PaperPlot:
    t = run.batch.t[:, 0]
    torque = run.batch.signals[:, 0, S.TORQUE : S.TORQUE + 4]
    axles = {"front": torque[:, :2].sum(axis=1), "rear": torque[:, 2:].sum(axis=1)}
    motors = tuple(
        Curve(name, t, np.array([motor_torque(float(value), RATIO, EFFICIENCY) for value in total]))
        for name, total in axles.items()
    )
    force = given_motion(run.batch, MATCHED["004.dlc"].vehicle).wheel_forces()
    forces = (
        Curve("front", t, force[:, :2].sum(axis=1)),
        Curve("rear", t, force[:, 2:].sum(axis=1)),
    )
    panels = (
        PlotPanel("motors", "t [s]", "torque [N·m]", motors),
        PlotPanel("axles", "t [s]", "F_x [N]", forces),
    )
    return PaperPlot(
        "torques", "Figure 9: torque of the front and rear motor, and the axles' force", panels
    )


def _state_plot(run: NoisyRun, name: str, title: str) -> PaperPlot:
    truth = run.batch.truth
    t = run.batch.t[:, 0]
    beta = np.arctan2(truth["true_vy"], truth["true_vx"])[:, 0]
    quantities = (
        ("v_x [m/s]", truth["true_vx"][:, 0], "vx", None),
        ("v_y [m/s]", truth["true_vy"][:, 0], "vy", None),
        ("yaw rate [rad/s]", truth["true_yaw_rate"][:, 0], "yaw_rate", None),
        ("sideslip β [rad]", beta, "sideslip", None),
        ("μ", run.batch.mu[:, 0], "mu", (0.75, 0.95)),
    )
    panels = []
    for label, true, column, limits in quantities:
        lines = tuple(
            Curve(each, t, getattr(run.reported[each], column)[:, 0], kind)
            for each, kind in FILTERS.items()
        )
        panels.append(
            PlotPanel("", "t [s]", label, (Curve("true", t, true, "truth"), *lines), limits)
        )
    adapted = tuple(
        Curve(each, t, run.reported[each].adaptation[:, 0], kind) for each, kind in FILTERS.items()
    )
    panels.append(PlotPanel("", "t [s]", "largest factor on R", adapted))
    for label, column in (("error of v_y [m/s]", "vy"), ("error of yaw rate [rad/s]", "yaw_rate")):
        errors = tuple(
            Curve(each, t, (getattr(run.reported[each], column) - truth[f"true_{column}"])[:, 0], k)
            for each, k in FILTERS.items()
        )
        panels.append(PlotPanel("", "t [s]", label, errors))
    return PaperPlot(f"states-{name}", title, tuple(panels), 2)


def _noisy_ay(run: NoisyRun) -> PaperPlot:
    t = run.batch.t[:, 0]
    curves = (
        Curve("measured", t, run.batch.signals[:, 0, S.AY], "comparator"),
        Curve("true", t, run.batch.truth["true_ay"][:, 0], "truth"),
    )
    panel = PlotPanel("", "t [s]", "a_y [m/s²]", curves)
    return PaperPlot("noisy-ay", "Figure 14: lateral acceleration with variable noise", (panel,))


def _set_plot(tuned: Memberships) -> PaperPlot:
    panels = []
    for title, sets in (("before", Memberships()), ("after", tuned)):
        for label, peaks in (("mismatch [1]", sets.inputs), ("step of ln R [1]", sets.outputs)):
            at = np.asarray(peaks)
            curves = tuple(
                Curve(f"peak {peak:.2g}", at, np.eye(len(at))[k]) for k, peak in enumerate(peaks)
            )
            panels.append(PlotPanel(title, label, "membership [1]", curves))
    return PaperPlot(
        "memberships",
        "Figures 2, 3, 6, 7: fuzzy sets before and after tuning, as shipped",
        tuple(panels),
        2,
    )


def _lower_vertices(tuned: LowerVertices) -> PaperPlot:
    panels = []
    for title, sets in (("before", LowerVertices()), ("after", tuned)):
        for label, triangles in zip(
            ("mismatch [1]", "step of ln R [1]"), sets.triangle_sets(), strict=True
        ):
            curves = tuple(
                Curve(
                    "",
                    triangle,
                    np.array([0.0, 1.0, 0.0]) if k not in (0, 4) else _shoulder_values(k),
                )
                for k, triangle in enumerate(triangles)
            )
            panels.append(PlotPanel(title, label, "membership [1]", curves))
    title = "Lower vertices before and after the colony, on the likelihood"
    return PaperPlot("lower-vertices", title, tuple(panels), 2)


def _shoulder_values(k: int) -> FloatArray:
    """Return the fuzzy membership (degree, 0 to 1) at the left foot, peak and right foot of fuzzy
    set k. The first and last set are shoulders, whose outer foot has membership 1.
    """
    return np.array([1.0, 1.0, 0.0]) if k == 0 else np.array([0.0, 1.0, 1.0])


def _search_plot(tuning: PaperTuning) -> PaperPlot:
    history = tuning.result.history
    at = np.array([line.iteration for line in history], float)
    curves = (
        Curve("best so far", at, np.array([line.best for line in history]), "improved"),
        Curve("mean of the iteration", at, np.array([line.mean for line in history]), "comparator"),
    )
    panel = PlotPanel("", "iteration", "log-likelihood [nat per sample]", curves)
    return PaperPlot("search", "Best objective of the colony over its iterations", (panel,))


def pheromone_plot(tuning: PaperTuning) -> PaperPlot:
    """Return the plot of the pheromone as a colour map. One axis shows the vertices (corners of the
    fuzzy sets), the other their positions (possible values). Pheromone is the colony's learned
    preference for a value.
    """
    count = len(tuning.pheromone)
    ticks = tuple(f"{'e' if k < count // 2 else 'n'} {k % (count // 2) + 1}" for k in range(count))
    label = "position of the vertex: " + ", ".join(f"{value:g}" for value in POSITIONS)
    heat = Heat("", label, "lower vertex", tuning.pheromone, ticks, "pheromone [1]")
    return PaperPlot("pheromone", "Pheromone (32) after the last iteration", (heat,))
