"""Campaign on broken receivers of a webhook: every alert arrives, waits in the queue, or is counted
as lost.

Each kind of receiver has a different fault. Most kinds fail only for their first connections and
then work; those in FOREVER fail for every connection. A receiver records the ids of the alerts that
it confirmed. The check uses this record, because the sender's own counters show only the losses
that the sender noticed.
"""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Final

from fleet_service.client.alert_queue import AlertQueue
from fleet_service.client.stretches import StretchAlert
from fleet_service.client.webhook import Webhook
from schemas.runtime.figures import Figure
from tests.faults.bars import make_figure
from tests.faults.frame import Site

ALERTS: Final = 5
BROKEN: Final = 2  # connections that fail before the receiver works again
TIMEOUT_S: Final = 0.5
PATIENCE_S: Final = 30.0  # time for all alerts to be delivered or dropped
FEW: Final = 3  # queue places for the receiver that stays absent too long
OK: Final = b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
FOREVER: Final = frozenset({"absent", "overflow", "refuses"})


def _make_response(code: int, more: str = "") -> bytes:
    return f"HTTP/1.1 {code} X\r\n{more}Content-Length: 0\r\nConnection: close\r\n\r\n".encode()


def _repeat_part(part: bytes, pause_s: float = 0.0) -> Callable[[socket.socket], None]:
    def send(client: socket.socket) -> None:
        client.sendall(b"HTTP/1.1 200 OK\r\n")
        end = time.monotonic() + 4 * TIMEOUT_S
        while time.monotonic() < end:
            client.sendall(part)
            time.sleep(pause_s)

    return send


def _stay_silent(client: socket.socket) -> None:
    client.settimeout(4 * TIMEOUT_S)
    client.recv(1)


def _answer_with(answer: bytes) -> Callable[[socket.socket], None]:
    return lambda client: client.sendall(answer)


BREAKS: Final[dict[str, Callable[[socket.socket], None]]] = {
    "not-http": _answer_with(b"220 mail.example ready\r\n\r\n"),
    "redirect-301": _answer_with(_make_response(301, "Location: /login\r\n")),
    "redirect-302": _answer_with(_make_response(302, "Location: /login\r\n")),
    "redirect-303": _answer_with(_make_response(303, "Location: /login\r\n")),
    "redirect-308": _answer_with(_make_response(308, "Location: /login\r\n")),
    "drips": _repeat_part(b"x", 0.05),
    "closes": lambda _: None,
    "half-head": _answer_with(b"HTTP/1.1 200 OK\r\nContent-Le"),
    "silent": _stay_silent,
    "huge-head": _repeat_part(b"x-a: " + b"y" * 60_000),
    "error-500": _answer_with(_make_response(500)),
    "error-429": _answer_with(_make_response(429)),
    "not-found": _answer_with(_make_response(404)),
    "bad-number": _answer_with(b"HTTP/1.1 two-hundred OK\r\n\r\n"),
    "refuses": _answer_with(_make_response(400)),
    "absent": _stay_silent,
    "overflow": _stay_silent,
}


class Receiver:
    """HTTP server on this machine that receives alerts. Its `kind` selects one of the faults in
    BREAKS. The fault affects the first BROKEN connections, or all connections if the kind is in
    FOREVER. A working receiver records in `received` the ids of the alerts that it confirmed.
    """

    def __init__(self, kind: str) -> None:
        self.received: set[str] = set()
        self._break = BREAKS[kind]
        self._left = 10**9 if kind in FOREVER else BROKEN
        self._server = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._server.getsockname()[1]}/hook"
        self._thread = threading.Thread(target=self._serve_clients, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the HTTP server."""
        self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        self._thread.join()

    def _serve_clients(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._server.accept()
                threading.Thread(target=self._answer_client, args=(client,), daemon=True).start()

    def _answer_client(self, client: socket.socket) -> None:
        with client, suppress(OSError, ValueError, IndexError):
            client.settimeout(4 * TIMEOUT_S)
            head, text = _read_request(client)
            if self._left > 0:
                self._left -= 1
                self._break(client)
            elif head.startswith(b"POST /hook "):
                client.sendall(OK)
                self.received.add(json.loads(text)["alerts"][0]["fingerprint"])
            else:
                client.sendall(OK)  # like a login page, which answers every GET


def _read_request(client: socket.socket) -> tuple[bytes, bytes]:
    data = b""
    while b"\r\n\r\n" not in data:
        data += client.recv(65536) or b"\r\n\r\n"
    head, _, text = data.partition(b"\r\n\r\n")
    lengths = [line for line in head.split(b"\r\n") if line.lower().startswith(b"content-length:")]
    while len(text) < int(lengths[0].split(b":")[1]):
        text += client.recv(65536)
    return head, text


def make_stretch(number: int) -> StretchAlert:
    """Return a made-up alert of a road stretch whose id is `number`."""
    return StretchAlert(
        id=f"id-{number}",
        state="raised",
        since=0,
        time=0,
        length_m=12.0,
        direction="north-south",
        headings=("north",),
        latitude=57.7,
        longitude=11.97,
        bbox=(11.9, 57.6, 12.0, 57.8),
        cells=1,
        mu=0.2,
        mu_lower=0.1,
        mu_upper=0.3,
        p_slippery=0.95,
        vehicles=3,
        reason="P(mu < 0.4) = 0.95 > 0.9",
        points=((57.7, 11.97),),
    )


def run_kind(folder: Path, kind: str) -> tuple[int, int]:
    """Send alerts by webhook to one kind of receiver. Return the number of alerts that arrived, and
    the number of missing ones that the sender counts neither as lost nor as waiting.
    """
    receiver = Receiver(kind)
    log_lines = list[str]()
    queue = AlertQueue(folder / f"{kind}.sqlite", FEW if kind == "overflow" else 1000)
    hook = Webhook(receiver.url, log_lines.append, queue, TIMEOUT_S)
    for number in range(ALERTS):
        hook.send(make_stretch(number))
    end = time.monotonic() + (1.0 if kind in FOREVER else PATIENCE_S)
    while time.monotonic() < end and len(receiver.received) + hook.lost_count < ALERTS:
        time.sleep(0.02)
    hook.close()
    receiver.close()
    missing = ALERTS - len(receiver.received)
    admitted = hook.lost_count + hook.waiting_count if log_lines else 0
    return len(receiver.received), max(missing - admitted, 0)


def run(site: Site) -> list[Figure]:
    """Send alerts by webhook to all kinds of failing receivers at the same time, for some seconds.
    Return as figures how many alerts arrived, and how many are missing although the sender counts
    them neither as lost nor as waiting.
    """
    with ThreadPoolExecutor(len(BREAKS)) as pool:
        found = dict(
            zip(BREAKS, pool.map(lambda kind: run_kind(site.folder, kind), BREAKS), strict=True)
        )
    for kind, (arrived, lost) in found.items():
        site.say(f"{kind}: {arrived} of {ALERTS} arrived, {lost} lost silently")
    short = [
        kind for kind, (arrived, _) in found.items() if kind not in FOREVER and arrived < ALERTS
    ]
    return [
        make_figure("faults.webhook.lost_silently", sum(lost for _, lost in found.values())),
        make_figure("faults.webhook.late", len(short)),
        make_figure("faults.webhook.kinds", len(found)),
        make_figure("faults.webhook.arrived", sum(arrived for arrived, _ in found.values())),
    ]
