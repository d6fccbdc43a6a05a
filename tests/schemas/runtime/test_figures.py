"""Tests of figures (measured values with a target, the bar). A figure meets or misses its bar, and
the stored file must record which.
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from schemas.runtime import figures as figures_module
from schemas.runtime.figures import Figure, find_commit, format_table, write_figures


@pytest.mark.parametrize(
    ("figure", "holds"),
    [
        (Figure("a", 1.0, "s", 2.0, "less"), True),
        (Figure("a", 3.0, "s", 2.0, "less"), False),
        (Figure("a", 3.0, "s", 2.0, "more"), True),
        (Figure("a", 0.9, "", (0.8, 0.99), "within"), True),
        (Figure("a", 1.0, "", (0.8, 0.99), "within"), False),
        (Figure("a", float("nan"), "s", 2.0, "less"), False),
        (Figure("a", float("nan"), "s"), False),
    ],
)
def test_figure_holds_on_the_right_side_and_never_when_missing(figure: Figure, holds: bool) -> None:
    assert figure.holds is holds


def _run_git(folder: Path, *words: str) -> str:
    who = ("-c", "user.name=nobody", "-c", "user.email=nobody@example.org")
    done = subprocess.run(
        ["git", *who, *words], cwd=folder, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def test_commit_is_that_of_the_source_with_a_mark_if_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    source = tmp_path / "house" / "room" / "code.py"
    other = tmp_path / "house" / "room" / "site-packages.py"
    source.parent.mkdir(parents=True)
    source.write_text("1")
    assert find_commit(source) == "unknown"
    _run_git(source.parent, "init", "-q")
    _run_git(source.parent, "add", ".")
    _run_git(source.parent, "commit", "-qm", "first")
    head = _run_git(source.parent, "rev-parse", "--short=7", "HEAD")
    assert find_commit(source) == head
    other.write_text("installed here, and no part of it")
    assert find_commit(other) == "unknown"
    source.write_text("2")
    assert find_commit(source) == f"{head}-dirty"


def test_figures_file_has_a_header_and_marks_missed_targets(tmp_path: Path) -> None:
    figures = [Figure("good", 1.0, "s", 2.0), Figure("bad", float("nan"), "s", 2.0)]
    write_figures(tmp_path / "out" / "figures.json", "demo", [1], figures)
    first, good, bad = json.loads((tmp_path / "out" / "figures.json").read_text())
    assert {"commit", "machine", "versions", "seeds", "date"} <= first.keys()
    assert (good["value"], good["holds"]) == (1.0, True)
    assert (bad["value"], bad["holds"]) == (None, False)
    assert "DOES NOT HOLD" in format_table(figures)


def test_a_value_of_numpy_is_written_like_any_other(tmp_path: Path) -> None:
    found = [
        Figure("a", np.float64(0.5), "", 1.0),
        Figure("b", np.float64(0.5), "", (0.6, 1.0), "within"),
    ]
    write_figures(tmp_path / "figures.json", "demo", [1], found)
    assert [row["holds"] for row in json.loads((tmp_path / "figures.json").read_text())[1:]] == [
        True,
        False,
    ]


def test_figures_are_written_without_an_optional_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures_module, "PACKAGES", ("numpy", "not-installed-anywhere"))
    write_figures(tmp_path / "figures.json", "demo", [1], [])
    versions = json.loads((tmp_path / "figures.json").read_text())[0]["versions"]
    assert list(versions) == ["numpy"]
