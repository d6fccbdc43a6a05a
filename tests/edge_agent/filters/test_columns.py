"""Tests that two forms of the cubature filter give the same points and the same prediction: one
stores its points in columns, the other in rows.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.filters import columns, householder
from edge_agent.filters.points import sigma_points
from edge_agent.filters.sigma import cubature_rule
from schemas.numeric import FloatArray

N = 6
RULE = cubature_rule(N)


def belief(seed: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(N, N))
    return rng.normal(size=N), np.asarray(np.linalg.cholesky(a @ a.T + 0.1 * np.eye(N)), np.float64)


def test_columns_are_the_points_of_the_rule() -> None:
    mean, root = belief(0)
    points = np.empty((N, 2 * N))
    rows = np.empty((2 * N, N))
    columns.spread_points(mean, root, points)
    sigma_points(mean, root, RULE.xi, rows)
    assert points == pytest.approx(rows.T, abs=1e-12)


@pytest.mark.parametrize("offset", [0.0, 5.4e6])
def test_gathering_is_the_square_root_prediction(offset: float) -> None:
    points = np.random.default_rng(1).normal(size=(N, 2 * N)) + offset
    std = np.linspace(0.1, 0.6, N)
    mean = np.empty(N)
    root = np.empty((N, N))
    expected = np.empty(N)
    expected_root = np.empty((N, N))
    householder.predict(
        np.ascontiguousarray(points.T),
        (RULE.w_mean, RULE.w_cov),
        0.5 * np.diag(std),
        expected,
        expected_root,
        np.empty((N, 3 * N)),
    )
    columns.gather_points(points, std, 0.5, mean, root)
    assert mean == pytest.approx(expected, rel=1e-14, abs=1e-12)
    assert root == pytest.approx(expected_root, abs=1e-8 if offset else 1e-12)


def test_equal_points_give_the_covariance_of_the_noise() -> None:
    mean = np.empty(N)
    root = np.empty((N, N))
    std = np.linspace(1e-9, 1e-3, N)
    columns.gather_points(np.full((N, 2 * N), 3.7), std, 1.0, mean, root)
    assert root == pytest.approx(np.diag(std), rel=1e-12)


def test_a_pivot_is_never_less_than_its_noise_however_alike_the_states_are() -> None:
    points = np.outer(np.ones(N), np.random.default_rng(2).normal(size=2 * N))
    mean = np.empty(N)
    root = np.empty((N, N))
    std = np.full(N, 1e-9)
    columns.gather_points(points, std, 1.0, mean, root)
    assert (np.diag(root) >= std).all()
    assert np.isfinite(root).all()
