"""Tests that the results page and the results block of the root README are made from the stored
figures.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fleet_service.lab import fading
from schemas.runtime import figures
from schemas.runtime.figures import Figure
from tests import results


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty folder that replaces deploy/figures during the test."""
    monkeypatch.setattr(results, "FOLDER", tmp_path / "figures")
    return tmp_path


def test_results_pages_are_current() -> None:
    assert results.find_stale() == []


def test_readme_has_one_results_block_of_at_most_eight_rows() -> None:
    block = results.readme_block()
    rows = [line for line in block.splitlines() if line.startswith("| ")][1:]
    assert 0 < len(rows) <= 8
    assert results.README.read_text(encoding="utf-8").count(results.BEGIN) == 1
    assert block in results.README.read_text(encoding="utf-8")


def test_every_judged_figure_is_on_the_page_with_its_commit() -> None:
    page = results.results_page()
    for name in results.CAMPAIGNS:
        for row in results.read_kept(name).values():
            assert row["commit"]
            if row["bar"] is not None:
                assert f"|`{row['name']}`|" in page


def test_missed_targets_are_first_and_marked(folder: Path) -> None:
    left = folder / "left.json"
    figures.write_figures(
        left,
        "demo",
        [1, 2, 3],
        [Figure("demo.a", 0.9, "", 0.8, "more"), Figure("demo.b", 0.2, "", 0.1)],
    )
    assert results.keep_figures("demo", left).startswith("demo: 2 figures")
    page = results.results_page()
    assert "2 figures have a target; 1 meet it and 1 miss it." in page
    assert f"|`demo.b` {results.MISSED}|0.2|≤ 0.1|" in page.split("\n## ")[1]
    section = page[page.index("## `make demo`") :]
    assert "seeds 1 to 3" in section
    assert section.index("`demo.b`") < section.index("`demo.a`")


def test_fault_campaign_is_kept_alone_if_it_is_complete(folder: Path) -> None:
    left = folder / "left.json"
    for title, expected in (
        ("faults --only path", "1 figures"),
        ("faults-quick --only path", "unchanged"),
    ):
        figures.write_figures(
            left, title, [0], [Figure("faults.path.teleports", 1000.0, "cars", 100)]
        )
        assert expected in results.keep_figures("faults", left)


def test_keep_takes_only_complete_runs_and_keeps_the_rest(folder: Path) -> None:
    left = folder / "left.json"
    figures.write_figures(
        left, "demo", [1], [Figure("demo.a", 0.955, "", 0.9, "more"), Figure("unshown", 1.0, "")]
    )
    assert results.keep_figures("demo", left).startswith("demo: 1 figures")
    figures.write_figures(left, "demo", [1], [Figure("demo.b", 0.1, "", 0.12)])
    assert results.keep_figures("demo", left).startswith("demo: 1 figures")
    assert set(results.read_kept("demo")) == {"demo.a", "demo.b"}
    figures.write_figures(left, "demo --quick", [1], [Figure("demo.a", 0.5, "")])
    assert "unchanged" in results.keep_figures("demo", left)
    assert results.read_kept("demo")["demo.a"]["value"] == 0.955
    assert "run `make demo` first" in results.keep_figures("demo", folder / "none.json")


def test_older_run_replaces_no_figure(folder: Path) -> None:
    left = folder / "left.json"
    figures.write_figures(left, "demo", [1], [Figure("demo.a", 0.5, "", 0.9)])
    results.keep_figures("demo", left)
    rows = json.loads(left.read_text())
    rows[0]["date"] = "2000-01-01T00:00:00+00:00"
    rows[1]["value"] = 0.1
    left.write_text(json.dumps(rows))
    assert "older" in results.keep_figures("demo", left)
    assert results.read_kept("demo")["demo.a"]["value"] == 0.5


def test_table_without_figures_states_that_they_are_missing() -> None:
    table = next(table for table in results.TABLES if table.campaign == "fleet")
    assert results._render_table(table, {}).startswith("Not complete: the kept run has no figure ")


def test_the_table_of_fading_has_all_weathers_and_times() -> None:
    names = [f"{fading.PREFIX}.{one}.min{at}" for one in fading.WEATHER for at in fading.AFTER_MIN]
    rows = results._format_fading(dict.fromkeys(names, 0.3)).splitlines()
    assert len(rows) == 2 + len(fading.WEATHER)
    assert {row.count("|") for row in rows} == {2 + len(fading.AFTER_MIN)}
