"""Plots of the map's evaluation, drawn only from its figures (named results). They need matplotlib,
which the optional dependencies `demo` install.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fleet_service.lab.bars import COUNTS
from fleet_service.lab.rules import RULES
from schemas.errors import InputError
from schemas.runtime.figures import Figure
from schemas.runtime.installing import install_command
from schemas.runtime.palette import ESTIMATORS

SIZE = (5.5, 4.2)
FORMATS = ("png", "svg", "pdf")


def draw_plots(found: Sequence[Figure], folder: Path) -> list[Path]:
    """Draw four plots from the figures `found`, and write each into `folder` in the file formats
    FORMATS. Return the paths of the files. The plots are:

    - reliability: share of true μ below the stated quantiles, for a fleet without faulty vehicles.
    - rmse: error of the median of μ by the number of vehicles that used grip in the cell.
    - delay: share of cells in which the appearance or the end of ice is detected, by the number of
      passes that used enough grip to measure μ.
    - misbehaving: error of the median of μ by the share of misbehaving vehicles, for the fusion and
      for simple rules.

    Raises:
        InputError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure as Canvas
    except ImportError as error:
        raise InputError(
            "plots", "matplotlib is not installed", install_command("analytics")
        ) from error
    values = {figure.name: figure.value for figure in found}
    paths = []
    for name, plot in (
        ("reliability", _draw_reliability),
        ("rmse", _draw_rmse),
        ("delay", _draw_delay),
        ("misbehaving", _draw_misbehaving),
    ):
        canvas = Canvas(figsize=SIZE, layout="constrained")
        axes = canvas.subplots()
        plot(axes, values)
        for form in FORMATS:
            paths.append(folder / f"{name}.{form}")
            canvas.savefig(paths[-1], dpi=130)
    return paths


def _values_below(values: Mapping[str, float], prefix: str) -> tuple[list[float], list[float]]:
    pairs = sorted(
        (float(name.removeprefix(prefix)), v)
        for name, v in values.items()
        if name.startswith(prefix)
    )
    return [x for x, _ in pairs], [y for _, y in pairs]


# The axes have no type here, because matplotlib is optional.
def _draw_reliability(axes: Any, values: Mapping[str, float]) -> None:  # noqa: ANN401
    axes.plot([0, 1], [0, 1], color="0.7")
    axes.plot(*_values_below(values, "fusion.clean.reliability."), marker="o", markersize=3)
    axes.set(
        title="Reliability, honest fleet",
        xlabel="stated: P(μ ≤ x)",
        ylabel="observed: share of true μ ≤ x",
    )


def _draw_rmse(axes: Any, values: Mapping[str, float]) -> None:  # noqa: ANN401
    axes.plot(
        COUNTS,
        [values.get(f"fusion.clean.rmse.n{n}", float("nan")) for n in COUNTS],
        marker="o",
        label="fusion",
    )
    axes.axhline(0.05, color="0.7", linewidth=1)
    axes.set(
        title="Error by number of excited vehicles",
        xlabel="vehicles that used grip in the cell",
        ylabel="RMSE of the median",
        xscale="log",
        ylim=(0, None),
    )


def _draw_delay(axes: Any, values: Mapping[str, float]) -> None:  # noqa: ANN401
    for name, label in (
        ("ice_onset", "ice appears: P(μ < .4) > .9"),
        ("ice_end", "ice ends: alert cleared"),
    ):
        axes.plot(
            *_values_below(values, f"fusion.{name}.share_after."),
            marker="o",
            markersize=3,
            label=label,
        )
    axes.set(
        title="Detection delay", xlabel="excited passes", ylabel="share of cells", ylim=(0, 1.02)
    )
    axes.legend()


def _draw_misbehaving(axes: Any, values: Mapping[str, float]) -> None:  # noqa: ANN401
    shares = {"clean": 0.0, "mis05": 5.0, "mis15": 15.0, "mis30_colluding": 30.0}
    axes.plot(
        shares.values(),
        [values.get(f"fusion.{n}.rmse", float("nan")) for n in shares],
        "o-",
        label="fusion",
    )
    for rule, style in zip(RULES, list(ESTIMATORS.values())[1:], strict=False):
        label = rule.replace(" ", "_")
        axes.plot(
            shares.values(),
            [values.get(f"rule.{n}.{label}.rmse", float("nan")) for n in shares],
            marker=".",
            linewidth=1,
            label=rule,
            color=style.colour,
            linestyle=style.dash,
        )
    axes.set(
        title="Error by share of misbehaving vehicles",
        xlabel="% of vehicles that always claim μ = .25 with high confidence",
        ylabel="RMSE of the median",
        ylim=(0, None),
    )
    axes.legend(fontsize=7)
