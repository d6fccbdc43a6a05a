"""Tests of fuzzy sets whose lower vertices (corners of the set) are free parameters. A vertex may
change the output only between its neighbours. Sets that leave values uncovered must be refused.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.adaptation.lower_vertices import FEET, LowerVertices
from schemas.errors import InputError


def test_untuned_sets_give_the_centroid_of_the_set_at_its_peak() -> None:
    sets = LowerVertices()
    _, outputs = sets.triangle_sets()
    for peak, triangle in zip(sets.peaks, outputs, strict=True):
        assert sets.step(peak) == pytest.approx(triangle.mean())


def test_step_rises_with_the_mismatch_and_stays_at_the_ends() -> None:
    sets = LowerVertices()
    at = np.linspace(-0.8, 4.0, 40)
    steps = [sets.step(float(value)) for value in at]
    assert (np.diff(steps) >= -1e-12).all()
    assert sets.step(-0.99) == sets.step(-0.8)
    assert sets.step(50.0) == sets.step(4.0)


def test_a_lower_vertex_changes_the_step_between_two_peaks_alone() -> None:
    wide = LowerVertices(feet=(1.0,) * 5 + (1.6,) + (1.0,) * 2)
    usual = LowerVertices()
    assert wide.step(0.3) != pytest.approx(usual.step(0.3), abs=1e-6)
    assert wide.step(2.5) == pytest.approx(usual.step(2.5))


def test_table_is_the_step_at_its_knots() -> None:
    sets = LowerVertices(feet=(0.7, 0.9) * 4, out_feet=(1.5, 0.4) * 4)
    at, steps = sets.knot_table(48)
    assert at.shape == steps.shape == (48,)
    assert (np.diff(at) >= 0.0).all()
    assert steps == pytest.approx([sets.step(float(value)) for value in at])


def test_vector_is_the_sets_and_a_gap_is_closed() -> None:
    sets = LowerVertices(feet=(0.7, 0.9) * 4, out_feet=(1.5, 0.4) * 4)
    assert LowerVertices.from_vector(sets.to_vector()) == sets
    closed = LowerVertices.from_vector(np.full(2 * FEET, 0.3))
    assert sum(closed.feet[:2]) > 1.0


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"feet": (1.0,) * 7}, "lower_vertices.feet"),
        ({"feet": (0.4,) * FEET}, "lower_vertices.feet"),
        ({"out_feet": (2.5,) * FEET}, "lower_vertices.out_feet"),
        ({"peaks": (0.0,) * 5}, "lower_vertices.peaks"),
    ],
)
def test_sets_with_a_gap_or_out_of_order_are_refused(
    change: dict[str, tuple[float, ...]], field: str
) -> None:
    with pytest.raises(InputError, match=field):
        LowerVertices(**change)
