"""Tests that commands refuse files that do not exist, whatever the other options are."""

from __future__ import annotations

from pathlib import Path

import pytest

from fleet_service.cli import main

ROUTER = ["--listen", "tcp/127.0.0.1:0", "--metrics-host", "127.0.0.1", "--metrics-port", "0"]


@pytest.mark.parametrize(
    "words",
    [
        ["router", *ROUTER, "--config", "{none}"],
        ["analyze", "grip", "--archive", "{none}", "--last", "12h"],
        ["export", "map", "--archive", "{none}", "--out", "{none}.csv", "--last", "12h"],
        ["export", "valhalla", "--archive", "{none}", "--out", "{none}.json", "--roads", "{none}"],
        ["export", "valhalla", "--archive", "{none}", "--out", "{none}.json", "--exclude-ice"],
    ],
)
def test_missing_file_is_refused(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    none = str(tmp_path / "none")
    assert main([word.format(none=none) for word in words]) == 2
    assert capsys.readouterr().err.startswith("error: ")
