"""`python -m tests.faults.link_ends JSON`: one endpoint of the link campaign, in the network
namespace in which it is started.

Roles: `receive` subscribes and records when each numbered message arrives; `send` publishes
numbered messages at a rate; `open` measures how long a session takes to open; `watch` prints when
its link changes. Times are those of the system's monotonic clock, which all processes of a machine
share.
"""

from __future__ import annotations

import json
import struct
import sys
import threading
import time
from pathlib import Path
from typing import Any, Final

import zenoh

from schemas import keys
from schemas.config import ZenohSettings
from schemas.runtime.link_watch import LinkWatch
from schemas.runtime.process import force_exit
from schemas.runtime.zenoh_session import open_session, quality_of
from tests.secured import settings
from tests.waiting import matched

HEAD: Final = struct.Struct("<Id")  # number of the message, and time [s] at which it was sent


def open_end(given: dict[str, Any]) -> zenoh.Session:
    """Open the Zenoh session of this endpoint of the link, with the certificate of the given
    name.
    """
    one = settings(given["connect"][0], Path(given["certificates"]))
    config = {key: value for key, value in one.config.items() if key != "connect/retry"}
    session = open_session(
        ZenohSettings(connect=given["connect"], config=config), None, given["name"]
    )
    assert session is not None
    return session


def receive(given: dict[str, Any]) -> None:
    """Receive messages until stdin is closed. Then print, for each Zenoh key, the number, the delay
    [s] and the arrival time [s] of each message.
    """
    arrived: dict[str, list[tuple[int, float, float]]] = {}

    def note_arrival(sample: zenoh.Sample) -> None:
        now = time.monotonic()
        number, put_at = HEAD.unpack(sample.payload.to_bytes()[: HEAD.size])
        arrived.setdefault(str(sample.key_expr), []).append((number, now - put_at, now))

    with open_end(given) as session:
        subscribers = [session.declare_subscriber(key, note_arrival) for key in given["keys"]]
        print(
            json.dumps({"protocols": wait_for_link(session), "subscribers": len(subscribers)}),
            flush=True,
        )
        sys.stdin.read()
        print(json.dumps(arrived), flush=True)


def send(given: dict[str, Any]) -> None:
    """Publish messages of several streams until stdin is closed. Then print how many messages were
    sent on each Zenoh key.

    Each stream has a key, a message size [bytes] and a rate [1/s]. Its quality of service is that
    of its topic. A stream with rate 0 sends as fast as the session accepts messages.
    """
    over = threading.Event()
    counts = dict[str, int]()

    def drive_stream(session: zenoh.Session, stream: dict[str, Any]) -> None:
        quality = quality_of(keys.TOPICS[stream["key"].split("/")[2]])
        filling = bytes(stream["size"] - HEAD.size)
        number = 0
        due = time.monotonic()
        while not over.is_set():
            session.put(stream["key"], HEAD.pack(number, time.monotonic()) + filling, **quality)
            number += 1
            counts[stream["key"]] = number
            if stream["rate"]:
                # No burst after a delay: the contract forbids it, and the router would drop
                # messages.
                due = max(due, time.monotonic()) + 1.0 / stream["rate"]
                over.wait(due - time.monotonic())

    sessions = {
        name: open_end({**given, "name": name})
        for name in {one.get("name", given["name"]) for one in given["streams"]}
    }
    links = {name: wait_for_link(session) for name, session in sessions.items()}
    publishers = [
        sessions[one.get("name", given["name"])].declare_publisher(one["key"])
        for one in given["streams"]
    ]
    for publisher in publishers:
        matched(publisher)  # Zenoh drops messages until it knows the subscription
    print(json.dumps({"protocols": links}), flush=True)
    sys.stdin.readline()
    threads = [
        threading.Thread(
            target=drive_stream, args=(sessions[one.get("name", given["name"])], one), daemon=True
        )
        for one in given["streams"]
    ]
    for thread in threads:
        thread.start()
    sys.stdin.read()
    over.set()
    for thread in threads:
        thread.join(5.0)
    time.sleep(given.get("drain_s", 0.0))
    print(json.dumps(counts), flush=True)


def wait_for_link(session: zenoh.Session) -> list[str]:
    """Wait until a Zenoh session has a link to its router. Return the transports (such as QUIC) of
    its links.
    """
    watch = LinkWatch(session, "link")
    while not watch.protocols:
        time.sleep(0.005)
    return watch.protocols


def measure_opening(given: dict[str, Any]) -> None:
    """Open the session of this endpoint. Print the time [s] until it was open, and its transport
    (QUIC or TLS).
    """
    began = time.monotonic()
    with open_end(given) as session:
        elapsed_s = time.monotonic() - began
        print(json.dumps({"seconds": elapsed_s, "protocols": wait_for_link(session)}), flush=True)


def watch(given: dict[str, Any]) -> None:
    """Print a line each time when the link of this endpoint's session to the router is lost or
    comes back, until stdin is closed.
    """
    with open_end(given) as session:
        seen: list[LinkWatch] = []

        def print_state() -> None:
            if seen:
                state = {
                    "time": time.monotonic(),
                    "connected": seen[0].is_connected,
                    "protocols": seen[0].protocols,
                }
                print(json.dumps(state), flush=True)

        seen.append(LinkWatch(session, given["name"], print_state))
        wait_for_link(session)
        print_state()
        sys.stdin.read()


ROLES: Final = {"receive": receive, "send": send, "open": measure_opening, "watch": watch}


def main() -> int:
    """Run the endpoint in the role (receive, send, open or watch) that the command line names."""
    given = json.loads(sys.argv[1])
    ROLES[given["role"]](given)
    return 0


if __name__ == "__main__":
    force_exit(main())
