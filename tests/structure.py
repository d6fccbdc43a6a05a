"""Figures about the structure of the code, counted from its source.

    python -m tests.structure [CHECKOUT]          print the table: figure, value, bar, ceiling
    python -m tests.structure --places [FIGURE]   print the code places that a figure counts

A part of a package is a module or sub-package in its folder. A bar is the target of a figure; its
ceiling is the present limit, which may only fall.
`tests/test_structure.py` compares each figure with its ceiling.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

from tests.import_circles import circles_of

ROOT: Final = Path(__file__).resolve().parents[1]
PACKAGES: Final = ("schemas", "edge_agent", "fleet_service", "deploy")
MOST_PARAMETERS: Final = 7
LIGHT: Final = "import schemas.keys, schemas.grid, schemas.wire, schemas.tables, schemas.query"
HEAVY: Final = ("numba", "llvmlite", "scipy", "zenoh")


def list_sources(root: Path, *folders: str) -> list[Path]:
    """Return the paths of all handwritten Python files in the given folders below `root`."""
    found = (path for folder in folders for path in sorted((root / folder).rglob("*.py")))
    return [path for path in found if not path.name.endswith("_pb2.py")]


@cache
def parse(path: Path) -> ast.Module:
    """Return the syntax tree of a Python file; each file is parsed only once per process."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def list_nodes(path: Path) -> tuple[ast.AST, ...]:
    """Return all nodes of the syntax tree of a Python file, in the order of `ast.walk`."""
    return tuple(ast.walk(parse(path)))


def list_imports(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line number and full name of every import in a syntax tree, also inside functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, name.name) for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            yield from ((node.lineno, f"{module}.{name.name}") for name in node.names)


def part_of(name: str) -> tuple[str, str]:
    """Return the first two parts of a dotted name: package and sub-package (or module)."""
    package, part, *_ = [*name.split("."), "", ""]
    return package, part


def list_part_imports(root: Path, package: str) -> dict[tuple[str, str], str]:
    """Return the pairs (first, second) of sub-packages in which the first imports the second,
    within one package. Each pair has one example: file and line of the import.
    """
    found: dict[tuple[str, str], str] = {}
    for path in list_sources(root, package):
        parts = path.relative_to(root / package).with_suffix("").parts
        for line, name in list_imports(parse(path)):
            other, part = part_of(name)
            if other == package and part and parts[0] not in (part, "__init__"):
                found.setdefault((parts[0], part), f"{path.relative_to(root)}:{line}")
    return found


def loose_modules(root: Path, package: str) -> list[str]:
    """Return the names of the modules that lie directly in a package's folder, outside its
    sub-packages.
    """
    return sorted(path.stem for path in (root / package).glob("*.py") if path.name != "__init__.py")


def too_wide(root: Path) -> list[str]:
    """Return the functions of the product (all code except tests) that have more than
    MOST_PARAMETERS positional parameters.
    """
    found = []
    for path in list_sources(root, *PACKAGES):
        for node in list_nodes(path):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                names = [argument.arg for argument in (*node.args.posonlyargs, *node.args.args)]
                count = len([name for name in names if name not in ("self", "cls")])
                if count > MOST_PARAMETERS:
                    found.append(f"{path.relative_to(root)}:{node.lineno} {node.name} ({count})")
    return found


def ambiguous_classes(root: Path) -> dict[str, list[str]]:
    """Return the names that several classes have; for each name the files and lines of these
    classes.
    """
    places: dict[str, list[str]] = {}
    for path in list_sources(root, *PACKAGES):
        for node in list_nodes(path):
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, []).append(f"{path.relative_to(root)}:{node.lineno}")
    return {name: found for name, found in places.items() if len(found) > 1}


def light_import(root: Path) -> tuple[float, int, list[str]]:
    """Import the contract package (`schemas`) in a new process. Return the time [ms], the number of
    loaded modules, and the heavy libraries among them.
    """
    words = (
        f"import sys, time; before = set(sys.modules); begun = time.perf_counter(); {LIGHT}; "
        "print(1e3 * (time.perf_counter() - begun), len(set(sys.modules) - before), *[name for "
        f"name in {HEAVY!r} if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", words], cwd=root, capture_output=True, text=True, check=True
    )
    milliseconds, modules, *heavy = done.stdout.split()
    return float(milliseconds), int(modules), heavy


