"""Search for regular expressions whose matching time grows faster than the length of the text.

    python -m tests.regexes      print every suspicious pattern of the product

A backtracking matcher takes quadratic time if two unbounded repeats that can match the same
character follow each other. The text can then be divided between them in many ways, unless
something mandatory and different stands between them. The matcher takes exponential time if such a
repeat is inside another. The check looks at literal patterns of the module `re`.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from re import _constants as sre  # type: ignore[attr-defined]
from re import _parser as parser  # type: ignore[attr-defined]
from typing import Any, Final, NamedTuple

from tests.structure import ROOT, list_sources, parse

CALLS: Final = {
    "compile",
    "match",
    "fullmatch",
    "search",
    "sub",
    "subn",
    "split",
    "findall",
    "finditer",
}
PRODUCT: Final = ("schemas", "edge_agent", "fleet_service", "deploy")
CHARACTERS: Final = frozenset(range(128))
MANY: Final = 64  # number of repeats; matches of shorter texts take no time
Characters = frozenset[int]


class Part(NamedTuple):
    """Part of a sequence in a regular expression: the characters that it can match, and two flags,
    True if the part may be empty and True if it repeats without bound.
    """

    characters: Characters
    is_optional: bool
    is_unbounded: bool


class Found(NamedTuple):
    """Regular expression that may take more than linear time, with its file and line."""

    place: str
    pattern: str


def is_superlinear(pattern: str) -> bool:
    """Return True if matching a regular expression may take more than linear time."""
    return any(_is_ambiguous(sequence) for sequence in _find_sequences(parser.parse(pattern)))


def _is_ambiguous(sequence: list[Any]) -> bool:
    """Return True if a sequence of parts of a regular expression can match a text in many ways,
    because an unbounded repeat contains another one or is followed by one that matches the same
    characters.
    """
    parts = [_describe_part(item) for item in sequence]
    for k, part in enumerate(parts):
        if not part.is_unbounded:
            continue
        if _holds_repeat(sequence[k]):
            return True
        free = part.characters
        for later in parts[k + 1 :]:
            if later.is_unbounded and free & later.characters:
                return not _never_fails(parts, k)
            if not later.is_optional:
                free &= later.characters
                if not free:
                    break
    return False


def _never_fails(parts: list[Part], start: int) -> bool:
    """Return True if all parts after number `start` are optional. The matcher then never fails
    after this part, and never backtracks into it.
    """
    return all(part.is_optional for part in parts[start + 1 :])


def _holds_repeat(item: Any) -> bool:  # noqa: ANN401 tuples of the parser
    """Return True if a repeated group can end with an unbounded repeat of a character with which
    the group can also begin. An example is `(a+)*`: the matcher can divide the text "aaa" between
    repetitions of the group in many ways.
    """
    parts = [_describe_part(one) for one in _open_groups(item[1][2])]
    if not any(part.is_unbounded for part in parts):
        return False
    first: Characters = frozenset()
    for part in parts:
        first |= part.characters
        if not part.is_optional:
            break
    for part in reversed(parts):
        if part.is_unbounded and part.characters & first:
            return True
        if not part.is_optional:
            break
    return False


def _find_sequences(parsed: Any) -> Iterator[list[Any]]:  # noqa: ANN401
    """Yield every sequence (parts that match one after the other) of a parsed regular expression.
    Groups that are not repeated are merged into their sequence.
    """
    yield _open_groups(parsed)
    for name, value in parsed:
        for inner in _inner_patterns(name, value):
            yield from _find_sequences(inner)


def _open_groups(parsed: Any) -> list[Any]:  # noqa: ANN401
    out: list[Any] = []
    for name, value in parsed:
        out += _open_groups(value[-1]) if name is sre.SUBPATTERN else [(name, value)]
    return out


def _inner_patterns(name: Any, value: Any) -> list[Any]:  # noqa: ANN401
    if name is sre.SUBPATTERN:
        return [value[-1]]
    if name in (sre.MAX_REPEAT, sre.MIN_REPEAT):
        return [value[2]]
    if name is sre.BRANCH:
        return list(value[1])
    return [value[1]] if name in (sre.ASSERT, sre.ASSERT_NOT) else []


def _describe_part(item: Any) -> Part:  # noqa: ANN401
    name, value = item
    if name in (sre.MAX_REPEAT, sre.MIN_REPEAT):
        least, most, inner = value
        return Part(_match_characters(inner), least == 0, most is sre.MAXREPEAT or most > MANY)
    if name in (sre.AT, sre.ASSERT, sre.ASSERT_NOT):
        return Part(frozenset(), True, False)
    return Part(_match_characters([item]), False, False)


def _match_characters(items: Any) -> Characters:  # noqa: ANN401
    """Return the ASCII characters (code numbers) that any of the given items of a pattern can
    match.
    """
    out: Characters = frozenset()
    for name, value in items:
        if name is sre.LITERAL:
            out |= {value} & CHARACTERS
        elif name is sre.NOT_LITERAL:
            out |= CHARACTERS - {value}
        elif name is sre.ANY:
            out |= CHARACTERS - {10}
        elif name is sre.IN:
            out |= _match_set(value)
        else:
            for inner in _inner_patterns(name, value):
                out |= _match_characters(inner)
    return out


def _match_set(items: Any) -> Characters:  # noqa: ANN401
    out: set[int] = set()
    negated = False
    for name, value in items:
        if name is sre.NEGATE:
            negated = True
        elif name is sre.LITERAL:
            out.add(value)
        elif name is sre.RANGE:
            out.update(range(value[0], min(value[1], 127) + 1))
        elif name is sre.CATEGORY:
            out |= _CATEGORIES[value]
    return CHARACTERS - out if negated else frozenset(out) & CHARACTERS


def _match_class(pattern: str) -> Characters:
    return frozenset(c for c in CHARACTERS if re.match(pattern, chr(c)))


_CATEGORIES: Final = {
    sre.CATEGORY_DIGIT: _match_class(r"\d"),
    sre.CATEGORY_NOT_DIGIT: _match_class(r"\D"),
    sre.CATEGORY_SPACE: _match_class(r"\s"),
    sre.CATEGORY_NOT_SPACE: _match_class(r"\S"),
    sre.CATEGORY_WORD: _match_class(r"\w"),
    sre.CATEGORY_NOT_WORD: _match_class(r"\W"),
}


def find_patterns(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line number and text of each regular expression that a file contains as a literal."""
    for node in ast.walk(parse(path)):
        if (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Attribute)
            and node.func.attr in CALLS
            and node.args
        ):
            is_module = isinstance(node.func.value, ast.Name) and node.func.value.id == "re"
            first = node.args[0]
            if is_module and isinstance(first, ast.Constant) and isinstance(first.value, str):
                yield node.lineno, first.value


def find_all() -> list[Found]:
    """Return the regular expressions in the product's code that may take more than linear time."""
    return [
        Found(f"{path.relative_to(ROOT)}:{line}", pattern)
        for folder in PRODUCT
        for path in list_sources(ROOT, folder)
        for line, pattern in find_patterns(path)
        if is_superlinear(pattern)
    ]


def main() -> int:
    """Print all regular expressions that may take more than linear time. Return 1 if there are any,
    otherwise 0.
    """
    found = find_all()
    for one in found:
        print(f"{one.place}: {one.pattern}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
