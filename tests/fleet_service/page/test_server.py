"""Tests of the page's server. It must refuse wrong requests with the reason, and send a newly
connected browser the present state and then each change. A slow browser must be told to reload.
"""

from __future__ import annotations

import asyncio
import gzip
import http.client
import json
import signal
import sys
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zenoh

from fleet_service.archive.format import snapshots
from fleet_service.cli import main
from fleet_service.fusion import Fusion
from fleet_service.page import server
from fleet_service.page.files import Files
from fleet_service.page.health import parse_metrics
from fleet_service.page.map_mirror import MapMirror
from fleet_service.page.records import HEAD
from fleet_service.page.watchers import WAITING, TooManyWatchersError, View, Watchers
from fleet_service.serve.encode import cell_table
from schemas.config import ZenohSettings
from tests.faults.processes import Part
from tests.fleet_service.conftest import running
from tests.fleet_service.examples import START, TILE, observations, value
from tests.fleet_service.page import street
from tests.fleet_service.page.conftest import Drive, RunningPage, page_of
from tests.waiting import PATIENCE_S, until

WORLD: Final = View((-180.0, -90.0, 180.0, 90.0), 21)


def ask(address: str, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Request `path` from the page at `address` with the given headers. Return status, headers and
    body of the answer.
    """
    connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=PATIENCE_S)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    try:
        return (
            answer.status,
            {name.lower(): value for name, value in answer.getheaders()},
            answer.read(),
        )
    finally:
        answer.close()
        connection.close()


@contextmanager
def listening(address: str, path: str = "/events") -> Iterator[Iterator[tuple[str, Any]]]:
    """Open an event stream of the page at `address`, and yield an iterator over its events."""
    connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=PATIENCE_S)
    connection.request("GET", path)
    answer = connection.getresponse()

    def events() -> Iterator[tuple[str, Any]]:
        name = ""
        lines = list[str]()
        for line in answer:
            text = line.decode().rstrip("\n")
            if text.startswith("event: "):
                name = text.removeprefix("event: ")
            elif text.startswith("data: "):
                lines.append(text.removeprefix("data: "))
            elif not text:
                yield name, lines if name == "tiles" else json.loads(lines[0])
                lines = []

    try:
        yield events()
    finally:
        answer.close()
        connection.close()


def test_every_answer_forbids_what_the_page_does_not_need(bare: str) -> None:
    for path in ("/", "/static/main.js", "/settings", "/nothing", "/blocks?tiles=x"):
        _, headers, _ = ask(bare, path)
        policy = headers["content-security-policy"]
        assert "default-src 'none'; script-src 'self'; style-src 'self'" in policy
        assert "unsafe" not in policy
        assert headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize(
    "path",
    [
        "/blocks?tiles=x",
        "/blocks?tiles=-1",
        "/blocks?level=22",
        "/tiles?at=yesterday",
        "/tiles?at=1",
        "/cell/7/9",
        "/events?bbox=1,2",
        "/route?points=1,2",
        "/route?points=1,2|3,95|x",
        "/blocks?tiles=" + "1," * 300,
    ],
)
def test_invalid_query_is_answered_with_field_and_fix(bare: str, path: str) -> None:
    status, _, body = ask(bare, path)
    assert status == 400
    assert b": " in body
    assert b"; " in body


def test_a_file_outside_the_page_and_another_hosts_name_are_refused(bare: str) -> None:
    for path in ("/static/../web.py", "/static/%2e%2e%2fweb.py", "/static/nothing.js"):
        assert ask(bare, path)[0] == 404
    assert ask(bare, "/", Host="elsewhere.example")[0] == 421
    assert ask(bare, "/", Host="localhost:1")[0] == 200


def test_file_is_compressed_if_accepted_and_not_sent_again(bare: str) -> None:
    _, plain, text = ask(bare, "/static/main.js")
    assert "content-encoding" not in plain
    _, packed, body = ask(bare, "/static/main.js", **{"Accept-Encoding": "gzip"})
    assert packed["content-encoding"] == "gzip"
    assert gzip.decompress(body) == text
    status, again, nothing = ask(bare, "/static/main.js", **{"If-None-Match": plain["etag"]})
    assert (status, nothing) == (304, b"")
    assert again["etag"] == packed["etag"] == plain["etag"]
    assert "javascript" in plain["content-type"]


def test_another_language_is_one_file(tmp_path: Path) -> None:
    for name in ("texts.en.json", "texts.de.json", "texts.pt-br.json", "main.js"):
        (tmp_path / name).write_text("{}")
    files = Files(tmp_path)
    asked = {
        "de-CH, en;q=.5": "de",
        "fr, de;q=.5": "de",
        "pt-BR": "pt-br",
        "pt": "en",
        "en, de": "en",
        "": "en",
    }
    assert {one: files.texts(one) for one in asked} == {
        one: f"texts.{tag}.json" for one, tag in asked.items()
    }


def test_unknown_language_gets_the_english_texts(bare: str) -> None:
    status, headers, body = ask(bare, "/texts", **{"Accept-Language": "../../x, xx"})
    assert (status, json.loads(body)["language"]) == (200, "en")
    assert "Accept-Language" in headers["vary"]


def test_client_receives_the_present_state_and_then_changes(
    page: RunningPage, drive: Drive
) -> None:
    drive("ice")
    until(lambda: json.loads(ask(page.address, "/tiles")[2]))
    with listening(page.address) as events:
        first = next(events)
        second = next(events)
        assert (first[0], second[0]) == ("alerts", "beat")
        assert second[1]["router"]
        drive("avenue")
        changed = next(value for name, value in events if name == "tiles")
        assert changed

    def count_heads() -> int:
        tiles = json.loads(ask(page.address, "/tiles")[2])
        _, headers, body = ask(page.address, f"/blocks?tiles={','.join(map(str, tiles))}")
        assert headers["content-type"] == "application/vnd.gripmap.blocks"
        heads = 0
        at = 0
        while at < len(body):
            count = HEAD.unpack_from(body, at)[3]
            heads = heads + count
            at = at + HEAD.size + (13 * count + 3) // 4 * 4
        return heads

    # The service may publish a tile before it has received all reports.
    until(lambda: count_heads() >= street.count_known("ice", "avenue"))


def test_subscriber_receives_an_alert_with_its_reason(page: RunningPage, drive: Drive) -> None:
    with listening(page.address) as events:
        assert next(events) == ("alerts", [])
        drive("ice")
        (alert, *_) = next(value for name, value in events if name == "alerts" and value)
    assert alert["vehicles"] >= 2
    assert "P(mu < 0.4)" in alert["reason"]


def test_event_stream_beyond_the_limit_gets_503_and_retry_after(router: ZenohSettings) -> None:
    with page_of(router, max_browsers=1) as address:
        with listening(address) as events:
            next(events)
            status, headers, _ = ask(address, "/events")
            assert status == 503
            assert headers["retry-after"]
        until(lambda: ask_briefly(address) == 200)


def ask_briefly(address: str) -> int:
    """Open an event stream of the page at `address`, close it at once, and return the HTTP status
    of the page's answer.
    """
    connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=PATIENCE_S)
    connection.request("GET", "/events")
    answer = connection.getresponse()
    answer.close()
    connection.close()
    return answer.status


def test_region_without_its_service_is_reported_and_keeps_its_cells(
    page: RunningPage, drive: Drive
) -> None:
    drive("dry")
    until(lambda: json.loads(ask(page.address, "/tiles")[2]))
    until(lambda: json.loads(ask(page.address, "/health")[2])["regions"])
    assert page.service is not None
    page.service.end()
    until(lambda: not json.loads(ask(page.address, "/health")[2])["regions"][0]["served"])
    with listening(page.address) as events:
        beat = next(
            value
            for name, value in events
            if name == "beat" and value["away"] and not value["served"]
        )
    assert beat["away"][0]["since"] <= time.time()
    assert json.loads(ask(page.address, "/tiles")[2]), "what was known is not emptiness"


def test_cell_route_returns_the_values_of_the_service(page: RunningPage, drive: Drive) -> None:
    drive("ice", "passed")
    ice, passed = (int(street.cells(street.PARTS[name])[1]) for name in ("ice", "passed"))

    def fetch_cell() -> dict[str, Any]:
        return dict(json.loads(ask(page.address, f"/cell/{ice}/{street.EAST}")[2]) or {})

    # Wait until all cars are on the map.
    until(lambda: fetch_cell().get("observations") == len(street.CARS))
    detail = fetch_cell()
    assert detail["mu_lower"] < detail["mu"] < 0.25
    assert detail["safe_speed"]["50"] < detail["safe_speed"]["100"] < 15.0
    assert detail["observations"] == len(street.CARS)
    bound = json.loads(ask(page.address, f"/cell/{passed}/{street.EAST}")[2])
    assert (bound["mu"], bound["safe_speed"], bound["basis"]) == (None, None, "bound")
    assert json.loads(ask(page.address, f"/cell/{ice}/{street.NORTH}")[2]) is None
    middle = (detail["south"] + detail["north"]) / 2
    points = f"{detail['west'] - 0.001},{middle}|{detail['east'] + 0.001},{middle}"
    found = json.loads(ask(page.address, f"/route?points={points}")[2])
    assert 0 < found["share"]["measured"] < 1
    assert found["share"]["unknown"] > 0


def test_page_without_a_router_reports_it(router: ZenohSettings) -> None:
    nowhere = ZenohSettings(connect=["tcp/127.0.0.1:1"])
    with page_of(nowhere) as address:
        assert not json.loads(ask(address, "/health")[2])["router"]
        assert ask(address, "/cell/1/1")[0] == 400
        assert json.loads(ask(address, "/tiles")[2]) == []


def test_slow_client_is_asked_to_reload_and_its_queue_is_limited() -> None:
    async def slow() -> list[bytes]:
        world = MapMirror()
        watchers = Watchers(world, dict, most=1)
        stream = watchers.add_watcher(WORLD)
        with pytest.raises(TooManyWatchersError):
            watchers.add_watcher(WORLD)
        fusion = Fusion(120.0)
        for k in range(2 * WAITING):
            fusion.update(observations([float(k)], [k], value([0.3 if k % 2 else 0.8])))
            world.take_tile(TILE, cell_table(fusion, np.arange(1), START), 1.0 + k)
            watchers.send_changes(world.changes())
        assert watchers.reloads
        watchers.close()
        return [event async for event in _all(stream)]

    events = asyncio.run(slow())
    assert len(events) <= WAITING
    assert any(event.startswith(b"event: reload") for event in events)


async def _all(stream: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    async for event in stream:
        yield event


def test_metrics_are_read_by_name_and_label() -> None:
    text = (
        '# HELP x\ngripmap_rows_total{kind="observation"} 12.0\ngripmap_cells 5.0\nother 1\n# EOF\n'
    )
    assert parse_metrics(text) == {"rows": {"observation": 12.0}, "cells": {"": 5.0}}


def test_page_survives_invalid_publications(
    page: RunningPage, session: zenoh.Session, drive: Drive
) -> None:
    for key in (
        "gripmap/v1/map/1202/310/201/2222",
        "gripmap/v1/alert/1202/310/201/2222",
        "gripmap/v1/map/x",
    ):
        session.put(key, b"\x00rubbish")
    drive("dry")
    until(lambda: json.loads(ask(page.address, "/tiles")[2]))


@pytest.mark.parametrize("way", ["connect", "config"])
def test_every_option_of_the_command_has_its_effect(
    router: ZenohSettings, tmp_path: Path, way: str
) -> None:
    archive = tmp_path / "archive"
    overlay = tmp_path / "truth.parquet"
    config = tmp_path / "reader.json"
    with running(router, archive):
        pass
    fusion = Fusion(120.0)
    fusion.update(observations([0.0], [1], value([0.3])))
    snapshots.write_snapshot(archive, cell_table(fusion, np.arange(1), START), START)
    pq.write_table(pa.table({"cell": [7, 7], "sector": [1, 1], "mu": [0.2, 0.4]}), overlay)
    config.write_text(json.dumps({"zenoh": router.model_dump()}))
    to = ["--connect", router.connect[0]] if way == "connect" else ["--config", str(config)]
    options = {
        "--archive": archive,
        "--host": "127.0.0.1",
        "--port": 0,
        "--name": "map.example",
        "--metrics": "http://127.0.0.1:1",
        "--overlay": overlay,
        "--base-map": "https://t.example/{z}/{x}/{y}.png",
        "--datex": tmp_path / "situations.xml",
        "--country": "se",
        "--supplier": "GripMap test",
        "--status": "technicalExercise",
    }
    words = [str(word) for option in options.items() for word in option]
    page = Part("page", [sys.executable, "-m", "fleet_service.cli", "page", *words, *to], tmp_path)
    page.start()
    try:
        address = page.line_with("page: ").removeprefix("page: ")
        assert address.startswith("http://127.0.0.1:")
        until(lambda: json.loads(ask(address, "/health")[2])["router"])
        assert json.loads(ask(address, "/moments")[2]) == [START // 10**9]
        assert json.loads(ask(address, "/overlay")[2]) == {
            "cell": ["7"],
            "sector": [1],
            "mu": [0.3],
        }
        assert json.loads(ask(address, "/health")[2])["services"] == [
            {"address": "http://127.0.0.1:1", "answers": False}
        ]
        status, headers, _ = ask(address, "/", Host="map.example")
        assert (status, ask(address, "/", Host="other.example")[0]) == (200, 421)
        until(lambda: ask(address, "/datex2/situation.xml")[0] == 503)  # no service is running
        assert "img-src 'self' data: https://t.example;" in headers["content-security-policy"]
        page.send_signal(signal.SIGTERM)
        page.wait(PATIENCE_S)
    finally:
        page.kill()


def test_files_of_the_map_that_are_missing_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    none = str(tmp_path / "none")
    base = ["--base-map", none + ".pmtiles", "--attribution", "the town"]
    for words in (base, ["--roads", none + ".parquet"]):
        assert main(["page", "--connect", "tcp/127.0.0.1:1", *words]) == 2
        assert "none" in capsys.readouterr().err


def test_overlay_without_its_columns_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "overlay.parquet"
    pq.write_table(pa.table({"cell": [7], "mu": [0.2]}), path)
    assert main(["page", "--connect", "tcp/127.0.0.1:1", "--overlay", str(path)]) == 2
    assert "error: overlay: overlay.parquet lacks the columns" in capsys.readouterr().err


def test_metrics_that_are_no_address_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["page", "--connect", "tcp/127.0.0.1:1", "--metrics", "foo"]) == 2
    assert capsys.readouterr().err.startswith("error: metrics: 'foo' is not an address; ")


def test_connection_that_zenoh_refuses_ends_the_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(server, "run", lambda *_: pytest.fail("the page is served"))
    assert main(["page", "--connect", "localhost"]) == 2
    assert capsys.readouterr().err.startswith("error: connect: localhost is not an endpoint; ")
