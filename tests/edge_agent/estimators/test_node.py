"""Tests that compare parts of a node (filter of one friction hypothesis) with textbook formulas:
sequential update and tyre curve.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from edge_agent.dynamics.tyres import magic_formula
from edge_agent.estimators.friction_mixture.node.node_filter import slip_noise_correction, take_rows
from edge_agent.estimators.friction_mixture.state.constants import (
    ACTIVE,
    NODES,
    ROWS,
    STATES,
    Constants,
)
from edge_agent.estimators.friction_mixture.state.friction_grid import node_table
from edge_agent.estimators.friction_mixture.state.split_sides import project_weights, side_table
from edge_agent.estimators.friction_mixture.state.tyre_curve import (
    curve_tables,
    magic_formulas,
    ratio_at,
    theta_at,
)
from edge_agent.estimators.friction_mixture.state.workspace import NodeWorkspace
from schemas.runtime.records import records

SEEDS = (0, 1, 2)


def covariance(seed: int) -> np.ndarray:
    factor = np.random.default_rng(seed).normal(size=(STATES, STATES))
    return np.asarray(factor @ factor.T + 0.1 * np.eye(STATES))


@pytest.mark.parametrize("missing", [(), (1,), (0, 4)])
@pytest.mark.parametrize("seed", SEEDS)
def test_rows_taken_in_one_by_one_are_the_textbook_s_update(
    seed: int, missing: tuple[int, ...]
) -> None:
    rng = np.random.default_rng(seed)
    before = np.linalg.cholesky(covariance(seed))
    mean = rng.normal(size=STATES)
    node = records(NodeWorkspace, 1)[0]
    # deviations that only the first ACTIVE axes of the factor see: rows = H*x with H = A*L^-1
    node["deviation"] = rng.normal(size=(ROWS, ACTIVE))
    node["residual"], node["inflated"] = rng.normal(size=ROWS), rng.uniform(0.1, 1.0, ROWS)
    a, v, r = (
        np.delete(node[name], missing, axis=0) for name in ("deviation", "residual", "inflated")
    )
    node["residual"][list(missing)] = np.nan
    spread = a @ a.T + np.diag(r)
    cross = before[:, :ACTIVE] @ a.T
    expected = mean + cross @ np.linalg.solve(spread, v)
    left = before @ before.T - cross @ np.linalg.solve(spread, cross.T)
    root = before.copy()
    loss, used = take_rows(mean, root, node, 0.0)
    assert used == ROWS - len(missing)
    assert mean == pytest.approx(expected, abs=1e-9)
    assert root @ root.T == pytest.approx(left, abs=1e-9)
    assert loss == pytest.approx(0.5 * v @ np.linalg.solve(spread, v), abs=1e-9)


def test_the_tables_are_the_magic_formula_and_its_inverse() -> None:
    c = Constants().curve_c
    e = Constants().curve_e
    curve = curve_tables(partial(magic_formulas, c=c, e=e))
    for theta in (0.01, 0.3, 1.0, 1.7, 4.0, 30.0, 900.0):
        assert ratio_at(curve, theta) * theta == pytest.approx(magic_formula(theta, c, e), abs=5e-4)
    for force in (0.05, 0.5, 0.9, 0.99):
        assert magic_formula(theta_at(curve, force), c, e) == pytest.approx(force, abs=1e-4)
    assert np.isinf(theta_at(curve, 1.0))


def test_slip_beyond_the_table_gives_the_sliding_force() -> None:
    curve = curve_tables(partial(magic_formulas, c=1.45, e=-0.1))
    assert ratio_at(curve, 1e4) * 1e4 == pytest.approx(magic_formula(1e4, 1.45, -0.1), abs=2e-3)


@pytest.mark.parametrize("slope", [0.0, 0.3, 1.0])
def test_residual_noise_equals_that_of_slip_and_force_about_a_line(
    slope: float,
) -> None:
    rng = np.random.default_rng(0)
    slip = rng.normal(0.0, 0.03, 100_000)
    force = rng.normal(0.0, 0.01, 100_000)
    distance = (force - slope * slip) / np.hypot(1.0, slope)
    felt = (0.5 - slip_noise_correction(slope)) * 0.03**2 + 0.01**2 / (1.0 + slope**2)
    assert distance.var() == pytest.approx(felt, rel=0.02)


def test_two_split_nodes_share_a_friction_that_lies_between_them() -> None:
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
