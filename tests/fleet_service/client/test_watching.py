"""Tests of `fleet-service watch`: no alert may stay active because a message about its end was
missed, or arrived before an older answer.
"""

from __future__ import annotations

import json
import threading
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from fleet_service.client import watching
from schemas import grid, keys, wire
from schemas.config import ZenohSettings
from tests.fleet_service.client.test_stretches import alert
from tests.waiting import until


def alert_states(lines: list[str]) -> list[str]:
    found = [json.loads(line) for line in lines]
    return [one["state"] for one in found if one["event"] == "alert"]


def test_alert_whose_end_was_missed_ends_after_the_next_query(
    router: ZenohSettings, session: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watching, "REFRESH_S", 0.0)
    standing = [alert(0)]
    key = keys.alert_key(int(grid.tile_of(standing[0].cell)))

    def answer(query: zenoh.Query) -> None:
        with query:
            if standing:
                query.reply(key, wire.encode_standing(standing))

    queryable = session.declare_queryable(key, answer)
    token = session.liveliness().declare_token(keys.ServiceToken("*/*/*", "one", "00").key)
    lines: list[str] = []
    stop = threading.Event()
    options = watching.WatchOptions(as_json=True)
    watcher = threading.Thread(
        target=watching.watch_map, args=(router, options, stop, lines.append)
    )
    watcher.start()
    try:
        until(lambda: alert_states(lines) == ["raised"])
        standing.clear()
        until(lambda: alert_states(lines) == ["raised", "cleared"])
    finally:
        stop.set()
        watcher.join()
        token.undeclare()
        queryable.undeclare()


def test_end_of_an_alert_holds_against_an_older_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    lines: list[str] = []
    watch = watching._Watch(watching.WatchOptions(as_json=True), lines.append, lambda _: None)
    payload = wire.encode_alert(alert(0, raised=False, at=5))
    key = keys.alert_key(int(grid.tile_of(alert(0).cell)))
    sample: Any = SimpleNamespace(key_expr=key, payload=SimpleNamespace(to_bytes=lambda: payload))

    def answer_late(_: object) -> list[wire.Alert]:
        watch.queue_alert(sample)
        return [alert(0)]

    monkeypatch.setattr(watching, "standing_alerts", answer_late)
    services: Any = SimpleNamespace(active=set())
    watch.query_alerts(services, services)
    watch.print_alerts()
    watch.print_alerts()
    assert alert_states(lines) == []
