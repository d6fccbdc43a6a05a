"""Live source for the positions that a running gpsd (position daemon) sends as JSON over TCP."""

from __future__ import annotations

import json
import socket
from typing import Final

import numpy as np

from edge_agent.inputs.live.feed import TICK_S, Feed, HostClock, Received
from edge_agent.inputs.readers.gnss import LONGEST_LINE, UNITS, parse_gpsd
from edge_agent.inputs.recording import Series

WATCH: Final = b'?WATCH={"enable":true,"json":true};\n'
CONNECT_S: Final = 5.0


class GpsdFeed(Feed):
    """Live source for the position reports (TPV) of a gpsd (position daemon) at the address (host,
    port).
    """

    def __init__(self, name: str, clock: HostClock, address: tuple[str, int]) -> None:
        super().__init__(name, clock)
        self._address = address

    def listen(self) -> None:
        """Receive position reports until the connection to gpsd ends."""
        with socket.create_connection(self._address, CONNECT_S) as connection:
            connection.sendall(WATCH)
            connection.settimeout(TICK_S)
            self.openings += 1
            rest = b""
            while not self.stopping.is_set():
                try:
                    part = connection.recv(65_536)
                except TimeoutError:
                    continue
                if not part:
                    return
                *lines, rest = (rest + part).split(b"\n")
                if len(rest) > LONGEST_LINE:
                    raise ValueError("a line without an end")
                for line in lines:
                    self._read_line(line)

    def _read_line(self, line: bytes) -> None:
        try:
            fix = parse_gpsd(line.decode("ascii", errors="replace")) if line.strip() else None
        except (
            json.JSONDecodeError,
            ValueError,
            RecursionError,
            OverflowError,
            TypeError,
        ) as error:
            self.unreadable(f"a report that cannot be read ({type(error).__name__})")
            return
        if fix is not None:
            self.store_message(fix.time, fix)

    def series(self, received: list[Received]) -> dict[str, Series]:
        """Return the positions in received gpsd reports as the signals latitude, longitude, speed
        and course.
        """
        t = np.array([time for time, _ in received])
        return {
            name: Series(t, np.array([getattr(fix, name) for _, fix in received]), UNITS[name])
            for name in UNITS
        }
