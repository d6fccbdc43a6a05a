"""Tests of the metrics of a running service. The metrics must count accepted, refused (by reason)
and waiting messages, and the health page must report each problem.
"""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path

import zenoh
from prometheus_client.openmetrics.parser import text_string_to_metric_families

from fleet_service.app import metrics
from fleet_service.app.clock import SteadyClock
from fleet_service.app.engine import Engine
from fleet_service.app.jobs import archive_jobs
from fleet_service.app.metrics import Pulse
from schemas import wire
from schemas.config import ServiceConfig, ZenohSettings
from schemas.wire import Kind
from tests.fleet_service.conftest import running
from tests.fleet_service.examples import SECOND, batch, key
from tests.schemas.runtime.test_metrics import fetch_page
from tests.waiting import PATIENCE_S, matched, until


def test_service_metrics_show_accepted_refused_and_waiting_messages(
    router: ZenohSettings, session: zenoh.Session, tmp_path: Path
) -> None:
    with running(router, tmp_path, metrics_port=0) as run:
        address = run.lines[0].split(", ")[-1]
        assert address.startswith("http://127.0.0.1:")
        publisher = session.declare_publisher(key("sim-001"))
        matched(publisher)
        for seq, speed in ((1, 15.0), (2, 999.0)):
            sent = batch("sim-001", seq, time.time_ns() - SECOND, [0.8], speed=[speed])
            session.put(key("sim-001"), wire.encode(sent), encoding=wire.ENCODING[Kind.OBSERVATION])
        list(session.get("gripmap/v1/map/**?colour=red", timeout=PATIENCE_S))

        def read_metrics() -> dict[str, float]:
            families = text_string_to_metric_families(fetch_page(f"{address}/metrics")[2])
            return {
                sample.name.removeprefix("gripmap_")
                + "".join(f".{v}" for v in sample.labels.values()): sample.value
                for family in families
                for sample in family.samples
            }

        until(
            lambda: (
                read_metrics().get("rows_total.observation")
                and read_metrics().get("refused_messages_total.speed")
            )
        )
        until(
            lambda: (
                read_metrics()["segments.observation"] == 1
                and not read_metrics()["unsettled_batches"]
            )
        )
        found = read_metrics()
        assert found["refused_messages_total.speed"] == 1
        assert found["bad_queries_total.query"] == 1, "the asker's own word is no label"
        assert (found["cells"], found["routers"], found["queue_capacity"]) == (1, 1, 20_000)
        assert 1.0 <= found["report_lag_seconds"] < 60.0
        status, _, text = fetch_page(f"{address}/healthz")
        assert (status, json.loads(text)["troubles"]) == (200, [])


def test_damaged_files_are_counted_by_a_job_not_by_metrics_readers(tmp_path: Path) -> None:
    config = ServiceConfig()
    pulse = Pulse(turn_age_s=0.1, queued=0, routers=1, clock_lag_s=0.0)
    engine = Engine(config, tmp_path)

    def count_damaged() -> object:
        found = {
            metric.name: metric.values
            for metric in metrics.collect_metrics(engine, pulse, config, tmp_path)
        }
        return found["damaged_files"][""]

    (tmp_path / "weather").mkdir(exist_ok=True)
    for name in ("inbox/a.parquet.bad", "weather/b.parquet.bad"):
        (tmp_path / name).touch()
    assert count_damaged() == 0, "a scrape walks through no archive"
    (inventory,) = (
        job
        for job in archive_jobs(engine, config, tmp_path, SteadyClock().moment)
        if job.name == "inventory"
    )
    inventory.work(threading.Event())
    assert count_damaged() == 2
    engine.close()


def test_each_health_problem_is_reported(tmp_path: Path) -> None:
    config = ServiceConfig(queue_batches=100)
    engine = Engine(config, tmp_path)
    well = Pulse(turn_age_s=0.1, queued=3, routers=1, clock_lag_s=0.0)
    assert metrics.health_problems(engine, well, config) == []
    engine.settlement.failing = "No space left on device"
    ill = Pulse(turn_age_s=60.0, queued=99, routers=0, clock_lag_s=0.0, answer_s=60.0)
    assert metrics.health_problems(engine, ill, config) == [
        "no router is connected",
        "the worker has been idle for 60 s",
        "a tile of an answer has been in progress for 60 s",
        "segments cannot be written (No space left on device)",
        "the queue is full",
    ]
    engine.close()
