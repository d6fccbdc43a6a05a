"""Tests that one client cannot use up the page's past maps, event streams or connections. Other
clients must still get answers.
"""

from __future__ import annotations

import asyncio
import socket
from contextlib import suppress
from types import SimpleNamespace
from typing import Any, cast

import pytest
import uvicorn

from fleet_service.page import connections
from fleet_service.page.connections import BoundedProtocol, RareMessages, report_loop_error
from fleet_service.page.map_mirror import MapMirror
from fleet_service.page.server import open_socket
from fleet_service.page.turns import (
    MOST_WAITING,
    RUNNING,
    PastTurns,
    RequestTurns,
    TooManyQuestionsError,
)
from fleet_service.page.watchers import TooManyWatchersError, View, Watchers

VIEW = View((-180.0, -85.0, 180.0, 85.0), 0)


def test_client_with_many_questions_does_not_keep_others_from_the_past() -> None:
    served: list[str] = []

    async def ask(turns: PastTurns, client: str, *, is_first: bool = False) -> None:
        try:
            async with turns.take(client):
                await asyncio.sleep(0)
                served.append(client)
        except TooManyQuestionsError:
            served.append(f"{client} refused")
        if is_first:
            assert not turns._waiting[client]

    async def run() -> None:
        turns = PastTurns()
        await asyncio.gather(
            *(ask(turns, "greedy") for _ in range(8)), *(ask(turns, f"other-{k}") for k in range(8))
        )
        await ask(turns, "greedy", is_first=True)

    asyncio.run(run())
    assert served.count("greedy") == MOST_WAITING + 1
    assert served.count("greedy refused") == 8 - MOST_WAITING
    assert all(served.count(f"other-{k}") == 1 for k in range(8))


def test_client_with_many_requests_waits_while_another_is_answered() -> None:
    async def count_running() -> int:
        turns = RequestTurns()
        gate = asyncio.Event()
        running: list[str] = []

        async def hold_turn(client: str) -> None:
            async with turns.take(client):
                running.append(client)
                await gate.wait()

        asked = [asyncio.create_task(hold_turn("greedy")) for _ in range(3 * RUNNING)]
        asked.append(asyncio.create_task(hold_turn("other")))
        while "other" not in running:
            await asyncio.sleep(0)
        at_once = running.count("greedy")
        gate.set()
        await asyncio.gather(*asked)
        assert not turns._free
        assert running.count("greedy") == 3 * RUNNING
        return at_once

    assert asyncio.run(count_running()) == RUNNING


def test_full_page_takes_a_stream_from_the_client_with_most() -> None:
    async def run() -> list[int]:
        watchers = Watchers(MapMirror(), dict, most=6)
        greedy = [watchers.add_watcher(VIEW, "greedy") for _ in range(6)]
        for _ in range(3):
            watchers.add_watcher(VIEW, "other")
        with pytest.raises(TooManyWatchersError):
            watchers.add_watcher(VIEW, "other")
        ended = 0
        for stream in greedy[:3]:
            events = [event async for event in stream]
            ended += bool(events)
        return [len(watchers), ended]

    assert asyncio.run(run()) == [6, 3]


class Transport:
    """Simulated network connection that records whether the server closed it."""

    def __init__(self, host: str) -> None:
        self._host = host
        self.is_aborted = False

    def abort(self) -> None:
        """Record that the server closed the simulated connection."""
        self.is_aborted = True

    def get_extra_info(self, name: str) -> Any:  # noqa: ANN401 as in asyncio
        """Return the network address of the simulated connection's client."""
        return (self._host, 1) if name == "peername" else None


def accept(
    open_ones: set[Any], timers: list[Any], host: str = ""
) -> tuple[BoundedProtocol, Transport]:
    """Let the server accept a simulated connection from a browser at address `host`. Return the
    server's protocol object and the connection, which records whether the server closed it.
    """
    protocol = BoundedProtocol.__new__(BoundedProtocol)

    def call_later(seconds: float, call: Any, *args: Any) -> Any:  # noqa: ANN401 as in asyncio
        timers.append((seconds, lambda: call(*args)))
        return SimpleNamespace()

    loop = SimpleNamespace(call_later=call_later)
    logger = SimpleNamespace(level=100)
    values = {
        "connections": open_ones,
        "loop": loop,
        "cycle": None,
        "logger": logger,
        "transport": None,
    }
    for name, value in values.items():
        setattr(protocol, name, value)
    transport = Transport(host)
    protocol.connection_made(cast(asyncio.Transport, transport))
    return protocol, transport


