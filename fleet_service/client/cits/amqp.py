"""AMQP 1.0 connection to an interchange (server that distributes hazard messages), on a separate
thread. Each message is sent repeatedly until the interchange accepts it. Messages of others are
received.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from schemas.errors import InputError
from schemas.runtime.installing import install_command

try:
    import proton
    from proton.handlers import MessagingHandler
    from proton.reactor import ApplicationEvent, Container, EventInjector, Selector
except ImportError as _missing:
    _problem = "the package python-qpid-proton is missing"
    raise InputError("cits", _problem, install_command("cits")) from _missing

CREDIT: Final = 200  # messages that the other side may send in advance
HEARTBEAT_S: Final = 10.0
RETRY_S: Final = (0.5, 1.0, 2.0, 5.0)  # [s] pauses between attempts to connect

log = logging.getLogger(__name__)


class Parcel(NamedTuple):
    """Hazard message (DENM) to send to the interchange. The function `on_accepted` is called with
    its name when the interchange has accepted it.
    """

    name: str
    body: bytes
    properties: Mapping[str, Any]


class _AmqpEvents(MessagingHandler):
    """Handler of events of the AMQP connection; all methods run on the thread of the AMQP library's
    event loop (its "container").
    """

    def __init__(self, link: AmqpLink) -> None:
        super().__init__(prefetch=CREDIT, auto_accept=True)
        self._link = link
        self._sender: Any = None
        self._flying: dict[Any, Parcel] = {}

    def on_start(self, event: Any) -> None:  # noqa: ANN401
        self._container = event.container
        event.container.selectable(self._link.injector)
        connection = event.container.connect(
            self._link.url, heartbeat=HEARTBEAT_S, reconnect=list(RETRY_S)
        )
        if self._link.target:
            self._sender = event.container.create_sender(connection, self._link.target)
        if self._link.source:
            select = Selector(self._link.selector) if self._link.selector else None
            event.container.create_receiver(connection, self._link.source, options=select)

    def on_connection_opened(self, _: Any) -> None:  # noqa: ANN401
        self._link.is_connected = True

    def on_disconnected(self, _: Any) -> None:  # noqa: ANN401
        self._link.is_connected = False
        log.warning("the interchange at %s does not answer; trying again", self._link.url)
        waiting = list(self._flying.values())
        self._flying.clear()
        self._link.queue.extendleft(reversed(waiting))

    def on_sendable(self, _: Any) -> None:  # noqa: ANN401
        self._send_queued()

    def on_send(self, _: Any) -> None:  # noqa: ANN401
        """Send to the interchange the messages that another thread has queued."""
        self._link.is_waking = False
        self._send_queued()

    def on_leave(self, _: Any) -> None:  # noqa: ANN401
        self._container.stop()

    def _send_queued(self) -> None:
        sender = self._sender
        queue = self._link.queue
        while sender is not None and queue and sender.credit > 0:
            parcel = queue.popleft()
            message = proton.Message(
                body=parcel.body, properties=dict(parcel.properties), durable=True, inferred=True
            )
            self._flying[sender.send(message)] = parcel

    def on_accepted(self, event: Any) -> None:  # noqa: ANN401
        parcel = self._flying.pop(event.delivery, None)
        if parcel is not None:
            self._link.on_accepted(parcel.name)

    def on_rejected(self, event: Any) -> None:  # noqa: ANN401
        parcel = self._flying.pop(event.delivery, None)
        if parcel is not None:
            self._link.rejected += 1
            log.warning(
                "the interchange refuses message %s: %s",
                parcel.name,
                event.delivery.remote.condition,
            )
            # Treat the message as done, because the interchange would refuse it again.
            self._link.on_accepted(parcel.name)

    def on_released(self, event: Any) -> None:  # noqa: ANN401
        parcel = self._flying.pop(event.delivery, None)
        if parcel is not None:
            self._link.queue.append(parcel)

    def on_message(self, event: Any) -> None:  # noqa: ANN401
        body = event.message.body
        self._link.on_message(
            bytes(body) if isinstance(body, bytes | memoryview) else b"",
            event.message.properties or {},
        )


class AmqpLink:
    """Connection to an interchange, the AMQP server that distributes hazard messages between
    operators.

    Args:
        url: amqp://HOST:PORT or amqps://HOST:PORT.
        target: address to send to; "" to send nothing.
        source: address to receive from; "" to receive nothing.
        selector: filter on the messages to receive, e.g. "messageType = 'DENM'".
        on_accepted: called with the name of each message that need not be sent again.
        on_message: called with body and properties of each received message.

    Attributes:
        is_connected: True while the interchange answers.
        is_waking: True while the connection's thread has been notified of queued messages but has
            not yet read the queue.
        rejected: number of messages that the interchange refused.
    """

    def __init__(
        self,
        url: str,
        target: str = "",
        source: str = "",
        *,
        selector: str = "",
        on_accepted: Callable[[str], None] = lambda _: None,
        on_message: Callable[[bytes, Mapping[str, Any]], None] = lambda *_: None,
    ) -> None:
        if not url.startswith(("amqp://", "amqps://")):
            raise InputError(
                "amqp",
                f"{url!r} is not an address",
                "write it like amqps://interchange.example.org:5671",
            )
        self.url = url
        self.target = target
        self.source = source
        self.selector = selector
        self.on_accepted = on_accepted
        self.on_message = on_message
        self.queue: deque[Parcel] = deque()
        self.is_connected = False
        self.is_waking = False
        self.rejected = 0
        self.injector = EventInjector()
        self._container = Container(_AmqpEvents(self))
        self._thread = threading.Thread(target=self._container.run, name="amqp", daemon=True)

    def open(self) -> AmqpLink:
        """Start the thread that connects to the interchange, and reconnects after a loss."""
        self._thread.start()
        return self

    def send(self, parcel: Parcel) -> None:
        """Queue a hazard message (DENM); it is sent repeatedly until the interchange accepts it."""
        self.queue.append(parcel)
        if not self.is_waking:
            self.is_waking = True
            self.injector.trigger(ApplicationEvent("send"))

    def close(self) -> None:
        """Close the connection to the interchange."""
        self.injector.trigger(ApplicationEvent("leave"))
        self._thread.join(5.0)
        self.injector.close()
