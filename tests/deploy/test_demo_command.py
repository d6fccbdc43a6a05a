"""Tests of the command `gripmap demo`."""

from __future__ import annotations

import pytest

from deploy import cli


@pytest.mark.parametrize(
    ("option", "value"), [("--page-port", "99999999"), ("--page-port", "-1"), ("--duration", "nan")]
)
def test_a_number_out_of_range_is_refused_before_anything_starts(
    option: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        cli.main(["demo", option, value])
    assert capsys.readouterr().err.startswith(f"error: argument {option}: '{value}' is not a p")
