"""Prepare a release: check the changelog, set the version, and build sdist, wheels, SBOM and
licences in `dist/`.

    python -m tests.release 0.2.0

The program changes `pyproject.toml` and `CITATION.cff`, but makes no commit and no tag.
`CHANGELOG.md` must have a section `## 0.2.0` with text: rename "Unreleased" first.
"""

from __future__ import annotations

import re
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import distributions
from pathlib import Path
from typing import Final

from schemas.errors import InputError
from tests.platform_wheel import build_packages
from tests.structure import ROOT

VERSION: Final = re.compile(r"\d+\.\d+\.\d+")


def changelog_section(text: str, version: str) -> str:
    """Return the changelog's section of a version.

    Raises:
        InputError: the section is missing or empty.
    """
    found = re.search(
        rf"^## {re.escape(version)}\b[^\n]*\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL
    )
    if found is None or not found[1].strip():
        raise InputError(
            "changelog", f"has no section '## {version}'", "rename the section Unreleased"
        )
    return found[1].strip()


def with_version(text: str, pattern: str, version: str) -> str:
    """Return a file's text in which the version number is replaced by `version`.

    Args:
        text: content of the file.
        pattern: regular expression with one group, the text before the version.
        version: the new version.

    Raises:
        InputError: the pattern does not match exactly once.
    """
    changed, count = re.subn(pattern + r"[^\"\n]+", rf"\g<1>{version}", text, flags=re.MULTILINE)
    if count != 1:
        raise InputError(
            "version", f"{pattern!r} matches {count} times", "correct the file or the pattern"
        )
    return changed


def set_version(root: Path, version: str, day: str) -> None:
    """Write version and date into `pyproject.toml` and `CITATION.cff`."""
    project = root / "pyproject.toml"
    project.write_text(
        with_version(project.read_text(encoding="utf-8"), r'^(version = ")', version),
        encoding="utf-8",
    )
    citation = root / "CITATION.cff"
    text = with_version(citation.read_text(encoding="utf-8"), r"^(version: )", version)
    citation.write_text(with_version(text, r'^(date-released: ")', day), encoding="utf-8")


def list_licences() -> str:
    """Return a text with name, version and licence of each installed package, one package per
    line.
    """
    lines = []
    for package in distributions():
        about = package.metadata
        classifiers = about.get_all("Classifier") or []
        named = [line.rpartition(" :: ")[2] for line in classifiers if line.startswith("License")]
        stated = [about[name] for name in ("License-Expression", "License") if name in about]
        text = next(iter([*stated[:1], ", ".join(named)]), "") or "?"
        text = text.splitlines()[0]
        lines.append(f"{about['Name']} {package.version}: {text}")
    return "\n".join(sorted(set(lines), key=str.lower)) + "\n"


def main() -> int:
    """Run all steps of a release, print the remaining manual steps, and return the exit code."""
    version = next(iter(sys.argv[1:]), "")
    if not VERSION.fullmatch(version):
        print("error: version: must be like 0.2.0; make release VERSION=0.2.0", file=sys.stderr)
        return 2
    try:
        section = changelog_section((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), version)
        set_version(ROOT, version, f"{datetime.now(UTC):%Y-%m-%d}")
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    build_packages(ROOT / "dist")
    sbom = ROOT / "dist" / f"gripmap-{version}.cdx.json"
    command = [sys.executable, "-m", "cyclonedx_py", "environment", "--output-file", str(sbom)]
    subprocess.run(command, cwd=ROOT, check=True)
    (ROOT / "dist" / "licences.txt").write_text(list_licences(), encoding="utf-8")
    print(f"dist/ holds version {version}. Commit, then: git tag -s v{version}\n\n{section}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
