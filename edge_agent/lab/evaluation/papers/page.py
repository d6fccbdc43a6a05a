"""The report of one paper's reproduction: an HTML page without scripts, and Markdown with its
tables and its elements (equations, tables and figures of the paper).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Final

from edge_agent.estimators.elements import VERDICTS, Element
from edge_agent.lab.evaluation.papers.outcome import COLUMNS, PaperRow, PaperTable, Reproduction

STYLE: Final = """\
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 72em; padding: 0 1em;
  color: #1a1a1a; }
h1 { font-size: 1.5em; } h2 { font-size: 1.2em; margin-top: 2em; } h3 { font-size: 1em; }
table { border-collapse: collapse; width: 100%; font-size: .92em; }
th, td { text-align: left; padding: .25em .6em; border-bottom: 1px solid #ddd;
  vertical-align: top; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
td.missed { background: #fde0dc; font-weight: bold; } td.held { background: #e3f2e1; }
img { max-width: 100%; } figure { margin: 1em 0; } .sum { font-size: 1.1em; }
"""

LEGEND: Final = (
    "Printed: the number in the paper. Matched: the paper's filter on a simulated car that equals "
    "the filter's model. Own plant: the same filter on the simulator's standard car. Realistic "
    "sensors: the paper's estimator as a car would run it, with ordinary sensors and vehicle "
    "parameters known to a few per cent. Default estimator: the estimator that agents run, on the "
    "same drives."
)


def format_number(value: float) -> str:
    """Return a number as text for the report, with three digits; a dash for NaN."""
    return "–" if math.isnan(value) else f"{value:.3g}"


def format_cells(row: PaperRow) -> list[str]:
    """Return the cells of a table row of the report as text: the number that the paper prints, and
    four results of this project for comparison.

    The four results are, in this order:

    - the paper's filter on a simulated car that equals the filter's model
    - the paper's filter on the simulator's standard car
    - the paper's estimator with ordinary sensors and vehicle parameters known to a few per cent
    - the project's default estimator on the same drives as the third result
    """
    shown = row.shown or format_number(row.printed)
    return [
        shown,
        *(format_number(value) for value in (row.matched, row.own, row.realistic, row.default)),
    ]


def limit_text(row: PaperRow) -> str:
    """Return as text the target for the result under the paper's conditions (`matched`), for
    example "≤ 0.02"; "" if there is no target.
    """
    if row.limit is None:
        return ""
    return f"{'≤' if row.better == 'less' else '≥'} {row.limit:g}"


def summary_sentence(done: Reproduction) -> str:
    """Return one sentence for the report: how many of the results under the paper's conditions meet
    their targets.
    """
    barred = [row for row in done.rows if row.limit is not None]
    text = f"{len(barred) - len(done.missed_rows)} of {len(barred)} matched numbers meet their bar."
    return text if not done.missed_rows else f"{text} Missed: {', '.join(done.missed_rows)}."


def markdown_tables(tables: Sequence[PaperTable]) -> str:
    """Return the tables of a reproduction as Markdown."""
    parts = []
    for table in tables:
        head = ("", *COLUMNS, "bar of matched", "")
        lines = [f"## {table.title}", "", "| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
        for row in table.rows:
            verdict = ""
            if row.limit is not None:
                verdict = "holds" if row.holds else "MISSED"
            lines.append(
                "| " + " | ".join((row.what, *format_cells(row), limit_text(row), verdict)) + " |"
            )
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def markdown_elements(elements: Sequence[Element]) -> str:
    """Return a Markdown table of a paper's elements (equations, tables, figures): for each element,
    whether it is implemented, the reason, and the place in the code.
    """
    lines = ["| paper | element | verdict | why | where |", "|---|---|---|---|---|"]
    for element in elements:
        where = f"`{element.where}`" if element.where else ""
        texts = (element.place, element.what, element.verdict, element.why, where)
        lines.append("| " + " | ".join(text.replace("|", "\\|") for text in texts) + " |")
    return "\n".join(lines)


def report_markdown(done: Reproduction) -> str:
    """Return the complete report of a reproduction as Markdown."""
    notes = "\n".join(f"- {note}" for note in done.notes)
    parts = (
        f"# Paper {done.paper}: {done.title}",
        summary_sentence(done),
        markdown_tables(done.tables),
        f"## Notes\n\n{notes}",
        f"## Elements of the paper\n\n{markdown_elements(done.elements)}",
    )
    return "\n\n".join(parts) + "\n"


def report_html(done: Reproduction, seconds: float) -> str:
    """Return the report as one HTML page that shows the SVG files in the same folder. `seconds` is
    the computing time that the page states.
    """
    counts = ", ".join(
        f"{sum(element.verdict == verdict for element in done.elements)} {verdict}"
        for verdict in VERDICTS
    )
    title = f"Paper {done.paper}: {done.title}"
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>",
        f"<h1>{escape(title)}</h1>",
        f'<p class="sum">{escape(summary_sentence(done))}</p>',
        f"<p>{escape(LEGEND)} Made in {seconds:.0f} s.</p>",
        "<h2>Tables</h2>",
        *(_table(table) for table in done.tables),
        "<h2>Notes</h2><ul>",
        *(f"<li>{escape(note)}</li>" for note in done.notes),
        "</ul><h2>Figures</h2>",
        *(
            f'<figure><img src="{plot.name}.svg" alt="{escape(plot.title)}"></figure>'
            for plot in done.plots
        ),
        f"<h2>Elements of the paper</h2><p>{counts}.</p>",
        _elements_table(done.elements),
        "</body></html>",
    ]
    return "\n".join(parts) + "\n"


def _table(table: PaperTable) -> str:
    head = "".join(f'<th class="number">{column}</th>' for column in COLUMNS)
    lines = [
        f"<h3>{escape(table.title)}</h3><table><tr><th></th>{head}<th>bar of matched</th></tr>"
    ]
    for row in table.rows:
        found = format_cells(row)
        verdict = ""
        if row.limit is not None:
            verdict = " held" if row.holds else " missed"
        body = [
            f'<td class="number">{found[0]}</td>',
            f'<td class="number{verdict}">{found[1]}</td>',
        ]
        body += [f'<td class="number">{cell}</td>' for cell in found[2:]]
        lines.append(
            f"<tr><td>{escape(row.what)}</td>{''.join(body)}<td>{limit_text(row)}</td></tr>"
        )
    return "\n".join(lines) + "</table>"


def _elements_table(elements: Sequence[Element]) -> str:
    lines = [
        "<table><tr><th>paper</th><th>element</th><th>verdict</th><th>why</th><th>where</th></tr>"
    ]
    for element in elements:
        where = f"<code>{escape(element.where)}</code>" if element.where else ""
        texts = (element.place, element.what, element.verdict, element.why)
        lines.append(
            "<tr>"
            + "".join(f"<td>{escape(text)}</td>" for text in texts)
            + f"<td>{where}</td></tr>"
        )
    return "\n".join(lines) + "</table>"
