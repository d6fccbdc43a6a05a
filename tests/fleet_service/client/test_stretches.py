"""Tests of alerts per road section. Neighbouring cells with ice must form one alert, which keeps
its id while it grows and until it ends. Webhooks (HTTP calls) must deliver alerts in order or
report their loss.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from fleet_service.cli import main
from fleet_service.client.alert_queue import AlertQueue
from fleet_service.client.stretches import LINK_CELLS, Stretches
from fleet_service.client.webhook import Webhook, alert_message, check_url
from schemas import grid
from schemas.config import ZenohSettings
from schemas.errors import InputError
from schemas.wire import Alert
from tests.faults.webhook import ALERTS, run_kind
from tests.fleet_service.app.test_service import Fleet
from tests.fleet_service.conftest import Running
from tests.fleet_service.examples import SECOND, batch
from tests.ports import free_ports
from tests.waiting import PATIENCE_S, until

# Column and row of cells near Gothenburg.
X = 1_118_000
Y = 630_000


def alert(
    x: int, y: int = 0, *, sector: int = 0, raised: bool = True, at: int = 0, mu: float = 0.2
) -> Alert:
    cell = int(grid.interleave(np.array([X + x]), np.array([Y + y]))[0])
    latitude, longitude = grid.centre(cell)
    return Alert(
        cell,
        sector,
        raised,
        (1_800_000_000 + at) * SECOND,
        mu,
        mu - 0.1,
        mu + 0.1,
        0.95,
        2,
        float(latitude),
        float(longitude),
        "P(mu < 0.4) = 0.95 > 0.9" if raised else "later visits measured good grip",
    )


def take_alerts(stretches: Stretches, *alerts: Alert) -> list[Any]:
    for one in alerts:
        stretches.apply_alert(one)
    return stretches.take_changes()


def test_an_icy_road_in_both_directions_is_one_alert() -> None:
    (found,) = take_alerts(
        Stretches(), *(alert(x, sector=s, at=x) for x in range(20) for s in (0, 2))
    )
    side = 360 / 2**21 * 111_195 * np.cos(np.radians(found.latitude))
    assert found.length_m == pytest.approx(20 * side, rel=0.01)
    assert (found.direction, found.headings, found.cells) == ("east-west", ("east", "west"), 20)
    assert found.state == "raised"
    assert (
        "m east-west, heading east and west; mu 0.20 [0.10, 0.30], 2 vehicles; since "
        "2027-01-15T08:00:00Z, state of 2027-01-15T08:" in found.to_line()
    )
    (north,) = take_alerts(Stretches(), *(alert(0, y) for y in range(10)))
    assert north.direction == "north-south"
    (one,) = take_alerts(Stretches(), alert(0))
    assert one.direction == "around one place"


def test_ice_far_away_is_another_alert_and_a_small_gap_is_none() -> None:
    gap = LINK_CELLS
    assert len(take_alerts(Stretches(), alert(0), alert(gap))) == 1
    assert len(take_alerts(Stretches(), alert(0), alert(gap + 1))) == 2


def test_a_stretch_keeps_its_id_while_it_grows_joins_falls_apart_and_ends() -> None:
    road = Stretches()
    (old,) = take_alerts(road, alert(0, at=0))
    (young,) = take_alerts(road, alert(8, at=10))
    assert old.id != young.id
    assert take_alerts(road, alert(0, at=0), alert(8, at=10)) == [], (
        "an alert is put again while it stands: that is no news"
    )
    joined = {one.id: one for one in take_alerts(road, *(alert(x, at=20) for x in (2, 4, 6)))}
    assert joined[old.id].state == "changed"
    assert joined[old.id].cells == 5
    assert joined[young.id].state == "cleared"
    assert joined[old.id].since == old.since
    apart = take_alerts(road, *(alert(x, raised=False, at=30) for x in (2, 4)))
    assert {one.state for one in apart} == {"changed", "raised"}
    assert [one.cells for one in apart if one.id == old.id] == [2], "the larger part keeps the name"
    ended = take_alerts(road, *(alert(x, raised=False, at=40) for x in (0, 6, 8)))
    assert {one.state for one in ended} == {"cleared"}
    assert {one.reason for one in ended} == {"later visits measured good grip"}
    assert take_alerts(road) == []


def test_end_of_a_stretch_states_its_own_time_and_reason() -> None:
    road = Stretches()
    take_alerts(road, alert(0, at=0), alert(100, at=1))
    (ended,) = take_alerts(road, alert(0, raised=False, at=5), alert(100, at=1))
    assert (ended.state, ended.time) == ("cleared", (1_800_000_000 + 5) * SECOND)
    assert ended.reason == "later visits measured good grip"


def test_line_of_a_stretch_has_the_values_of_one_cell() -> None:
    ice = replace(alert(0, at=0, mu=0.14), p_slippery=0.999, reason="P(mu < 0.4) = 0.95 > 0.9")
    snow = replace(alert(1, at=9, mu=0.35), p_slippery=0.91, reason="P(mu < 0.4) = 0.91 > 0.9")
    (stretch,) = take_alerts(Stretches(), ice, snow)
    assert "mu 0.14" in stretch.to_line()
    assert "; P(mu < 0.4) = 1.00; " in stretch.to_line()


@contextmanager
def receiver(refuse: int = 0) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Yield the address of a real HTTP server, and the list of webhooks (HTTP calls) that it
    received. The server refuses the first `refuse` requests.
    """
    received: list[dict[str, Any]] = []
    left = [refuse]

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            text = self.rfile.read(int(self.headers["Content-Length"]))
            refused = left[0] > 0
            left[0] -= refused
            if not refused:
                assert self.headers["Content-Type"] == "application/json"
                received.append(json.loads(text))
            self.send_response(503 if refused else 200)
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002
            """Suppress the log of the HTTP server in this test."""

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/hook", received
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def test_webhook_has_alertmanagers_format_and_order_after_a_refusal(tmp_path: Path) -> None:
    road = Stretches()
    log_lines = list[str]()
    with receiver(refuse=1) as (url, received):
        hook = Webhook(url, log_lines.append, AlertQueue(tmp_path / "queue"))
        for one in (*take_alerts(road, alert(0)), *take_alerts(road, alert(0, raised=False, at=5))):
            hook.send(one)
        until(lambda: len(received) == 2)
        hook.close()
    assert [one["status"] for one in received] == ["firing", "resolved"]
    assert [one["version"] for one in received] == ["4", "4"]
    (first,), (second,) = (one["alerts"] for one in received)
    assert first["fingerprint"] == second["fingerprint"] == first["labels"]["id"]
    assert first["labels"]["alertname"] == "SlipperyRoad"
    assert (first["startsAt"], first["endsAt"]) == ("2027-01-15T08:00:00Z", "0001-01-01T00:00:00Z")
    assert second["endsAt"] == "2027-01-15T08:00:05Z"
    assert "does not accept alerts" in log_lines[0]
    assert "answers again" in log_lines[1]


