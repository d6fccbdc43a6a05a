"""Plots of the evaluation, similar to those in the papers.

Each scenario has a plot of the drive with the first seed: estimated and true motion, friction with
its 90 % interval, and the adapted factor on the measurement noise R. Further plots show results
over all drives, and the fuzzy sets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app.tuned_memberships import shipped_memberships
from edge_agent.estimators import TUNED
from edge_agent.lab.evaluation.campaign import DEFAULT, PlottedDrive, Results
from edge_agent.lab.evaluation.detection import KINDS, ROC_FLAG_MU, ROC_NATS
from edge_agent.lab.evaluation.measures import mean_bounds, nees
from edge_agent.lab.evaluation.real_world import RealWorldResults
from edge_agent.lab.evaluation.scenarios import OTHERS, PAPERS, VEHICLES
from schemas.runtime.figures import Figure
from schemas.runtime.palette import ESTIMATORS, TRUTH, line_of
from schemas.signals import Health, S
from schemas.thresholds import SURFACES

if TYPE_CHECKING:
    from matplotlib.axes import Axes


SCENARIOS: Final = {**PAPERS, **OTHERS, **VEHICLES}
DPI: Final = 110  # resolution of PNG files: 1000 points wide; SVG and PDF are for print
NEARLY_ALIKE: Final = 0.02  # a smaller range of friction is shown as one value


def draw_plots(
    results: Results, figures: Sequence[Figure], folder: Path, *, seed: int = 0, form: str = "png"
) -> list[Path]:
    """Draw all plots and write them into `folder`; return the paths of the files.

    `seed` is the seed of the displayed drive, which the titles state. `form` is the file format,
    png, svg or pdf.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    written = []
    for scenario in sorted({scenario for scenario, _ in results.drives}):
        drives = {name: drive for (of, name), drive in results.drives.items() if of == scenario}
        written.append(_scenario(scenario, drives, seed, folder / f"{scenario}.{form}"))
    if results.rough is not None:
        written.append(_draw_rough_car(results.rough, folder / f"rough.{form}"))
    return [
        *written,
        _draw_surfaces(figures, folder / f"surfaces.{form}"),
        _draw_memberships(folder / f"memberships.{form}"),
        _draw_reliability(figures, folder / f"reliability.{form}"),
        _draw_consistency(figures, folder / f"consistency.{form}"),
    ]


def _scenario(scenario: str, drives: dict[str, PlottedDrive], seed: int, path: Path) -> Path:
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(6, 1, figsize=(9, 14), sharex=True, layout="constrained")
    first = next(iter(drives.values()))
    t = first.batch.t[:, 0]
    for axis, (name, label) in zip(
        axes,
        (("vx", "v_x [m/s]"), ("vy", "v_y [m/s]"), ("yaw_rate", "yaw rate [rad/s]")),
        strict=False,
    ):
        axis.plot(t, first.batch.truth[f"true_{name}"][:, 0], **_true(), label="true")
        for estimator, drive in drives.items():
            axis.plot(t, getattr(drive.reported, name)[:, 0], **_line(estimator), label=estimator)
        axis.set_ylabel(label)
    axes[3].plot(t, first.batch.mu[:, 0], **_true(), label="true, mean of the wheels")
    for estimator, drive in drives.items():
        reported = drive.reported
        style = _line(estimator)
        axes[3].plot(t, reported.mu[:, 0], **style)
        if estimator == DEFAULT or len(drives) == 1:
            band = {
                "color": style["color"],
                "alpha": 0.2,
                "lw": 0,
                "label": f"90 % band of {estimator}",
            }
            axes[3].fill_between(t, reported.mu_lower[:, 0], reported.mu_upper[:, 0], **band)
        axes[4].plot(t, reported.adaptation[:, 0], **style)
        axes[5].semilogy(t, nees(drive.batch, reported).mean(axis=1), **style)
    axes[3].set(ylabel="μ and its 90 % band", ylim=(0.0, 1.25))
    axes[4].set(ylabel="factor on R")
    ends = mean_bounds("nees", first.batch.t.shape[1])
    axes[5].axhspan(*ends, color="k", alpha=0.15, lw=0, label="95 % of a consistent filter's mean")
    axes[5].set(ylabel="NEES, all drives", xlabel="t [s]", ylim=(1e-3, 1e3))
    axes[0].set_title(drive_title(scenario, first, seed))
    for axis in (axes[0], axes[3], axes[5]):
        axis.legend(fontsize="x-small", ncols=3)
    figure.savefig(path, dpi=DPI)
    plt.close(figure)
    return path


