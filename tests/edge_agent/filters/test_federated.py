"""Tests of federated filters (sub-filters whose results are fused) by mathematical identities, and
by comparison with the Kalman filter on linear systems.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.filters.downdate import downdate, update_by_downdate
from edge_agent.filters.federated import fuse_estimates, share_information
from edge_agent.filters.householder import Measurement, predict, update
from edge_agent.filters.points import axis_points, sigma_points
from edge_agent.filters.sigma import cubature_rule
from schemas.numeric import FloatArray


def covariance(n: int, seed: int) -> FloatArray:
    a = np.random.default_rng(seed).normal(size=(n, n))
    return np.asarray(a @ a.T + 0.1 * np.eye(n))


def root_of(cov: FloatArray) -> FloatArray:
    """Return the lower triangular Cholesky factor (n, n) of a covariance (n, n)."""
    return np.asarray(np.linalg.cholesky(cov), np.float64)


System = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""f, q, h and the standard deviations of the measurement."""


def textbook(
    mean: FloatArray, cov: FloatArray, system: System, z: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean (n,) and covariance (n, n) after one step of the textbook Kalman filter with the
    measurement `z`. `system` is the linear system. The filter computes with full covariances, not
    with their Cholesky factors.
    """
    f, q, h, noise = system
    mean = f @ mean
    cov = f @ cov @ f.T + q
    s = h @ cov @ h.T + np.diag(noise**2)
    gain = cov @ h.T @ np.linalg.inv(s)
    return mean + gain @ (z - h @ mean), cov - gain @ s @ gain.T


@pytest.mark.parametrize("beta", [0.1, 0.5, 0.83])
def test_share_then_fuse_is_the_identity(beta: float) -> None:
    root = root_of(covariance(5, 0))
    mean = np.arange(5.0)
    first = np.empty((5, 5))
    second = np.empty((5, 5))
    work = np.empty((10, 10))
    share_information(root, beta, first)
    share_information(root, 1.0 - beta, second)
    fused = mean.copy()
    fuse_estimates(fused, first, mean, second, work)
    assert first @ first.T == pytest.approx(root @ root.T, abs=1e-12)
    assert fused == pytest.approx(mean, abs=1e-12)


def test_fusing_adds_information() -> None:
    p = covariance(4, 1)
    q = covariance(4, 2)
    x = np.array([1.0, 2.0, 3.0, 4.0])
    y = np.array([1.5, 1.0, 3.0, 5.0])
    mean = x.copy()
    root = root_of(p)
    fuse_estimates(mean, root, y, root_of(q), np.empty((8, 8)))
    information = np.linalg.inv(p) + np.linalg.inv(q)
    assert root @ root.T == pytest.approx(np.linalg.inv(information), abs=1e-12)
    expected = np.linalg.solve(information, np.linalg.solve(p, x) + np.linalg.solve(q, y))
    assert mean == pytest.approx(expected, abs=1e-12)


def test_federated_filter_with_halved_shared_rows_is_the_kalman_filter() -> None:
    """Two sub-filters with measurements [z1, z2] and [z2] run ten steps of a linear system. Both
    double the variance of the shared measurement z2, so that each uses half of its information. The
    fused result must equal the textbook Kalman filter.
    """
    rng = np.random.default_rng(3)
    n = 3
    f = np.eye(n) + 0.1 * rng.normal(size=(n, n))
    h = rng.normal(size=(2, n))
    q = 0.05 * covariance(n, 4)
    noise = np.array([0.2, 0.3])
    mean = np.ones(n)
    cov = covariance(n, 5)
    x = mean.copy()
    root = root_of(cov)
    rule = cubature_rule(n)
    for _ in range(10):
        z = rng.normal(size=2)
        mean, cov = textbook(mean, cov, (f, q, h, noise), z)
        x, root = _federated_turn(rule.xi, rule.w_cov, (x, root), (f, q, h, noise), z, 0.37)
    assert x == pytest.approx(mean, abs=1e-12)
    assert root @ root.T == pytest.approx(cov, abs=1e-12)


def _federated_turn(
    xi: FloatArray,
    weight: FloatArray,
    state: tuple[FloatArray, FloatArray],
    system: System,
    z: FloatArray,
    beta: float,
) -> tuple[FloatArray, FloatArray]:
    (mean, root) = state
    (f, q, h, noise) = system
    n = len(mean)
    work = np.empty((20, 40))
    parts = []
    for sub, part in enumerate((beta, 1.0 - beta)):
        own = np.empty(n)
        own_root = np.empty((n, n))
        points = np.empty((2 * n, n))
        share_information(root, part, own_root)
        axis_points(mean, own_root, xi, points)
        predict(
            np.ascontiguousarray(points @ f.T),
            (weight, weight),
            root_of(q / part),
            own,
            own_root,
            work,
        )
        innovation = z - h @ own
        std = noise * np.array([1.0, np.sqrt(2.0)])
        if sub == 1:
            innovation[0] = np.nan
        update(
            own,
            own_root,
            own_root.copy(),
            Measurement(np.ascontiguousarray(h @ own_root), innovation, std),
            work,
        )
        parts.append((own, own_root))
    fuse_estimates(parts[0][0], parts[0][1], parts[1][0], parts[1][1], work)
    return parts[0]


def test_points_by_singular_values_have_the_moments_of_the_state() -> None:
    rule = cubature_rule(4)
    root = root_of(covariance(4, 6))
    mean = np.arange(4.0)
    points = np.empty((8, 4))
    axis_points(mean, root, rule.xi, points)
    assert rule.w_mean @ points == pytest.approx(mean, abs=1e-12)
    centred = points - mean
    assert (rule.w_cov[:, None] * centred).T @ centred == pytest.approx(root @ root.T, abs=1e-12)


def test_points_by_singular_values_lie_on_the_axes_of_the_ellipsoid() -> None:
    root = root_of(covariance(3, 7))
    points = np.empty((6, 3))
    axis_points(np.zeros(3), root, cubature_rule(3).xi, points)
    gram = points[:3] @ points[:3].T
    assert gram - np.diag(np.diag(gram)) == pytest.approx(np.zeros((3, 3)), abs=1e-12)


def test_downdate_removes_a_column() -> None:
    cov = covariance(5, 8)
    column = 0.2 * np.random.default_rng(9).normal(size=5)
    root = root_of(cov)
    assert downdate(root, column, np.empty(5))
    assert root @ root.T == pytest.approx(cov - np.outer(column, column), abs=1e-12)
    assert np.array_equal(root, np.tril(root))


def test_downdate_without_a_valid_covariance_has_no_effect() -> None:
    root = root_of(covariance(3, 10))
    before = root.copy()
    assert not downdate(root, 1.0001 * root[:, 0], np.empty(3))
    assert np.array_equal(root, before)


def _make_update(
    seed: int, noise: float
) -> tuple[tuple[FloatArray, ...], tuple[int, float, float, bool]]:
    rng = np.random.default_rng(seed)
    root = root_of(covariance(4, seed))
    mean = rng.normal(size=4)
    h = rng.normal(size=(3, 4))
    innovation = rng.normal(size=3)
    innovation[1] = np.nan
    args = (
        root.copy(),
        Measurement(np.ascontiguousarray(h @ root), innovation, np.full(3, noise)),
        np.empty((12, 12)),
    )
    other = mean.copy()
    other_root = root.copy()
    updated = update_by_downdate(mean, root, *args)
    plain = update(other, other_root, *args)
    assert updated[:3] == pytest.approx(plain, rel=1e-9)
    return (mean, other, root @ root.T, other_root @ other_root.T), updated


@pytest.mark.campaign
def test_an_update_by_downdates_is_the_orthogonal_update() -> None:
    (mean, other, cov, other_cov), updated = _make_update(11, 0.5)
    assert not updated[3]
    assert mean == pytest.approx(other, abs=1e-9)
    assert cov == pytest.approx(other_cov, abs=1e-9)


@pytest.mark.campaign
def test_downdate_filter_is_the_textbook_filter_on_a_linear_system() -> None:
    rng = np.random.default_rng(21)
    n = 4
    f = 0.9 * np.eye(n) + 0.05 * rng.normal(size=(n, n))
    h = rng.normal(size=(3, n))
    q = 0.01 * covariance(n, 22)
    noise = np.array([0.2, 0.3, 0.4])
    rule = cubature_rule(n)
    mean = np.ones(n)
    cov = covariance(n, 23)
    x = mean.copy()
    root = root_of(cov)
    points = np.empty((2 * n, n))
    work = np.empty((20, 40))
    for _ in range(50):
        z = rng.normal(size=3)
        mean, cov = textbook(mean, cov, (f, q, h, noise), z)
        sigma_points(x, root, rule.xi, points)
        predict(
            np.ascontiguousarray(points @ f.T),
            (rule.w_mean, rule.w_cov),
            root_of(q),
            x,
            root,
            work,
        )
        updated = update_by_downdate(
            x,
            root,
            root.copy(),
            Measurement(np.ascontiguousarray(h @ root), z - h @ x, noise),
            work,
        )
        assert not updated[3]
        assert x == pytest.approx(mean, abs=1e-12)
        assert root @ root.T == pytest.approx(cov, abs=1e-12)


def test_where_the_downdate_refuses_the_orthogonal_update_does_the_work() -> None:
    """The noise is so small that rounding leaves no variance in the measured direction. The filter
    must refuse the downdate of the covariance, and use the orthogonal update instead.
    """
    (mean, other, cov, other_cov), updated = _make_update(12, 1e-9)
    assert updated[3]
    assert np.array_equal(mean, other)
    assert np.array_equal(cov, other_cov)
