"""Functions that wait for a condition with a deadline, instead of sleeping for a fixed time."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable

import zenoh

# [s] A condition that holds is seen at once. The limit only matters on a busy machine.
PATIENCE_S = 100.0


def until(condition: Callable[[], object], patience_s: float = PATIENCE_S) -> None:
    """Wait until `condition()` is true.

    Raises:
        TimeoutError: the condition did not become true within `patience_s`.
    """
    deadline = time.monotonic() + patience_s
    pause = threading.Event()
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"not within {patience_s} s: {condition}")
        pause.wait(0.005)


def freeze(process: subprocess.Popen[bytes]) -> None:
    """Freeze a child process until it receives SIGCONT, and return when all its threads stand.

    The signal alone is not enough: on a busy machine, threads of the process run on for tens of
    milliseconds, until its main thread has received the signal.
    """
    process.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)


def matched(asker: zenoh.Publisher | zenoh.Querier) -> None:
    """Wait until `asker` has a partner: for a publisher a subscriber, for a querier a queryable
    (handler of queries).
    """
    # The stubs declare `matching` as a bool.
    until(lambda: asker.matching_status.matching)  # type: ignore[attr-defined]
