"""Tests that the router runs in Python without another program, and that the shipped configurations
can be read and contain only settings that Zenoh knows.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import zenoh

from deploy import router
from schemas import config
from schemas.config import AgentConfig, ServiceConfig, ZenohSettings
from schemas.errors import InputError
from schemas.runtime.zenoh_session import open_session
from tests.waiting import PATIENCE_S, matched


def test_clients_of_a_router_receive_each_others_messages() -> None:
    session, endpoints = router.open_router(listen="tcp/127.0.0.1:0")
    with session:
        settings = ZenohSettings(connect=endpoints)
        first = open_session(settings)
        second = open_session(settings)
        assert first is not None
        assert second is not None
        with first, second:
            queryable = second.declare_queryable(
                "gripmap/v1/map/test", lambda query: query.reply(query.key_expr, "here")
            )
            querier = first.declare_querier("gripmap/v1/map/test")
            matched(querier)
            assert [reply.ok.payload.to_string() for reply in querier.get() if reply.ok] == ["here"]
            queryable.undeclare()


def test_router_process_prints_its_endpoint_and_ends_on_a_signal() -> None:
    command = [sys.executable, "-m", "deploy.router", "--listen", "tcp/127.0.0.1:0"]
    for _ in range(8):  # a signal directly after the line must not kill the process
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("router: tcp/127.0.0.1:")
            process.send_signal(signal.SIGTERM)
            assert process.wait(PATIENCE_S) == 0


def test_a_wrong_configuration_names_the_field_and_the_fix(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "router.json5"
    path.write_text("{\n mode: 'wanderer' \n")
    before = signal.getsignal(signal.SIGTERM)
    assert router.main(["--config", str(path)]) == 2
    assert signal.getsignal(signal.SIGTERM) == before, "who called it hears signals as before"
    err = capsys.readouterr().err
    assert err.startswith("error: config: cannot use")
    assert err.count("\n") == 1


def test_an_address_that_is_no_endpoint_names_the_form() -> None:
    with pytest.raises(InputError, match="listen: 127.0.0.1:7447 is not a Zenoh endpoint.*tcp/"):
        router.load_configuration(listen="127.0.0.1:7447")


def test_occupied_port_is_reported() -> None:
    session, endpoints = router.open_router(listen="tcp/127.0.0.1:0")
    with session, pytest.raises(InputError, match="^listen: .*; free the port"):
        router.open_router(listen=endpoints[0])


def test_a_failure_other_than_a_taken_port_has_another_fix() -> None:
    with pytest.raises(InputError, match="^listen: .*; correct the endpoint"):
        router.open_router(listen="tcp/127.0.0.1")


def test_a_missing_key_of_the_router_is_named(tmp_path: Path) -> None:
    key = tmp_path / "router-a.key"
    config = tmp_path / "router.json5"
    tls = {"listen_private_key": str(key)}
    config.write_text(json.dumps({"mode": "router", "transport": {"link": {"tls": tls}}}))
    with pytest.raises(InputError, match=f"listen_private_key: there is no file {key}; "):
        router.open_router(config)


@pytest.mark.parametrize(
    ("name", "model"), [("agent.json", AgentConfig), ("service.json", ServiceConfig)]
)
def test_shipped_configurations_are_read(name: str, model: type[AgentConfig]) -> None:
    assert config.load_config(router.CONFIG.with_name(name), model).zenoh.connect == [
        "tcp/127.0.0.1:7447"
    ]


def test_every_setting_of_a_session_is_one_that_zenoh_knows() -> None:
    with pytest.raises(InputError, match=r"^zenoh.config.transport/link/tx/colour: "):
        open_session(ZenohSettings(config={"transport/link/tx/colour": "red"}))


def test_the_router_listens_on_loopback_only() -> None:
    endpoints = zenoh.Config.from_file(str(router.CONFIG)).get_json("listen/endpoints")
    assert endpoints == '["tcp/127.0.0.1:7447"]'
