"""Tests of the lease (ownership of an archive). Simulated histories of it in virtual time must keep
every promise of the protocol, and deliberately broken protocols must be detected.
"""

from __future__ import annotations

import pytest

from tests.faults.lease import judge_seeds, judge_without_comparison, judge_without_expiry
from tests.faults.lease_histories import Event, ServiceHistory, Verdict, judge_history

# In this history a renewal once repeated the turn of a failed renewal, which took effect late.
FOUND_BUG = 32
SEEDS = (*range(12), FOUND_BUG)


@pytest.mark.campaign
def test_lease_histories_lose_and_double_no_row() -> None:
    judged = judge_seeds(SEEDS)
    assert (judged.acknowledged_by_two, judged.violations) == (0, 0)
    assert judged.failovers > 50
    assert judged.refused > 20


@pytest.mark.campaign
def test_protocol_without_comparison_or_expiry_is_found_out() -> None:
    assert judge_without_comparison(SEEDS).acknowledged_by_two > 0
    assert judge_without_expiry(SEEDS).acknowledged_by_two > 0


def test_history_follows_from_its_seed() -> None:
    events = []
    for _ in range(2):
        history = ServiceHistory(3)
        history.run()
        events.append(history.events)
    assert events[0] == events[1]
    assert len(events[0]) > 50


@pytest.mark.parametrize(
    ("events", "verdict"),
    [
        ([Event("serves", 1, ()), Event("acknowledges", 1, (5,)), Event("reads", 1, (5,))], (0, 0)),
        ([Event("serves", 1, ()), Event("acknowledges", 1, (5,)), Event("serves", 2, ())], (0, 1)),
        ([Event("serves", 1, ()), Event("reads", 1, (5, 5))], (0, 1)),
        ([Event("serves", 2, (5,)), Event("acknowledges", 1, (5,))], (1, 0)),
        ([Event("acknowledges", 1, (4,)), Event("reads", 1, (5,))], (0, 1)),
    ],
)
def test_judge_names_each_kind_of_violation(events: list[Event], verdict: tuple[int, int]) -> None:
    assert judge_history(events) == Verdict(*verdict)
