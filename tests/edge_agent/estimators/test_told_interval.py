"""Tests of the reported interval of friction. Its ends must be the intended quantiles of the
belief. A possible ice patch must lower only the lower end.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.estimators.friction_mixture.block.grip_guard import lower_while_sliding
from edge_agent.estimators.friction_mixture.report.reported_interval import (
    LOWER_END,
    NEARER,
    UPPER_END,
    find_interval,
)
from edge_agent.estimators.friction_mixture.state.constants import PATCH_NODES
from edge_agent.estimators.friction_mixture.state.design import design_of
from edge_agent.estimators.friction_mixture.state.friction_grid import probability_below, quantile
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from edge_agent.estimators.friction_mixture.state.workspace import MixtureContext
from schemas.mugrid import LOWER, UPPER
from schemas.numeric import FloatArray
from schemas.runtime.jit import nogil
from schemas.runtime.records import Records, put_record, records
from schemas.thresholds import SLIPPERY_MU

DESIGN = design_of(Memberships(), adaptive=True)


@nogil
def _tell(
    contexts: Records[MixtureContext],
    filters: Records[MixtureMemory],
    weight: FloatArray,
    patch: FloatArray,
    likeness: float,
) -> tuple[float, float, float]:
    context = contexts[0]
    friction = filters[0].friction
    find_interval(context.design, weight, patch, context.scratch.blended, likeness, friction)
    return friction.lower, friction.median, friction.upper


def find_told_interval(
    weight: FloatArray, patch: float = 0.0, likeness: float = 0.0
) -> tuple[float, float, float]:
    """Return lower end, median and upper end of the interval reported for a belief.

    Args:
        weight: probabilities of the nodes (friction hypotheses).
        patch: probability of an ice patch.
        likeness: degree (0 to 1) to which the car agrees with its vehicle file.
    """
    contexts = records(MixtureContext, 1)
    put_record(contexts["design"][0], DESIGN)
    return _tell(
        contexts,
        records(MixtureMemory, 1),
        weight,
        np.full(PATCH_NODES, patch / PATCH_NODES),
        likeness,
    )


def weights_around(mu: float, width: float) -> FloatArray:
    """Return the probabilities (nodes,) of the friction hypotheses as a bell curve of width `width`
    around the friction `mu`.
    """
    weight = DESIGN.prior * np.exp(-0.5 * ((DESIGN.mu - mu) / width) ** 2)
    return np.asarray(weight / weight.sum())


def test_filter_without_evidence_reports_the_prior() -> None:
    lower, median, upper = find_told_interval(DESIGN.prior)
    expected = [prior_quantile(level) for level in (LOWER_END, 0.5, UPPER_END)]
    assert [lower, median, upper] == pytest.approx(expected, abs=0.01)


def prior_quantile(level: float) -> float:
    """Return the quantile of the prior: uniform from .05 to `common_mu`, then falling linearly to 0
    at 1.2.
    """
    common_mu = DESIGN.constants.physical.common_mu
    tail_mass = 0.5 * (UPPER - common_mu)
    mass_above = (1.0 - level) * (common_mu - LOWER + tail_mass)
    if mass_above <= tail_mass:
        return UPPER - float(np.sqrt(2.0 * mass_above * (UPPER - common_mu)))
    return common_mu + tail_mass - mass_above


@pytest.mark.parametrize("mu", [0.15, 0.3, 0.5, 0.8])
def test_correct_vehicle_file_lowers_only_the_upper_end(
    mu: float,
) -> None:
    weight = weights_around(mu, 0.1)
    usual_interval = find_told_interval(weight)
    nearer_interval = find_told_interval(weight, likeness=0.7)
    assert nearer_interval[:2] == usual_interval[:2]
    assert nearer_interval[2] <= usual_interval[2] - (0.02 if mu > 0.4 else 0.0)
    assert find_told_interval(DESIGN.prior, likeness=1.0) == find_told_interval(DESIGN.prior)


@pytest.mark.parametrize(("likeness", "level"), [(0.0, UPPER_END), (1.0, UPPER_END - NEARER)])
def test_upper_end_of_much_evidence_is_its_quantile(likeness: float, level: float) -> None:
    weight = weights_around(0.8, 0.1)
    upper = find_told_interval(weight, likeness=likeness)[2]
    assert upper == pytest.approx(quantile(DESIGN.mu, DESIGN.width, weight, level), abs=2e-3)


def test_a_long_upper_tail_is_not_cut_off() -> None:
    weight = 0.85 * weights_around(0.35, 0.05) + 0.15 * weights_around(0.9, 0.05)
    widest_end = quantile(DESIGN.mu, DESIGN.width, weight, UPPER_END)
    upper = find_told_interval(weight, likeness=1.0)[2]
    assert upper == pytest.approx(widest_end - NEARER, abs=1e-3)


@pytest.mark.parametrize("mu", [0.1, 0.2, 0.3, 0.38, 0.42, 0.6])
def test_slippery_probability_agrees_with_the_quantiles(mu: float) -> None:
    weight = weights_around(mu, 0.08)
    below = probability_below(DESIGN.mu, DESIGN.width, weight, SLIPPERY_MU)
    assert quantile(DESIGN.mu, DESIGN.width, weight, below) == pytest.approx(SLIPPERY_MU, abs=1e-6)


def test_no_value_of_the_upper_end_is_preferred() -> None:
    upper_ends = np.array(
        [find_told_interval(weights_around(mu, 0.08))[2] for mu in np.linspace(0.1, 0.4, 31)]
    )
    assert (np.diff(upper_ends) > 0.0).all()


@pytest.mark.parametrize(("mu", "level"), [(0.15, 0.5 * LOWER_END), (0.8, LOWER_END)])
def test_lower_end_is_lower_on_a_slippery_road(mu: float, level: float) -> None:
    weight = weights_around(mu, 0.05)
    lower, _, _ = find_told_interval(weight)
    assert lower == pytest.approx(quantile(DESIGN.mu, DESIGN.width, weight, level), abs=1e-3)


def test_a_patch_lowers_the_lower_end_alone() -> None:
    lower, median, upper = find_told_interval(weights_around(0.8, 0.1))
    icy, same_median, same_upper = find_told_interval(weights_around(0.8, 0.1), 0.1)
    assert icy < 0.2 < lower
    assert (same_median, same_upper) == (median, upper)


@nogil
def _lower_while_sliding(slides: float, used: float, lower: float) -> float:
    return lower_while_sliding(slides, used, lower, 0.05)


@pytest.mark.parametrize(
    ("slides", "used", "lower", "reported"),
    [
        # The tyre may be at its peak: friction equals the grip in use.
        (1.0, 0.10, 0.15, 0.95 * 0.10),
        (1.0, 0.30, 0.15, 0.15),  # the belief's lower bound is lower already
        (0.0, 0.10, 0.15, 0.15),  # no wheel slides: the grip in use says nothing about the limit
        (0.5, 0.10, 0.15, 0.5 * (0.15 + 0.95 * 0.10)),
    ],
)
def test_lower_end_of_a_sliding_tyre_is_at_most_its_grip_in_use(
    slides: float, used: float, lower: float, reported: float
) -> None:
    assert _lower_while_sliding(slides, used, lower) == pytest.approx(reported)
