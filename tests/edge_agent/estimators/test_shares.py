"""Test that the results of an estimator bank (filters of N vehicles) do not change by one bit if
several threads share its vehicles.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators import ESTIMATORS
from edge_agent.estimators.estimates import COLUMNS
from edge_agent.estimators.shares import in_shares
from schemas.errors import InputError
from tests.edge_agent.estimators.drives import drive


@pytest.mark.parametrize(("count", "threads"), [(7, 1), (7, 2), (7, 3), (2, 5), (1, 4), (0, 2)])
def test_shares_cover_every_vehicle_once_with_one_place_each(count: int, threads: int) -> None:
    seen: list[tuple[int, int, int]] = []
    in_shares(lambda share, first, last: seen.append((share, first, last)), count, threads)
    assert sorted(n for _, first, last in seen for n in range(first, last)) == list(range(count))
    assert len({share for share, _, _ in seen}) == len(seen) <= threads


def test_no_thread_at_all_is_refused() -> None:
    with pytest.raises(InputError, match="threads: 0 is below 1"):
        in_shares(lambda share, first, last: None, 3, 0)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_two_threads_give_the_numbers_of_one_bit_for_bit(name: str) -> None:
    t, signals, vehicle = drive("slalom", 0.3, seconds=1.0)
    count = 5
    crowd = np.repeat(signals[:, None], count, axis=1)
    crowd += 0.01 * np.random.default_rng(0).normal(size=(1, count, crowd.shape[2]))
    times = np.repeat(t[:, None], count, axis=1)
    reported = [
        bank_of(name, [vehicle] * count).advance(times, crowd, threads=threads)
        for threads in (1, 2)
    ]
    for array in COLUMNS:
        assert np.array_equal(getattr(reported[0], array), getattr(reported[1], array)), array