FunctionNode = ast.FunctionDef | ast.AsyncFunctionDef
Places = list[str]
CONSTANT_FOLDERS: Final = (
    "edge_agent/adaptation",
    "edge_agent/estimators/common",
    "edge_agent/estimators/friction_mixture",
    "edge_agent/observe",
    "fleet_service/fusion",
)
PRODUCT: Final = ("schemas", "edge_agent", "fleet_service")


def functions(root: Path, *packages: str) -> Iterator[tuple[str, FunctionNode]]:
    """Yield place (file, line and name) and syntax node of every function in the given packages."""
    for path in list_sources(root, *packages):
        for node in list_nodes(path):
            if isinstance(node, FunctionNode):
                yield f"{path.relative_to(root)}:{node.lineno} {node.name}", node


def list_inner_imports(root: Path, folder: str) -> Places:
    """Return one text per pair (first, second) of sub-packages or modules of a folder in which the
    first imports the second.
    """
    base = folder.replace("/", ".")
    found: dict[tuple[str, str], str] = {}
    for path in list_sources(root, folder):
        own = path.relative_to(root / folder).with_suffix("").parts[0]
        for line, name in list_imports(parse(path)):
            if name.startswith(f"{base}."):
                other = name.removeprefix(f"{base}.").split(".")[0]
                exists = (root / folder / other).is_dir() or (
                    root / folder / f"{other}.py"
                ).exists()
                if exists and other != own and own != "__init__":
                    found.setdefault((own, other), f"{path.relative_to(root)}:{line}")
    return [f"{a} -> {b}: {place}" for (a, b), place in sorted(found.items())]


def import_circles(root: Path) -> Places:
    """Return one text per circle of modules that import each other, also inside functions."""
    return circles_of(
        {path.relative_to(root): parse(path) for path in list_sources(root, *PACKAGES)}
    )


def methods_of_largest_class(root: Path) -> Places:
    """Return the methods and properties of the class that has the most, one entry per method."""
    largest: Places = []
    for path in list_sources(root, *PACKAGES):
        for node in list_nodes(path):
            if isinstance(node, ast.ClassDef):
                methods = [item for item in node.body if isinstance(item, FunctionNode)]
                if len(methods) > len(largest):
                    largest = [
                        f"{path.relative_to(root)}:{item.lineno} {node.name}.{item.name}"
                        for item in methods
                    ]
    return largest


def most_parameters(root: Path) -> Places:
    """Return the parameters, one entry each, of the function that has the most. Keyword parameters
    count; `self` and `cls` do not.
    """
    most: Places = []
    for place, node in functions(root, *PACKAGES):
        arguments = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
        names = [argument.arg for argument in arguments if argument.arg not in ("self", "cls")]
        if len(names) > len(most):
            most = [f"{place}: {name}" for name in names]
    return most


def functions_with_many_parameters(root: Path) -> Places:
    """Return the functions with more than six parameters, including keyword parameters."""
    found = []
    for place, node in functions(root, *PACKAGES):
        arguments = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
        count = len([argument for argument in arguments if argument.arg not in ("self", "cls")])
        if count > 6:
            found.append(f"{place} ({count})")
    return found


def packed_assignments(root: Path) -> Places:
    """Return the places of assignments of a literal tuple to several names: `a, b = x, y`."""
    found = []
    for path in list_sources(root, *PACKAGES):
        for node in list_nodes(path):
            match node:
                case ast.Assign(targets=[*_, ast.Tuple()], value=ast.Tuple()):
                    found.append(f"{path.relative_to(root)}:{node.lineno}")
    return found


def fmt_skips(root: Path) -> Places:
    """Return the places of all source lines, also in tests, that a comment excludes from
    formatting.
    """
    marker = "# fmt: " + "skip"
    return [
        f"{path.relative_to(root)}:{line}"
        for path in list_sources(root, *PACKAGES, "tests")
        for line, text in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if marker in text
    ]


