"""Result of a reader: named series on one clock, and the selection of the signals that a profile
needs.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from schemas.errors import InputError
from schemas.numeric import FloatArray


@dataclass(frozen=True)
class Series:
    """One recorded signal: times t (n,) [s] since its recording's start, values (n,), and the
    unit if it is known.
    """

    t: FloatArray
    values: FloatArray
    unit: str = ""


@dataclass
class Recording:
    """Signals of one source by name, all on one clock.

    Attributes:
        name: of the file, for messages.
        start_ns: ns UTC of t = 0, None where the source has no date.
        rows: whether all signals share their times, as the columns of a table do.
        notes: remarks of the reader.
    """

    name: str
    signals: dict[str, Series]
    start_ns: int | None = None
    rows: bool = False
    notes: list[str] = field(default_factory=list)


@contextmanager
def foreign_errors(path: Path, kind: str) -> Iterator[None]:
    """Turn any exception that a library raises on a broken file into an error of one line that
    names the file.

    Raises:
        InputError: the file cannot be read as `kind`.
    """
    try:
        yield
    except (InputError, MemoryError):
        raise
    except FileNotFoundError as error:
        raise InputError(
            "source", f"{path} does not exist", "give the path of a recording"
        ) from error
    except Exception as error:  # a reader of others may raise anything over a hostile file
        reason = (str(error) or type(error).__name__).splitlines()[0][:200]
        raise InputError(
            "source", f"{path} is not a valid {kind} file ({reason})", "record or convert it again"
        ) from error


def import_optional(name: str, extra: str = "inputs") -> Any:  # noqa: ANN401 modules of optional libraries have no common type
    """Import an optional library.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            "source", f"needs {name}, which is not installed", f"install gripmap[{extra}]"
        ) from error
