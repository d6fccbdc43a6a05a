"""Tests of metrics and health over real HTTP on loopback. A metrics parser must read all values,
health must follow the reported problems, and log lines must be JSON if requested.
"""

from __future__ import annotations

import json
import socket
import urllib.error
import urllib.request
from collections.abc import Sequence
from urllib.parse import urlsplit

import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families

from schemas.errors import InputError
from schemas.runtime import metrics
from schemas.runtime.metrics import Metric, gauge, serve_metrics
from tests.waiting import PATIENCE_S

HOSTILE = 'a"b\\c\nd<script>'


def read_metrics() -> Sequence[Metric]:
    return [
        Metric(
            "refused_messages", "counter", "refused, by reason", {"time": 3, HOSTILE: 4}, "reason"
        ),
        gauge("queue_messages", "waiting", 7),
    ]


def fetch_page(address: str) -> tuple[int, str, str]:
    try:
        with urllib.request.urlopen(address, timeout=PATIENCE_S) as reply:
            return reply.status, reply.headers["Content-Type"], reply.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.headers["Content-Type"], error.read().decode()


def test_metric_values_survive_the_formats_own_parser() -> None:
    with serve_metrics("127.0.0.1", 0, read_metrics, list) as address:
        status, form, text = fetch_page(f"{address}/metrics")
    families = {family.name: family for family in text_string_to_metric_families(text)}
    assert status == 200
    assert form.startswith("application/openmetrics-text; version=1.0.0")
    refused = {
        sample.labels["reason"]: sample.value
        for sample in families["gripmap_refused_messages"].samples
    }
    assert refused == {"time": 3, HOSTILE: 4}
    assert [sample.value for sample in families["gripmap_queue_messages"].samples] == [7]


def test_health_follows_the_troubles() -> None:
    troubles: list[str] = []
    with serve_metrics("127.0.0.1", 0, read_metrics, lambda: troubles) as address:
        assert fetch_page(f"{address}/healthz")[0] == 200
        troubles.append("the disk is full")
        status, form, text = fetch_page(f"{address}/healthz")
        assert (status, form) == (503, "application/json")
        assert json.loads(text) == {"status": "trouble", "troubles": ["the disk is full"]}
        assert fetch_page(f"{address}/elsewhere")[0] == 404
        request = urllib.request.Request(f"{address}/metrics", data=b"x", method="POST")
        with pytest.raises(urllib.error.HTTPError, match="501") as refused:
            urllib.request.urlopen(request, timeout=PATIENCE_S)
        refused.value.close()


def test_no_metrics_server_runs_without_a_port() -> None:
    with serve_metrics("127.0.0.1", None, read_metrics, list) as address:
        assert address is None


def test_occupied_port_is_reported() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"^metrics_port: cannot listen on 127.0.0.1:{port}"):
            serve_metrics("127.0.0.1", port, read_metrics, list).__enter__()
        with pytest.raises(InputError, match="^health_port: "):
            serve_metrics("127.0.0.1", port, read_metrics, list, "health_port").__enter__()


@pytest.mark.parametrize("host", ["203.0.113.1", "no host"])
def test_host_that_is_not_of_this_machine_is_named(host: str) -> None:
    with pytest.raises(InputError, match=f"^metrics_host: cannot listen on {host}:0 "):
        serve_metrics(host, 0, read_metrics, list).__enter__()


def test_request_that_arrives_drop_by_drop_is_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "READ_S", 0.2)
    with serve_metrics("127.0.0.1", 0, read_metrics, list) as address:
        place = urlsplit(str(address))
        with socket.create_connection((str(place.hostname), int(place.port or 0))) as one:
            one.settimeout(0.05)
            assert any(has_ended(one) for _ in range(200))


def has_ended(connection: socket.socket) -> bool:
    """Send a byte over the connection. Return True if the server has ended the request, with or
    without an answer.
    """
    try:
        connection.send(b"G")
        connection.recv(1)
    except TimeoutError:
        return False
    except OSError:
        return True
    return True
