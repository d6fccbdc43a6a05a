"""Tests of the page's static files. Every text must stand in one table, modules must be short and
joined into one script, and the page must load nothing from another host.
"""

from __future__ import annotations

import json
import re
from graphlib import CycleError
from pathlib import Path

import pytest

from fleet_service.page.files import SCRIPT
from fleet_service.page.module_bundle import bundle_modules
from tests.structure import ROOT


def test_every_text_is_in_the_table_and_every_entry_is_used() -> None:
    static = ROOT / "fleet_service/page/static"
    table: dict[str, str] = json.loads((static / "texts.en.json").read_text())
    source = "\n".join(path.read_text() for path in static.glob("*.js"))
    families = (
        "tab.",
        "heading.",
        "basis.",
        "legend.kind.",
        "legend.sure.",
        "legend.short.",
        "cell.headline.",
        "card.",
        "theme.",
        "alert.",
        "show.",
        "share.",
        "ago.",
        "health.router.",
        "overview.share.",
    )
    unused = [key for key in table if f'"{key}"' not in source and not key.startswith(families)]
    assert unused == []
    assert all(f'"{key}"' not in source or key in table for key in table)


def test_bundled_modules_behave_as_separate_ones() -> None:
    """When the page's modules are joined, each import must become the exported value. A private
    name that two modules use must become two variables.
    """
    modules = {
        "main": (
            'import {\n  add as sum,\n  ONE,\n} from "./a.js";\n'
            'import { two } from "./b.js";\nsay(sum(two(), ONE));\n'
        ),
        "a": (
            "const own = 1;\nexport const ONE = own;\n"
            "export function add(x, y) { return x + y; }\nexport class Not {}\n"
        ),
        "b": (
            'import { ONE } from "./a.js";\nconst own = 41;\nexport const two = () => own + ONE;\n'
        ),
    }
    assert bundle_modules(modules, "main") == (
        "const from_a = (() => {\nconst own = 1;\nconst ONE = own;\nfunction add(x, y) { return x "
        "+ y; }\n"
        "class Not {}\nreturn { ONE, add };\n})();\n"
        "const from_b = (() => {\nconst { ONE } = from_a;\nconst own = 41;\nconst two = () => own "
        "+ ONE;\n"
        "return { two };\n})();\n"
        "const { add: sum, ONE } = from_a;\nconst { two } = from_b;\nsay(sum(two(), ONE));\n"
    )


@pytest.mark.parametrize(
    "text",
    [
        'import main from "./main.js";\n',
        'import "./main.js";\n',
        "export default 1;\n",
        "export { a };\n",
    ],
)
def test_modules_that_cannot_be_bundled_raise(text: str) -> None:
    with pytest.raises(ValueError, match="cannot be joined"):
        bundle_modules({"main": text}, "main")
    with pytest.raises(CycleError):
        bundle_modules({"main": 'import { a } from "./main.js";\n'}, "main")


def test_every_module_is_in_the_one_script_that_the_page_asks_for() -> None:
    static = ROOT / "fleet_service/page/static"
    modules = {path.stem: path.read_text() for path in static.glob("*.js")}
    script = bundle_modules(modules, "main")
    assert all(f"const from_{name} = " in script for name in modules if name != "main")
    assert re.findall(r"<script[^>]*>", (static / "index.html").read_text()) == [
        f'<script type="module" src="/static/{SCRIPT}">'
    ]


@pytest.mark.parametrize(
    "path", sorted((ROOT / "fleet_service/page/static").glob("*.js")), ids=lambda path: path.name
)
def test_page_modules_are_short_and_take_nothing_from_elsewhere(path: Path) -> None:
    text = path.read_text()
    assert text.count("\n") <= 400
    assert max(map(len, text.splitlines())) <= 100
    assert "http://" not in text.replace("http://www.w3.org/2000/svg", "")
    assert "https://" not in text
    assert "innerHTML" not in text
