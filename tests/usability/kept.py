"""The figures that READMEs quote, kept in deploy/figures, each with the commit that it was measured on: `make figures`.

A page quotes a figure as a link whose label is the figure's name; the definition names the file, and how it is written:

    | truth inside the interval | [96 %][demo.map.coverage90] | 80 – 99 % |

    [demo.map.coverage90]: deploy/figures/demo.json "{:.0%}"

What misses its bar is bold. A table that a campaign's report has stands whole, and nobody types in it:

    <!-- edge: papers -->
    ...
    <!-- end -->

`make figures` takes what the campaigns' last whole runs left, and writes all pages anew:
python -m tests.usability.kept [NAME=FILE ...], where FILE is a campaign's figures.json from elsewhere.
Kept is what has a bar, what a page quotes, and what its tables are made from.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NamedTuple

from edge_agent.lab.evaluation import printed, report
from edge_agent.lab.tuning import study_report
from fleet_service.lab import fading
from schemas.runtime.figures import Figure
from tests.house import ROOT

FOLDER: Final = ROOT / "deploy" / "figures"
NONE: Final = "none"  # how a value is written that was not measured, because nothing came


class Campaign(NamedTuple):
    """What makes a file of figures: the command, where it leaves them, and what it calls a whole run."""

    command: str
    left: str
    title: str


CAMPAIGNS: Final = {
    "demo": Campaign("make demo", ".demo", "demo"),
    "bench": Campaign("make bench", ".bench", "bench"),
    "faults": Campaign("make faults", ".faults", "faults"),
    "kube": Campaign("make kube", ".kube", "kube"),
    "cluster": Campaign("make cluster-faults", ".faults/cluster", "cluster"),
    "country": Campaign("make country-bench", ".country", "country"),
    "batch": Campaign("make batch-bench", ".batch", "batch"),
    "page": Campaign("make page-bench", ".page", "page"),
    "roads": Campaign("make roads-bench", ".roads", "roads"),
    "usability": Campaign("make usability", ".usability", "usability"),
    "edge": Campaign("edge-agent evaluate --out .evaluation/edge", ".evaluation/edge", "edge-agent evaluate"),
    "inputs": Campaign(
        "edge-agent evaluate --only inputs --recorded tests/data/rav4.blf --out .evaluation/inputs",
        ".evaluation/inputs", "edge-agent evaluate --only inputs",
    ),
    "ahead": Campaign(
        "edge-agent evaluate --only ahead --out .evaluation/ahead", ".evaluation/ahead",
        "edge-agent evaluate --only ahead",
    ),
    "listening": Campaign(
        "python -m deploy.listening --out .evaluation/listening", ".evaluation/listening", "deploy.listening"
    ),
    "fleet": Campaign("fleet-service evaluate --out .evaluation/fleet", ".evaluation/fleet", "fusion"),
    "study": Campaign(
        "edge-agent tune --study .evaluation/study", ".evaluation/study", "edge-agent tune --study"
    ),
    "analytics": Campaign("make analytics-bench", ".analytics", "analytics"),
}  # fmt: skip


class Table(NamedTuple):
    """A table of a campaign's report: the names of the figures that it needs, and how it is made from them."""

    names: re.Pattern[str]
    made: Callable[[dict[str, float]], str]


TABLES: Final = {
    "edge: papers": Table(re.compile(f"({'|'.join(map(re.escape, printed.names()))})$"), report.table),
    "edge: world": Table(re.compile(r"world\."), report.world),
    "edge: faults": Table(
        re.compile(r"faults\..*\.(told|finite|coverage90|aco-fckf\.(width|rmse_vx|rmse_vy))$"), report.faults
    ),
    "fleet: stays dry": Table(re.compile(re.escape(fading.PREFIX)), fading.table),
    "study: held out": Table(
        re.compile(r"tuning\.(?!convergence)"),
        lambda values: study_report.markdown([Figure(name, value, "") for name, value in values.items()]).rstrip(),
    ),
}

