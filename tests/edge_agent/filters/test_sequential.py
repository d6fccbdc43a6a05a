"""Tests that compare Cholesky factors, and square-root updates by one scalar after the other, with
textbook and orthogonal algorithms.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_agent.filters.cholesky import covariance_of_factor, factorize, variance
from edge_agent.filters.householder import Measurement, update
from edge_agent.filters.sequential import apply_projection, carlson_update, potter_factors
from schemas.numeric import FloatArray

N = 6
ROWS = 3
SEEDS = (0, 1, 2)


def belief(seed: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(N, N))
    return rng.normal(size=N), np.asarray(np.linalg.cholesky(a @ a.T + 0.1 * np.eye(N)), np.float64)


def covariance(seed: int) -> FloatArray:
    _, root = belief(seed)
    return root @ root.T


@pytest.mark.parametrize("seed", SEEDS)
def test_a_covariance_is_its_factor_times_itself_turned(seed: int) -> None:
    root = np.full((N, N), np.nan)
    again = np.empty((N, N))
    factorize(covariance(seed), root, 1e-18)
    assert root == pytest.approx(np.linalg.cholesky(covariance(seed)), abs=1e-12)
    covariance_of_factor(root, np.zeros(N), again)
    assert again == pytest.approx(covariance(seed), abs=1e-12)
    assert [variance(root, i) for i in range(N)] == pytest.approx(
        np.diag(covariance(seed)), abs=1e-12
    )


def test_noise_is_added_to_the_diagonal_of_a_product() -> None:
    mean, root = belief(1)
    plain = np.empty((N, N))
    noisy = np.empty((N, N))
    covariance_of_factor(root, np.zeros(N), plain)
    covariance_of_factor(root, mean**2, noisy)
    assert noisy - plain == pytest.approx(np.diag(mean**2), abs=1e-12)


def test_a_pivot_that_rounding_took_is_what_is_surely_there() -> None:
    root = np.empty((2, 2))
    factorize(np.array([[1.0, 1.0], [1.0, 1.0 - 1e-15]]), root, 1e-6)
    assert root == pytest.approx(np.array([[1.0, 0.0], [1.0, 1e-3]]))


@pytest.mark.parametrize("seen", [N, N - 2])
@pytest.mark.parametrize("seed", SEEDS)
def test_rows_taken_in_one_by_one_by_potter_are_the_textbook_s_update(seed: int, seen: int) -> None:
    rng = np.random.default_rng(seed)
    mean, root = belief(seed)
    f = rng.normal(size=(ROWS, seen))
    nu = rng.normal(size=ROWS)
    r = rng.uniform(0.1, 1.0, ROWS)
    spread = f @ f.T + np.diag(r)
    cross = root[:, :seen] @ f.T
    expected = mean + cross @ np.linalg.solve(spread, nu)
    left = root @ root.T - cross @ np.linalg.solve(spread, cross.T)
    square = nu @ np.linalg.solve(spread, nu)
    log_det = np.linalg.slogdet(spread)[1]
    for row in range(ROWS):
        a, gain = potter_factors(f[row], r[row])
        step = nu[row] / a
        square = square - nu[row] * step
        log_det = log_det - math.log(a)
        apply_projection(mean, root, f[row], step, gain)
        apply_projection(nu[row + 1 :], f[row + 1 :], f[row], -step, gain)
    assert mean == pytest.approx(expected, abs=1e-9)
    assert root @ root.T == pytest.approx(left, abs=1e-9)
    assert (square, log_det) == pytest.approx((0.0, 0.0), abs=1e-9)


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
