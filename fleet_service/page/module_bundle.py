"""Bundler that joins the page's ES modules into one script. Pure (no I/O).

Browsers open only six connections per host, so two dozen modules delay the first display. In the
bundle, each module is a function that returns its exports. It is called once, after the modules
that it imports. There is no build step: the server makes the bundle when it starts.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping
from graphlib import TopologicalSorter
from typing import Final

_IMPORT: Final = re.compile(r'^import \{([^{}]+)\} from "\./(\w+)\.js";$', re.MULTILINE)
_EXPORT: Final = re.compile(r"^export (?=(?:async )?function |class |const )", re.MULTILINE)
_OTHER: Final = re.compile(r"^(?:import|export)\b.*$", re.MULTILINE)


def bundle_modules(modules: Mapping[str, str], main: str) -> str:
    """Return one script with the same effect as the module `main`.

    Args:
        modules: text of each module by name; a module is imported as `./NAME.js`.
        main: name of the module to run, which no other module imports.

    Raises:
        ValueError: an import or export has another form than `import { a, b } from "./name.js";`,
            or imports are circular.
        KeyError: a module is missing.
    """
    imported_names: defaultdict[str, set[str]] = defaultdict(set)
    needs: dict[str, list[str]] = {}
    waiting = [main]
    while waiting:
        name = waiting.pop()
        if name in needs:
            continue
        found = _IMPORT.findall(modules[name])
        needs[name] = [module for _, module in found]
        waiting += needs[name]
        for names, module in found:
            imported_names[module] |= {one.split(" as ")[0] for one in _split_names(names)}
    return "".join(
        _strip_imports(modules[name])
        if name == main
        else _wrap_module(name, _strip_imports(modules[name]), sorted(imported_names[name]))
        for name in TopologicalSorter(needs).static_order()
    )


def _wrap_module(name: str, body: str, exported: list[str]) -> str:
    return f"const from_{name} = (() => {{\n{body}return {{ {', '.join(exported)} }};\n}})();\n"


def _split_names(names: str) -> list[str]:
    """Return the names of an import, which may be on several lines; "a as b" is one of them."""
    return [one.strip() for one in names.split(",") if one.strip()]


def _strip_imports(text: str) -> str:
    """Return a module's text with its imports replaced by constants, and without the keyword
    `export`.
    """
    text = _IMPORT.sub(
        lambda m: (
            f"const {{ {', '.join(_split_names(m[1])).replace(' as ', ': ')} }} = from_{m[2]};"
        ),
        _EXPORT.sub("", text),
    )
    if other := _OTHER.search(text):
        raise ValueError(f"{other[0]!r} cannot be joined into one script")
    return text
