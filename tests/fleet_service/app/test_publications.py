"""Tests of the publication of acknowledgements in parts, between which messages are processed."""

from __future__ import annotations

import queue

import zenoh

from fleet_service.app.publications import WaitingAcks
from schemas import keys
from tests.waiting import PATIENCE_S


def test_acknowledgements_are_published_in_parts_in_their_order(session: zenoh.Session) -> None:
    received: queue.Queue[bytes] = queue.Queue()
    session.declare_subscriber(
        keys.ack_key("car-001"), lambda sample: received.put(sample.payload.to_bytes())
    )
    sent = [b"%d" % k for k in range(1000)]
    waiting = WaitingAcks()
    waiting.add([("car-001", ack) for ack in sent])
    left = []
    while waiting:
        waiting.publish_part(session)
        left.append(len(waiting))
    assert left[0] == 750, "a quarter of many"
    assert left[-3] - left[-2] == 64, "at least 64 of few"
    assert [received.get(timeout=PATIENCE_S) for _ in sent] == sent


def test_all_waiting_acknowledgements_are_published_at_the_end(session: zenoh.Session) -> None:
    received: queue.Queue[bytes] = queue.Queue()
    session.declare_subscriber(
        keys.ack_key("car-002"), lambda sample: received.put(sample.payload.to_bytes())
    )
    waiting = WaitingAcks()
    waiting.add([("car-002", b"first")] * 300)
    waiting.add([("car-002", b"last")])
    waiting.publish_all(session)
    assert not waiting
    assert [received.get(timeout=PATIENCE_S) for _ in range(301)][-1] == b"last"
