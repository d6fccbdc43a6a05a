"""Result of a reader: series (recorded signals) by name with a common clock. The module also has
helpers for the readers of other formats.
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
from schemas.runtime.installing import install_command


@dataclass(frozen=True)
class Series:
    """One recorded signal: times t (n,) [s] since its recording's start, values (n,), and the unit
    ("" if unknown).
    """

    t: FloatArray
    values: FloatArray
    unit: str = ""


@dataclass
class Recording:
    """Signals of one source of a recording, such as a file, by name; all have the same clock.

    Attributes:
        name: name of the file, for messages.
        signals: the recorded signals by name.
        start_ns: time [ns UTC] of t = 0; None if the source has no date.
        rows: True if all signals have the same times, like the columns of a table.
        notes: remarks of the reader.
        has_zone: True if its date certainly is UTC or has a time zone.
    """

    name: str
    signals: dict[str, Series]
    start_ns: int | None = None
    rows: bool = False
    notes: list[str] = field(default_factory=list)
    has_zone: bool = False

    @property
    def time_span(self) -> tuple[float, float]:
        """Return the times [s] of the first and the last reading; zeros without readings."""
        times = [series.t for series in self.signals.values() if len(series.t)]
        if not times:
            return 0.0, 0.0
        return min(float(t[0]) for t in times), max(float(t[-1]) for t in times)


@contextmanager
def foreign_errors(path: Path, kind: str) -> Iterator[None]:
    """Return a context manager that converts any exception of a library in the `with` block into a
    one-line error that names the file.

    Raises:
        InputError: the file cannot be read as `kind`, the name of its format.
    """
    try:
        yield
    except (InputError, MemoryError):
        raise
    except FileNotFoundError as error:
        raise InputError(
            "source", f"{path} does not exist", "give the path of a recording"
        ) from error
    except Exception as error:  # a library may raise any error on a hostile file
        reason = (str(error) or type(error).__name__).splitlines()[0][:200]
        raise InputError(
            "source", f"{path} is not a valid {kind} file ({reason})", "record or convert it again"
        ) from error


# Modules have no common type.
def import_optional(name: str, extra: str = "inputs") -> Any:  # noqa: ANN401
    """Import the optional library `name` and return it. `extra` is the optional part of the package
    that installs the library.

    Raises:
        InputError: the library is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            "source", f"needs {name}, which is not installed", install_command(extra)
        ) from error
