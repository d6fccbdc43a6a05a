"""Tests of the structure of the packages, read from the source. Imports must follow the allowed
directions, the core must do no I/O, sizes must stay below their limits, and everything public must
have a docstring.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import structure
from tests.structure import MOST_PARAMETERS, PACKAGES, ROOT, list_imports, parse

LONGEST_FILE = 530  # [lines] a longer file does more than one thing

# Other packages of this project that each package may import.
MAY_IMPORT = {
    "schemas": set(),
    "edge_agent": {"schemas"},
    "fleet_service": {"schemas"},
    "deploy": {"schemas", "edge_agent", "fleet_service"},
}

# Other folders of its package that each folder may import: only in the direction of the data.
PART_IMPORTS: dict[str, dict[str, set[str]]] = {
    "edge_agent": {
        "inputs": set(),
        "calibration": {"inputs"},
        "dynamics": set(),
        "filters": set(),
        "adaptation": set(),
        "estimators": {"dynamics", "filters", "adaptation"},
        "observe": {"inputs", "estimators"},
        "publish": {"observe"},
        "ahead": set(),
        "app": {"inputs", "calibration", "adaptation", "estimators", "observe", "publish"},
        "lab": {
            "inputs",
            "calibration",
            "dynamics",
            "filters",
            "adaptation",
            "estimators",
            "observe",
            "ahead",
            "app",
        },
        "cli": {
            "inputs",
            "calibration",
            "adaptation",
            "estimators",
            "observe",
            "publish",
            "ahead",
            "app",
            "lab",
        },
    },
    "fleet_service": {
        "counts": set(),
        "fusion": set(),
        "archive": set(),
        "ingest": {"counts", "fusion", "archive"},
        "serve": {"counts", "fusion"},
        "replay": {"fusion", "archive", "ingest"},
        "replication": {"archive"},
        "shards": set(),
        "enrolment": set(),
        "client": set(),
        "page": {"archive", "client"},
        "app": {
            "counts",
            "fusion",
            "archive",
            "ingest",
            "serve",
            "replay",
            "replication",
            "shards",
            "enrolment",
        },
        "analytics": {"fusion", "archive", "serve", "replay"},
        "lab": {"fusion", "archive", "ingest", "serve", "replay", "app"},
        "cli": {
            "archive",
            "replication",
            "shards",
            "app",
            "client",
            "page",
            "enrolment",
            "analytics",
            "lab",
        },
    },
}
MOST_IMPORTS = {"edge_agent": 29, "fleet_service": 37}
# Evaluated code does not import the evaluating code in this folder; commands start both.
JUDGED_BY = "lab"

# The pure core takes time and randomness as arguments and does no input or output.
PURE = (
    "edge_agent/dynamics",
    "edge_agent/filters",
    "edge_agent/adaptation",
    "edge_agent/estimators",
    "edge_agent/observe",
    *(
        f"edge_agent/ahead/{name}.py"
        for name in ("path", "local_map", "horizon", "roads", "warnings", "request_log", "prior")
    ),
    "edge_agent/inputs/block.py",
    "fleet_service/fusion",
    *(f"fleet_service/ingest/{name}.py" for name in ("dedup", "grouping", "paths")),
    *(
        f"fleet_service/serve/{name}.py"
        for name in ("alerts", "idle_roads", "map_state", "neighbour_fill", "view", "visitors")
    ),
)
# Modules outside the pure core that convert data in memory. They may use tables and messages, but
# no input or output.
SANS_IO = (
    "edge_agent/publish/batching.py",
    "edge_agent/ahead/cell_decoder.py",
    *(f"fleet_service/ingest/{name}.py" for name in ("acks", "validation")),
    *(f"fleet_service/serve/{name}.py" for name in ("encode", "query", "tile_cache")),
    *(
        f"fleet_service/page/{name}.py"
        for name in ("colours", "features", "module_bundle", "records", "route")
    ),
)
IMPURE = {
    "asyncio",
    "datetime",
    "duckdb",
    "http",
    "logging",
    "multiprocessing",
    "os",
    "pathlib",
    "pyarrow",
    "random",
    "secrets",
    "socket",
    "sqlite3",
    "subprocess",
    "tempfile",
    "threading",
    "time",
    "urllib",
    "zenoh",
}
IMPURE_CALLS = {"open", "print", "input"}
# Modules of `schemas` that the pure core may use: numbers, names and errors, but no messages,
# tables or transport.
PURE_SCHEMAS = {
    "config",
    "errors",
    "excitation",
    "grid",
    "mugrid",
    "numeric",
    "runtime.jit",
    "runtime.lanes",
    "runtime.prefetch",
    "runtime.records",
    "signals",
    "stopping",
    "thresholds",
    "vehicle",
    "wire",
}

# Top-level entries as in section 2 of the design; dot files and lock files may be added.
TOP_LEVEL = {
    "pyproject.toml",
    "README.md",
    "edge_agent",
    "fleet_service",
    "schemas",
    "deploy",
    "tests",
    "Makefile",
    "LICENSE",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "SECURITY.md",
    "CITATION.cff",
    "constraints.txt",
    "gripmap.py",  # common import name of the four packages
}
# Files that Python's tools leave in a working copy and that are never committed.
LEFT_BEHIND = ("__pycache__", "gripmap.egg-info", "build", "dist")
TRIED = "try"  # folder into which the README's commands write; git ignores it


def all_sources(*folders: str) -> list[Path]:
    """Return the paths of all handwritten Python files below the given folders of the
    repository.
    """
    return [
        path
        for name in folders
        for path in ([ROOT / name] if name.endswith(".py") else structure.list_sources(ROOT, name))
    ]


def place_of(path: Path, line: int) -> str:
    return f"{path.relative_to(ROOT)}:{line}"


def find_crossings(tree: ast.AST, package: str) -> list[tuple[int, str]]:
    """Return line and name of each forbidden import in a module of `package`: an import of a
    project package that `package` must not use.
    """
    forbidden = set(PACKAGES) - MAY_IMPORT[package] - {package}
    return [(line, name) for line, name in list_imports(tree) if name.split(".")[0] in forbidden]


def find_impurities(tree: ast.AST) -> list[tuple[int, str]]:
    """Return line and name of the imports and calls that do I/O and are therefore forbidden in a
    pure module.
    """
    found = [(line, name) for line, name in list_imports(tree) if name.split(".")[0] in IMPURE]
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id in IMPURE_CALLS
        ):
            found.append((node.lineno, node.func.id))
        if isinstance(node, ast.Attribute) and ast.unparse(node).startswith(
            ("np.random.", "numpy.random.")
        ):
            found.extend(
                [(node.lineno, node.attr)] if node.attr not in {"Generator", "random"} else []
            )
    return found


def find_undocumented(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and name of public modules, classes and functions without a docstring. Names
    inside a function are not public.
    """
    if ast.get_docstring(tree) is None:
        yield 1, "module"
    stack: list[ast.AST] = [tree]
    while stack:
        for node in ast.iter_child_nodes(stack.pop()):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                public = not node.name.startswith("_")
                if public and ast.get_docstring(node) is None and not _is_overload(node):
                    yield node.lineno, node.name
                if public and isinstance(node, ast.ClassDef):
                    stack.append(node)
            elif isinstance(node, ast.If | ast.Try):
                stack.append(node)


