"""Set-up of a long-lived process: memory, and its log lines, text for people or JSON lines for programs."""

from __future__ import annotations

import atexit
import ctypes
import json
import logging
import os
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from importlib.abc import MetaPathFinder
from typing import Any, Final, Literal, NoReturn, TextIO

Form = Literal["text", "json"]
_MMAP_THRESHOLD: Final = -3  # M_MMAP_THRESHOLD of glibc's malloc.h
_LARGE: Final = 4 << 20  # bytes; a turn's own arrays are smaller


class Line(str):
    """A line with its numbers by name, for those who read JSON."""

    __slots__ = ("values",)

    def __new__(cls, text: str, **values: object) -> Line:
        """Text for people, values for programs."""
        line = super().__new__(cls, text)
        line.values = values
        return line

    values: dict[str, object]


def limit_memory(*without: str) -> None:
    """Keep from a process that lives long what its libraries would do for others; call it at its very start.

    Args:
        without: modules that its libraries can do without, and it does.

    Arrow loads pandas, where that is installed, to look whether what it is handed is a data frame: half a second, and
    30 MB for good. The linear algebra behind numpy starts a thread a core, which wait for each other by turning: on
    products as small as ours they double the processor time. And the allocator learns from the first large array that
    is given back to keep the next ones, among which small things stay behind: a tenth of a gigabyte. Arrow's own
    allocator keeps some for each thread that ever used it.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    with suppress(AttributeError, OSError):  # where it is another allocator than glibc's
        ctypes.CDLL(None).mallopt(_MMAP_THRESHOLD, _LARGE)
    sys.meta_path.insert(0, _Without({"pandas", *without}))


def trim_memory() -> None:
    """Give the system what lies free between what is in use: after work that takes much memory for a short time."""
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)


def end_now(code: int) -> NoReturn:
    """End the process with an exit code, although one of its threads hangs; call it when its files are closed.

    What the threads are doing ends at this instant. What was printed is printed.
    """
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):  # a full disk, a reader that left, a closed stream
            stream.flush()
    os._exit(code)


def leave(code: int) -> NoReturn:
    """End the process as a command does whose work is done, without taking the interpreter apart.

    Each compiled kernel is a module of LLVM: after a first use, taking some hundred of them apart was five seconds
    without a word, beside other work; and a thread of a library that calls back meanwhile, a Zenoh session's, would
    abort the process. As at Python's own end, threads that are no daemons are waited for, and what is registered for
    the exit runs.
    """
    threading._shutdown()  # type: ignore[attr-defined] # no public way
    atexit._run_exitfuncs()
    end_now(code)


class _Without(MetaPathFinder):
    def __init__(self, names: set[str]) -> None:
        self._names = names

    def find_spec(self, fullname: str, path: object, target: object = None) -> None:  # noqa: ARG002 as finders have it
        if fullname in self._names:
            raise ModuleNotFoundError(f"{fullname} is kept out of this process", name=fullname)


def print_line(line: str, stream: TextIO) -> None:
    """Print a line at once, whole also where other threads print; what lies behind the stream (a full disk, a reader
    that left) never ends the process."""
    with suppress(OSError):
        stream.write(f"{line}\n")  # in one piece: `print` writes the end of a line by itself
        stream.flush()


def line_logger(form: Form, stream: TextIO, **who: object) -> Callable[[str], None]:
    """What takes the lines; as JSON each with time, process and `who`, the first word as its event."""

    def text(line: str) -> None:
        print_line(line, stream)

    def as_json(line: str) -> None:
        event = line.partition(":")[0] if ":" in line else line.partition(" ")[0]
        values = line.values if isinstance(line, Line) else {}
        print_line(_record("info", **{"event": event, "message": str(line), **who, **values}), stream)

    return text if form == "text" else as_json


def log_as(form: Form, stream: TextIO, **who: object) -> None:
    """Let warnings of the program and its libraries go to `stream` in this form."""
    handler = logging.StreamHandler(stream)
    handler.setFormatter(_Formatter(who) if form == "json" else logging.Formatter("%(levelname)s: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)


class _Formatter(logging.Formatter):
    def __init__(self, who: dict[str, object]) -> None:
        super().__init__()
        self._who = who

    def format(self, record: logging.LogRecord) -> str:
        raised = {"error": self.formatException(record.exc_info)} if record.exc_info else {}
        level, event = record.levelname.lower(), record.name
        return _record(level, event=event, message=record.getMessage(), **self._who, **raised)


def _record(level: str, **values: Any) -> str:  # noqa: ANN401 whatever JSON takes
    now = datetime.now(UTC).isoformat(timespec="milliseconds")
    return json.dumps({"time": now, "level": level, "pid": os.getpid(), **values}, default=str)
