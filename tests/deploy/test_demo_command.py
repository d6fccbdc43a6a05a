"""Tests of the command `gripmap demo`."""

from __future__ import annotations

import pytest

from deploy import cli


@pytest.mark.parametrize("port", ["99999999", "-1"])
def test_a_port_out_of_range_is_refused_before_anything_starts(
    port: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["demo", "--page-port", port]) == 2
    assert capsys.readouterr().err == f"error: page-port: {port} is not a port; give 0 to 65535\n"