def _is_overload(node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) -> bool:
    return any(ast.unparse(decorator).endswith("overload") for decorator in node.decorator_list)


@pytest.mark.parametrize("figure", structure.FIGURES, ids=lambda figure: figure.name)
def test_figure_of_structure_stays_under_its_ceiling(figure: structure.Figure) -> None:
    value = figure.measure(ROOT)
    assert value <= figure.ceiling, "\n".join(figure.places(ROOT)[:200])


def test_figures_count_planted_faults(tmp_path: Path) -> None:
    package = tmp_path / "schemas"
    package.mkdir()
    (package / "a.py").write_text(
        "from schemas import b\n\ndef many(a, b, c, d, e, f, g):\n    x, y = a, b\n    return x\n"
    )
    (package / "b.py").write_text("def later():\n    from schemas import a\n    return a\n")
    assert structure.import_circles(tmp_path) == ["schemas.a <-> schemas.b"]
    assert structure.functions_with_many_parameters(tmp_path) == ["schemas/a.py:3 many (7)"]
    assert structure.packed_assignments(tmp_path) == ["schemas/a.py:4"]
    structure.parse.cache_clear()
    (package / "b.py").write_text("def later():\n    return 1\n")
    assert not structure.import_circles(tmp_path)


@pytest.mark.parametrize("package", PART_IMPORTS)
def test_parts_import_each_other_only_in_the_direction_of_the_data(package: str) -> None:
    found = structure.list_part_imports(ROOT, package)
    assert {part for pair in found for part in pair} <= set(PART_IMPORTS[package]), (
        "a part that is not in the table"
    )
    astray = [
        f"{a} -> {b}: {place}"
        for (a, b), place in found.items()
        if b not in PART_IMPORTS[package][a]
    ]
    assert not astray, "\n".join(astray)
    assert len(found) <= MOST_IMPORTS[package]