def test_undelivered_alerts_stay_for_the_next_watch(tmp_path: Path) -> None:
    log_lines: list[str] = []
    hook = Webhook("http://127.0.0.1:9/none", log_lines.append, AlertQueue(tmp_path / "queue"))
    hook.send(take_alerts(Stretches(), alert(0))[0])
    until(lambda: bool(hook.health_problems()))
    hook.close()
    assert log_lines[-1] == "webhook: 1 alerts remain in the queue for the next watch"
    assert (hook.waiting_count, hook.lost_count) == (1, 0)
    with receiver() as (url, received):
        again = Webhook(url, log_lines.append, AlertQueue(tmp_path / "queue"))
        until(lambda: again.counts["delivered"] == 1)
        again.close()
    assert (len(received), again.waiting_count, again.health_problems()) == (1, 0, [])
    assert set(alert_message(take_alerts(Stretches(), alert(0))[0])) >= {
        "receiver",
        "status",
        "alerts",
        "groupLabels",
        "externalURL",
    }


def test_full_queue_drops_the_oldest_and_reports_it(tmp_path: Path) -> None:
    log_lines: list[str] = []
    hook = Webhook("http://127.0.0.1:9/none", log_lines.append, AlertQueue(tmp_path / "queue", 2))
    for one in take_alerts(Stretches(), *(alert(10 * x) for x in range(5))):
        hook.send(one)
    assert hook.counts["dropped"] == 3
    assert "webhook: 3 alerts were lost" in hook.health_problems()
    assert {m.name: dict(m.values) for m in hook.metrics()}["webhook_waiting"] == {"": 2.0}
    hook.close()
    assert log_lines[-1] == "webhook: 3 alerts were lost"


@pytest.mark.parametrize("kind", ["not-http", "redirect-302", "drips", "refuses"])
def test_broken_receiver_loses_no_alert_silently(tmp_path: Path, kind: str) -> None:
    arrived, lost = run_kind(tmp_path, kind)
    assert lost == 0
    assert arrived == (0 if kind == "refuses" else ALERTS)


@pytest.mark.parametrize("url", ["ftp://x", "x", "http://", "http://[", "http://a:99999999/"])
def test_webhook_refuses_an_invalid_url(url: str) -> None:
    with pytest.raises(InputError, match="is not a URL"):
        check_url(url)


def test_queue_belongs_to_one_watch(tmp_path: Path) -> None:
    first = AlertQueue(tmp_path / "queue")
    with pytest.raises(InputError, match="webhook_queue: .*queue cannot be used"):
        AlertQueue(tmp_path / "queue")
    first.close()
    (tmp_path / "bad").write_bytes(b"no database" * 100)
    with pytest.raises(InputError, match="webhook_queue"):
        AlertQueue(tmp_path / "bad")


@pytest.mark.usefixtures("service")
def test_watch_prints_stretches_as_json_and_sends_them(
    router: ZenohSettings, session: zenoh.Session, service: Running, tmp_path: Path
) -> None:
    with receiver() as (url, received):
        (port,) = free_ports(1)
        words = ["watch", "--alerts", "--json", "--webhook", url, "--connect", router.connect[0]]
        words += ["--webhook-queue", str(tmp_path / "queue"), "--health-port", str(port)]
        command = [sys.executable, "-m", "fleet_service.cli", *words]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as watching:
            assert watching.stdout is not None
            assert json.loads(watching.stdout.readline()) == {"event": "watching"}
            fleet = Fleet(session).await_services()
            fleet.settle(
                *(batch(f"sim-{k:03}", 1, time.time_ns() - SECOND, [0.2]) for k in range(4))
            )
            line = json.loads(watching.stdout.readline())
            until(lambda: received)
            with urllib.request.urlopen(
                f"http://127.0.0.1:{port}/healthz", timeout=PATIENCE_S
            ) as answer:
                assert json.load(answer)["status"] == "ok"
            watching.terminate()
            assert watching.wait(PATIENCE_S) == 0
    assert (line["event"], line["state"], line["cells"]) == ("alert", "raised", 1)
    assert received[0]["alerts"][0]["labels"]["id"] == line["id"]


def test_a_webhook_that_is_no_url_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", "--webhook", "x"]) == 2
    assert capsys.readouterr().err.startswith("error: webhook: 'x' is not a URL")
    assert main(["watch", "--health-port", "1"]) == 2
    assert capsys.readouterr().err.startswith("error: health_port: needs a webhook")
