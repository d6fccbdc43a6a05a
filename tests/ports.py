"""Unused network ports of this machine, for servers that start, or restart, later."""

from __future__ import annotations

import random
import socket
from pathlib import Path
from typing import Final

OUTGOING: Final = Path("/proc/sys/net/ipv4/ip_local_port_range")
USUAL_OUTGOING: Final = 32768  # first port of outgoing connections by Linux's default
FIRST: Final = 15_000


def free_ports(count: int) -> list[int]:
    """Return `count` different ports of 127.0.0.1 on which no server listens, by TCP or UDP.

    The ports lie below the range that the system uses for outgoing connections (read from the file
    `OUTGOING`). A port of that range could be taken before its server starts.
    """
    try:
        last = int(OUTGOING.read_text(encoding="ascii").split()[0])
    except (OSError, ValueError):
        last = USUAL_OUTGOING
    if last <= FIRST:
        last = USUAL_OUTGOING
    found: list[int] = []
    for port in random.SystemRandom().sample(range(FIRST, last), last - FIRST):
        with socket.socket() as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
            try:
                tcp.bind(("127.0.0.1", port))
                udp.bind(("127.0.0.1", port))
            except OSError:
                continue
        found.append(port)
        if len(found) == count:
            return found
    raise OSError(f"127.0.0.1 has no {count} free ports from {FIRST} to {last}")
