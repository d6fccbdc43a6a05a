"""Tests that a third party can take part with the contract (package `schemas`) alone. It has no
compiler, science library, agent or service.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from deploy.router import open_router


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """Yield the results that a third party's process printed. The router and the service of the
    test run in separate processes.
    """
    folder = tmp_path_factory.mktemp("third-party")
    router, endpoints = open_router(listen="tcp/127.0.0.1:0")
    config = folder / "service.json"
    config.write_text(json.dumps({"zenoh": {"connect": endpoints}, "segment_s": 0.1, "put_s": 0.1}))
    words = [
        "fleet_service.cli",
        "run",
        "--config",
        str(config),
        "--archive",
        str(folder / "archive"),
    ]
    with (
        router,
        subprocess.Popen(
            [sys.executable, "-m", *words], stdout=subprocess.PIPE, text=True
        ) as service,
    ):
        try:
            assert service.stdout is not None
            assert service.stdout.readline().startswith("ready: ")
            run = [sys.executable, "-m", "tests.schemas.third_party", endpoints[0]]
            done = subprocess.run(run, capture_output=True, text=True, timeout=120)
            assert done.returncode == 0, done.stderr
            yield json.loads(done.stdout)
        finally:
            service.terminate()
            service.communicate(timeout=30)


@pytest.mark.campaign
def test_third_party_loads_only_the_contract_and_its_libraries(found: dict[str, Any]) -> None:
    assert not found["loaded"]
    assert found["blocked"] == [
        "numba",
        "llvmlite",
        "scipy",
        "edge_agent",
        "fleet_service",
        "deploy",
    ]


def test_its_batches_are_acknowledged_as_durable_and_can_be_read_again(
    found: dict[str, Any],
) -> None:
    sent = found["sent"]
    (first, second) = found["sent"]["vehicles"]
    durable = [[1, 1]]
    acks = {
        vehicle: [stream[:4] for stream in streams] for vehicle, streams in found["acks"].items()
    }
    assert acks == {
        first: [[41, sent["region"], durable, []]],
        second: [[42, sent["region"], durable, []]],
    }
    late, times = zip(
        *(stream[4:] for streams in found["acks"].values() for stream in streams), strict=True
    )
    assert late == ([], [])
    assert min(times) > 0, "the service's time"
    assert sorted(found["batches"]) == [
        [vehicle, sent["visits"], sent["region"]] for vehicle in (first, second)
    ]
    assert not found["errors"]


def test_third_party_reads_tile_and_alert_caused_by_its_reports(
    found: dict[str, Any],
) -> None:
    assert {encoding for encoding, _ in found["tiles"]} == {"application/vnd.apache.arrow.stream"}
    alert = found["alerts"][0]
    cell = found["sent"]["cell"]
    assert (alert["cell"], alert["sector"], alert["raised"], alert["vehicles"]) == (
        cell,
        1,
        True,
        2,
    )
    assert found["standing"] == ["application/protobuf;gripmap.v1.StandingAlerts", [cell]]


def test_three_forms_of_an_answer_agree(found: dict[str, Any]) -> None:
    encoding, (cell,) = found["arrow"]
    assert encoding == "application/vnd.apache.arrow.stream"
    assert (cell["cell"], cell["sector"], cell["basis"], cell["vehicles"]) == (
        found["sent"]["cell"],
        1,
        "measured",
        2,
    )
    assert cell["mu_lower"] <= 0.2 <= cell["mu_upper"] < 0.4
    (same,) = found["json"]["cells"]
    (feature,) = found["geojson"]["features"]
    for other in (same, feature["properties"]):
        assert (other["cell"], other["observations"]) == (cell["cell"], cell["observations"])
        # The stored knowledge fades slightly between two queries.
        assert other["mu"] == pytest.approx(cell["mu"], abs=1e-3)


def test_a_question_that_cannot_be_read_is_answered_with_the_fix(found: dict[str, Any]) -> None:
    assert found["refusal"].startswith("bbox: ")