def long_lines(root: Path) -> Places:
    """Return the places of all source lines, also in tests, with more than 100 characters."""
    return [
        f"{path.relative_to(root)}:{line}"
        for path in list_sources(root, *PACKAGES, "tests")
        for line, text in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if len(text) > 100
    ]


_NESTING: Final = (ast.If, ast.For, ast.While, ast.With, ast.Try, ast.AsyncFor, ast.AsyncWith)


def _measure_depth(node: ast.AST) -> int:
    """Return the largest depth of nested blocks in a function. An `elif` adds no depth. Inner
    functions do not count here, because they are measured separately.
    """
    deepest = 0
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            continue
        is_elif = isinstance(node, ast.If) and isinstance(child, ast.If) and node.orelse == [child]
        deepest = max(
            deepest, _measure_depth(child) + (isinstance(child, _NESTING) and not is_elif)
        )
    return deepest


def deep_nesting(root: Path) -> Places:
    """Return the functions with more than four levels of nested blocks."""
    found = ((place, _measure_depth(node)) for place, node in functions(root, *PACKAGES))
    return [f"{place} ({depth})" for place, depth in found if depth > 4]


def many_locals(root: Path) -> Places:
    """Return the functions with more than forty local names, including parameters."""
    found = []
    for place, node in functions(root, *PACKAGES):
        names = {item.arg for item in ast.walk(node.args) if isinstance(item, ast.arg)}
        for item in ast.walk(node):
            if isinstance(item, ast.Name) and isinstance(item.ctx, ast.Store):
                names.add(item.id)
        if len(names) > 40:
            found.append(f"{place} ({len(names)})")
    return found


def named_constants(root: Path) -> Places:
    """Return the places of named numbers in the code that processes data between sensor and map
    (the folders CONSTANT_FOLDERS).

    Counted are module constants (capital letters), and fields of classes called …Constants. Their
    value must be a number or an expression of numbers.
    """
    found = []
    for path in list_sources(root, *CONSTANT_FOLDERS):
        tree = parse(path)
        bodies = [("", tree.body)]
        bodies += [
            (f"{node.name}.", node.body)
            for node in tree.body
            if isinstance(node, ast.ClassDef) and node.name.endswith("Constants")
        ]
        for owner, body in bodies:
            for node in body:
                value = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
                target = (
                    node.targets[0]
                    if isinstance(node, ast.Assign)
                    else getattr(node, "target", None)
                )
                if value is None or not isinstance(target, ast.Name) or not _is_number(value):
                    continue
                if owner or target.id.isupper():
                    found.append(f"{path.relative_to(root)}:{node.lineno} {owner}{target.id}")
    return found


def _is_number(node: ast.AST) -> bool:
    """Return True if the syntax node is a number or an arithmetic expression of numbers, but no
    bool or text.
    """
    parts = list(ast.walk(node))
    constants = [part.value for part in parts if isinstance(part, ast.Constant)]
    plain = all(
        isinstance(part, ast.Constant | ast.BinOp | ast.UnaryOp | ast.operator | ast.unaryop)
        for part in parts
    )
    return plain and bool(constants) and all(type(value) in (int, float) for value in constants)


# Prefixes of methods that a library calls: `ast.NodeVisitor`, Proton's `MessagingHandler` and
# `http.server.BaseHTTPRequestHandler`.
LIBRARY_CALLS: Final = ("visit_", "on_", "log_message")


def only_tests_use(root: Path) -> Places:
    """Return the places of product functions and classes whose name occurs only in tests. The
    product does not need them.

    A name counts as used if any other line of product, deployment, Makefile, pages or examples
    contains it. Left out are functions with a decorator other than `property`, which may register
    them, and methods that a library calls by their name (`LIBRARY_CALLS`).
    """
    texts = {path: path.read_text(encoding="utf-8") for path in list_sources(root, *PACKAGES)}
    others = [
        root / "Makefile",
        root / "pyproject.toml",
        *root.rglob("deploy/**/*.md"),
        *root.glob("*/**/README.md"),
    ]
    others += [
        *root.glob("*.md"),
        *root.rglob("deploy/**/*.ipynb"),
        *root.rglob("*/static/**/*.js"),
    ]
    words = Counter(
        re.findall(
            r"\w+", "\n".join([*texts.values(), *(path.read_text("utf-8") for path in others)])
        )
    )
    tests = set(
        re.findall(
            r"\w+", "\n".join(path.read_text("utf-8") for path in list_sources(root, "tests"))
        )
    )
    found = []
    for path in texts:
        for node in list_nodes(path):
            if isinstance(
                node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
            ) and not node.name.startswith("_"):
                exposed = bool(getattr(node, "decorator_list", [])) and not isinstance(
                    node, ast.ClassDef
                )
                exposed = exposed and "property" not in ast.unparse(node.decorator_list[0])
                if (
                    words[node.name] == 1
                    and node.name in tests
                    and not exposed
                    and not node.name.startswith(LIBRARY_CALLS)
                ):
                    lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
                    found += [f"{path.relative_to(root)}:{line} {node.name}" for line in lines]
    return found


