"""Reference page that lists every equation, table and figure of the papers, from the lists in the
estimators' modules.
"""

from __future__ import annotations

from typing import Final

from edge_agent.estimators import (
    adaptive_federated_ckf,
    compensated_wckf,
    federated_ckf,
    paper_aco_fckf,
    sr_ukf,
)
from edge_agent.estimators.elements import VERDICTS, Element
from edge_agent.lab.evaluation.papers.page import markdown_elements

PAPERS: Final[dict[str, tuple[str, tuple[Element, ...]]]] = {
    "000": ("federated-ckf", federated_ckf.ELEMENTS),
    "001": ("adaptive-federated-ckf", adaptive_federated_ckf.ELEMENTS),
    "002": ("compensated-wckf", compensated_wckf.ELEMENTS),
    "003": ("sr-ukf", sr_ukf.ELEMENTS),
    "004": ("paper-aco-fckf", paper_aco_fckf.ELEMENTS),
}
INTRODUCTION: Final = """\
# Elements of the papers

Every equation, table and figure of the five papers, and whether the code follows it.

- *As printed*: no change.
- *Option*: as printed if an option is set; the default needs something else.
- *Corrected*: changed, with the reason.
- *Left out*: not in the code, with the reason.

The lists are in the modules of the estimators. Paths in the column "where" are relative to
`edge_agent`, mostly below `edge_agent/estimators`.
"""


def elements_page() -> str:
    """Return the reference page of the papers' equations, tables and figures as Markdown."""
    parts = [INTRODUCTION]
    for paper, (estimator, elements) in PAPERS.items():
        counts = ", ".join(
            f"{sum(e.verdict == verdict for e in elements)} {verdict}" for verdict in VERDICTS
        )
        parts.append(
            f"## Paper {paper}: `{estimator}`\n\n{counts}.\n\n{markdown_elements(elements)}\n"
        )
    return "\n".join(parts)
