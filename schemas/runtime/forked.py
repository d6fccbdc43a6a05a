"""Work in a child process that has a copy of this process's memory, as it is at one moment.

The operating system copies a page of memory (4 kB) only when one of the two processes changes it.
Therefore the copy takes milliseconds, and needs memory only for the pages that change meanwhile.
"""

from __future__ import annotations

import gc
import os
import pickle
import signal
from collections.abc import Callable

from schemas.runtime.process import end_with_parent


class ForkedWork:
    """Running child process of `run_forked`."""

    def __init__(self, pid: int, pipe: int) -> None:
        self._pid = pid
        self._pipe = pipe

    def wait(self) -> None:
        """Wait until the child process has ended. Call this once.

        Raises:
            ChildProcessError: the child process was ended by a signal.
            Exception: the exception that the work raised.
        """
        with os.fdopen(self._pipe, "rb") as reading:
            raised = reading.read()
        _, status = os.waitpid(self._pid, 0)
        if raised:
            raise pickle.loads(raised)
        if status:
            code = os.waitstatus_to_exitcode(status)
            raise ChildProcessError(f"the child process ended with code {code}")


def run_forked(work: Callable[[], object]) -> ForkedWork:
    """Start `work` in a child process with a copy of this process's memory, and return without
    waiting for its end. The child process ends when this thread ends.

    Other threads do not exist in the child process, and a lock that another thread holds stays
    locked there. Therefore `work` may use only data and locks of the calling thread.

    Raises:
        OSError: the operating system has no memory for another process.
    """
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        _run_child(work, writing)
    os.close(writing)
    return ForkedWork(pid, reading)


def _run_child(work: Callable[[], object], pipe: int) -> None:
    """Run `work`, write its exception to `pipe`, and end the process."""
    code = 1
    try:
        gc.disable()  # objects of other threads, such as sessions, must not be destroyed here
        # The parent process handles signals, also those to the whole group.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        end_with_parent(signal.SIGKILL)
        work()
        code = 0
    except BaseException as error:  # noqa: BLE001 the parent process raises it
        os.write(pipe, pickle.dumps(error))
    finally:
        os._exit(code)
