"""Live source for a CAN bus, by python-can. A filter of the CAN interface passes only frames with
the identifiers of needed messages.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from edge_agent.inputs.live.feed import TICK_S, Feed, HostClock, Received
from edge_agent.inputs.profile import Profile
from edge_agent.inputs.readers.can_log import Frames, Log, decode_log
from edge_agent.inputs.readers.dbc import Database
from edge_agent.inputs.recording import Series, import_optional
from schemas.errors import InputError
from schemas.thresholds import NS

EXTENDED_MASK = 0x1FFFFFFF
STANDARD_MASK = 0x7FF
OWN: Final = "gripmap"


class Decoder:
    """Decoder of CAN frames to signals, by a CAN database.

    `profile` assigns signals to channels, and `bus` is the number of the bus. Messages that the
    profile assigns to another bus are left out.
    """

    def __init__(self, profile: Profile, database: Database, bus: int | None = None) -> None:
        elsewhere = {
            c.message
            for c in profile.channels.values()
            if c.message and bus is not None and c.bus not in (None, bus)
        }
        self.database = {
            name: message for name, message in database.items() if name not in elsewhere
        }
        self.requested_signals = {
            name for name in profile.needed_signals() if name.partition(".")[0] in self.database
        }
        messages = {name.partition(".")[0] for name in self.requested_signals}
        self.identifiers = {
            (self.database[name].identifier, self.database[name].extended) for name in messages
        }

    def series(self, received: list[Received]) -> dict[str, Series]:
        """Return the signals decoded from received CAN frames, by name. Each element of `received`
        is a frame (time, (identifier, extended, data)).
        """
        log: Log = {}
        for time, (identifier, extended, data) in received:
            log.setdefault((0, identifier, extended), Frames()).add(time, data)
        return decode_log(lambda _: (log, 0.0), OWN, self.database, self.requested_signals).signals


class CanFeed(Feed):
    """Live source for one CAN bus, read by the library python-can.

    Args:
        name: name of the source.
        clock: clock of the host.
        decoder: decodes the frames with the needed signals.
        options: options of `can.Bus`: interface, channel and further options of the interface.

    Raises:
        InputError: python-can is not installed, or does not know the interface.
    """

    def __init__(
        self, name: str, clock: HostClock, decoder: Decoder, options: Mapping[str, Any]
    ) -> None:
        super().__init__(name, clock)
        self._can_library = import_optional("can")
        if (interface := options["interface"]) not in self._can_library.VALID_INTERFACES:
            known = ", ".join(sorted(self._can_library.VALID_INTERFACES))
            raise InputError("source", f"there is no interface {interface}", f"use one of {known}")
        self._decoder = decoder
        self._options = dict(options)

    def listen(self) -> None:
        """Receive frames from the CAN bus until the bus fails or the source is stopped."""
        filters = [
            {
                "can_id": identifier,
                "can_mask": EXTENDED_MASK if extended else STANDARD_MASK,
                "extended": extended,
            }
            for identifier, extended in sorted(self._decoder.identifiers)
        ]
        with self._can_library.Bus(can_filters=filters, **self._options) as bus:
            self.openings += 1
            while not self.stopping.is_set():
                message = bus.recv(TICK_S)
                if message is None or message.is_error_frame or message.is_remote_frame:
                    continue
                frame = message.arbitration_id, message.is_extended_id, bytes(message.data)
                self.store_message(round(message.timestamp * NS), frame)

    def series(self, received: list[Received]) -> dict[str, Series]:
        """Return the needed signals by name, decoded from the received CAN frames."""
        return self._decoder.series(received)
