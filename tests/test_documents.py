"""Tests that the documentation agrees with the code. Every option must be documented, every command
on a page must be valid, links must lead to their targets, and pages must keep their size limits.
"""

from __future__ import annotations

import ast
import re
import shlex
import subprocess

import pytest

from fleet_service.cli import export
from schemas.errors import InputError
from schemas.runtime import commandline
from tests import reference_pages
from tests.language import NOT_OURS
from tests.results import list_pages
from tests.structure import ROOT
from tests.test_commands import LINES
from tests.usability import mistakes, readme

HALVES = {"edge_agent": "edge-agent", "fleet_service": "fleet-service"}
README_WORDS = 450
FIRST_COMMAND_WITHIN = 120
README_LINES = 60
COLUMNS = 100
CONTRACT = "schemas/README.md"  # reference for other languages, not an overview of a folder


@pytest.mark.parametrize("half", HALVES)
def test_every_option_and_setting_is_documented(half: str) -> None:
    assert reference_pages.undocumented_options() == []
    rows = list(reference_pages.settings_rows(reference_pages.SETTINGS[HALVES[half]]))
    assert len(rows) > 10
    assert not [name for name, _, about in rows if not about]
    page = reference_pages.command_page(HALVES[half])
    assert not [c.name for c in LINES[HALVES[half]].COMMANDS if f"\n## `{c.name}`\n" not in page]


def test_tables_page_has_every_column() -> None:
    page = reference_pages.tables_page()
    for fields in reference_pages.TABLES.values():
        assert not [field.name for field in fields if f"| `{field.name}` |" not in page]


def test_a_mistake_is_made_with_every_command() -> None:
    for lines, half in ((mistakes.EDGE, "edge-agent"), (mistakes.FLEET, "fleet-service")):
        made = {line.split()[0] for line in lines if line}
        assert made >= {command.name for command in LINES[half].COMMANDS}
    assert len(mistakes.EDGE) + len(mistakes.FLEET) >= 60


def list_commands(text: str) -> list[str]:
    """Return the commands in the code blocks of a page. Comments are left out, and also lines that
    contain brackets (synopses).
    """
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    lines = [line.strip() for block in blocks for line in block.splitlines() if "[" not in line]
    lines += [
        line.strip() for line in re.findall(r"^    \S.*$", text, re.MULTILINE) if "[" not in line
    ]
    commands = [line for line in lines if line.startswith(("edge-agent ", "fleet-service "))]
    return [re.split(r"\s{2,}|\s[#>]|\|", command)[0] for command in commands]


def test_every_command_of_every_page_is_understood() -> None:
    found = [
        (str(page.relative_to(ROOT)), line)
        for page in list_pages()
        for line in list_commands(page.read_text())
    ]
    assert len({page for page, _ in found}) >= 6
    assert len(found) > 30
    for page, line in found:
        name, *words = shlex.split(line)
        try:
            arguments = commandline.parser_of(*LINES[name].LINE, words[0]).parse_args(
                commandline.join_negative_numbers(words)
            )
            if words[0] == "export":
                export.check_options(arguments)
        except (SystemExit, InputError) as error:
            pytest.fail(f"{page}: {line}: {error}")


@pytest.mark.parametrize("half", HALVES)
def test_readme_of_a_package_lists_every_sub_package(half: str) -> None:
    page = (ROOT / half / "README.md").read_text(encoding="utf-8")
    folders = [path.parent.name for path in (ROOT / half).glob("*/__init__.py")]
    assert len(folders) > 8
    assert not [folder for folder in folders if f"`{folder}/" not in page]


def test_modules_in_the_tables_of_a_readme_exist() -> None:
    missing = []
    for page in list_pages():
        if page.name != "README.md":
            continue
        for cell in re.findall(r"^\|([^|]*)\|", page.read_text(), re.MULTILINE):
            modules = re.findall(r"`([\w/]+\.py)`", cell)
            missing += [
                f"{page.relative_to(ROOT)}: {module}"
                for module in modules
                if not list(page.parent.rglob(module))
            ]
    assert not missing


