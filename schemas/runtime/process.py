"""Set-up of a long-lived process: memory limits, log lines as text or JSON, and fast exit."""

from __future__ import annotations

import atexit
import ctypes
import json
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from importlib.abc import MetaPathFinder
from typing import Any, Final, Literal, NoReturn, TextIO

Form = Literal["text", "json"]
_MMAP_THRESHOLD: Final = -3  # M_MMAP_THRESHOLD in glibc's malloc.h
_SET_PARENT_DEATH_SIGNAL: Final = 1  # PR_SET_PDEATHSIG of prctl(2)
# [bytes] larger arrays get memory of their own; the arrays of one pass of the service's main loop
# are smaller.
_LARGE: Final = 4 << 20


class LogLine(str):
    """Log line as text for people. It also carries values by name, which the JSON form of the log
    line contains.
    """

    __slots__ = ("values",)

    def __new__(cls, text: str, **values: object) -> LogLine:
        """Create a log line from text for people and values for programs."""
        line = super().__new__(cls, text)
        line.values = values
        return line

    values: dict[str, object]


def limit_memory(*without: str) -> None:
    """Prevent libraries from using memory and threads that a long-lived process does not need. Call
    this before other imports.

    Args:
        without: modules that the libraries can do without; importing them is blocked.

    Four causes of such use are removed. Arrow imports pandas, if installed: half a second and 30
    MB. The linear algebra library of numpy starts one thread per core, and these threads busy-wait,
    which doubles the processor time. The memory allocator keeps about 0.1 GB of freed arrays.
    Arrow's own allocator keeps memory for each thread that ever used it.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    with suppress(AttributeError, OSError):  # the C library is not glibc
        ctypes.CDLL(None).mallopt(_MMAP_THRESHOLD, _LARGE)
    sys.meta_path.insert(0, _Without({"pandas", *without}))


def trim_memory() -> None:
    """Return unused memory to the operating system. Call this after work that needed much memory
    for a short time.
    """
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)


def end_with_parent() -> None:
    """On Linux, make the operating system end this process as soon as its parent process ends;
    elsewhere do nothing.
    """
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGTERM)


def force_exit(code: int) -> NoReturn:
    """End the process at once with an exit code, even if a thread hangs. Call this after closing
    files.

    Text that was printed before is flushed first. Other threads are stopped without cleanup.
    """
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):  # full disk, closed pipe or closed stream
            stream.flush()
    os._exit(code)


def exit_fast(code: int) -> NoReturn:
    """Exit without interpreter teardown.

    Unloading hundreds of LLVM modules takes about five seconds, and a Zenoh callback during
    teardown aborts the process. As at a normal exit, the process waits for non-daemon threads, and
    exit handlers run.
    """
    threading._shutdown()  # type: ignore[attr-defined] # no public way
    atexit._run_exitfuncs()
    force_exit(code)


class _Without(MetaPathFinder):
    def __init__(self, names: set[str]) -> None:
        self._names = names

    # The signature is prescribed by importlib's finder interface.
    def find_spec(self, fullname: str, path: object, target: object = None) -> None:  # noqa: ARG002
        if fullname in self._names:
            raise ModuleNotFoundError(
                f"{fullname} must not be imported in this process", name=fullname
            )


def print_line(line: str, stream: TextIO) -> None:
    """Print a line with one write and flush it, so that lines of several threads do not mix. Errors
    of the stream (full disk, closed pipe) are ignored.
    """
    with suppress(OSError):
        stream.write(f"{line}\n")  # one write: `print` writes the line feed separately
        stream.flush()


def line_logger(form: Form, stream: TextIO, **who: object) -> Callable[[str], None]:
    """Return a function that prints log lines on `stream`, as text or as JSON depending on `form`.
    A JSON line contains the time, the process id, and the values `who`, which identify the process.
    Its field `event` has the text before the first colon, or the first word of a text without
    colon.
    """

    def text(line: str) -> None:
        print_line(line, stream)

    def as_json(line: str) -> None:
        event = line.partition(":")[0] if ":" in line else line.partition(" ")[0]
        values = line.values if isinstance(line, LogLine) else {}
        print_line(
            _make_record("info", **{"event": event, "message": str(line), **who, **values}), stream
        )

    return text if form == "text" else as_json


def log_as(form: Form, stream: TextIO, **who: object) -> None:
    """Set up logging: write the warnings and errors of the program and its libraries to `stream`,
    as text or as JSON depending on `form`. JSON lines contain the values `who`, which identify the
    process.
    """
    handler = logging.StreamHandler(stream)
    handler.setFormatter(
        _Formatter(who) if form == "json" else logging.Formatter("%(levelname)s: %(message)s")
    )
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)


class _Formatter(logging.Formatter):
    def __init__(self, who: dict[str, object]) -> None:
        super().__init__()
        self._who = who

    def format(self, record: logging.LogRecord) -> str:
        raised = {"error": self.formatException(record.exc_info)} if record.exc_info else {}
        level = record.levelname.lower()
        event = record.name
        return _make_record(level, event=event, message=record.getMessage(), **self._who, **raised)


def _make_record(level: str, **values: Any) -> str:  # noqa: ANN401 any JSON value
    now = datetime.now(UTC).isoformat(timespec="milliseconds")
    return json.dumps({"time": now, "level": level, "pid": os.getpid(), **values}, default=str)
