"""An agent as its operator sees it: what was sent and settled, what waits, whether it keeps up."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge_agent.app import metrics
from edge_agent.app.live_loop import Progress
from schemas.wire import Kind
from tests.edge_agent.publish.test_publisher import drive, publisher_of, settings
from tests.edge_agent.service import Router, Service
from tests.waiting import until


def test_an_agent_shows_what_was_settled_and_what_waits(router: Router, service: Service, tmp_path: Path) -> None:
    service.answer = False
    publisher, progress = publisher_of(settings(router, tmp_path)), Progress()
    observations, _ = drive()
    sent = len(observations.vehicle)
    publisher.offer(observations)

    def shown(name: str, kind: str = "") -> float:
        return {metric.name: metric.values for metric in metrics.metrics(publisher, progress)}[name][kind]

    until(lambda: service.batches and shown("published_records", "observation") == sent)
    assert shown("unsettled_records") == sent
    service.answer = True
    until(lambda: shown("acknowledged_records", "observation") == sent)
    assert publisher.close(within_s=5.0)
    assert (shown("unsettled_records"), shown("rejected_records", Kind.STATE.name.lower())) == (0, 0)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_an_agent_whose_sender_has_died_is_in_trouble(tmp_path: Path, router: Router) -> None:
    publisher = publisher_of(settings(router, tmp_path))
    until(lambda: publisher.links == 3)
    assert metrics.troubles(publisher, Progress()) == []
    observations, _ = drive()
    publisher.offer(observations._replace(vehicle=observations.vehicle + 1000))  # nobody has this number
    until(lambda: metrics.troubles(publisher, Progress()))
    assert metrics.troubles(publisher, Progress()) == ["the thread that sends has died; start the agent again"]
    publisher.close(within_s=0.0)


def test_an_agent_without_a_router_or_behind_its_time_is_in_trouble(tmp_path: Path, router: Router) -> None:
    publisher = publisher_of(settings(router, tmp_path))
    until(lambda: publisher.links == 3)
    assert metrics.troubles(publisher, Progress()) == []
    assert metrics.troubles(publisher, Progress(now_s=4.0)) == ["4.0 s behind real time"]
    publisher.close(within_s=0.0)
    router.stop()
    alone = publisher_of(settings(router, tmp_path))
    assert metrics.troubles(alone, Progress()) == ["no session is open"]
    alone.close(within_s=0.0)