def test_every_command_of_the_tutorials_is_understood_and_writes_to_try() -> None:
    found = readme.list_commands(readme.read_pages())
    assert len(found) > 15
    for command in found:
        if "\n" in command:
            ast.parse(command)
            continue
        words = shlex.split(command)
        if words[0] in LINES:
            arguments = commandline.parser_of(*LINES[words[0]].LINE, words[1]).parse_args(
                commandline.join_negative_numbers(words[1:])
            )
            written = [
                str(getattr(arguments, name))
                for name in ("out", "archive", "vehicle_out")
                if getattr(arguments, name, None)
            ]
            assert all(path.startswith("try/") for path in written), command


def test_git_ignores_what_the_tutorials_make_and_every_key() -> None:
    """After the tutorials, `git add .` must add no file, above all no private key."""
    made = [
        "try/certs/ca/key.pem",
        "certs/ca/key.pem",
        "any.key",
        "deploy/any.pem",
        "archive/x",
        "drives/x",
        "spool.sqlite",
    ]
    done = subprocess.run(
        ["git", "check-ignore", *made], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.stdout.splitlines() == made
    done = subprocess.run(
        ["git", "check-ignore", "README.md"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.stdout == ""


def list_anchors(text: str) -> set[str]:
    """Return the anchors of a page: those that GitHub makes from its headings, and its explicit
    labels.
    """
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    slugs = {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}
    return slugs | set(re.findall(r"^\((.*)\)=$", text, re.MULTILINE))


def test_links_of_pages_lead_to_files_and_headings() -> None:
    found = [
        (page, link, anchor)
        for page in list_pages()
        for link, _, anchor in re.findall(
            r"\]\(([^)#\s]*)(#([^)]*))?\)", page.read_text(encoding="utf-8")
        )
        if "://" not in link
    ]
    assert len(found) > 40
    for page, link, anchor in found:
        target = (page.parent / link).resolve() if link else page
        assert target.exists(), (str(page), link)
        if anchor:
            assert anchor in list_anchors(target.read_text(encoding="utf-8")), (
                str(page),
                link,
                anchor,
            )


def test_pages_have_no_reference_links_which_the_link_test_cannot_follow() -> None:
    """Pages must not contain Markdown reference links (`[text][label]`, with `[label]: target` at
    the end of the page). The test of links follows only inline links, `[text](target)`.
    """
    reference = re.compile(r"^\[[^\]]+\]: \S|\]\[[\w.]+\]", re.MULTILINE)
    for page in list_pages():
        assert not reference.findall(page.read_text(encoding="utf-8")), page


def test_root_readme_is_short_and_soon_has_a_command() -> None:
    words = (ROOT / "README.md").read_text(encoding="utf-8").split()
    assert len(words) <= README_WORDS
    assert " ".join(words).split(" make demo")[0].count(" ") < FIRST_COMMAND_WITHIN


def test_readmes_of_sub_packages_have_at_most_sixty_lines() -> None:
    for page in list_pages():
        name = str(page.relative_to(ROOT))
        if page.name == "README.md" and name not in (CONTRACT, "README.md"):
            lines = len(page.read_text(encoding="utf-8").splitlines())
            assert lines <= README_LINES, f"{name}: {lines} lines"


def test_prose_of_pages_keeps_to_the_line_length_of_the_code() -> None:
    """Tables and code may be wider. Otherwise README_LINES would not limit the length of a page."""
    for page in list_pages():
        if page.name in NOT_OURS:
            continue
        text = page.read_text(encoding="utf-8")
        prose = re.sub(r"^```.*?^```|^    \S.*$|^\|.*$", "", text, flags=re.DOTALL | re.MULTILINE)
        wide = [line for line in prose.splitlines() if len(line) > COLUMNS]
        assert not wide, f"{page.relative_to(ROOT)}: {wide}"
