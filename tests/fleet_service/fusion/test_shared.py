"""Tests of errors that all vehicles in one cell have in common. Reports from the same manoeuvre
share such an error, so many of them must not reduce the estimated uncertainty. Reports from
different manoeuvres must reduce it.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_service.fusion import Fusion, constants, shared
from fleet_service.fusion.store.records import NONE, ManoeuvreKind
from schemas import mugrid
from tests.fleet_service.examples import belief, interval, observations, value

_rising = (
    st.lists(st.floats(0.0, 1.0), min_size=32, max_size=32)
    .map(np.sort)
    .filter(lambda p: p.sum() > 0.1)
)


@pytest.mark.parametrize("used", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("stated", [0.0, 0.2])
def test_kernel_rows_are_probabilities_and_keep_the_prior(used: float, stated: float) -> None:
    kernel = shared.shared_kernel(used, 1.0, stated)
    np.testing.assert_allclose(kernel.sum(axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(kernel @ mugrid.PRIOR, mugrid.PRIOR, atol=1e-15)


@given(_rising)
def test_shared_bounds_never_lower_the_upper_end_of_a_rising_belief(p: np.ndarray) -> None:
    road = shared.base_kernel() @ p
    assert np.diff(road).min() >= -1e-12
    assert mugrid.quantiles(road / road.sum(), 0.95) >= mugrid.quantiles(mugrid.PRIOR, 0.95) - 1e-9


def width(used: float, manoeuvres: np.ndarray, mu: float = 0.6) -> float:
    """Return the width [1] of a cell's 90 % interval of friction after thirty reports. Each reports
    the friction `mu` and the used grip `used`; `manoeuvres` are the manoeuvres in which the
    vehicles measured.
    """
    fusion = Fusion(120.0)
    n = len(manoeuvres)
    o = observations(np.arange(n) * 1.0, np.arange(n), value(np.full(n, mu)))
    o = dataclasses.replace(
        o, used=np.full(n, used, np.float32), manoeuvre=manoeuvres.astype(np.int8)
    )
    fusion.update(o)
    lower, upper = interval(belief(fusion))
    return upper - lower


def test_certainty_grows_with_manoeuvres_not_with_equal_vehicles() -> None:
    same = np.full(30, ManoeuvreKind.BRAKING)
    mixed = np.arange(30) % 4
    spread = np.hypot(constants.COMMON_ALWAYS, constants.COMMON_MANOEUVRE) * 0.6
    assert width(0.6, same) > 3.0 * spread
    assert width(0.6, mixed) < 0.95 * width(0.6, same)
    assert width(0.2, same) > 1.2 * width(0.6, same)


def test_unknown_manoeuvre_counts_as_the_same_as_all_others() -> None:
    same = np.full(30, ManoeuvreKind.BRAKING)
    unknown = np.where(np.arange(30) % 2, NONE, ManoeuvreKind.BRAKING)
    assert width(0.6, unknown) == pytest.approx(width(0.6, same), abs=1e-3)


def test_manoeuvre_is_the_larger_part_of_the_grip_used() -> None:
    along = np.array([0.5, -0.5, 0.1, 0.1, np.nan])
    across = np.array([0.1, 0.1, 0.5, -0.5, 0.5])
    expected = [
        ManoeuvreKind.DRIVING,
        ManoeuvreKind.BRAKING,
        ManoeuvreKind.LEFT,
        ManoeuvreKind.RIGHT,
        NONE,
    ]
    assert shared.manoeuvre_of(along, across).tolist() == expected
