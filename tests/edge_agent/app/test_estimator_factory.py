"""Tests of the function that creates an estimator bank (filters of N vehicles) by name. The tuned
estimator must use the memberships (parameters of fuzzy sets) in its file, and an unknown name must
be refused.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app.estimator_factory import bank_of
from edge_agent.app.tuned_memberships import shipped_memberships
from edge_agent.estimators import ESTIMATORS, TUNED, create
from schemas.errors import InputError
from tests.edge_agent.estimators.drives import drive


@pytest.mark.parametrize("name", TUNED)
def test_tuned_estimator_runs_with_the_memberships_of_its_file(name: str) -> None:
    t, signals, vehicle = drive("slalom", 0.3, seconds=6.0)
    t = t[:, None]
    signals = signals[:, None]
    reported = bank_of(name, [vehicle]).advance(t, signals)
    tuned = create(name, [vehicle], memberships=shipped_memberships(TUNED[name])).advance(
        t, signals
    )
    untuned = create(name, [vehicle], memberships=Memberships()).advance(t, signals)
    assert np.array_equal(reported.vx, tuned.vx)
    # The default estimator's vertices are the defaults of `Memberships`: values set by hand scored
    # best.
    if shipped_memberships(TUNED[name]) != Memberships():
        assert not np.array_equal(reported.vx, untuned.vx)


@pytest.mark.parametrize("name", TUNED)
def test_create_without_memberships_refers_to_bank_of(name: str) -> None:
    with pytest.raises(InputError, match=r"memberships: .*bank_of"):
        create(name, [drive("slalom", 0.3, seconds=1.5)[2]])


@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_estimator_has_a_bank(name: str) -> None:
    t, signals, vehicle = drive("slalom", 0.3, seconds=1.5)
    reported = bank_of(name, [vehicle] * 2).advance(
        np.repeat(t[:3, None], 2, 1), np.repeat(signals[:3, None], 2, 1)
    )
    assert reported.mu.shape == (3, 2)


def test_an_unknown_estimator_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="estimator"):
        bank_of("kalman", [drive("slalom", 0.3, seconds=1.5)[2]])
