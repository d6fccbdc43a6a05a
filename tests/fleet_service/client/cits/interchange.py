"""Simulated AMQP interchange (message broker). It accepts every message, and delivers the messages
that a test gives it.
"""

from __future__ import annotations

import multiprocessing
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

import proton
from proton.handlers import MessagingHandler
from proton.reactor import ApplicationEvent, Container, EventInjector

from tests.ports import free_ports


@dataclass
class Interchange:
    """Simulated interchange (message broker): its address, and the messages that it received."""

    url: str
    received: list[tuple[bytes, dict[str, Any]]] = field(default_factory=list)


class _Handler(MessagingHandler):
    def __init__(
        self, peer: Interchange, offered: Sequence[proton.Message], injector: EventInjector
    ) -> None:
        super().__init__(prefetch=500)
        self._peer = peer
        self._offered = deque(offered)
        self._injector = injector
        self.listening = threading.Event()

    def on_start(self, event: Any) -> None:  # noqa: ANN401
        self._container = event.container
        event.container.selectable(self._injector)
        event.container.listen(self._peer.url)
        self.listening.set()

    def on_message(self, event: Any) -> None:  # noqa: ANN401
        self._peer.received.append((bytes(event.message.body), dict(event.message.properties)))

    def on_sendable(self, event: Any) -> None:  # noqa: ANN401
        while self._offered and event.sender.credit > 0:
            event.sender.send(self._offered.popleft())

    def on_leave(self, _: Any) -> None:  # noqa: ANN401
        self._container.stop()


def free_url() -> str:
    """Return an AMQP address at which no server listens."""
    return f"amqp://127.0.0.1:{free_ports(1)[0]}"


@contextmanager
def interchange(url: str, offered: Sequence[proton.Message] = ()) -> Iterator[Interchange]:
    """Yield a simulated interchange (message broker) that listens at an address and delivers the
    messages `offered`.
    """
    peer = Interchange(url)
    injector = EventInjector()
    handler = _Handler(peer, offered, injector)
    thread = threading.Thread(target=Container(handler).run, daemon=True)
    thread.start()
    assert handler.listening.wait(30.0)
    try:
        yield peer
    finally:
        injector.trigger(ApplicationEvent("leave"))
        thread.join(10.0)
        injector.close()


@contextmanager
def separate_interchange(url: str) -> Iterator[Connection]:
    """Start a simulated interchange (message broker) in a separate process. Yield a pipe to this
    process: the answer to each request is the list of all messages received so far.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(url, theirs), daemon=True)
    process.start()
    try:
        yield ours
    finally:
        ours.send(False)
        process.join(30.0)


def _serve(url: str, requests: Connection) -> None:
    with interchange(url) as peer:
        while requests.recv():
            requests.send([(body, _plain(given)) for body, given in peer.received])


def _plain(given: dict[str, Any]) -> dict[str, Any]:
    """Return the application properties of a received AMQP message, with plain Python types in
    place of AMQP types.
    """
    return {name: int(value) if isinstance(value, int) else value for name, value in given.items()}
