"""Tests of an agent's metrics and health. They must show the numbers of reports that were sent,
settled (acknowledged or refused by the service) and are waiting. They must report problems such as
a lost router or delay behind real time.
"""

from __future__ import annotations

import re
import time
from pathlib import Path

import numpy as np

from edge_agent.app import metrics
from edge_agent.app.live_loop import Progress
from edge_agent.publish.outbox import Outbox
from edge_agent.publish.publisher import Publisher
from schemas.wire import Kind
from tests.edge_agent.publish.test_publisher import NAMES, drive, publisher_of, settings
from tests.edge_agent.service import Router, Service
from tests.waiting import PATIENCE_S, until


def test_agent_metrics_show_settled_and_waiting_records(
    router: Router, service: Service, tmp_path: Path
) -> None:
    service.answer = False
    publisher = publisher_of(settings(router, tmp_path))
    progress = Progress()
    observations, _ = drive()
    sent = len(observations.vehicle)
    publisher.offer(observations)

    def read_metric(name: str, kind: str = "") -> float:
        return {
            metric.name: metric.values for metric in metrics.agent_metrics(publisher, progress)
        }[name][kind]

    until(lambda: service.batches and read_metric("published_records", "observation") == sent)
    assert read_metric("unsettled_records") == sent
    service.answer = True
    until(lambda: read_metric("acknowledged_records", "observation") == sent)
    assert publisher.close(within_s=PATIENCE_S)
    assert (
        read_metric("unsettled_records"),
        read_metric("rejected_records", Kind.STATE.name.lower()),
    ) == (
        0,
        0,
    )


def test_unsendable_records_are_dropped_and_counted_and_others_are_sent(
    tmp_path: Path, router: Router, service: Service
) -> None:
    publisher = publisher_of(settings(router, tmp_path))
    observations, states = drive()
    # No enrolled vehicle has this number.
    publisher.offer(observations._replace(vehicle=observations.vehicle + 1000))
    # Does not fit into 32 bits.
    strange = states.columns | {"health": np.full(len(states.vehicle), 1 << 40)}
    publisher.offer(states._replace(columns=strange), observations)
    until(lambda: publisher.counts.acknowledged[Kind.OBSERVATION] == len(observations.vehicle))
    assert publisher.counts.dropped == {
        Kind.OBSERVATION: len(observations.vehicle),
        Kind.STATE: len(states.vehicle),
    }
    assert publisher.counts.failures > 1
    assert not publisher.is_broken
    assert publisher.close(within_s=PATIENCE_S)


def test_agent_without_answers_or_with_full_outbox_reports_problems(
    tmp_path: Path, router: Router
) -> None:
    late: list[float] = []
    config = settings(router, tmp_path)
    publisher = Publisher(
        NAMES,
        Outbox(config.spool, capacity_bytes=40_000),
        config,
        "test",
        clock=lambda: time.monotonic() + sum(late),
    )
    publisher.start()
    for seed in range(6):
        publisher.offer(*drive(seed))
    until(lambda: publisher.status.fill_share > metrics.FULL)
    until(lambda: publisher.status.unanswered_s > 0.0)
    late.append(metrics.UNANSWERED_S)
    found = metrics.health_problems(publisher, Progress())
    silent = [re.match(r"nothing was acknowledged for (\d+) s", text) for text in found]
    assert any(one and int(one[1]) >= metrics.UNANSWERED_S for one in silent)
    assert "the outbox is full: the oldest states are dropped first" in found
    publisher.close(within_s=0.0)


def test_an_agent_without_a_router_or_behind_its_time_is_in_trouble(
    tmp_path: Path, router: Router
) -> None:
    publisher = publisher_of(settings(router, tmp_path))
    until(lambda: publisher.status.links == 3 and not publisher.status.cut_off)
    assert metrics.health_problems(publisher, Progress()) == []
    assert metrics.health_problems(publisher, Progress(lag_s=4.0)) == ["4.0 s behind real time"]
    publisher.close(within_s=0.0)
    router.stop()
    alone = publisher_of(settings(router, tmp_path))
    assert metrics.health_problems(alone, Progress()) == ["no session is open"]
    alone.close(within_s=0.0)
