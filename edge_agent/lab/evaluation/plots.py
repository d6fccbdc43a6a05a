"""Plots as in the papers, of the first seed: motion against truth, friction with its band, adaptation, fuzzy sets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app.tuned_memberships import shipped
from edge_agent.estimators import TUNED
from edge_agent.lab.evaluation.campaign import DEFAULT, PlottedDrive, Results
from edge_agent.lab.evaluation.measures import bounds, nees
from edge_agent.lab.evaluation.real_world import SURFACES, RealWorldResults
from schemas.runtime.figures import Figure
from schemas.signals import Health, S

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
    if results.rough is not None:
        written.append(_rough(results.rough, folder / "rough.png"))
    return [
        *written,
        _surfaces(figures, folder / "surfaces.png"),
        _memberships(folder / "memberships.png"),
        _reliability(figures, folder / "reliability.png"),
        _consistency(figures, folder / "consistency.png"),
    ]


def _scenario(scenario: str, drives: dict[str, PlottedDrive], path: Path) -> Path:
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(6, 1, figsize=(9, 14), sharex=True, layout="constrained")
    first = next(iter(drives.values()))
    t = first.batch.t[:, 0]
    for axis, (name, label) in zip(
        axes, (("vx", "v_x [m/s]"), ("vy", "v_y [m/s]"), ("yaw_rate", "yaw rate [rad/s]")), strict=False
    ):
        axis.plot(t, first.batch.truth[f"true_{name}"][:, 0], "k", label="true")
        for estimator, drive in drives.items():
            axis.plot(t, getattr(drive.reported, name)[:, 0], lw=0.8, label=estimator)
        axis.set_ylabel(label)
    axes[3].plot(t, first.batch.mu[:, 0], "k")
    for estimator, drive in drives.items():
        line = axes[3].plot(t, drive.reported.mu[:, 0], lw=0.8)[0]
        if estimator == DEFAULT or len(drives) == 1:
            axes[3].fill_between(
                t, drive.reported.mu_lower[:, 0], drive.reported.mu_upper[:, 0], color=line.get_color(), alpha=0.2, lw=0
            )
        axes[4].plot(t, drive.reported.adaptation[:, 0], lw=0.8)
        axes[5].semilogy(t, nees(drive.batch, drive.reported).mean(axis=1), lw=0.8)
    axes[3].set(ylabel="μ and its 90 % band", ylim=(0.0, 1.25))
    axes[4].set(ylabel="factor on R")
    axes[5].axhspan(*bounds("nees", first.batch.t.shape[1]), color="k", alpha=0.15, lw=0)
    axes[5].set(ylabel="NEES, all drives", xlabel="t [s]", ylim=(1e-3, 1e3))
    axes[0].set_title(scenario)
    axes[0].legend(fontsize="x-small", ncols=3)
    figure.savefig(path, dpi=80)
    plt.close(figure)
    return path


def _rough(world: RealWorldResults, path: Path) -> Path:
    """One rough car in a hilly town: speed beside the wheels', slope, friction with the default's interval, health."""
    from matplotlib import pyplot as plt

    batch, car = world.batch, int(np.argmax(np.ptp(world.batch.truth["true_slope"], axis=0)))
    t, first = batch.t[:, car], next(iter(world.reported.values()))
    figure, axes = plt.subplots(5, 1, figsize=(9, 12), sharex=True, layout="constrained")
    wheels = batch.vehicles[car].wheel_radius * np.nanmean(batch.signals[:, car, S.OMEGA : S.OMEGA + 4], axis=-1)
    axes[0].plot(t, batch.truth["true_vx"][:, car], "k", label="true")
    axes[1].plot(t, wheels - batch.truth["true_vx"][:, car], color="0.7", lw=0.8, label="mean of the wheels")
    for name, reported in world.reported.items():
        line = axes[0].plot(t, reported.vx[:, car], lw=0.8, label=name)[0]
        axes[1].plot(t, reported.vx[:, car] - batch.truth["true_vx"][:, car], lw=0.8, color=line.get_color())
    axes[2].plot(t, 100.0 * batch.truth["true_slope"][:, car], "k")
    axes[3].plot(t, batch.mu[:, car], "k")
    axes[3].plot(t, first.mu[:, car], lw=0.8)
    axes[3].fill_between(t, first.mu_lower[:, car], first.mu_upper[:, car], alpha=0.2, lw=0)
    for flag in Health:
        if flag and (when := (first.health[:, car].astype(np.int64) & int(flag)) != 0).any():
            axes[4].plot(t[when], [flag.name] * int(when.sum()), "|")
    axes[0].set(
        ylabel="v_x [m/s]", title=f"car {car + 1} of a hilly town; interval and health: {next(iter(world.reported))}"
    )
    axes[1].set(ylabel="error of v_x [m/s]", ylim=(-2.0, 2.0))
    axes[2].set(ylabel="slope [%]")
    axes[3].set(ylabel="μ and its 90 % band", ylim=(0.0, 1.25))
    axes[4].set(ylabel="health", xlabel="t [s]")
    axes[0].legend(fontsize="x-small", ncols=3)
    figure.savefig(path, dpi=80)
    plt.close(figure)
    return path


def _surfaces(figures: Sequence[Figure], path: Path) -> Path:
    """Coverage of the 90 % interval by surface, for every estimator in the rough world."""
    from matplotlib import pyplot as plt

    values = {figure.name: figure.value for figure in figures if figure.name.startswith("world.")}
    names = list(dict.fromkeys(name.split(".")[1] for name in values if name.endswith(".coverage90")))
    drawn, axis = plt.subplots(figsize=(9, 4), layout="constrained")
    for k, name in enumerate(names):
        shares = [values.get(f"world.{name}.coverage90.{surface}", np.nan) for surface in SURFACES]
        axis.bar(np.arange(len(SURFACES)) + 0.8 * (k + 0.5) / len(names) - 0.4, shares, 0.8 / len(names), label=name)
    axis.axhline(0.9, color="k", ls=":")
    axis.set(
        xticks=range(len(SURFACES)), xticklabels=list(SURFACES), ylabel="coverage of the 90 % interval", ylim=(0, 1)
    )
    axis.legend(fontsize="x-small", ncols=4)
    drawn.savefig(path, dpi=80)
    plt.close(drawn)
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
