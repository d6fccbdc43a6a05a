"""Tests of the provider that writes friction to a Kuksa databroker, with a real gRPC server. All
values must arrive, and unknown values must be cleared. A broker that starts late must get the
latest values.
"""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path

import pytest

from edge_agent.app.kuksa_provider import CONDITION, FRICTION, KuksaProvider, surface_condition
from edge_agent.cli import main
from edge_agent.publish.vss import road_friction
from schemas.errors import InputError
from schemas.thresholds import NS
from tests.benchmarks.inputs.databroker import Databroker
from tests.edge_agent.service import Router, Service
from tests.ports import free_ports
from tests.waiting import until

TIME = 1_800_000_000 * NS + 5
ICE = road_friction(0.12, 0.09, 0.17, 0.11)


def test_all_signals_arrive_with_their_time_and_unknown_ones_are_cleared() -> None:
    with Databroker("127.0.0.1:0", [*FRICTION, CONDITION]) as broker:
        provider = KuksaProvider(f"127.0.0.1:{broker.port}")
        provider.write(ICE, TIME)
        until(lambda: provider.written == 4)
        points = [broker.value(path) for path in FRICTION]
        assert [round(point.value.float, 3) for point in points] == [12.0, 9.0, 17.0]
        assert points[0].timestamp.seconds * NS + points[0].timestamp.nanos == TIME
        assert broker.value(CONDITION).value.string == "ICE"
        provider.write({}, TIME + NS)
        provider.close()
        assert not any(broker.value(path).HasField("value") for path in FRICTION)
        assert broker.value(CONDITION).value.string == "UNKNOWN"
        assert (provider.written, provider.refused) == (8, 0)


def test_signal_that_the_broker_does_not_know_is_logged_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with Databroker("127.0.0.1:0", FRICTION) as broker:
        provider = KuksaProvider(f"127.0.0.1:{broker.port}")
        for k in range(3):
            provider.write(ICE, TIME + k)
            until(lambda k=k: provider.written == 3 * (k + 1))  # type: ignore[misc]
        provider.close()
        assert provider.refused == 1
    assert caplog.text.count(f"does not know {CONDITION}") == 1


def test_rejected_value_does_not_leave_the_previous_one_at_the_broker(
    caplog: pytest.LogCaptureFixture,
) -> None:
    dry = road_friction(0.9, 0.85, 1.0, 0.0)
    with Databroker("127.0.0.1:0", [*FRICTION, CONDITION], rejected={"ICE"}) as broker:
        provider = KuksaProvider(f"127.0.0.1:{broker.port}")
        for k, (signals, word) in enumerate([(dry, "DRY"), (ICE, ""), (ICE, ""), (dry, "DRY")]):
            provider.write(signals, TIME + k)
            until(lambda k=k: provider.written == 4 * (k + 1))  # type: ignore[misc]
            assert broker.value(CONDITION).value.string == word
        provider.close()
        assert provider.refused == 2
    assert caplog.text.count(f"rejects a value of {CONDITION}") == 1


def test_broker_that_comes_later_gets_the_latest_values(
    caplog: pytest.LogCaptureFixture,
) -> None:
    address = f"127.0.0.1:{free_ports(1)[0]}"
    with closing(KuksaProvider(address)) as provider:
        provider.write(ICE, TIME)
        until(lambda: provider.refused)
        assert caplog.text.count("writing to the databroker fails") == 1
        with Databroker(address, [*FRICTION, CONDITION]) as broker:

            def write() -> bool:
                provider.write(ICE, TIME)
                return provider.written >= 4

            until(write)
            assert broker.value(CONDITION).value.string == "ICE"


def test_unexpected_error_does_not_end_the_provider(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        Databroker("127.0.0.1:0", [*FRICTION, CONDITION]) as broker,
        closing(KuksaProvider(f"127.0.0.1:{broker.port}")) as provider,
    ):
        with monkeypatch.context() as patch:
            patch.setattr(provider, "_write_one", lambda *_: 1 / 0)
            provider.write(ICE, TIME)
            until(lambda: "fails (division by zero)" in caplog.text)
        provider.write(ICE, TIME)
        until(lambda: provider.written == 4)


@pytest.mark.parametrize(
    ("lower", "upper", "condition"),
    [(0.05, 0.19, "ICE"), (0.05, 0.21, "UNKNOWN"), (0.81, 1.1, "DRY"), (0.79, 1.1, "UNKNOWN")],
)
def test_condition_is_named_only_where_friction_proves_it(
    lower: float, upper: float, condition: str
) -> None:
    assert surface_condition(road_friction(0.5, lower, upper, 0.5)) == condition


@pytest.mark.parametrize("text", ["", ":1", "host:port", "host:1?secret=x", "host:1?ca=/nowhere"])
def test_address_that_makes_no_sense_is_one_clear_error(text: str) -> None:
    with pytest.raises(InputError, match="kuksa|source"):
        KuksaProvider(text)


@pytest.mark.campaign
def test_command_writes_the_friction_to_the_databroker(
    router: Router, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "agent.json"
    config.write_text(
        json.dumps({"zenoh": router.settings.model_dump(), "spool": str(tmp_path / "spool.sqlite")})
    )
    words = ["run", "--scenario", "test", "--estimator", "ckf", "--name", "car-one"]
    with Databroker("127.0.0.1:0", [*FRICTION, CONDITION]) as broker, Service(router):
        address = f"127.0.0.1:{broker.port}"
        more = ["--duration", "6", "--kuksa", address, "--config", str(config)]
        assert main([*words, *more]) == 0
        lower, upper = (broker.value(path).value.float for path in FRICTION[1:])
        assert 0.0 < lower < upper <= 100.0
    assert "RoadFriction" not in capsys.readouterr().out
