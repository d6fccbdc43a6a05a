"""Tests of mathematical identities of the friction mixture (grid of friction hypotheses). The prior
must be uniform up to the friction of common tyres, and a road change must conserve probability. The
likelihood that a visit (passage of a map cell) reports must equal the likelihood that entered the
filter.
"""

from __future__ import annotations

import inspect
import re
from itertools import pairwise

import numpy as np
import pytest

from edge_agent.estimators.friction_mixture.state.constants import NODES, Constants
from edge_agent.estimators.friction_mixture.state.friction_grid import (
    RoadChange,
    change_road,
    friction_prior,
    multiply_likelihood,
    node_table,
    quantile,
    visit_evidence,
)
from schemas.mugrid import CENTRES

MU, WIDTH = node_table(NODES)
PRIOR = friction_prior(MU, WIDTH, Constants().physical.common_mu)


def test_widths_of_nodes_are_uniform_in_mu() -> None:
    assert WIDTH.sum() == pytest.approx(1.0)
    for q in (0.05, 0.5, 0.95):
        assert quantile(MU, WIDTH, WIDTH, q) == pytest.approx(0.05 + 1.15 * q, abs=1e-9)


def test_prior_falls_above_the_common_friction() -> None:
    prior_density = PRIOR / WIDTH
    is_common = Constants().physical.common_mu > MU
    assert PRIOR.sum() == pytest.approx(1.0)
    assert prior_density[is_common] == pytest.approx(prior_density[0])
    assert (np.diff(prior_density[~is_common]) < 0.0).all()
    assert prior_density[-1] > 0.1 * prior_density[0]
    assert prior_density[~is_common].max() < 0.8 * prior_density[0]


def test_road_change_leaves_the_prior_as_it_is() -> None:
    out = np.empty(NODES)
    change_road(PRIOR, PRIOR, NODES, RoadChange(0.1, 0.3), out)
    assert out == pytest.approx(PRIOR, abs=1e-12)


def test_road_change_keeps_the_mass_and_converges_to_the_prior() -> None:
    w = np.zeros(NODES)
    w[3] = 1.0
    out = np.empty(NODES)
    for _ in range(400):
        change_road(w, PRIOR, NODES, RoadChange(0.02, 0.05), out)
        w[:] = out
        assert w.sum() == pytest.approx(1.0)
    assert w == pytest.approx(PRIOR, abs=1e-3)


def test_evidence_is_the_likelihood_that_was_put_in() -> None:
    w = PRIOR.copy()
    log_likelihood = -((MU - 0.6) ** 2) / 0.02
    multiply_likelihood(w, log_likelihood - log_likelihood.max())
    out = np.empty(len(CENTRES))
    visit_evidence(MU, PRIOR, w, CENTRES, out)
    inner = (CENTRES > 0.3) & (CENTRES < 0.9)
    expected = -((CENTRES - 0.6) ** 2) / 0.02
    assert out.max() == 0.0
    assert np.abs((out - out[inner].max()) - (expected - expected[inner].max()))[inner].max() < 0.2


def test_every_constant_has_its_unit_and_its_reason_above_it() -> None:
    # Join comments of several lines.
    groups = "".join(inspect.getsource(type(group)) for group in Constants())
    source = re.sub(r"\n +# (?!\[)", " ", groups)
    lines = [line.strip() for line in source.splitlines()]
    found = {line.split(":")[0]: above for above, line in pairwise(lines) if ": float = " in line}
    assert list(found) == list(Constants().by_name())
    for name, above in found.items():
        assert re.fullmatch(r"# \[[^]]+\] \S.{5,}", above), name


def test_replaced_constants_keep_the_others_and_refuse_unknown_names() -> None:
    usual = Constants()
    changed = usual.replace_values(hazard=0.5, window=2.0)
    assert {n for n, v in changed.by_name().items() if v != usual.by_name()[n]} == {
        "hazard",
        "window",
    }
    with pytest.raises(KeyError, match="hazards"):
        usual.replace_values(hazards=0.5)
