"""Pages that lag behind the code fail here: commands, options, rooms, examples and figures of the READMEs."""

from __future__ import annotations

import ast
import re
import shlex

import pytest

from schemas.runtime import commandline
from tests.house import ROOT
from tests.test_commands import LINES
from tests.usability import readme, stale

README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("half", stale.HALVES)
def test_the_page_of_options_is_what_the_commands_take(half: str) -> None:
    """`python -m tests.usability.stale` writes it anew."""
    assert (ROOT / half / "cli" / "README.md").read_text(encoding="utf-8") == stale.page_of_options(half)
    assert stale.undocumented() == []


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


@pytest.mark.parametrize("page", ["README.md", "edge_agent/README.md", "fleet_service/README.md", "deploy/README.md"])
def test_files_that_a_page_links_to_are_there(page: str) -> None:
    links = re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", (ROOT / page).read_text(encoding="utf-8"))
    local = [link for link in links if "://" not in link]
    assert not [link for link in local if not ((ROOT / page).parent / link).exists()]
