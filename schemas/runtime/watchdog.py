"""Watchdog signal for systemd (sd_notify): systemd restarts a process that stops sending it."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final

_ADDRESS = "NOTIFY_SOCKET"
_WITHIN: Final = "WATCHDOG_USEC"  # set by systemd: longest time between two notifications
_USUAL_US: Final = 40e6
LONG_S: Final = 900.0  # longest start of a process, as TimeoutStartSec in the systemd units
_at_work = threading.Event()


def notify_alive() -> None:
    """Notify the service manager (systemd) that the process is ready and working; do nothing
    without a service manager.
    """
    _at_work.set()
    _notify_systemd()


def notify_waiting() -> Callable[[], None]:
    """Start a thread that repeatedly notifies systemd that the process works. Use it while the
    process (a standby service, for example) waits and cannot call `notify_alive` regularly.

    Returns:
        a function "beat" that the waiting code must call repeatedly.

    The thread ends in two cases. First, the process calls `notify_alive`, because the wait is over.
    Second, "beat" has not been called for LONG_S seconds, because the waiting code hangs; systemd
    then restarts the process.
    """
    last = time.monotonic()
    every_s = float(os.environ.get(_WITHIN, _USUAL_US)) * 1e-6 / 4

    def beat() -> None:
        nonlocal last
        last = time.monotonic()

    def notify_repeatedly() -> None:
        while not _at_work.wait(every_s) and time.monotonic() - last < LONG_S:
            _notify_systemd()

    _at_work.clear()
    threading.Thread(target=notify_repeatedly, name="watchdog", daemon=True).start()
    return beat


def _notify_systemd() -> None:
    address = os.environ.get(_ADDRESS)
    if address:
        with (
            suppress(OSError),
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender,
        ):
            sender.sendto(
                b"READY=1\nWATCHDOG=1", f"\0{address[1:]}" if address.startswith("@") else address
            )
