"""Tests of a release: it must be refused without a changelog section, and must set the version
exactly once in each file.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from schemas.errors import InputError
from tests import release
from tests.structure import ROOT


def test_changelog_section_ends_at_the_next_heading() -> None:
    assert (
        release.changelog_section("# C\n\n## 0.2.0\n### Added\n- a\n\n## 0.1.0\nb\n", "0.2.0")
        == "### Added\n- a"
    )


@pytest.mark.parametrize(
    "text", ["# C\n\n## Unreleased\n- a\n", "# C\n\n## 0.2.0\n\n## 0.1.0\nb\n"]
)
def test_a_missing_or_empty_section_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="no section '## 0.2.0'"):
        release.changelog_section(text, "0.2.0")


def test_version_and_date_are_set_in_both_files(tmp_path: Path) -> None:
    for name in ("pyproject.toml", "CITATION.cff"):
        shutil.copy(ROOT / name, tmp_path / name)
    release.set_version(tmp_path, "9.8.7", "2031-01-02")
    assert 'version = "9.8.7"' in (tmp_path / "pyproject.toml").read_text()
    citation = (tmp_path / "CITATION.cff").read_text()
    assert "version: 9.8.7\n" in citation
    assert 'date-released: "2031-01-02"' in citation


def test_a_version_that_is_none_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["release", "soon"])
    assert release.main() == 2
    assert capsys.readouterr().err.startswith("error: version: must be like 0.2.0")


def test_every_pinned_version_has_its_hashes() -> None:
    pinned = re.findall(r"^\S+==\S+", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    hashed = (ROOT / "deploy" / "constraints-hashes.txt").read_text()
    found = re.findall(r"^(\S+==\S+) \\\n +--hash=sha256:", hashed, re.MULTILINE)
    assert sorted(map(normalise_name, pinned)) == sorted(map(normalise_name, found))


def normalise_name(requirement: str) -> str:
    name, _, version = requirement.partition("==")
    return f"{re.sub('[-_.]+', '-', name).lower()}=={version}"
