"""Tests of the sigma-point rules and the square-root filter. A rule must integrate quadratic
functions exactly, and the filter must equal textbook filters.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_agent.filters import householder
from edge_agent.filters.householder import Measurement
from edge_agent.filters.points import centred_deviations, sigma_points
from edge_agent.filters.sigma import SigmaRule, cubature_rule, unscented_rule
from schemas.errors import InputError
from schemas.numeric import FloatArray

RULES = [
    cubature_rule(4),
    unscented_rule(4, 1.0, 0.0, 0.0),
    unscented_rule(4, 1.0, 2.0, 0.5),
    unscented_rule(4, 0.9, 2.0, 1.0),
]


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_a_rule_integrates_a_random_quadratic_exactly(rule: SigmaRule) -> None:
    rng = np.random.default_rng(1)
    a = rng.normal(size=(4, 4))
    b = rng.normal(size=4)
    values = np.einsum("pi,ij,pj->p", rule.xi, a, rule.xi) + rule.xi @ b + 3.0
    assert rule.w_mean @ values == pytest.approx(np.trace(a) + 3.0, abs=1e-9)


def test_cubature_is_unscented_with_alpha_one_and_beta_and_kappa_zero() -> None:
    for n in range(1, 9):
        left = cubature_rule(n)
        right = unscented_rule(n, 1.0, 0.0, 0.0)
        assert np.array_equal(left.xi, right.xi)
        assert np.array_equal(left.w_mean, right.w_mean)
        assert np.array_equal(left.w_cov, right.w_cov)


@pytest.mark.parametrize("place", ["xi", "w_mean", "w_cov"])
def test_a_rule_with_one_corrupted_constant_is_refused(place: str) -> None:
    rule = cubature_rule(3)
    parts = {name: getattr(rule, name).copy() for name in ("xi", "w_mean", "w_cov")}
    parts[place].flat[0] += 1e-6
    with pytest.raises(InputError, match="moment"):
        SigmaRule("corrupted", **parts)


def test_a_negative_covariance_weight_is_refused() -> None:
    with pytest.raises(InputError, match="negative"):
        unscented_rule(4, 1.0, 0.0, -2.0)


@pytest.mark.parametrize("shape", [(3, 3), (3, 7), (6, 20)])
def test_triangularizing_keeps_the_product_and_makes_a_cholesky_factor(
    shape: tuple[int, int],
) -> None:
    a = np.random.default_rng(5).normal(size=shape)
    b = a.copy()
    householder.triangularize(b, *shape)
    factor = b[:, : shape[0]]
    assert np.allclose(factor @ factor.T, a @ a.T, rtol=0, atol=1e-12)
    assert np.allclose(factor, np.tril(factor))
    assert (np.diag(factor) >= 0).all()


@pytest.mark.parametrize(
    "rule", [cubature_rule(2), unscented_rule(2, 1.0, 2.0, 0.5)], ids=lambda rule: rule.name
)
def test_a_covariance_keeps_a_centimetre_at_an_offset_of_5400_kilometres(rule: SigmaRule) -> None:
    points = np.empty((len(rule.xi), 2))
    mean = np.empty(2)
    work = np.zeros((2, 8))
    root = np.zeros((2, 2))
    sigma_points(np.array([5.4e6, -5.4e6]), 0.01 * np.eye(2), rule.xi, points)
    householder.predict(points, (rule.w_mean, rule.w_cov), np.zeros((2, 2)), mean, root, work)
    assert np.diag(root) == pytest.approx([0.01, 0.01], rel=1e-6)


def factor_of(cov: FloatArray) -> FloatArray:
    """Return the lower triangular Cholesky factor (n, n) of a covariance (n, n)."""
    return np.asarray(np.linalg.cholesky(cov), np.float64)


def _predict_moments(
    rule: SigmaRule, mean: FloatArray, cov: FloatArray, f: FloatArray, q: FloatArray
) -> tuple[FloatArray, FloatArray]:
    n = len(mean)
    count = len(rule.xi)
    points = np.empty((count, n))
    sigma_points(mean, factor_of(cov), rule.xi, points)
    new = np.empty(n)
    root = np.zeros((n, n))
    noise = factor_of(q)
    householder.predict(
        points @ f.T, (rule.w_mean, rule.w_cov), noise, new, root, np.zeros((n, count + n))
    )
    return new, root


def _update_moments(
    rule: SigmaRule,
    mean: FloatArray,
    root: FloatArray,
    h: FloatArray,
    std: FloatArray,
    z: FloatArray,
) -> tuple[FloatArray, FloatArray, tuple[int, float, float]]:
    n = len(mean)
    count = len(rule.xi)
    rows = len(z)
    points = np.empty((count, n))
    sigma_points(mean, root, rule.xi, points)
    x = np.empty((n, count))
    y = np.empty((rows, count))
    centred_deviations(points, mean, rule.w_cov, x, 0)
    seen = points @ h.T
    centred_deviations(seen, rule.w_mean @ seen, rule.w_cov, y, 0)
    new = mean.copy()
    factor = root.copy()
    work = np.zeros((rows + n, count + rows))
    statistics = householder.update(
        new, factor, x, Measurement(y, z - rule.w_mean @ seen, std), work
    )
    return new, factor, statistics


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_on_a_linear_system_the_core_is_the_kalman_filter(rule: SigmaRule) -> None:
    rng = np.random.default_rng(2)
    f = 0.9 * np.eye(4) + 0.05 * rng.normal(size=(4, 4))
    h = rng.normal(size=(3, 4))
    q = 0.01 * np.eye(4)
    std = np.array([0.1, 0.2, 0.3])
    mean = rng.normal(size=4)
    cov = np.eye(4)
    ours = mean
    ours_cov = cov
    for _ in range(50):
        z = rng.normal(size=3)
        mean = f @ mean
        cov = f @ cov @ f.T + q
        s = h @ cov @ h.T + np.diag(std**2)
        k = cov @ h.T @ np.linalg.inv(s)
        nu = z - h @ mean
        expected = -0.5 * (nu @ np.linalg.solve(s, nu) + np.linalg.slogdet(2 * np.pi * s)[1])
        rest = np.eye(4) - k @ h
        mean = mean + k @ nu
        cov = rest @ cov @ rest.T + k @ np.diag(std**2) @ k.T
        ours, root = _predict_moments(rule, ours, ours_cov, f, q)
        ours, root, statistics = _update_moments(rule, ours, root, h, std, z)
        ours_cov = root @ root.T
        assert statistics[1] == pytest.approx(expected, abs=1e-9)
        assert np.allclose(ours, mean, rtol=0, atol=1e-12)
        assert np.allclose(ours_cov, cov, rtol=0, atol=1e-12)


def test_square_root_filter_is_textbook_for_a_nonlinear_measurement() -> None:
    rule = cubature_rule(3)
    rng = np.random.default_rng(4)
    a = rng.normal(size=(3, 3))
    mean = rng.normal(size=3)
    cov = a @ a.T
    points = mean + rule.xi @ np.linalg.cholesky(cov).T
    seen = np.stack([np.sin(points[:, 0]), points[:, 1] * points[:, 2]], axis=1)
    centre = seen.mean(0)
    r = np.array([0.3, 0.4])
    s = (seen - centre).T @ (seen - centre) / 6 + np.diag(r**2)
    c = (points - mean).T @ (seen - centre) / 6
    nu = np.array([0.2, -0.5])
    k = c @ np.linalg.inv(s)
    new = mean.copy()
    root = factor_of(cov)
    householder.update(
        new,
        root,
        (points - mean).T / math.sqrt(6),
        Measurement((seen - centre).T / math.sqrt(6), nu, r),
        np.zeros((5, 8)),
    )
    assert np.allclose(new, mean + k @ nu, rtol=0, atol=1e-9)
    assert np.allclose(root @ root.T, cov - k @ s @ k.T, rtol=0, atol=1e-9)


def _textbook(
    rule: SigmaRule, mean: FloatArray, cov: FloatArray, q: FloatArray, r: FloatArray, z: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean (2,) and covariance (2, 2) of a pendulum (functions `swing` and `look`) after one
    step of the cubature filter with the measurement `z`. The filter computes with full covariances,
    not with their factors.
    """
    points = swing(mean + rule.xi @ np.linalg.cholesky(cov).T)
    mean = points.mean(axis=0)
    cov = (points - mean).T @ (points - mean) / len(points) + q
    points = mean + rule.xi @ np.linalg.cholesky(cov).T
    seen = look(points)
    expected = seen.mean(axis=0)
    s = (seen - expected).T @ (seen - expected) / len(points) + np.diag(r**2)
    gain = (points - mean).T @ (seen - expected) / len(points) @ np.linalg.inv(s)
    return mean + gain @ (z - expected), cov - gain @ s @ gain.T


