"""Functions that other threads ask the worker thread to run between two segments (files of new
rows), when all accepted rows are on disk.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Any, Final, TypeVar

WAIT_S: Final = 0.2  # [s] period of the checks whether the service stops
# [s] Longest wait for a segment to be written. With a full disk none is written, and the jobs that
# make space must not wait for it.
MOST_S: Final = 10.0
T = TypeVar("T")


class Tasks:
    """Queue of functions that other threads ask the worker (the thread that processes messages) to
    run. The queue as a boolean is True if it is not empty.
    """

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[tuple[Future[Any], Callable[[], object]]] = (
            queue.SimpleQueue()
        )

    def __bool__(self) -> bool:
        return not self._queue.empty()

    def run_on_worker(self, work: Callable[[], T], stop: threading.Event) -> T | None:
        """Queue the function `work`, wait until the worker has run it, and return its result; None
        if `stop` is set meanwhile.

        Raises:
            OSError: no segment could be written for too long.
        """
        done: Future[T] = Future()
        self._queue.put((done, work))
        deadline = time.monotonic() + MOST_S
        while True:
            wait([done], WAIT_S)
            if done.done():
                return done.result()
            if (stop.is_set() or time.monotonic() > deadline) and done.cancel():
                if stop.is_set():
                    return None
                raise OSError("no segment could be written within the time limit")

    def run_queued(self) -> None:
        """Run all queued functions; the worker calls this."""
        while self:
            done, work = self._queue.get()
            if done.set_running_or_notify_cancel():
                try:
                    done.set_result(work())
                except Exception as error:  # noqa: BLE001 the waiting thread gets it
                    done.set_exception(error)