@pytest.mark.parametrize("package", PART_IMPORTS)
def test_table_of_parts_has_no_circle_and_only_commands_import_the_lab(package: str) -> None:
    parts = PART_IMPORTS[package]
    while parts:
        ends = {part for part, others in parts.items() if not others & parts.keys()}
        assert ends, f"a circle among {', '.join(parts)}"
        parts = {part: others for part, others in parts.items() if part not in ends}
    assert [part for part, others in PART_IMPORTS[package].items() if JUDGED_BY in others] == [
        "cli"
    ]


@pytest.mark.parametrize("package", PART_IMPORTS)
def test_package_has_at_most_three_modules_outside_its_sub_packages(package: str) -> None:
    assert len(structure.loose_modules(ROOT, package)) <= 3


def test_contract_imports_no_compiler_session_or_science_library() -> None:
    _, modules, heavy = structure.light_import(ROOT)
    assert modules > 50, "nothing was imported"
    assert not heavy


def test_no_function_has_too_many_positional_parameters() -> None:
    found = structure.too_wide(ROOT)
    assert not found, f"more than {MOST_PARAMETERS} positional parameters:\n" + "\n".join(found)


def test_class_names_are_unique() -> None:
    found = structure.ambiguous_classes(ROOT)
    assert not found, "\n".join(f"{name}: {', '.join(places)}" for name, places in found.items())


# Numbers that only schemas/thresholds.py may contain, in any notation.
SHARED_NUMBER = re.compile(
    r"(?<![\w.])(9\.81|9\.80665|1\.64\d+|6_?378_?137(\.0)?|40_?075_?01\d[\d._]*"
    r"|111_?[123]\d\d(\.0)?|10\*\*9|1e9|1_?000_?000_?000"
    r"|(EXCITED|SLIPPERY)\w*(: Final)? = 0?\.\d+)(?![\w])"
)


def shared_numbers(text: str) -> Iterator[tuple[int, str]]:
    """Yield line number and text of each line of code that repeats a number of
    `schemas.thresholds`. Comments are ignored.
    """
    for line, words in enumerate(text.splitlines(), 1):
        if found := SHARED_NUMBER.search(words.partition("#")[0]):
            yield line, found[0]


def test_number_shared_by_packages_is_defined_once() -> None:
    found = [
        f"{place_of(path, line)} {number}"
        for path in all_sources(*PACKAGES)
        if path != ROOT / "schemas" / "thresholds.py"
        for line, number in shared_numbers(path.read_text(encoding="utf-8"))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "line", ["G = 9.81", "ns = t * 1e9", "half = 1.645 * std", "EXCITED = 0.6", "d * 111_195.0"]
)
def test_shared_number_is_found(line: str) -> None:
    assert list(shared_numbers(line))
    assert not list(shared_numbers("x = 19.815 + 0.6  # 1.645"))


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_between_packages_point_one_way(package: str) -> None:
    found = [
        f"{place_of(path, line)} imports {name}"
        for path in all_sources(package)
        for line, name in find_crossings(parse(path), package)
    ]
    assert not found, "\n".join(found)