def drive_title(scenario: str, drive: PlottedDrive, seed: int) -> str:
    """Return the title of a drive's plot, which states scenario, manoeuvre, speed, friction,
    vehicle and seed.
    """
    spec = SCENARIOS.get(scenario)
    batch = drive.batch
    mu = batch.mu[:, 0]
    speed = batch.truth["true_vx"][0, 0]
    road = f"{mu.min():.2f}" if np.ptp(mu) < NEARLY_ALIKE else f"{mu.max():.2f} to {mu.min():.2f}"
    about = spec.about if spec is not None else "drive"
    return (
        f"{scenario}: {about}\nfrom {speed:.0f} m/s, μ {road}, {batch.vehicles[0].name}, seed "
        f"{seed}"
    )


def _line(estimator: str) -> dict[str, Any]:
    """Return the line style of an estimator: colour, dashes and width. An estimator has the same
    style in every plot.
    """
    style = line_of(estimator)
    return {"color": style.colour, "linestyle": style.dash, "lw": 1.0}


def _true() -> dict[str, Any]:
    return {"color": TRUTH.colour, "linestyle": TRUTH.dash, "lw": 1.6}


def _draw_rough_car(world: RealWorldResults, path: Path) -> Path:
    """Plot the drive of one car with large sensor errors ("rough" car) in a hilly town over time:
    speed and wheel speed, slope, friction with the default estimator's interval, health flags.
    """
    from matplotlib import pyplot as plt

    batch = world.batch
    car = int(np.argmax(np.ptp(world.batch.truth["true_slope"], axis=0)))
    t = batch.t[:, car]
    first = next(iter(world.reported.values()))
    figure, axes = plt.subplots(5, 1, figsize=(9, 12), sharex=True, layout="constrained")
    wheels = batch.vehicles[car].wheel_radius * np.nanmean(
        batch.signals[:, car, S.OMEGA : S.OMEGA + 4], axis=-1
    )
    axes[0].plot(t, batch.truth["true_vx"][:, car], "k", label="true")
    axes[1].plot(
        t, wheels - batch.truth["true_vx"][:, car], color="0.7", lw=0.8, label="mean of the wheels"
    )
    for name, reported in world.reported.items():
        axes[0].plot(t, reported.vx[:, car], **_line(name), label=name)
        axes[1].plot(t, reported.vx[:, car] - batch.truth["true_vx"][:, car], **_line(name))
    axes[2].plot(t, 100.0 * batch.truth["true_slope"][:, car], "k")
    style = _line(next(iter(world.reported)))
    axes[3].plot(t, batch.mu[:, car], **_true(), label="true")
    axes[3].plot(t, first.mu[:, car], **style, label=f"median of {next(iter(world.reported))}")
    band = {"color": style["color"], "alpha": 0.2, "lw": 0, "label": "its 90 % band"}
    axes[3].fill_between(t, first.mu_lower[:, car], first.mu_upper[:, car], **band)
    axes[3].legend(fontsize="x-small", ncols=3)
    axes[1].legend(fontsize="x-small")
    for flag in Health:
        if flag and (is_set := (first.health[:, car].astype(np.int64) & int(flag)) != 0).any():
            axes[4].plot(t[is_set], [flag.name] * int(is_set.sum()), "|")
    axes[0].set(
        ylabel="v_x [m/s]",
        title=f"car {car + 1} of a hilly town; interval and health: {next(iter(world.reported))}",
    )
    axes[1].set(ylabel="error of v_x [m/s]", ylim=(-2.0, 2.0))
    axes[2].set(ylabel="slope [%]")
    axes[3].set(ylabel="μ and its 90 % band", ylim=(0.0, 1.25))
    axes[4].set(ylabel="health", xlabel="t [s]")
    axes[0].legend(fontsize="x-small", ncols=3)
    figure.savefig(path, dpi=DPI)
    plt.close(figure)
    return path