_BLOCK: Final = re.compile(r"<!-- (\w+: [\w ]+) -->\n(.*?)<!-- end -->", re.DOTALL)
_DEFINITION: Final = re.compile(r'^\[([\w.-]+)\]: (\S*figures/(\w+)\.json) "(\{:[^}]*\}[^"]*)"$', re.MULTILINE)
_TABLE: Final = re.compile(r"^(\|.*\|)\n\|[ :|-]+\|\n((?:\|.*\|\n?)+)", re.MULTILINE)
_QUOTED: Final = re.compile(r"\[[^\]\[]*\]\[[\w.-]+\]|`[^`]*`")
_NUMBER: Final = re.compile(r"(?<![\w.])\.?\d")
Rows = dict[str, dict[str, Any]]


class Quote(NamedTuple):
    """A figure in a page: its name, the file that it is kept in, how it is written, and what the page says now."""

    page: Path
    name: str
    file: str
    form: str
    said: tuple[str, ...]


def pages() -> list[Path]:
    """Every page that a person wrote."""
    found = [*ROOT.glob("*.md"), *(page for half in ("schemas", "edge_agent", "fleet_service", "deploy", "tests")
                                   for page in (ROOT / half).rglob("*.md"))]  # fmt: skip
    return sorted(page for page in found if "node_modules" not in page.parts)


def quotes(page: Path) -> list[Quote]:
    """The figures that a page quotes."""
    text = page.read_text(encoding="utf-8")
    return [
        Quote(page, name, file, form, tuple(match[0] for match in _mark(name).finditer(text)))
        for name, _, file, form in _DEFINITION.findall(text)
    ]


def _mark(name: str) -> re.Pattern[str]:
    """A quotation of a figure in a text: its stars, its words."""
    return re.compile(rf"(?:\*\*)?\[[^\]\[\n]*\]\[{re.escape(name)}\](?:\*\*)?")


def written(quote: Quote, row: dict[str, Any]) -> str:
    """A quotation as it is to be."""
    value = row["value"]
    words = NONE if value is None or not math.isfinite(value) else quote.form.format(value)
    words = re.sub(r"(?<!\d)0\.(?=\d)", ".", words).replace(",", " ").replace("%", " %").replace("-", "−")
    link = f"[{words}][{quote.name}]"
    return link if row["holds"] else f"**{link}**"


def kept(name: str) -> Rows:
    """The figures of a file by name; none where there is no such file yet."""
    return {row["name"]: row for row in _read(name)[1:]}


def _runs(name: str) -> Rows:
    """Date, machine and seeds of the runs that a file's figures are of, by commit."""
    return dict(header["runs"]) if (header := next(iter(_read(name)), None)) else {}


def _read(name: str) -> list[dict[str, Any]]:
    path = FOLDER / f"{name}.json"
    found: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    return found


def stale() -> list[str]:
    """Quotations that say another number than the file, or that no file has."""
    texts = {page: page.read_text(encoding="utf-8") for page in pages()}
    found = [f"{page.relative_to(ROOT)}: a table is not that of the kept figures; make figures"
             for page, text in texts.items() if tables(text) != text]  # fmt: skip
    for quote in (quote for page in texts for quote in quotes(page)):
        where, row = f"{quote.page.relative_to(ROOT)}: {quote.name}", kept(quote.file).get(quote.name)
        if row is None:
            found.append(f"{where} is not in {FOLDER.relative_to(ROOT)}/{quote.file}.json; {_how(quote.file)}")
        elif not quote.said:
            found.append(f"{where} is defined and not quoted")
        else:
            found += [f"{where} is {written(quote, row)}, not {said}" for said in quote.said
                      if said != written(quote, row)]  # fmt: skip
    return found


def by_hand() -> list[str]:
    """Figures that somebody typed: a number that is no quotation in a column `measured` or `value`, or anywhere
    but in the first column and the last of a table that ends with `bar`."""
    found = []
    for page in pages():
        text = _BLOCK.sub("", page.read_text(encoding="utf-8"))
        for head, rows in _TABLE.findall(text):
            titles = [title.strip() for title in head.strip("|").split("|")]
            judged = [
                number for number, title in enumerate(titles)
                if title in ("measured", "value") or (titles[-1] == "bar" and 0 < number < len(titles) - 1)
            ]  # fmt: skip
            for row in rows.splitlines():
                cells = row.strip("|").split("|")
                typed = [cells[number].strip() for number in judged if _NUMBER.search(_QUOTED.sub("", cells[number]))]
                found += [f"{page.relative_to(ROOT)}: {cells[0].strip()}: {cell}" for cell in typed]
    return found


