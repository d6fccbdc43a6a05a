"""A sign of life for systemd (sd_notify): a process that hangs gives none, and is ended and started anew."""

from __future__ import annotations

import os
import socket
from contextlib import suppress

_ADDRESS = "NOTIFY_SOCKET"


def alive() -> None:
    """Tell the service manager that the process does its work, and so is ready; nothing where none asked for it."""
    address = os.environ.get(_ADDRESS)
    if address:
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender:
            sender.sendto(b"READY=1\nWATCHDOG=1", f"\0{address[1:]}" if address.startswith("@") else address)
