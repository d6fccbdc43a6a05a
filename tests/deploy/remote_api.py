"""Substitute for the remote-api plug-in of `zenohd`. It receives the messages with which a client
publishes, subscribes and queries over WebSocket, and passes them to a Zenoh session.

The plug-in is a library that `zenohd` loads, so the router in Python (`deploy.router`) cannot use
it. The layout of the messages is that of zenoh-ts 1.10 (`message.ts`), in Zenoh's serialization
format.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final

import zenoh
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from schemas.config import ZenohSettings
from schemas.runtime.zenoh_session import open_session

HAS_SEQUENCE: Final = 0x80  # bit in the first byte: the number of a request follows
# Types of messages from the client.
DECLARE_SUBSCRIBER: Final = 2
UNDECLARE_SUBSCRIBER: Final = 3
PUT: Final = 14
GET: Final = 18
PING: Final = 25
# Types of messages to the client.
PONG: Final = 0
OK: Final = 1
SAMPLE: Final = 5
REPLY: Final = 7
LAST_REPLY: Final = 8
ENCODINGS: Final = {0: "zenoh/bytes", 5: "application/json", 13: "application/protobuf"}
PRIORITIES: Final = (  # priorities in the order of their numbers, from 1
    zenoh.Priority.REAL_TIME,
    zenoh.Priority.INTERACTIVE_HIGH,
    zenoh.Priority.INTERACTIVE_LOW,
    zenoh.Priority.DATA_HIGH,
    zenoh.Priority.DATA,
    zenoh.Priority.DATA_LOW,
    zenoh.Priority.BACKGROUND,
)
CUSTOM: Final = 0xFFFF  # encoding of which the schema gives the whole name
# [s] The bridge answers no earlier, like a router behind a slow link or on a busy machine. By
# default, zenoh-ts waits only for half a second.
SLOW_S: Final = 0.7


class SerializedReader:
    """Reader of numbers, texts and bytes in Zenoh's serialization format."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def read_number(self, layout: str) -> int:
        """Read the next little-endian number from the serialized data and return it. `layout` is
        the format of the number in the notation of the module `struct`.
        """
        (found,) = struct.unpack_from("<" + layout, self._data, self._at)
        self._at += struct.calcsize("<" + layout)
        return int(found)

    def read_bytes(self) -> bytes:
        """Read a length n, stored in LEB128 (variable-length integer), and return the n bytes after
        it.
        """
        size = 0
        for shift in range(0, 63, 7):
            byte = self.read_number("B")
            size |= (byte & 0x7F) << shift
            if byte < 0x80:
                break
        self._at += size
        return self._data[self._at - size : self._at]

    def read_text(self) -> str:
        """Read a text, stored as its length in bytes and then its bytes in UTF-8; return
        the text.
        """
        return self.read_bytes().decode()

    def read_encoding(self) -> zenoh.Encoding:
        """Read a Zenoh encoding, stored as a number that stands for its name and a text for its
        schema; return the encoding.
        """
        name = ENCODINGS.get(self.read_number("H"), "")
        schema = self.read_text()
        return zenoh.Encoding(";".join(part for part in (name, schema) if part))


def _bytes(data: bytes) -> bytes:
    out = bytearray()
    size = len(data)
    while size > 0x7F:
        out.append(0x80 | size & 0x7F)
        size >>= 7
    return bytes(out) + bytes([size]) + data


def _encoding(encoding: zenoh.Encoding) -> bytes:
    name, _, schema = str(encoding).partition(";")
    for number, known in ENCODINGS.items():
        if name == known:
            return struct.pack("<H", number) + _bytes(schema.encode())
    return struct.pack("<H", CUSTOM) + _bytes(str(encoding).encode())