def _how(name: str) -> str:
    return f"{CAMPAIGNS[name].command}, then make figures"


def take(name: str, left: Path) -> str:
    """Keep the figures of a campaign's last run, each with its commit; what a part of it did not measure stays.

    Returns:
        what was done, or why not, in a line.
    """
    campaign = CAMPAIGNS[name]
    if not left.exists():
        return f"{name}: as it was; {_how(name)}"
    header, *rows = json.loads(left.read_text(encoding="utf-8"))
    if header["campaign"] != campaign.title:
        return f"{name}: as it was; {left} is of {header['campaign']!r}"
    before, runs = kept(name), _runs(name)
    commit = header["commit"]
    if runs.get(commit, header)["date"] > header["date"]:
        return f"{name}: as it was; {left} is older"
    runs[commit] = {key: header[key] for key in ("date", "machine", "seeds")}
    rows = [row for row in rows if runs[before.get(row["name"], {}).get("commit", commit)]["date"] <= header["date"]]
    newer = {row["name"]: {**row, "commit": commit} for row in filter(_wanted(name), rows)}
    found = before | newer
    used = {row["commit"] for row in found.values()}
    about = {"campaign": campaign.title, "command": campaign.command, "runs": {c: runs[c] for c in runs if c in used}}
    FOLDER.mkdir(exist_ok=True)
    lines = [about, *found.values()]
    body = ",\n".join(json.dumps(line, ensure_ascii=False) for line in lines)
    (FOLDER / f"{name}.json").write_text(f"[\n{body}\n]\n", encoding="utf-8")
    changed = sum(row["value"] != before.get(key, {}).get("value") for key, row in newer.items())
    dirty = " (measured on uncommitted changes)" if "dirty" in commit else ""
    return f"{name}: {len(newer)} figures of {commit}{dirty}, {changed} new or changed"


def _wanted(name: str) -> Callable[[dict[str, Any]], bool]:
    """Which figures of a file are worth keeping: what has a bar, and what a page shows."""
    quoted = {quote.name for page in pages() for quote in quotes(page) if quote.file == name}
    shown = [table.names for title, table in TABLES.items() if title.startswith(f"{name}: ")]
    return lambda row: row["bar"] is not None or row["name"] in quoted or any(one.match(row["name"]) for one in shown)


def tables(text: str) -> str:
    """A page with the tables of campaigns as their kept figures have them; where none are kept, as it was."""

    def made(block: re.Match[str]) -> str:
        name, _, _ = block[1].partition(": ")
        values = {key: math.nan if row["value"] is None else row["value"] for key, row in kept(name).items()}
        return f"<!-- {block[1]} -->\n{TABLES[block[1]].made(values)}\n<!-- end -->" if values else block[0]

    return _BLOCK.sub(made, text)


def renew() -> list[str]:
    """Write all quotations anew; names of the pages that changed."""
    changed = []
    for page in pages():
        before = text = page.read_text(encoding="utf-8")
        for quote in quotes(page):
            row = kept(quote.file).get(quote.name)
            if row is not None:
                text = _mark(quote.name).sub(lambda _, q=quote, r=row: written(q, r), text)  # type: ignore[misc]
        text = tables(text)
        if text != before:
            page.write_text(text, encoding="utf-8")
            changed.append(str(page.relative_to(ROOT)))
    return changed


def main() -> int:
    """Take, renew, and say what is still stale; 1 where something is."""
    parser = argparse.ArgumentParser(prog="make figures", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sources", nargs="*", metavar="NAME=FILE", help=f"NAME is one of {', '.join(CAMPAIGNS)}")
    given = dict(word.partition("=")[::2] for word in parser.parse_args().sources)
    if unknown := set(given) - set(CAMPAIGNS):
        parser.error(f"{', '.join(sorted(unknown))}: unknown; choose from {', '.join(CAMPAIGNS)}")
    for name, campaign in CAMPAIGNS.items():
        print(take(name, Path(given.get(name, ROOT / campaign.left / "figures.json"))))
    print("pages written anew:", ", ".join(renew()) or "none")
    left = stale()
    print("\n".join(left))
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
