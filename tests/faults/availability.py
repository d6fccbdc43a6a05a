"""Availability of the page and the service during attacks: share of an honest reader's requests
that are answered.

One attack runs at a time, from an address of its own. Meanwhile the honest reader sends requests,
one after the other. They need the same resource (such as threads or connections) as the attack. A
request fails if it is refused or not answered within PATIENCE_S. Page, service and router run in
separate processes.
"""

from __future__ import annotations

import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from http.client import HTTPConnection, HTTPException
from typing import Final, NamedTuple
from urllib.parse import urlsplit

from schemas import keys
from schemas.config import ZenohSettings
from schemas.runtime.figures import Figure
from schemas.runtime.zenoh_session import open_session
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.faults.processes import Part, open_stage
from tests.faults.queries import _await_tile, _fill_map, _find_tile

PATIENCE_S: Final = 10.0  # longest wait of a human user
ATTACKER: Final = "127.0.0.66"
CONNECTIONS: Final = 1024
HALF: Final = b"GET / HTTP/1.1\r\nHost: 127"
REST: Final = b" HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
STREAMS: Final = 420
LOOPS: Final = 3
ITEMS: Final = "/collections/grip/items"


Attack = AbstractContextManager[None]


class Target(NamedTuple):
    """Addresses of the live page and of the service, which are attacked, and of the router between
    them.
    """

    host: str
    port: int
    endpoint: str
    at: str


def run(site: Site) -> list[Figure]:
    """Send twenty requests of an honest reader during each attack (in a quick run, six). Return as
    a figure the share of them that are answered during the worst attack.
    """
    asked = site.choose_amount(20, 6)
    served = {}
    with open_stage(site.folder, vehicle_kb_s=1e4, vehicle_burst_kb=1e5) as stage:
        session = open_session(ZenohSettings(connect=[stage.endpoint]))
        assert session is not None
        with session:
            _fill_map(session, stage, site.choose_amount(40, 10))
            _await_tile(session)
        words = ["page", "--connect", stage.endpoint, "--port", "0"]
        words += ["--archive", str(stage.archive)]
        page = Part("page", [sys.executable, "-m", "fleet_service.cli", *words], site.folder)
        page.start()
        try:
            address = urlsplit(page.line_with("page: ").removeprefix("page: "))
            moment = datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
            target = Target(str(address.hostname), int(address.port or 0), stage.endpoint, moment)
            time.sleep(1.0)
            _await_page(target)
            for name, (attack, ask) in ATTACKS.items():
                with attack(target):
                    served[name] = sum(ask(target) for _ in range(asked))
                size = page.log.stat().st_size
                site.say(f"{name}: {served[name]} of {asked} served; log of the page {size} bytes")
        finally:
            page.kill()
    shares = {name: count / asked for name, count in served.items()}
    return [
        make_figure("faults.availability.other_reader_served", min(shares.values())),
        make_figure("faults.availability.attackers", len(shares)),
        make_figure("faults.availability.log_bytes", size),
        *(
            Figure(f"faults.availability.served.{name}", share, "of the requests")
            for name, share in shares.items()
        ),
    ]


def _await_page(target: Target) -> None:
    end = time.monotonic() + 30.0
    while not _ask_cells(target) and time.monotonic() < end:
        time.sleep(0.2)


def _get(target: Target, path: str, source: str = "127.0.0.1") -> int:
    """Send an HTTP request for `path` to the attacked page. Return the HTTP status of the answer,
    or 0 if no answer arrives.
    """
    connection = HTTPConnection(target.host, target.port, PATIENCE_S, (source, 0))
    try:
        connection.request("GET", path)
        answer = connection.getresponse()
        if path.startswith("/events"):
            answer.read(1)
        else:
            answer.read()
    except (OSError, HTTPException):
        return 0
    else:
        return answer.status
    finally:
        connection.close()


def _ask_past(target: Target) -> bool:
    return _get(target, f"{ITEMS}?datetime={target.at}&limit=10") == 200


def _ask_cells(target: Target) -> bool:
    return _get(target, f"{ITEMS}?limit=10") == 200


def _ask_start(target: Target) -> bool:
    return _get(target, "/") == 200