def test_silent_connections_are_closed_and_give_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "MOST", 3)
    open_ones: set[Any] = set()
    timers: list[Any] = []
    first = accept(open_ones, timers)
    others = [accept(open_ones, timers) for _ in range(2)]
    newest = accept(open_ones, timers)
    assert first[1].is_aborted
    assert len(open_ones) == 3
    seconds, close = timers[-1]
    close()
    assert (seconds, newest[1].is_aborted) == (connections.HEAD_S, True)
    busy = [others[0][0], others[1][0], newest[0]]
    for one in busy:
        one.cycle = cast(Any, SimpleNamespace(response_complete=False))
    refused = accept(open_ones, timers)
    assert refused[1].is_aborted
    assert refused[0] not in open_ones
    fair = accept(open_ones, timers, "another")
    assert others[0][1].is_aborted
    assert fair[0] in open_ones


@pytest.mark.parametrize("rest", [b"GET / HT", b"POST / HTTP/1.1\r\ncontent-length: 99\r\n\r\n"])
def test_connection_that_does_not_end_its_second_request_is_closed(
    monkeypatch: pytest.MonkeyPatch, rest: bytes
) -> None:
    monkeypatch.setattr(connections, "HEAD_S", 0.2)

    async def answer_empty(_: object, __: object, send: Any) -> None:  # noqa: ANN401 as in ASGI
        await send({"type": "http.response.start", "status": 204, "headers": []})
        await send({"type": "http.response.body"})

    async def send_both() -> bytes:
        config = uvicorn.Config(answer_empty, http=BoundedProtocol, lifespan="off", ws="none")
        server = uvicorn.Server(config)
        config.load()
        server.lifespan = config.lifespan_class(config)
        listening = socket.create_server(("127.0.0.1", 0))
        await server.startup([listening])
        reader, writer = await asyncio.open_connection(*listening.getsockname())
        writer.write(b"GET / HTTP/1.1\r\nhost: a\r\n\r\n")
        head = await reader.readuntil(b"\r\n\r\n")
        writer.write(rest)
        with suppress(ConnectionResetError):
            await asyncio.wait_for(reader.read(), 5.0)
        writer.close()
        await server.shutdown([listening])
        return head

    assert asyncio.run(send_both()).startswith(b"HTTP/1.1 204")


def test_web_server_sends_each_part_of_an_answer_at_once() -> None:
    """The page's server must set the socket option TCP_NODELAY. Otherwise each part of an answer
    waits up to 40 ms for the acknowledgement of the previous part.
    """

    async def accept() -> int:
        accepted: asyncio.Future[int] = asyncio.get_running_loop().create_future()

        def note_option(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            connection = writer.get_extra_info("socket")
            accepted.set_result(connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
            writer.close()

        with open_socket("127.0.0.1", 0) as listening:
            server = await asyncio.start_server(note_option, sock=listening)
            async with server:
                _, writer = await asyncio.open_connection(*listening.getsockname())
                writer.close()
                return await accepted

    assert asyncio.run(accept()) == 1


def test_repeated_messages_are_logged_once_in_a_while(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    rare = RareMessages()
    loop = cast(asyncio.AbstractEventLoop, None)
    connections.log.addFilter(rare)
    try:
        for _ in range(100):
            report_loop_error(loop, {"message": "accept failed"})
        monkeypatch.setattr(connections, "LOG_S", 0.0)
        report_loop_error(loop, {"message": "accept failed"})
    finally:
        connections.log.removeFilter(rare)
    assert [record.getMessage() for record in caplog.records] == [
        "web server: accept failed",
        "web server: accept failed (and 99 more since the last message)",
    ]