def swing(x: FloatArray) -> FloatArray:
    """Return the states (n, 2) of a damped pendulum, angle and rate, 50 ms after it had the states
    `x` (n, 2).
    """
    return np.stack([x[:, 0] + 0.05 * x[:, 1], 0.99 * x[:, 1] - 0.5 * np.sin(x[:, 0])], axis=1)


def look(x: FloatArray) -> FloatArray:
    """Return the measurements (n, 2) of a pendulum in the states `x`: horizontal position, and rate
    times height.
    """
    return np.stack([np.sin(x[:, 0]), x[:, 1] * np.cos(x[:, 0])], axis=1)


def test_square_root_filter_is_textbook_for_a_nonlinear_system() -> None:
    rule = cubature_rule(2)
    rng = np.random.default_rng(8)
    q = 1e-3 * np.array([[1.0, 0.3], [0.3, 2.0]])
    r = np.array([0.1, 0.2])
    mean = np.array([0.8, 0.0])
    cov = 0.1 * np.eye(2)
    ours = mean.copy()
    root = factor_of(cov)
    work = np.zeros((8, 16))
    points = np.empty((4, 2))
    for _ in range(100):
        z = rng.normal(0.3, 0.3, size=2)
        mean, cov = _textbook(rule, mean, cov, q, r, z)
        sigma_points(ours, root, rule.xi, points)
        householder.predict(
            swing(points), (rule.w_mean, rule.w_cov), factor_of(q), ours, root, work
        )
        sigma_points(ours, root, rule.xi, points)
        seen = look(points)
        x = np.empty((2, 4))
        y = np.empty((2, 4))
        centred_deviations(points, ours, rule.w_cov, x, 0)
        centred_deviations(seen, rule.w_mean @ seen, rule.w_cov, y, 0)
        householder.update(ours, root, x, Measurement(y, z - rule.w_mean @ seen, r), work)
        assert np.allclose(ours, mean, rtol=0, atol=1e-9)
        assert np.allclose(root @ root.T, cov, rtol=0, atol=1e-9)


def test_missing_measurement_equals_an_update_without_it() -> None:
    rule = cubature_rule(2)
    mean = np.array([1.0, 2.0])
    root = np.array([[1.0, 0.0], [0.3, 0.5]])
    h = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    std = np.array([0.1, 0.2, 0.3])
    gappy = _update_moments(rule, mean, root, h, std, np.array([1.5, math.nan, 3.0]))
    whole = _update_moments(rule, mean, root, h[[0, 2]], std[[0, 2]], np.array([1.5, 3.0]))
    assert np.array_equal(gappy[0], whole[0])
    assert np.array_equal(gappy[1], whole[1])
    nothing = _update_moments(rule, mean, root, h, std, np.full(3, math.nan))
    assert np.array_equal(nothing[0], mean)
    assert nothing[2] == (0, 0.0, 0.0)