def _ask_events(target: Target) -> bool:
    return _get(target, "/events") == 200


def _ask_tile(target: Target, parameters: str = "") -> bool:
    """Query the service for one map tile over Zenoh. Return True if the service answers."""
    session = open_session(ZenohSettings(connect=[target.endpoint]))
    assert session is not None
    with session:
        place = keys.map_key(_find_tile()) + parameters
        return any(reply.ok for reply in session.get(place, timeout=PATIENCE_S))


def _ask_service_past(target: Target) -> bool:
    return _ask_tile(target, f"?at={target.at}")


@contextmanager
def _loops(work: Callable[[], object]) -> Iterator[None]:
    """Call `work` again and again in LOOPS threads for the duration of the `with` block."""
    stop = threading.Event()

    def go_on() -> None:
        while not stop.is_set():
            work()

    threads = [threading.Thread(target=go_on, daemon=True) for _ in range(LOOPS)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join(2 * PATIENCE_S)


def _loop_past(target: Target) -> Attack:
    return _loops(lambda: _get(target, f"{ITEMS}?datetime={target.at}", ATTACKER))


def _loop_borrowed(target: Target) -> Attack:
    tiles = ",".join([str(_find_tile())] * 256)
    return _loops(lambda: _get(target, f"/blocks?tiles={tiles}&borrowed=1", ATTACKER))


def _loop_map(target: Target) -> Attack:
    return _loop_service(target, f"{keys.ROOT}/map/**?format=geojson")


def _loop_service_past(target: Target) -> Attack:
    return _loop_service(target, f"{keys.ROOT}/map/**?at={target.at}")


@contextmanager
def _loop_service(target: Target, query: str) -> Iterator[None]:
    """Send the query `query` to the service repeatedly, in LOOPS threads that share one Zenoh
    session, for the duration of the `with` block.
    """
    session = open_session(ZenohSettings(connect=[target.endpoint]))
    assert session is not None
    with session, _loops(lambda: list(session.get(query, timeout=PATIENCE_S))):
        yield


@contextmanager
def _hold_connections(target: Target, *parts: bytes) -> Iterator[None]:
    """Open CONNECTIONS connections to the attacked page. On each connection, send the `parts` of a
    request one after the other, and read a little of the answer in between. The connections stay
    open during the `with` block.
    """
    with ExitStack() as stack:
        for _ in range(CONNECTIONS):
            with suppress(OSError):
                one = stack.enter_context(socket.socket())
                one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                one.settimeout(PATIENCE_S)
                one.bind((ATTACKER, 0))
                one.connect((target.host, target.port))
                one.sendall(parts[0])
                for part in parts[1:]:
                    one.recv(4096)
                    one.sendall(part)
        yield


def _hold_half_questions(target: Target) -> Attack:
    return _hold_connections(target, HALF)


def _hold_second_questions(target: Target) -> Attack:
    return _hold_connections(target, b"GET /tiles" + REST, HALF)


def _hold_unread_answers(target: Target) -> Attack:
    return _hold_connections(target, (b"GET " + ITEMS.encode() + b"?limit=10000" + REST) * 40)


@contextmanager
def _hold_streams(target: Target) -> Iterator[None]:
    """Open event streams of the attacked page without reading their events, and keep them open
    during the `with` block.
    """
    with ExitStack() as stack:
        for _ in range(STREAMS):
            one = HTTPConnection(target.host, target.port, PATIENCE_S, (ATTACKER, 0))
            stack.callback(one.close)
            with suppress(OSError):
                one.request("GET", "/events")
        yield


ATTACKS: Final[dict[str, tuple[Callable[[Target], Attack], Callable[[Target], bool]]]] = {
    "past": (_loop_past, _ask_past),
    "past of the service": (_loop_service_past, _ask_service_past),
    "past of the service, page": (_loop_service_past, _ask_past),
    "whole map": (_loop_map, _ask_tile),
    "borrowed tiles": (_loop_borrowed, _ask_cells),
    "half questions": (_hold_half_questions, _ask_start),
    "half second questions": (_hold_second_questions, _ask_start),
    "unread answers": (_hold_unread_answers, _ask_cells),
    "streams": (_hold_streams, _ask_events),
}
