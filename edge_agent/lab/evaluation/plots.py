"""Plots as in the papers, of the first seed: motion against truth, friction with its band, adaptation, fuzzy sets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app.tuned_memberships import shipped
from edge_agent.estimators import TUNED
from edge_agent.lab.evaluation.campaign import DEFAULT, Drive, Results
from edge_agent.lab.evaluation.measures import bounds, nees
from schemas.runtime.figures import Figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw(results: Results, figures: Sequence[Figure], folder: Path) -> list[Path]:
    """Write the plots (PNG) into `folder`; returns their paths."""
    import matplotlib as mpl

    mpl.use("Agg")
    written = []
    for scenario in sorted({scenario for scenario, _ in results.drives}):
        drives = {name: drive for (of, name), drive in results.drives.items() if of == scenario}
        written.append(_scenario(scenario, drives, folder / f"{scenario}.png"))
    return [
        *written,
        _memberships(folder / "memberships.png"),
        _reliability(figures, folder / "reliability.png"),
        _consistency(figures, folder / "consistency.png"),
    ]


def _scenario(scenario: str, drives: dict[str, Drive], path: Path) -> Path:
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(6, 1, figsize=(9, 14), sharex=True, layout="constrained")
    first = next(iter(drives.values()))
    t = first.batch.t[:, 0]
    for axis, (name, label) in zip(
        axes, (("vx", "v_x [m/s]"), ("vy", "v_y [m/s]"), ("yaw_rate", "yaw rate [rad/s]")), strict=False
    ):
        axis.plot(t, first.batch.truth[f"true_{name}"][:, 0], "k", label="true")
        for estimator, drive in drives.items():
            axis.plot(t, getattr(drive.said, name)[:, 0], lw=0.8, label=estimator)
        axis.set_ylabel(label)
    axes[3].plot(t, first.batch.mu[:, 0], "k")
    for estimator, drive in drives.items():
        line = axes[3].plot(t, drive.said.mu[:, 0], lw=0.8)[0]
        if estimator == DEFAULT or len(drives) == 1:
            axes[3].fill_between(
                t, drive.said.mu_lower[:, 0], drive.said.mu_upper[:, 0], color=line.get_color(), alpha=0.2, lw=0
            )
        axes[4].plot(t, drive.said.adaptation[:, 0], lw=0.8)
        axes[5].semilogy(t, nees(drive.batch, drive.said).mean(axis=1), lw=0.8)
    axes[3].set(ylabel="μ and its 90 % band", ylim=(0.0, 1.25))
    axes[4].set(ylabel="factor on R")
    axes[5].axhspan(*bounds("nees", first.batch.t.shape[1]), color="k", alpha=0.15, lw=0)
    axes[5].set(ylabel="NEES, all drives", xlabel="t [s]", ylim=(1e-3, 1e3))
    axes[0].set_title(scenario)
    axes[0].legend(fontsize="x-small", ncols=3)
    figure.savefig(path, dpi=80)
    plt.close(figure)
    return path


def _consistency(figures: Sequence[Figure], path: Path) -> Path:
    """NEES and NIS per scenario and estimator, with the 95 % bounds of their mean over the drives at one instant."""
    from matplotlib import pyplot as plt

    ends = {figure.name: figure.value for figure in figures if figure.name.startswith("bounds.")}
    drawn, axes = plt.subplots(2, 1, figsize=(9, 8), sharex=True, layout="constrained")
    for axis, measure in zip(axes, ("nees", "nis"), strict=True):
        found: dict[str, dict[str, float]] = {}
        for figure in figures:
            if figure.name.startswith("real.") and figure.name.endswith(f".{measure}"):
                scenario, _, estimator = figure.name[len("real.") : -len(f".{measure}")].rpartition(".")
                found.setdefault(estimator, {})[scenario] = figure.value
        for estimator, values in found.items():
            axis.plot(list(values), list(values.values()), "o", label=estimator)
        axis.axhspan(ends[f"bounds.{measure}.lower"], ends[f"bounds.{measure}.upper"], color="k", alpha=0.15, lw=0)
        axis.set(ylabel=measure.upper(), yscale="log")
    axes[0].legend(fontsize="x-small", ncols=3)
    axes[1].tick_params(axis="x", rotation=90)
    drawn.savefig(path, dpi=80)
    plt.close(drawn)
    return path


def _memberships(path: Path) -> Path:
    """The fuzzy sets before and after the ant colony."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(3, 2, figsize=(9, 7), layout="constrained")
    tuned = ((f"after, {name}", shipped(file)) for name, file in TUNED.items())
    for row, (name, sets) in enumerate((("before", Memberships()), *tuned)):
        _triangles(axes[row, 0], sets.inputs, f"{name}: mismatch")
        _triangles(axes[row, 1], sets.outputs, f"{name}: step of ln R")
    figure.savefig(path, dpi=80)
    plt.close(figure)
    return path


def _triangles(axis: Axes, peaks: tuple[float, ...], title: str) -> None:
    for k in range(len(peaks)):
        axis.plot(peaks, np.eye(len(peaks))[k])
    axis.set_title(title)


def _reliability(figures: Sequence[Figure], path: Path) -> Path:
    """Share of truths below each stated quantile, over all scenarios."""
    from matplotlib import pyplot as plt

    found: dict[str, dict[float, float]] = {}
    for figure in figures:
        if figure.name.startswith("reliability."):
            estimator, _, level = figure.name.removeprefix("reliability.").rpartition(".below_")
            found.setdefault(estimator, {})[int(level) / 100] = figure.value
    drawn, axis = plt.subplots(figsize=(5, 5), layout="constrained")
    axis.plot([0, 1], [0, 1], "k:")
    for estimator, levels in found.items():
        axis.plot(list(levels), list(levels.values()), "o-", ms=3, label=estimator)
    axis.set(xlabel="stated", ylabel="share of truths below", title="reliability of friction")
    axis.legend(fontsize="x-small")
    drawn.savefig(path, dpi=80)
    plt.close(drawn)
    return path
