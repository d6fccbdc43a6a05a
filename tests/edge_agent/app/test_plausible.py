"""Tests of the plausibility check of a drive's estimates."""

from __future__ import annotations

import pytest

from edge_agent.app.plausible import Plausibility


@pytest.mark.parametrize(("last", "resets", "bad"), [(60.0, 5, 0), (60.0, 50, 1), (6e4, 6000, 1)])
def test_reset_at_every_sample_is_implausible_with_any_unit_of_time(
    last: float, resets: int, bad: int
) -> None:
    found = Plausibility(0.3, first_s=0.0, last_s=last, samples=6000, resets=resets)
    assert len(found.problems()) == bad


def test_estimates_of_faulty_signals_are_implausible() -> None:
    found = Plausibility(0.3, has_faulty_signals=True, first_s=0.0, last_s=60.0, samples=6000)
    assert found.summary_line().endswith("NOT PLAUSIBLE: signals have faults; run edge-agent check")
