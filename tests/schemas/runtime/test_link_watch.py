"""Tests of the watch of a session's links (connections to routers). It must report when a real
router starts and stops.
"""

from __future__ import annotations

import logging
from collections import Counter
from functools import partial
from pathlib import Path

import pytest
import zenoh

from deploy.router import open_router
from schemas.config import ZenohSettings
from schemas.runtime.link_watch import LinkWatch, link_metrics, router_metrics
from schemas.runtime.zenoh_session import configuration
from tests.fleet_service.examples import key
from tests.ports import free_ports
from tests.secured import READER, ROUTERS, VEHICLES, open_network
from tests.waiting import until

RETRY = {
    "connect/retry": {"period_init_ms": 50, "period_max_ms": 100, "period_increase_factor": 1.0}
}


def test_a_lost_router_is_noticed_and_logged_at_once(caplog: pytest.LogCaptureFixture) -> None:
    changes = list[bool]()
    router, endpoints = open_router(listen=f"tcp/127.0.0.1:{free_ports(1)[0]}")
    with (
        caplog.at_level(logging.INFO),
        zenoh.open(configuration(ZenohSettings(connect=endpoints, config=RETRY))) as car,
    ):
        watch = LinkWatch(car, "anna", lambda: changes.append(watch.is_connected))
        until(lambda: watch.is_connected and watch.protocols == ["tcp"])
        assert (watch.epoch, watch.lost) == (1, 0)
        router.close()
        until(lambda: not watch.is_connected and not watch.protocols)
        assert watch.lost == 1
        router, _ = open_router(listen=endpoints)
        until(lambda: watch.is_connected and watch.protocols)
        assert watch.epoch == 2
        shown = {metric.name: metric.values for metric in link_metrics([watch])}
        assert shown == {
            "links": {"quic": 0.0, "tls": 0.0, "tcp": 1.0},
            "links_opened": {"": 2.0},
            "links_lost": {"": 1.0},
        }
        of_router = {metric.name: metric.values for metric in router_metrics(router)}
        assert of_router["router_sessions"] == {"client": 1.0, "router": 0.0, "peer": 0.0}
        assert of_router["router_links"]["tcp"] == 1.0
        # The message is logged after the state has changed.
        until(lambda: len(_link_messages(caplog)) >= 3)
        watch.close()
    router.close()
    assert changes[-2:] == [False, True]
    address = endpoints[0].partition("/")[2]
    assert _link_messages(caplog) == [
        f"anna is connected to the router at {address} over tcp",
        f"anna lost the router at {address} (tcp)",
        f"anna is connected to the router at {address} over tcp",
    ]


def _link_messages(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return the messages that the link watch has logged."""
    return [record.getMessage() for record in caplog.records if record.name.endswith("link_watch")]


def test_session_prefers_quic_and_takes_tls_where_udp_is_closed(tmp_path: Path) -> None:
    with open_network(tmp_path, protocol="quic") as network:
        quic = network.endpoints[ROUTERS[0]]
        tls = network.between[ROUTERS[0]]
        closed = "quic/127.0.0.1:9"
        for first, used in ((quic, "quic"), (closed, "tls")):
            with network.session_at(READER, [first, tls]) as session:
                watch = LinkWatch(session, READER)
                until(lambda watch=watch: watch.protocols)  # type: ignore[misc]
                assert watch.protocols == [used]


@pytest.mark.parametrize("capped", [True, False])
def test_router_drops_messages_of_a_vehicle_that_floods(tmp_path: Path, capped: bool) -> None:
    sent = 200
    received: Counter[tuple[str, bytes]] = Counter()  # messages by vehicle and payload

    def count_message(sample: zenoh.Sample) -> None:
        received[str(sample.key_expr).rpartition("/")[2], sample.payload.to_bytes()] += 1

    def has_reached(payload: bytes, session: zenoh.Session, name: str) -> bool:
        session.put(key(name), payload)
        return bool(received[name, payload])

    with (
        open_network(tmp_path, protocol="quic", capped=capped) as network,
        network.open_session("shard-0") as service,
        network.open_session(VEHICLES[0]) as car,
        network.open_session(VEHICLES[1]) as other,
    ):
        service.declare_subscriber("gripmap/v1/obs/**", count_message)
        for session, name in ((car, VEHICLES[0]), (other, VEHICLES[1])):
            until(partial(has_reached, b"before", session, name))
        for _ in range(sent):
            car.put(key(VEHICLES[0]), b"flood", congestion_control=zenoh.CongestionControl.BLOCK)
        until(partial(has_reached, b"after", other, VEHICLES[1]))
        if capped:
            assert received[VEHICLES[0], b"flood"] < sent / 2
        else:
            until(lambda: received[VEHICLES[0], b"flood"] == sent)
