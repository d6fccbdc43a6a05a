"""Output of alerts as DENM (hazard messages) to an AMQP server ("interchange"). Each message is
saved to a file before it is sent, and stays in the file until the server accepts it.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from fleet_service.client.cits.amqp import Parcel
from fleet_service.client.cits.denm import Denm, decode_denm, encode_denm
from fleet_service.client.cits.events import EventBook
from fleet_service.client.cits.properties import Originator, message_properties
from fleet_service.client.stretches import StretchAlert
from schemas.errors import InputError
from schemas.runtime import commandline
from schemas.runtime.durable import open_durably

CHECK_S: Final = 10.0  # [s] period of the checks for events whose validity must be renewed


class DenmOutput:
    """Output that sends the active alerts to an AMQP server and keeps them up to date there.

    Args:
        station: identifier of the originating station.
        originator: publisher, for the properties of the messages.
        path: state file with the events and the messages that are not accepted yet. If it exists,
            the output starts from its content, so a restart does not repeat events.
        send: function that sends a message; `mark_accepted` must be called with the message's name
            once it is accepted.
        clock: function that returns the time [ns UTC].

    Raises:
        InputError: the state file is damaged, belongs to another station, or was not written by
            this class.
    """

    def __init__(
        self,
        station: int,
        originator: Originator,
        path: Path,
        send: Callable[[Parcel], None],
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self._originator = originator
        self._path = path
        self._send = send
        self._clock = clock
        self._lock = threading.Lock()
        self._checked = -float("inf")
        before = _read_state(path)
        self._book = EventBook(station, before["book"])
        self._pending = {name: bytes.fromhex(body) for name, body in before["pending"].items()}
        for name, body in list(self._pending.items()):
            self._send(self._make_parcel(name, body, decode_denm(body)))

    @property
    def is_due(self) -> bool:
        """Return True if it is time to check whether hazard events must be sent again before their
        validity ends.
        """
        return time.monotonic() >= self._checked + CHECK_S

    def mark_accepted(self, name: str) -> None:
        """Record that the interchange accepted the DENM with this name, so that it is not sent
        again.
        """
        with self._lock:
            self._pending.pop(name, None)

    def keep_up(
        self, standing: Sequence[StretchAlert], has_service: Callable[[float, float], bool]
    ) -> None:
        """Send the DENM that are due.

        Args:
            standing: every stretch of road with an active alert.
            has_service: function that returns True if a service answers for a place (latitude,
                longitude).

        Raises:
            InputError: the file cannot be written; nothing was sent.
        """
        self._checked = time.monotonic()
        due = self._book.update(standing, self._clock(), has_service)
        with self._lock:
            fresh = {f"{one.sequence}-{one.referenced}": (encode_denm(one), one) for one in due}
            self._pending |= {name: body for name, (body, _) in fresh.items()}
            content = {
                "book": self._book.content,
                "pending": {name: body.hex() for name, body in self._pending.items()},
            }
        with commandline.report_write_errors(self._path), open_durably(self._path) as file:
            file.write(json.dumps(content).encode())
        for name, (body, denm) in fresh.items():
            self._send(self._make_parcel(name, body, denm))

    def _make_parcel(self, name: str, body: bytes, denm: Denm) -> Parcel:
        return Parcel(name, body, message_properties(denm, self._originator))


def _read_state(path: Path) -> dict[str, Any]:
    """Return the events ("book", None without a file) and the pending messages of a state file."""
    if not path.exists():
        return {"book": None, "pending": {}}
    try:
        found: dict[str, Any] = json.loads(path.read_text())
        if not isinstance(found["pending"], dict) or not isinstance(found["book"], dict):
            raise TypeError("other content")
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            "state", f"{path} is not a file of events", "give another, or move it away"
        ) from error
    return found
