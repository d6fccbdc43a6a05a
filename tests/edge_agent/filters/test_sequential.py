"""Tests of Carlson's update of a square-root filter. A square-root filter stores the covariance as
a Cholesky factor, and the update uses one scalar measurement of a state. The result must equal that
of the orthogonal update in `householder`.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_agent.filters.cholesky import variance
from edge_agent.filters.householder import Measurement, update
from edge_agent.filters.sequential import carlson_update
from schemas.numeric import FloatArray

N = 6
ROWS = 3
SEEDS = (0, 1, 2)


def belief(seed: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(N, N))
    return rng.normal(size=N), np.asarray(np.linalg.cholesky(a @ a.T + 0.1 * np.eye(N)), np.float64)


@pytest.mark.parametrize("seed", SEEDS)
def test_variance_of_a_state_is_the_square_of_its_row(seed: int) -> None:
    _, root = belief(seed)
    assert [variance(root, i) for i in range(N)] == pytest.approx(np.diag(root @ root.T), abs=1e-12)


@pytest.mark.parametrize("state", [0, 2, 5])
def test_carlson_s_update_by_a_state_is_the_orthogonal_one(state: int) -> None:
    mean, root = belief(3)
    ours = mean.copy()
    ours_root = root.copy()
    gain = np.empty(N)
    far, expected = carlson_update(ours, ours_root, state, mean[state] + 0.7, 0.04, gain)
    used, log_likelihood, square = update(
        mean,
        root,
        root.copy(),
        Measurement(root[state : state + 1].copy(), np.array([0.7]), np.array([0.2])),
        np.zeros((9, 9)),
    )
    assert ours == pytest.approx(mean, abs=1e-12)
    assert ours_root == pytest.approx(root, abs=1e-12)
    assert used == 1
    assert square == pytest.approx(far, rel=1e-12)
    assert -0.5 * (math.log(2.0 * math.pi * expected) + far) == pytest.approx(
        log_likelihood, rel=1e-12
    )
