"""The page's own files, as text: words in one table, modules that are short, asked for together, from nowhere else."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tests.house import ROOT


def test_every_word_stands_in_the_table_and_every_entry_is_used() -> None:
    static = ROOT / "fleet_service/page/static"
    table: dict[str, str] = json.loads((static / "texts.en.json").read_text())
    source = "\n".join(path.read_text() for path in static.glob("*.js"))
    families = (
        "tab.",
        "heading.",
        "basis.",
        "legend.class.",
        "legend.two.",
        "show.",
        "share.",
        "ago.",
        "health.router.",
    )
    unused = [key for key in table if f'"{key}"' not in source and not key.startswith(families)]
    assert unused == []
    assert all(f'"{key}"' not in source or key in table for key in table)


def test_all_modules_are_asked_for_at_once_and_not_one_after_the_other() -> None:
    static = ROOT / "fleet_service/page/static"
    named = re.findall(r'<link rel="modulepreload" href="/static/(.*?)">', (static / "index.html").read_text())
    assert named == sorted(path.name for path in static.glob("*.js") if path.name != "main.js")


@pytest.mark.parametrize("path", sorted((ROOT / "fleet_service/page/static").glob("*.js")), ids=lambda path: path.name)
def test_a_module_is_short_enough_to_be_read_and_takes_nothing_from_elsewhere(path: Path) -> None:
    text = path.read_text()
    assert text.count("\n") <= 400
    assert "http://" not in text.replace("http://www.w3.org/2000/svg", "")
    assert "https://" not in text
    assert "innerHTML" not in text
