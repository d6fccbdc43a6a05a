"""Test of a cell's basis (kind of evidence). The basis of a cell that is probably slippery must
never be "only a lower bound of friction".
"""

from __future__ import annotations

import numpy as np
import pytest

from fleet_service.fusion.belief import PRIOR, quantiles
from fleet_service.serve.encode import batch_of
from fleet_service.serve.view import LOWER, UPPER, CellView, is_measured
from schemas import mugrid
from schemas.numeric import FloatArray
from tests.fleet_service.examples import CELL, START


def belief_around(mu: float, std: float) -> FloatArray:
    shape = np.exp(-0.5 * ((mugrid.CENTRES - mu) / std) ** 2)
    return np.asarray(shape / shape.sum())


def make_view(belief: FloatArray, values: float) -> CellView:
    one = np.ones(1, np.int64)
    return CellView(
        one * CELL,
        one * 2,
        belief[None],
        np.array([values], np.float32),
        one * 9,
        one * 20,
        one * START,
        one * START,
        np.zeros(1, bool),
    )


@pytest.mark.parametrize("mu", [0.15, 0.2, 0.3])
def test_a_slippery_belief_without_values_of_its_own_is_measured(mu: float) -> None:
    row = batch_of(make_view(belief_around(mu, 0.05), 0.0), START + 1).to_pylist()[0]
    assert row["p_slippery"] > 0.5
    assert row["basis"] == "measured"
    assert row["mu"] is not None


def test_a_belief_that_is_probably_not_slippery_stays_a_bound() -> None:
    passed = np.where(mugrid.CENTRES > 0.3, PRIOR, 0.0)
    row = batch_of(make_view(passed / passed.sum(), 0.0), START + 1).to_pylist()[0]
    assert row["basis"] == "bound"
    assert row["mu"] is None


def test_known_slippery_is_measured_over_all_beliefs() -> None:
    rng = np.random.default_rng(5)
    beliefs = rng.dirichlet(np.full(len(mugrid.CENTRES), 0.1), 2000)
    lower, upper = quantiles(beliefs, (LOWER, UPPER))
    slippery = beliefs @ mugrid.SLIPPERY_SHARE
    found = is_measured(lower, upper, np.zeros(len(beliefs), np.float32), slippery)
    assert (found == (slippery > 0.5)).all()
    assert 0 < found.sum() < len(beliefs)
