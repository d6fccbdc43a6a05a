"""Tests of the documentation pages: their examples run, and their tables agree with the contract
(the tables in `schemas`).
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import edge_agent.cli
from fleet_service.analytics import synthetic
from fleet_service.archive.maintenance.compaction import compact
from schemas import grid, tables
from tests import results
from tests.structure import ROOT

DOCS = ROOT / "deploy" / "docs"


def test_the_examples_of_the_reference_run_in_their_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    examples = re.findall(
        r"^```python\n(.*?)^```",
        (DOCS / "reference" / "api.md").read_text(),
        re.DOTALL | re.MULTILINE,
    )
    assert len(examples) >= 4
    drive = ["simulate", "slalom", "--duration", "2", "--out", str(tmp_path / "drive.parquet")]
    assert edge_agent.cli.main([*drive, "--vehicle-out", str(tmp_path / "drive.json")]) == 0
    world = synthetic.SyntheticFleet(rows=6000, days=1, vehicles=20, roads=4, length=30, icy=2)
    synthetic.write_archive(tmp_path / "archive", world, 2000)
    compact(tmp_path / "archive")
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    for example in examples:
        exec(compile(example, "api.md", "exec"), {})
        assert capsys.readouterr().out
    assert {"drive.svg", "worst.geojson"} <= {path.name for path in tmp_path.iterdir()}


def test_site_contents_list_every_page() -> None:
    """Every page must be in the table of contents of the site. Otherwise Sphinx warns of the page,
    and `make docs` treats the warning as an error.
    """
    tables = re.findall(r"```\{toctree\}\n(.*?)```", (DOCS / "index.md").read_text(), re.DOTALL)
    entries = [
        line for table in tables for line in table.splitlines() if line and not line.startswith(":")
    ]
    listed = [(DOCS / f"{entry}.md").resolve() for entry in entries]
    generated = DOCS / "reference" / "generated"
    assert not [path for path in listed if not path.exists() and path.parent != generated]
    # The index of the decisions lists these by a pattern.
    decisions = set((DOCS / "decisions").glob("0*.md"))
    written = {
        page for page in results.list_pages() if page.name == "README.md" or DOCS in page.parents
    }
    written = {page for page in written if page.parent != DOCS / "reference" / "generated"}
    written -= {ROOT / "README.md", DOCS / "index.md"} | decisions
    assert written - set(listed) == set()
    assert len(written) > 25
    assert len(decisions) >= 12


def test_map_columns_page_has_every_column_sector_and_cell_size() -> None:
    page = (DOCS / "reference" / "map-columns.md").read_text()
    rows = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `")]
    named = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert sorted(named) == sorted(field.name for field in tables.MAP_CELL)
    assert ", ".join(f"{number} {name}" for number, name in enumerate(grid.HEADINGS)) in page
    for latitude, words in ((0.0, "19 m at the equator"), (57.7, "10 m in Gothenburg")):
        _, south, _, north = grid.bounds(grid.cell_of(latitude, 11.97))
        assert f"{float(north - south) * 111_320.0:.0f} m" == words[: words.index("m") + 1]
        assert words in " ".join(page.split())