def test_no_package_imports_relatively() -> None:
    found = [
        place_of(path, line)
        for path in all_sources(*PACKAGES)
        for line, name in list_imports(parse(path))
        if name[0] == "."
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("folder", [*PURE, *SANS_IO])
def test_pure_core_uses_no_files_network_clock_or_global_randomness(folder: str) -> None:
    assert all_sources(folder), f"{folder} is gone; name its successor in PURE"
    tables = ("pyarrow",) if folder in SANS_IO else ()
    found = [
        f"{place_of(path, line)} uses {name}"
        for path in all_sources(folder)
        for line, name in find_impurities(parse(path))
        if name not in tables
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("folder", PURE)
def test_pure_core_imports_only_pure_core_and_plain_contract(folder: str) -> None:
    allowed = {pure.removesuffix(".py").replace("/", ".") for pure in PURE} | {
        f"schemas.{name}" for name in PURE_SCHEMAS
    }
    found = [
        f"{place_of(path, line)} imports {name}"
        for path in all_sources(folder)
        for line, name in list_imports(parse(path))
        if name.split(".")[0] in PACKAGES
        and not any(f"{name}.".startswith(f"{good}.") for good in allowed)
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "text",
    [
        "import zenoh",
        "def f():\n    from time import monotonic",
        "import os.path",
        "open('x')",
        "import numpy as np\nnp.random.normal()",
        "import numpy as np\nnp.random.default_rng()",
    ],
)
def test_impure_line_is_found(text: str) -> None:
    assert find_impurities(ast.parse(text))


def test_a_generator_as_an_argument_is_pure() -> None:
    assert not find_impurities(
        ast.parse("import numpy as np\ndef f(rng: np.random.Generator): return rng.normal()")
    )


def test_forbidden_import_across_packages_is_found() -> None:
    assert find_crossings(ast.parse("def f():\n    import fleet_service.app.service"), "edge_agent")
    assert find_crossings(ast.parse("from edge_agent import agent"), "schemas")
    assert not find_crossings(ast.parse("from schemas import grid"), "edge_agent")


def test_no_file_exceeds_the_length_limit() -> None:
    lengths = {
        path: path.read_text(encoding="utf-8").count("\n")
        for path in all_sources(*PACKAGES, "tests")
    }
    found = [
        f"{path.relative_to(ROOT)}: {length} lines"
        for path, length in lengths.items()
        if length > LONGEST_FILE
    ]
    assert not found, "\n".join(found)


def test_top_level_holds_only_the_entries_of_the_design() -> None:
    present = {path.name for path in ROOT.iterdir() if not path.name.startswith(".")}
    found = sorted(
        name for name in present - TOP_LEVEL - {*LEFT_BEHIND, TRIED} if not name.endswith(".lock")
    )
    assert not found, f"not in the design, section 2: {', '.join(found)}"


@pytest.mark.parametrize("package", PACKAGES)
def test_everything_public_has_a_docstring(package: str) -> None:
    found = [
        f"{place_of(path, line)} {name}"
        for path in all_sources(package)
        for line, name in find_undocumented(parse(path))
    ]
    assert not found, "\n".join(found)


def test_missing_docstring_is_found_only_for_public_names() -> None:
    tree = ast.parse(
        '"""M."""\nclass A:\n    """A."""\n    def f(self): ...\n'
        "    def _g(self): ...\ndef _h(): ..."
    )
    assert [name for _, name in find_undocumented(tree)] == ["f"]


def test_the_tests_mirror_the_packages() -> None:
    folders = {
        path.name
        for path in (ROOT / "tests").iterdir()
        if path.is_dir() and path.name != "__pycache__"
    }
    assert folders - {"end_to_end", "benchmarks", "faults", "data", "usability"} <= set(PACKAGES)
