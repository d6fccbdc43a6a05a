"""Tests that compare the computations of a group of nodes (filters of one friction hypothesis each)
with textbook formulas. The computations are update, prediction, mixing and tyre curve.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from edge_agent.dynamics.tyres import magic_formula
from edge_agent.estimators.friction_mixture.node.covariance import (
    factorize_first,
    mix_states,
    predict_covariance,
)
from edge_agent.estimators.friction_mixture.node.linearization import slip_noise_correction
from edge_agent.estimators.friction_mixture.node.node_filter import find_covariances, take_rows
from edge_agent.estimators.friction_mixture.state.constants import (
    ACTIVE,
    CURVED,
    NODES,
    ROWS,
    STATES,
    Constants,
    NodeState,
)
from edge_agent.estimators.friction_mixture.state.friction_grid import node_table
from edge_agent.estimators.friction_mixture.state.memory import VelocityGain
from edge_agent.estimators.friction_mixture.state.split_sides import project_weights, side_table
from edge_agent.estimators.friction_mixture.state.tyre_curve import (
    curve_tables,
    magic_formulas,
    ratio_at,
    theta_at,
)
from edge_agent.estimators.friction_mixture.state.workspace import BlockFeatures, NodeWorkspace
from schemas.numeric import FloatArray
from schemas.runtime.jit import nogil
from schemas.runtime.lanes import lanes_at, put_lanes
from schemas.runtime.records import LANES, records

SEEDS = (0, 1, 2)


def covariances(seed: int) -> FloatArray:
    """Return LANES random covariances (STATES, STATES, LANES), one per SIMD lane (position in a
    vector).
    """
    factor = np.random.default_rng(seed).normal(size=(LANES, STATES, STATES))
    return np.ascontiguousarray(
        np.moveaxis(factor @ factor.swapaxes(1, 2) + 0.1 * np.eye(STATES), 0, -1)
    )


def whole(covariance: FloatArray, lane: int) -> FloatArray:
    """Return the full covariance matrix of the node in SIMD lane `lane` (position in a vector).
    `covariance` stores only the lower half.
    """
    lower = np.tril(covariance[..., lane])
    return np.asarray(lower + np.tril(lower, -1).T)


@pytest.mark.parametrize("missing", [(), (1,), (0, 4)])
@pytest.mark.parametrize("seed", SEEDS)
def test_rows_taken_one_by_one_are_the_textbook_update(seed: int, missing: tuple[int, ...]) -> None:
    rng = np.random.default_rng(seed)
    before = covariances(seed)
    mean = rng.normal(size=(STATES, LANES))
    h = rng.normal(size=(ROWS, STATES, LANES))
    h[list(missing)] = 0.0
    v = rng.normal(size=(ROWS, LANES))
    noise = rng.uniform(0.1, 1.0, (ROWS, LANES))
    node = records(NodeWorkspace, 1)[0]
    features = records(BlockFeatures, 1)[0]
    for row in missing:
        features["rolling" if row < 4 else "side"][row % 4] = np.nan
    node["residual"] = v
    node["cross"] = np.einsum("ijl,rjl->irl", before, h)
    node["spread"] = np.einsum("ril,iql->rql", h, node["cross"])
    for row in range(ROWS):
        node["spread"][row, row] += noise[row]
    after = before.copy()
    found = mean.copy()
    take_all_rows(features, found, after, node)
    seen = np.delete(np.arange(ROWS), missing)
    for lane in range(LANES):
        own = h[seen, :, lane]
        cross = before[..., lane] @ own.T
        spread = own @ cross + np.diag(noise[seen, lane])
        expected = mean[:, lane] + cross @ np.linalg.solve(spread, v[seen, lane])
        left = before[..., lane] - cross @ np.linalg.solve(spread, cross.T)
        assert found[:, lane] == pytest.approx(expected, abs=1e-9)
        assert whole(after, lane) == pytest.approx(left, abs=1e-9)
        loss = 0.5 * v[seen, lane] @ np.linalg.solve(spread, v[seen, lane])
        assert node["gain"][0, lane] == pytest.approx(loss, abs=1e-9)


@nogil
def take_all_rows(
    features: BlockFeatures, mean: FloatArray, covariance: FloatArray, node: NodeWorkspace
) -> None:
    """Update mean and covariance of each node (filter of one friction hypothesis) with all six
    measurements (four wheels, two axles).

    Write the resulting loss (negative log-likelihood) of each node into `node.gain`, where the test
    reads it.
    """
    put_lanes(node.gain, 0, take_rows(features, mean, covariance, node, 0.0))


@pytest.mark.parametrize("seed", SEEDS)
def test_covariances_with_rows_are_those_of_the_whole_factor(seed: int) -> None:
    rng = np.random.default_rng(seed)
    covariance = covariances(seed)
    node = records(NodeWorkspace, 1)[0]
    node["curved"] = rng.normal(size=(CURVED, ROWS, LANES))
    node["derivative"] = rng.normal(size=(ACTIVE, ROWS, LANES))
    node["derivative"][:CURVED] = np.nan
    factorize_first(covariance, node["root"])
    find_covariances(covariance, node)
    for lane in range(LANES):
        root = np.linalg.cholesky(covariance[..., lane])
        deviation = node["derivative"][CURVED:, :, lane].T @ root[CURVED:ACTIVE]
        deviation[:, :CURVED] += node["curved"][..., lane].T
        assert node["root"][..., lane] == pytest.approx(root[:, :CURVED], abs=1e-12)
        assert node["cross"][..., lane] == pytest.approx(root @ deviation.T, abs=1e-9)
        spread = np.tril(deviation @ deviation.T)
        assert np.tril(node["spread"][..., lane]) == pytest.approx(spread, abs=1e-9)


def test_a_pivot_lost_by_rounding_is_raised_to_its_limit() -> None:
    root = np.zeros((STATES, CURVED, LANES))
    factorize_first(np.zeros((STATES, STATES, LANES)), root)
    assert root[0, 0] == pytest.approx(1e-6)


def test_prediction_is_the_textbook_one() -> None:
    rng = np.random.default_rng(0)
    before = covariances(0)
    after = before.copy()
    gain = records(VelocityGain, 1)[0]
    gain["leak_y"]["x"] = 0.3
    gain["leak_y"]["y"] = -0.7
    gain["unit"]["x"] = 0.05
    gain["unit"]["y"] = 0.002
    keep = rng.uniform(0.5, 1.0, STATES)
    noise = rng.uniform(0.0, 0.1, STATES)
    angle = 0.2
    turn = (np.cos(angle), np.sin(angle))
    predict_covariance(after, np.zeros((2, STATES, LANES)), gain, turn, keep, noise)
    f = np.diag(keep)
    f[:2] = 0.0
    f[0, :2] = (turn[0], turn[1])
    f[1, :2] = (-turn[1], turn[0])
    f[:2, NodeState.LEAK_Y] = -0.3, 0.7
    f[:2, [NodeState.BIAS_X, NodeState.SLOPE]] = [[-0.05], [-0.002]]
    f[:2, [NodeState.BIAS_Y, NodeState.BANK]] = [[0.002], [-0.05]]
    for lane in range(LANES):
        expected = f @ before[..., lane] @ f.T + np.diag(noise)
        assert whole(after, lane) == pytest.approx(expected, abs=1e-12)


def test_mixing_matches_the_moments_of_both_distributions() -> None:
    rng = np.random.default_rng(0)
    own = covariances(0)
    overall = covariances(1)[..., 0]
    mean = rng.normal(size=(STATES, LANES))
    overall_mean = rng.normal(size=STATES)
    z = np.linspace(0.0, 1.0, LANES)
    mixed = own.copy()
    mixed_mean = mean.copy()
    mix_all(mixed_mean, mixed, z, overall_mean, overall)
    for lane, share in enumerate(z):
        apart = overall_mean - mean[:, lane]
        expected = (1.0 - share) * own[..., lane] + share * overall
        expected = expected + share * (1.0 - share) * np.outer(apart, apart)
        assert whole(mixed, lane) == pytest.approx(expected, abs=1e-12)
        assert mixed_mean[:, lane] == pytest.approx(mean[:, lane] + share * apart, abs=1e-12)


@nogil
def mix_all(
    mean: FloatArray,
    covariance: FloatArray,
    z: FloatArray,
    overall_mean: FloatArray,
    overall_covariance: FloatArray,
) -> None:
    mix_states(mean, covariance, lanes_at(z, 0), overall_mean, overall_covariance)


def test_the_tables_are_the_magic_formula_and_its_inverse() -> None:
    c = Constants().physical.curve_c
    e = 0.0
    curve = curve_tables(partial(magic_formulas, c=c, e=e))
    for theta in (0.01, 0.3, 1.0, 1.7, 4.0, 30.0, 900.0):
        assert ratio_at(curve, theta, theta / (1.0 + theta)) * theta == pytest.approx(
            magic_formula(theta, c, e), abs=5e-4
        )
    for force in (0.05, 0.5, 0.9, 0.99):
        assert magic_formula(theta_at(curve, force), c, e) == pytest.approx(force, abs=1e-4)
    assert np.isinf(theta_at(curve, 1.0))


def test_slip_beyond_the_table_gives_the_sliding_force() -> None:
    curve = curve_tables(partial(magic_formulas, c=1.45, e=-0.1))
    assert ratio_at(curve, 1e4, 1e4 / (1.0 + 1e4)) * 1e4 == pytest.approx(
        magic_formula(1e4, 1.45, -0.1), abs=2e-3
    )


@pytest.mark.parametrize("slope", [0.0, 0.3, 1.0])
def test_residual_noise_equals_that_of_slip_and_force_about_a_line(
    slope: float,
) -> None:
    rng = np.random.default_rng(0)
    slip = rng.normal(0.0, 0.03, 100_000)
    force = rng.normal(0.0, 0.01, 100_000)
    distance = (force - slope * slip) / np.hypot(1.0, slope)
    expected = (0.5 - slip_noise_correction(slope)) * 0.03**2 + 0.01**2 / (1.0 + slope**2)
    assert distance.var() == pytest.approx(expected, rel=0.02)


def test_split_nodes_share_probability_with_a_friction_between_them() -> None:
    mu, prior = node_table(NODES)
    sides = side_table(mu, prior, 0.05)
    for side in range(2):
        middles = np.unique(sides.mu[NODES:, side])
        for one, next_one in pairwise(middles):
            between = np.searchsorted(mu, 0.5 * (one + next_one))
            held = [
                sides.share[side][sides.mu[NODES:, side] == place][0][between]
                for place in (one, next_one)
            ]
            assert min(held) > 0.0


def test_split_nodes_exist_for_both_sides_and_their_cells_sum_to_one() -> None:
    mu, prior = node_table(NODES)
    sides = side_table(mu, prior, 0.05)
    assert sides.prior.sum() == pytest.approx(1.0)
    assert sides.prior[NODES:].sum() == pytest.approx(0.05)
    assert sides.share.sum(axis=2) == pytest.approx(1.0)
    pairs = {tuple(pair) for pair in sides.mu[NODES:].round(6)}
    assert pairs == {(right, left) for left, right in pairs}
    out = np.empty(NODES)
    for share in sides.share:
        project_weights(sides.prior, share, out)
        assert out.sum() == pytest.approx(1.0)
