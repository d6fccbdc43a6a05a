"""Set-up of a long-lived process: memory limits, and fast exit."""

from __future__ import annotations

import atexit
import ctypes
import os
import signal
import sys
import threading
from contextlib import suppress
from importlib.abc import MetaPathFinder
from typing import Final, NoReturn

_MMAP_THRESHOLD: Final = -3  # M_MMAP_THRESHOLD in glibc's malloc.h
_SET_PARENT_DEATH_SIGNAL: Final = 1  # PR_SET_PDEATHSIG of prctl(2)
# [bytes] larger arrays get memory of their own; the arrays of one pass of the service's main loop
# are smaller.
_LARGE: Final = 4 << 20


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
    sys.meta_path.insert(0, _BlockedImports({"pandas", *without}))


def trim_memory() -> None:
    """Return unused memory to the operating system. Call this after work that needed much memory
    for a short time.
    """
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)


def end_with_parent(number: int = signal.SIGTERM) -> None:
    """On Linux, make the operating system send the signal `number` to this process as soon as the
    thread that started it ends; elsewhere do nothing.
    """
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, number)


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


class _BlockedImports(MetaPathFinder):
    """Finder that raises ModuleNotFoundError for the modules `names`."""

    def __init__(self, names: set[str]) -> None:
        self._names = names

    # The signature is prescribed by importlib's finder interface.
    def find_spec(self, fullname: str, path: object, target: object = None) -> None:  # noqa: ARG002
        if fullname in self._names:
            raise ModuleNotFoundError(
                f"{fullname} must not be imported in this process", name=fullname
            )
