"""Lazy public names of a package: each name is imported at its first use, so that importing the
package is fast.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_exports(
    package: str, names: Mapping[str, str]
) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__all__`, `__getattr__` and `__dir__` for a package whose public names are imported
    at their first use (PEP 562).

    Args:
        package: name of the package, for the error message.
        names: dictionary from each public name to the name of the module that defines it.
    """
    face = sorted(names)

    def look_up(name: str) -> Any:  # noqa: ANN401 an export may be any object
        if name not in names:
            raise AttributeError(
                f"{package} has no {name!r}; its public names are {', '.join(face)}"
            )
        return getattr(import_module(names[name]), name)

    return face, look_up, lambda: face