def _sample(sample: zenoh.Sample) -> bytes:
    """Return a sample that the router's session received, serialized for the client, without
    attachment and timestamp.
    """
    congestion = int(sample.congestion_control == zenoh.CongestionControl.BLOCK)
    priority = 1 + PRIORITIES.index(sample.priority)
    quality = priority | congestion << 3 | int(sample.express) << 4
    head = _bytes(str(sample.key_expr).encode()) + _bytes(sample.payload.to_bytes())
    return head + b"\x00" + _encoding(sample.encoding) + b"\x00\x00" + bytes([quality])


class RemoteClient:
    """WebSocket connection of a client of the remote API, with the Zenoh session that the server
    opened for it.
    """

    def __init__(self, link: ServerConnection, session: zenoh.Session) -> None:
        self._link = link
        self._session = session
        self._subscribers: dict[int, zenoh.Subscriber[None]] = {}

    def run(self) -> None:
        """Carry out the messages that the client sends over WebSocket until it disconnects."""
        for message in self._link:
            assert isinstance(message, bytes)
            reader = SerializedReader(message)
            kind = reader.read_number("B")
            has_sequence = bool(kind & HAS_SEQUENCE)
            sequence = reader.read_number("I") if has_sequence else 0
            answer = self._answer(kind & ~HAS_SEQUENCE, reader)
            if has_sequence:
                self._send(answer[0] | HAS_SEQUENCE, struct.pack("<I", sequence) + answer[1])

    def _answer(self, kind: int, reader: SerializedReader) -> tuple[int, bytes]:
        if kind == PING:
            return PONG, _bytes(str(self._session.info.zid()).encode())
        if kind == DECLARE_SUBSCRIBER:
            self._subscribe(reader.read_number("I"), reader.read_text())
        elif kind == UNDECLARE_SUBSCRIBER:
            self._subscribers.pop(reader.read_number("I")).undeclare()
        elif kind == PUT:
            self._put(reader)
        elif kind == GET:
            self._get(reader)
        else:
            raise ValueError(f"message {kind} is not part of this bridge; add it here")
        return OK, bytes([kind])

    def _subscribe(self, name: int, key: str) -> None:
        def pass_on(sample: zenoh.Sample) -> None:
            self._send(SAMPLE, struct.pack("<I", name) + _sample(sample))

        self._subscribers[name] = self._session.declare_subscriber(key, pass_on)

    def _put(self, reader: SerializedReader) -> None:
        key = reader.read_text()
        payload = reader.read_bytes()
        encoding = reader.read_encoding()
        assert reader.read_number("H") == 0, "attachments and timestamps are not part of the bridge"
        quality = reader.read_number("B")
        self._session.put(
            key,
            payload,
            encoding=encoding,
            priority=PRIORITIES[(quality & 7) - 1],
            congestion_control=zenoh.CongestionControl.BLOCK
            if quality & 8
            else zenoh.CongestionControl.DROP,
            express=bool(quality & 16),
        )

    def _get(self, reader: SerializedReader) -> None:
        name = struct.pack("<I", reader.read_number("I"))
        key = reader.read_text()
        parameters = reader.read_text()

        def pass_on(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._send(REPLY, name + b"\x01" + _sample(reply.ok))
            elif reply.err is not None:
                payload = _bytes(reply.err.payload.to_bytes())
                self._send(REPLY, name + b"\x00" + payload + _encoding(reply.err.encoding))

        def finish() -> None:
            self._send(LAST_REPLY, name)

        self._session.get(
            f"{key}?{parameters}" if parameters else key, zenoh.handlers.Callback(pass_on, finish)
        )

    def _send(self, kind: int, content: bytes) -> None:
        with suppress(ConnectionClosed):
            self._link.send(bytes([kind]) + content)


@contextmanager
def serve_remote_api(endpoint: str) -> Iterator[str]:
    """Serve clients of a router over WebSocket, slowly. Yield the locator to which zenoh-ts
    connects.
    """

    def answer(link: ServerConnection) -> None:
        threading.Event().wait(SLOW_S)
        session = open_session(ZenohSettings(connect=[endpoint]))
        assert session is not None
        with session:
            RemoteClient(link, session).run()

    with serve(answer, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"ws/127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join(10.0)
