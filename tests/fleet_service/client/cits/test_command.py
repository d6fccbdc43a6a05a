"""Tests that the command `fleet-service cits` refuses invalid arguments."""

from __future__ import annotations

import pytest

from fleet_service.cli import main

DETAILS = ["--selector", "quadTree LIKE '1%'", "--witness", "cits-se", "--station", "7"]
WHOSE = ["--country", "SE", "--publisher", "SE00001", "--state", "events.json"]


def test_command_without_a_direction_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    where = ["--amqp", "amqp://127.0.0.1:1", "--connect", "tcp/127.0.0.1:1"]
    assert main(["cits", *where, *DETAILS, *WHOSE]) == 2
    assert "give --to, --from or both" in capsys.readouterr().err


def test_missing_configuration_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--amqp", "amqp://127.0.0.1:1", "--to", "ours", "--from", "theirs"]
    more = ["--witness", "cits-se", "--station", "7", *WHOSE, "--config", "none.json"]
    assert main(["cits", *words, *more]) == 2
    assert "none.json" in capsys.readouterr().err
