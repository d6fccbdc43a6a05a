"""The shape of the house, counted from its source: `python -m tests.house [ANOTHER_CHECKOUT]`.

Rooms are the entries of a package's folder; an arrow says that one of them imports another.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
PACKAGES: Final = ("schemas", "edge_agent", "fleet_service", "deploy")
MOST_PARAMETERS: Final = 7
LIGHT: Final = "import schemas.keys, schemas.grid, schemas.wire, schemas.tables, schemas.query"
HEAVY: Final = ("numba", "llvmlite", "scipy", "zenoh")


def sources(root: Path, *folders: str) -> list[Path]:
    """Every Python file below the folders that a person wrote."""
    found = (path for folder in folders for path in sorted((root / folder).rglob("*.py")))
    return [path for path in found if not path.name.endswith("_pb2.py")]


def parse(path: Path) -> ast.Module:
    """The syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


def imported(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and full name of everything imported in a syntax tree, also inside functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, name.name) for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            yield from ((node.lineno, f"{module}.{name.name}") for name in node.names)


def room_of(name: str) -> tuple[str, str]:
    """Package and room of a dotted name."""
    package, room, *_ = [*name.split("."), "", ""]
    return package, room


def arrows(root: Path, package: str) -> dict[tuple[str, str], str]:
    """Which room of a package imports which, each with one place where it does."""
    found: dict[tuple[str, str], str] = {}
    for path in sources(root, package):
        parts = path.relative_to(root / package).with_suffix("").parts
        for line, name in imported(parse(path)):
            other, room = room_of(name)
            if other == package and room and parts[0] not in (room, "__init__"):
                found.setdefault((parts[0], room), f"{path.relative_to(root)}:{line}")
    return found


def loose_modules(root: Path, package: str) -> list[str]:
    """Modules that stand outside every room."""
    return sorted(path.stem for path in (root / package).glob("*.py") if path.name != "__init__.py")


def too_wide(root: Path) -> list[str]:
    """Functions with more positional parameters than a reader holds in mind."""
    found = []
    for path in sources(root, *PACKAGES):
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                names = [argument.arg for argument in (*node.args.posonlyargs, *node.args.args)]
                count = len([name for name in names if name not in ("self", "cls")])
                if count > MOST_PARAMETERS:
                    found.append(f"{path.relative_to(root)}:{node.lineno} {node.name} ({count})")
    return found


def ambiguous_classes(root: Path) -> dict[str, list[str]]:
    """Names of classes, public or not, that stand for several things, with their places."""
    places: dict[str, list[str]] = {}
    for path in sources(root, *PACKAGES):
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, []).append(f"{path.relative_to(root)}:{node.lineno}")
    return {name: found for name, found in places.items() if len(found) > 1}


def light_import(root: Path) -> tuple[float, int, list[str]]:
    """Milliseconds and modules of importing the contract, and what of the heavy libraries came along."""
    words = (
        f"import sys, time; before = set(sys.modules); begun = time.perf_counter(); {LIGHT}; "
        f"print(1e3 * (time.perf_counter() - begun), len(set(sys.modules) - before), "
        f"*[name for name in {HEAVY!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", words], cwd=root, capture_output=True, text=True, check=True)
    milliseconds, modules, *heavy = done.stdout.split()
    return float(milliseconds), int(modules), heavy


def main(root: Path) -> None:
    """Print the figures of a checkout."""
    for package in PACKAGES[:3]:
        print(f"{package}: {len(loose_modules(root, package))} loose modules, {len(arrows(root, package))} arrows")
    print(f"functions over {MOST_PARAMETERS} parameters: {len(too_wide(root))}")
    print(f"class names used more than once: {len(ambiguous_classes(root))}")
    milliseconds, modules, heavy = light_import(root)
    print(f"{LIGHT}: {milliseconds:.0f} ms, {modules} modules, {', '.join(heavy) or 'nothing heavy'}")
    counts = Counter(place.split(":")[0] for place in too_wide(root))
    for name, count in counts.most_common():
        print(f"  {name}: {count} wide")
    for name, places in ambiguous_classes(root).items():
        print(f"  {name}: {', '.join(places)}")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else ROOT)
