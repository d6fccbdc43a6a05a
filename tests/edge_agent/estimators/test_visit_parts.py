"""Tests of the likelihood that the estimator reports for a visit (pass through one cell). It must
have two parts if the friction jumps during the visit, and one part otherwise.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators import Estimates
from schemas import mugrid
from tests.edge_agent.estimators.drives import drive

DEFAULT = "aco-fckf"


def one_visit(name: str, mu: float | None, seed: int) -> tuple[np.ndarray, Estimates]:
    """Return times (T,) [s] and estimates of the named manoeuvre, as if the whole drive lay within
    one cell.
    """
    t, signals, vehicle = drive(name, mu, seed)
    closes = np.zeros((len(t), 1), np.bool_)
    closes[0] = True
    closes[-1] = True
    return t, bank_of(DEFAULT, [vehicle]).advance(t[:, None], signals[:, None], closes)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_evidence_at_the_jump_of_a_stop_onto_snow_is_of_the_dry_road(seed: int) -> None:
    t, estimates = one_visit("jump-braking", None, seed)
    assert estimates.jumps is not None
    assert estimates.evidence is not None
    # Only the first jump counts, because the end of the stop may look like another road change.
    jump = int(np.flatnonzero(estimates.jumps[:, 0])[0])
    assert 2.0 < t[jump] < 3.0
    likely = mugrid.CENTRES[estimates.evidence[jump, 0] > -3.0]
    assert likely.min() > 0.6
    assert likely.min() < 0.85 < likely.max()


@pytest.mark.parametrize(
    "name", ["braking", "slalom", "double-lane-change", "pulses", "constant-radius", "stop-and-go"]
)
def test_a_friction_that_stays_never_jumps(name: str) -> None:
    for seed in (1, 2):
        _, estimates = one_visit(name, None, seed)
        assert estimates.jumps is not None
        assert not estimates.jumps.any()


def test_evidence_is_given_only_at_visit_ends_and_jumps() -> None:
    _, estimates = one_visit("jump-braking", None, 2)
    assert estimates.jumps is not None
    assert estimates.evidence is not None
    has_evidence = np.isfinite(estimates.evidence[:, 0]).all(axis=1)
    assert has_evidence.sum() == estimates.jumps.sum() + 2
