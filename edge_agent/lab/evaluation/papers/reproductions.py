"""Table of the functions that reproduce the papers, and the function that writes the files of
`edge-agent evaluate --paper`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from edge_agent.estimators.elements import elements_without_reason
from edge_agent.lab.evaluation.papers import (
    reproduction_000,
    reproduction_001,
    reproduction_002,
    reproduction_003,
    reproduction_004,
)
from edge_agent.lab.evaluation.papers.drawing import write_plots
from edge_agent.lab.evaluation.papers.outcome import Reproduction
from edge_agent.lab.evaluation.papers.page import report_html, report_markdown
from schemas.runtime.figures import Figure, write_figures

REPRODUCTIONS: Final[dict[str, Callable[[Sequence[int]], Reproduction]]] = {
    "000": reproduction_000.reproduce,
    "001": reproduction_001.reproduce,
    "002": reproduction_002.reproduce,
    "003": reproduction_003.reproduce,
    "004": reproduction_004.reproduce,
}
LONGEST_S: Final = 90.0  # [s] limit for the reproduction of one paper on two cores


def write_paper(
    paper: str, seeds: Sequence[int], folder: Path, *, plots: bool = True
) -> Reproduction:
    """Reproduce the results of a paper and return them. Write figures.json (the numbers) and
    report.md into the folder. With `plots`, also write the plots, and index.html, which shows the
    plots.
    """
    began = time.monotonic()
    done = REPRODUCTIONS[paper](seeds)
    if plots:
        write_plots(done.plots, folder)
    seconds = time.monotonic() - began
    unsaid = len(elements_without_reason(done.elements))
    done.figures += [
        Figure(f"papers.{paper}.elements.missing_unsaid", unsaid, "1", 0.0, "less"),
        Figure(f"papers.{paper}.seconds", seconds, "s", LONGEST_S, "less"),
    ]
    write_figures(
        folder / "figures.json",
        f"edge-agent evaluate --paper {paper}",
        list(seeds),
        done.all_figures(),
    )
    (folder / "report.md").write_text(report_markdown(done), encoding="utf-8")
    if plots:
        (folder / "index.html").write_text(report_html(done, seconds), encoding="utf-8")
    return done