def _draw_surfaces(figures: Sequence[Figure], path: Path) -> Path:
    """Plot the coverage of the 90 % interval by surface (ice, snow, wet, dry) for every estimator.
    The data come from the towns whose cars have large sensor errors, as real cars have.
    """
    from matplotlib import pyplot as plt

    values = {figure.name: figure.value for figure in figures if figure.name.startswith("world.")}
    names = list(
        dict.fromkeys(name.split(".")[1] for name in values if name.endswith(".coverage90"))
    )
    drawn, axis = plt.subplots(figsize=(9, 4), layout="constrained")
    for k, name in enumerate(names):
        shares = [values.get(f"world.{name}.coverage90.{surface}", np.nan) for surface in SURFACES]
        axis.bar(
            np.arange(len(SURFACES)) + 0.8 * (k + 0.5) / len(names) - 0.4,
            shares,
            0.8 / len(names),
            label=name,
            color=line_of(name).colour,
        )
    axis.axhline(0.9, color="k", ls=":")
    axis.set(
        xticks=range(len(SURFACES)),
        xticklabels=list(SURFACES),
        ylabel="coverage of the 90 % interval",
        ylim=(0, 1),
    )
    axis.legend(fontsize="x-small", ncols=4)
    drawn.savefig(path, dpi=DPI)
    plt.close(drawn)
    return path


def _draw_consistency(figures: Sequence[Figure], path: Path) -> Path:
    """Plot NEES and NIS (normalised squared errors and innovations) per scenario and estimator,
    with the 95 % bounds of their mean over the drives at one instant.
    """
    from matplotlib import pyplot as plt

    ends = {figure.name: figure.value for figure in figures if figure.name.startswith("bounds.")}
    drawn, axes = plt.subplots(2, 1, figsize=(9, 8), sharex=True, layout="constrained")
    for axis, measure in zip(axes, ("nees", "nis"), strict=True):
        found: dict[str, dict[str, float]] = {}
        for figure in figures:
            if figure.name.startswith("real.") and figure.name.endswith(f".{measure}"):
                scenario, _, estimator = figure.name[len("real.") : -len(f".{measure}")].rpartition(
                    "."
                )
                found.setdefault(estimator, {})[scenario] = figure.value
        for estimator, values in found.items():
            axis.plot(
                list(values),
                list(values.values()),
                "o",
                color=line_of(estimator).colour,
                label=estimator,
            )
        axis.axhspan(
            ends[f"bounds.{measure}.lower"],
            ends[f"bounds.{measure}.upper"],
            color="k",
            alpha=0.15,
            lw=0,
        )
        axis.set(ylabel=measure.upper(), yscale="log")
    axes[0].legend(fontsize="x-small", ncols=3)
    axes[1].tick_params(axis="x", rotation=90)
    drawn.savefig(path, dpi=DPI)
    plt.close(drawn)
    return path


