"""Plot of the country run: memory and cells of each service, and waiting time of batches."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure as Canvas

from tests.benchmarks.country.nation import SERVICES, WARM_S

SPAN_S: Final = 10.0  # time that a plotted point covers
COLOURS: Final = ("#0072b2", "#d55e00", "#009e73")


def draw(course: Path, out: Path) -> None:
    """Draw memory, cells and waiting times of a finished country run from its files.

    Args:
        course: folder with `course.npz` and `waits.npz`.
        out: image file to write.
    """
    with np.load(course / "course.npz") as looks, np.load(course / "waits.npz") as waits:
        time_s = looks["time"]
        memory = looks["memory"]
        cells = looks["cells"]
        put = waits["put"].ravel()
        wait = np.nan_to_num(waits["wait"].ravel(), nan=np.inf)
    canvas = Canvas(figsize=(8.0, 7.0), layout="constrained")
    above, middle, below = canvas.subplots(3, 1, sharex=True)
    for k, (name, colour) in enumerate(zip(SERVICES, COLOURS, strict=True)):
        above.plot(time_s, memory[:, k], color=colour, label=name)
        middle.plot(time_s, cells[:, k] / 1e3, color=colour, label=name)
    above.set(
        title="A country of 100 000 vehicles, 20 000 observations/s, three services",
        ylabel="memory [MB]",
    )
    middle.set(ylabel="cells [thousand]")
    edges = np.arange(0.0, np.nanmax(put) + SPAN_S, SPAN_S)
    part = np.digitize(put, edges)
    inside = [wait[part == number] for number in range(1, len(edges))]
    for label, share, colour in (
        ("longest", 1.0, "0.75"),
        ("99 %", 0.99, "0.45"),
        ("median", 0.5, "0.0"),
    ):
        worst = [np.quantile(one, share) if len(one) else np.nan for one in inside]
        below.plot(edges[:-1] + SPAN_S / 2, worst, color=colour, label=label)
    below.set(xlabel="time [s]", ylabel="wait for the ack [s]", ylim=(0, 1.25 * below.dataLim.y1))
    for axes in (above, middle, below):
        axes.axvline(WARM_S, color="0.7", linewidth=1, linestyle=":")
        axes.legend(frameon=False, ncols=3, loc="upper right" if axes is below else "lower right")
        axes.set_xlim(0, None)
    canvas.savefig(out, dpi=130)
