"""Pages that lag behind the code fail here: commands, options, rooms, examples and figures of the READMEs."""

from __future__ import annotations

import ast
import re
import shlex
import subprocess
from pathlib import Path

import pytest

from schemas.runtime import commandline, figures
from schemas.runtime.figures import Figure
from tests.house import ROOT
from tests.test_commands import LINES
from tests.usability import kept, mistakes, readme, stale

README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("half", stale.HALVES)
def test_the_page_of_options_is_what_the_commands_take(half: str) -> None:
    """`python -m tests.usability.stale` writes it anew."""
    assert (ROOT / half / "cli" / "README.md").read_text(encoding="utf-8") == stale.page_of_options(half)
    assert stale.undocumented() == []


def test_a_mistake_is_made_with_every_command() -> None:
    for lines, half in ((mistakes.EDGE, "edge_agent"), (mistakes.FLEET, "fleet_service")):
        made = {line.split()[0] for line in lines if line}
        assert made >= {command.name for command in stale.HALVES[half].COMMANDS}
    assert len(mistakes.EDGE) + len(mistakes.FLEET) >= 60


def typed(page: str) -> list[str]:
    """Commands of the blocks of a page, without what is said beside them; synopses with brackets are none."""
    blocks = re.findall(r"^```\w*\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    lines = [line.strip() for block in blocks for line in block.splitlines() if "[" not in line]
    commands = [line for line in lines if line.startswith(("edge-agent ", "fleet-service "))]
    return [re.split(r"\s{2,}|\s[#>]|\|", command)[0] for command in commands]


def test_every_command_of_every_page_is_understood() -> None:
    pages = [str(page.relative_to(ROOT)) for page in kept.pages()]
    found = [(page, line) for page in pages for line in typed(page)]
    assert len({page for page, _ in found}) >= 6
    assert len(found) > 50
    for page, line in found:
        name, *words = shlex.split(line)
        try:
            commandline.parser_of(*LINES[name].LINE, words[0]).parse_args(commandline.joined(words))
        except SystemExit:
            pytest.fail(f"{page}: {line}")


@pytest.mark.parametrize("half", stale.HALVES)
def test_every_room_and_command_stands_in_the_readme_of_its_half(half: str) -> None:
    page = (ROOT / half / "README.md").read_text(encoding="utf-8")
    rooms = [path.parent.name for path in (ROOT / half).glob("*/__init__.py")]
    assert len(rooms) > 8
    assert not [room for room in rooms if f"`{room}/" not in page]
    assert not [
        command.name
        for command in stale.HALVES[half].COMMANDS
        if f"{half.replace('_', '-')} {command.name}" not in page
    ]


def test_every_command_of_the_root_readme_is_understood_and_writes_where_git_looks_away() -> None:
    found = readme.commands(README)
    assert len(found) > 15
    for command in found:
        if "\n" in command:
            ast.parse(command)
            continue
        words = shlex.split(command)
        if words[0] in LINES:
            arguments = commandline.parser_of(*LINES[words[0]].LINE, words[1]).parse_args(commandline.joined(words[1:]))
            written = [
                str(getattr(arguments, name))
                for name in ("out", "archive", "vehicle_out")
                if getattr(arguments, name, None)
            ]
            assert all(path.startswith("try/") for path in written), command


def test_git_looks_away_from_what_the_readmes_make_and_from_every_key() -> None:
    """`git add .` behind the first hour adds nothing, an authority's private key least of all."""
    made = [
        "try/certs/ca/key.pem",
        "certs/ca/key.pem",
        "any.key",
        "deploy/any.pem",
        "archive/x",
        "drives/x",
        "spool.sqlite",
    ]
    done = subprocess.run(["git", "check-ignore", *made], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == made
    done = subprocess.run(["git", "check-ignore", "README.md"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout == ""


def test_files_that_pages_link_to_are_there() -> None:
    found = [
        (page, link)
        for page in kept.pages()
        for link in re.findall(r"\]\(([^)#\s]+?)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
        if "://" not in link
    ]
    assert len(found) > 40
    assert not [(str(page), link) for page, link in found if not (page.parent / link).exists()]


def test_figures_that_pages_quote_are_those_that_are_kept() -> None:
    """`make figures` writes both anew."""
    quoted = [quote for page in kept.pages() for quote in kept.quotes(page)]
    assert len(quoted) > 30
    measured = [quote for quote in quoted if (kept.FOLDER / f"{quote.file}.json").exists()]
    assert len(measured) >= 8
    there = [line for line in kept.stale() if any(f" {quote.name} " in f"{line} " for quote in measured)]
    assert there == []
    assert all(quote.said for quote in quoted), "defined and never quoted"
    for name in {quote.file for quote in measured}:
        assert all(row["commit"] for row in kept.kept(name).values())


def test_no_figure_is_typed_into_a_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert kept.by_hand() == []
    page = tmp_path / "README.md"
    page.write_text("| figure | value | note |\n|---|---|---|\n| a | [.11][demo.a], `x1` | 3 |\n| b | 7 ms | |\n\n"
                    "| figure | mine | theirs | bar |\n|---|---|---|---|\n| 2 | [1][demo.a] | **.3** | 4 |\n\n"
                    "| constant | why |\n|---|---|\n| 5 | 6 |\n")  # fmt: skip
    monkeypatch.setattr(kept, "ROOT", tmp_path)
    monkeypatch.setattr(kept, "pages", lambda: [page])
    assert kept.by_hand() == ["README.md: b: 7 ms", "README.md: 2: **.3**"]


def test_a_quoted_figure_that_changes_is_found_and_written_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page, left = tmp_path / "README.md", tmp_path / "left.json"
    page.write_text('Covers [95 %][demo.a], and [.11][demo.b].\n\n[demo.a]: figures/demo.json "{:.0%}"\n'
                    '[demo.b]: figures/demo.json "{:.2f}"\n')  # fmt: skip
    monkeypatch.setattr(kept, "ROOT", tmp_path)
    monkeypatch.setattr(kept, "FOLDER", tmp_path / "figures")
    monkeypatch.setattr(kept, "pages", lambda: [page])
    figures.write(left, "demo", [1], [Figure("demo.a", 0.955, "", 0.9, "more"), Figure("demo.b", 0.125, "", 0.12)])
    assert len(kept.stale()) == 2
    assert kept.take("demo", left).startswith("demo: 2 figures")
    assert [line.partition(" is ")[2] for line in kept.stale()] == [
        "[96 %][demo.a], not [95 %][demo.a]", "**[.12][demo.b]**, not [.11][demo.b]"
    ]  # fmt: skip
    assert kept.renew() == ["README.md"]
    assert page.read_text().startswith("Covers [96 %][demo.a], and **[.12][demo.b]**.\n")
    assert kept.stale() == []
    assert kept.renew() == []
    figures.write(left, "demo", [1], [Figure("demo.b", 0.1, "", 0.12), Figure("nobody.shows.it", 1.0, "")])
    assert kept.take("demo", left).startswith("demo: 1 figures")
    assert kept.renew() == ["README.md"]
    figures.write(left, "demo --quick", [1], [Figure("demo.a", 0.5, "")])
    assert "as it was" in kept.take("demo", left)
    assert kept.stale() == []


def test_a_table_of_a_campaigns_report_is_made_from_what_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page, left = tmp_path / "README.md", tmp_path / "left.json"
    page.write_text("Before.\n\n<!-- edge: world -->\n| 1 |\n<!-- end -->\n\nBehind.\n")
    monkeypatch.setattr(kept, "ROOT", tmp_path)
    monkeypatch.setattr(kept, "FOLDER", tmp_path / "figures")
    monkeypatch.setattr(kept, "pages", lambda: [page])
    assert kept.stale() == []
    found = [Figure("world.ckf.coverage90", 0.875, "1"), Figure("world.ckf.lost", 0.25, "1"), Figure("else", 1.0, "")]
    figures.write(left, kept.CAMPAIGNS["edge"].title, [1], found)
    assert kept.take("edge", left).startswith("edge: 2 figures")
    assert kept.stale() == ["README.md: a table is not that of the kept figures; make figures"]
    assert kept.renew() == ["README.md"]
    assert kept.stale() == []
    text = page.read_text()
    assert text.startswith("Before.\n\n<!-- edge: world -->\n| estimator | coverage |")
    assert text.endswith("|\n<!-- end -->\n\nBehind.\n")
    assert "| ckf | 0.875 |" in text
    assert " 0.25 |" in text