def _draw_memberships(path: Path) -> Path:
    """Plot the fuzzy sets before and after tuning by the ant colony."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(3, 2, figsize=(9, 7), layout="constrained")
    tuned = ((f"after, {name}", shipped_memberships(file)) for name, file in TUNED.items())
    for row, (name, sets) in enumerate((("before", Memberships()), *tuned)):
        _triangles(
            axes[row, 0],
            sets.inputs,
            f"{name}: sets of the mismatch",
            "mismatch of the innovations [1]",
        )
        _triangles(axes[row, 1], sets.outputs, f"{name}: sets of the step", "step of ln R [1]")
    figure.savefig(path, dpi=DPI)
    plt.close(figure)
    return path


def _triangles(axis: Axes, peaks: tuple[float, ...], title: str, name: str) -> None:
    for k, style in zip(range(len(peaks)), ESTIMATORS.values(), strict=False):
        axis.plot(
            peaks,
            np.eye(len(peaks))[k],
            color=style.colour,
            label=f"set {k + 1}, peak {peaks[k]:.2g}",
        )
    axis.set(title=title, xlabel=name, ylabel="membership [1]")
    axis.legend(fontsize="xx-small")


def _draw_reliability(figures: Sequence[Figure], path: Path) -> Path:
    """Plot, over all scenarios, the share of drives and times at which the true friction lies below
    each quantile of the estimate.
    """
    from matplotlib import pyplot as plt

    found: dict[str, dict[float, float]] = {}
    for figure in figures:
        if figure.name.startswith("reliability."):
            estimator, _, level = figure.name.removeprefix("reliability.").rpartition(".below_")
            found.setdefault(estimator, {})[int(level) / 100] = figure.value
    drawn, axis = plt.subplots(figsize=(5, 5), layout="constrained")
    axis.plot([0, 1], [0, 1], "k:")
    for estimator, levels in found.items():
        axis.plot(
            list(levels),
            list(levels.values()),
            marker="o",
            ms=3,
            **_line(estimator),
            label=estimator,
        )
    axis.set(xlabel="stated", ylabel="share of truths below", title="reliability of friction")
    axis.legend(fontsize="x-small")
    drawn.savefig(path, dpi=DPI)
    plt.close(drawn)
    return path


def draw_detection(figures: Sequence[Figure], path: Path) -> Path:
    """Write the ROC plot of the detection evaluation: share of passes over slippery road that are
    found, against the number of false reports away from snow and ice. The plot compares the
    estimator, the slip flag (ordinary ABS logic) and the oracle (an ideal observer that knows
    motion and forces).
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    values = {figure.name: figure.value for figure in figures}
    drawn, axes = plt.subplots(1, 2, figsize=(11, 4.5), sharey=True, layout="constrained")
    for axis, kind in zip(axes, KINDS, strict=True):
        for road, dash in (("ice", "-"), ("snow", "--")):
            _draw_roc_curves(axis, values, kind, road, dash)
        oracle = values.get(f"oracle.ice.favoured.short.{kind}")
        if oracle is not None:
            axis.axhline(oracle, color="0.5", ls=":", label="oracle, excited visits on ice")
        axis.set(
            xlabel="false events per 1000 km of wet and dry road",
            title=f"{kind} cars",
            ylim=(0.0, 1.02),
        )
        axis.set_xscale("symlog", linthresh=10.0)
        axis.set_xlim(left=-1.0)
        if axis.lines:
            axis.legend(fontsize="x-small")
    axes[0].set_ylabel("share of passes found")
    drawn.savefig(path, dpi=DPI)
    plt.close(drawn)
    return path


def _draw_roc_curves(
    axis: Axes, values: Mapping[str, float], kind: str, road: str, dash: str
) -> None:
    """Draw the curves of the estimator and of the slip flag for one kind of cars (rough or plain)
    and one road (ice or snow), and the point of the reports. Figures that are missing in `values`
    are left out.
    """
    estimator = line_of(DEFAULT)
    for way, limits, colour, name in (
        ("roc", ROC_NATS, estimator.colour, f"belief of {DEFAULT}"),
        ("flag", ROC_FLAG_MU, TRUTH.colour, "slip flag"),
    ):
        found = [
            (
                values.get(f"{way}.{limit:g}.false_events.{kind}"),
                values.get(f"{way}.{limit:g}.{road}.{kind}"),
            )
            for limit in limits
        ]
        known = [
            (events, share) for events, share in found if events is not None and share is not None
        ]
        if known:
            axis.plot(
                *zip(*known, strict=True),
                marker="o",
                ms=3,
                ls=dash,
                color=colour,
                label=f"{name}, {road}",
            )
    share = values.get(f"passes.{road}.short.{kind}")
    events = values.get(f"false_events.short.{kind}")
    if share is not None and events is not None:
        axis.plot(
            events,
            share,
            "*",
            ms=11,
            color=estimator.colour,
            label=f"reported, {road}, short drives",
        )
