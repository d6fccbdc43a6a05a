"""Search for circular imports between modules."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from pathlib import Path


def circles_of(modules: Mapping[Path, ast.Module]) -> list[str]:
    """Return one text per group of modules that import each other in a circle; imports inside
    functions count too.

    Args:
        modules: syntax trees by path below the root.
    """
    names = {_module_name(path): tree for path, tree in modules.items()}
    graph: dict[str, set[str]] = {name: set() for name in names}
    for name, tree in names.items():
        for node in _run_time_nodes(tree):
            targets: list[str] = []
            if isinstance(node, ast.Import):
                targets = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                full = [f"{node.module}.{alias.name}" for alias in node.names]
                targets = [target if target in names else node.module for target in full]
            graph[name].update(target for target in targets if target in names and target != name)
    return [" <-> ".join(sorted(circle)) for circle in _find_components(graph) if len(circle) > 1]


def _module_name(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _run_time_nodes(tree: ast.Module) -> list[ast.AST]:
    """Return the nodes of a syntax tree, without blocks that only the type checker reads (`if
    TYPE_CHECKING`).
    """
    found: list[ast.AST] = []
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        found.append(node)
        waiting += ast.iter_child_nodes(node)
    return found


def _find_components(graph: dict[str, set[str]]) -> list[set[str]]:
    """Return the strongly connected components of a directed graph (Kosaraju's algorithm)."""
    order: list[str] = []
    seen: set[str] = set()
    for start in graph:
        stack = [(start, iter(graph[start]))] if start not in seen else []
        seen.add(start)
        while stack:
            node, following = stack[-1]
            successor = next((one for one in following if one not in seen), None)
            if successor is None:
                order.append(node)
                stack.pop()
            else:
                seen.add(successor)
                stack.append((successor, iter(graph[successor])))
    back: dict[str, set[str]] = {name: set() for name in graph}
    for name, targets in graph.items():
        for target in targets:
            back[target].add(name)
    components: list[set[str]] = []
    placed: set[str] = set()
    for start in reversed(order):
        component: set[str] = set()
        waiting = [start] if start not in placed else []
        while waiting:
            node = waiting.pop()
            if node not in placed:
                placed.add(node)
                component.add(node)
                waiting += back[node]
        components += [component] if component else []
    return components
