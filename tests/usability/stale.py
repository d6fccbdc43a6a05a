"""Pages against code: options that no page mentions, and the pages of options."""

from __future__ import annotations

import argparse
import importlib
import re
from collections.abc import Iterator
from typing import Any, Final

import edge_agent.cli
import fleet_service.cli
from tests.house import ROOT

HALVES: Final[dict[str, Any]] = {"edge_agent": edge_agent.cli, "fleet_service": fleet_service.cli}


def options() -> Iterator[tuple[str, str, str]]:
    """Half, command and option of everything that can be typed."""
    for half, line in HALVES.items():
        for command in line.COMMANDS:
            parser = argparse.ArgumentParser(add_help=False)
            importlib.import_module(command.module).add_arguments(parser)
            for action in parser._actions:
                if action.option_strings:
                    yield half, command.name, action.option_strings[0]


def page_of_options(half: str) -> str:
    """The page of a half's commands and options, made from the parsers: `python -m tests.usability.stale` writes it."""
    line = HALVES[half]
    made = "Made from the code by `python -m tests.usability.stale`; a test fails when it lags."
    parts = [f"# The options of `{half.replace('_', '-')}`\n\n{made} Every command has `-h`, `-v` and `-q`.\n"]
    for command in line.COMMANDS:
        parser = argparse.ArgumentParser(add_help=False)
        importlib.import_module(command.module).add_arguments(parser)
        parts.append(
            f"\n## `{command.name}`: {command.help}\n\n```\n{command.example}\n```\n\n| option | |\n|---|---|\n"
        )
        for action in parser._actions:
            name = ", ".join(action.option_strings) or (
                action.metavar if isinstance(action.metavar, str) else action.dest
            )
            about = (action.help or "") % {"default": action.default} if action.help else ""
            choices = f" ({', '.join(map(str, action.choices))})" if action.choices and not action.metavar else ""
            parts.append(f"| `{_cell(name)}` | {_cell(about + choices)} |\n")
    return "".join(parts)


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def undocumented() -> list[str]:
    """Options that stand neither in the pages of their half nor in the root README."""
    pages = {
        half: "".join(page.read_text() for page in [ROOT / "README.md", *sorted((ROOT / half).rglob("README.md"))])
        for half in HALVES
    }
    return [f"{half} {name} {option}" for half, name, option in options() if not re.search(rf"{option}\b", pages[half])]


def main() -> None:
    """Write the pages of options."""
    for half in HALVES:
        (ROOT / half / "cli" / "README.md").write_text(page_of_options(half), encoding="utf-8")


if __name__ == "__main__":
    main()