def _per_1000_lines(count: int, root: Path) -> float:
    lines = sum(
        path.read_text(encoding="utf-8").count("\n") for path in list_sources(root, *PACKAGES)
    )
    return round(1000.0 * count / lines, 2)


class Figure(NamedTuple):
    """Figure about the code's structure, with its limits; one row of the printed table.

    Attributes:
        name: name of the figure.
        bar: target value.
        ceiling: value that must not be exceeded; at most the last measured value.
        places: function that returns one entry per counted code place.
        per_1000: True if the figure is the count per 1,000 lines of the packages.
    """

    name: str
    bar: float
    ceiling: float
    places: Callable[[Path], Places]
    per_1000: bool = False

    def measure(self, root: Path) -> float:
        """Return the figure's value for a checkout of the repository."""
        count = len(self.places(root))
        return _per_1000_lines(count, root) if self.per_1000 else float(count)


FIGURES: Final = (
    Figure(
        "imports between parts of archive/",
        10,
        6,
        lambda root: list_inner_imports(root, "fleet_service/archive"),
    ),
    Figure(
        "imports between parts of friction_mixture/",
        22,
        21,
        lambda root: list_inner_imports(root, "edge_agent/estimators/friction_mixture"),
    ),
    Figure("import circles", 0, 0, import_circles),
    Figure("methods of the largest class", 15, 15, methods_of_largest_class),
    Figure("most parameters", 6, 6, most_parameters),
    Figure("functions with more than 6 parameters", 0, 0, functions_with_many_parameters),
    Figure("packed assignments per 1,000 lines", 2, 2, packed_assignments, per_1000=True),
    Figure("fmt: skip", 40, 0, fmt_skips),
    Figure("lines over 100 columns", 0, 0, long_lines),
    Figure("functions with nesting over 4", 0, 0, deep_nesting),
    Figure("functions with more than 40 local names", 0, 0, many_locals),
    Figure("named constants between sensor and map", 230, 230, named_constants),
    Figure("product lines that only tests use", 0, 0, only_tests_use),
)


def main(arguments: list[str]) -> None:
    """Print the table of figures of a checkout, or the code places that figures count."""
    if arguments[:1] == ["--places"]:
        for figure in FIGURES:
            if not arguments[1:] or arguments[1] in figure.name:
                print(f"{figure.name}:", *figure.places(ROOT), sep="\n  ")
        return
    root = Path(arguments[0]).resolve() if arguments else ROOT
    print(f"{'figure':<44}{'value':>9}{'bar':>9}{'ceiling':>9}")
    for figure in FIGURES:
        value = figure.measure(root)
        mark = "" if value <= figure.bar else "  ✗"
        print(f"{figure.name:<44}{value:>9g}{figure.bar:>9g}{figure.ceiling:>9g}{mark}")
    for package in PACKAGES[:3]:
        loose = len(loose_modules(root, package))
        imports = len(list_part_imports(root, package))
        print(f"{package}: {loose} loose modules, {imports} imports between parts")
    print(f"class names used more than once: {len(ambiguous_classes(root))}")
    milliseconds, modules, heavy = light_import(root)
    print(
        f"{LIGHT}: {milliseconds:.0f} ms, {modules} modules, {', '.join(heavy) or 'nothing heavy'}"
    )


if __name__ == "__main__":
    main(sys.argv[1:])
