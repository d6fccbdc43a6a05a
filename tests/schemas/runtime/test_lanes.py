"""Tests of lanes (numbers side by side in a vector register). Arithmetic on lanes must equal that
on single numbers. Exponential and logarithm must equal those of NumPy.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
import pytest

from schemas.numeric import FloatArray
from schemas.runtime.jit import inlined, nogil
from schemas.runtime.lanes import (
    any_lane,
    exp_lanes,
    floor,
    gather_pair,
    inverse_of,
    inverse_root_of,
    lanes_at,
    largest_lane,
    log_lanes,
    put_lanes,
    select,
    sum_lanes,
)
from schemas.runtime.records import LANES, LaneArray, records

ROWS = 500
# Largest relative error of exponential, inverse and root, and largest error of the logarithm.
EXACT = 5e-16


class LaneRecord:
    """Record with lanes (vectors of numbers) after a field whose size is no multiple of a cache
    line.
    """

    first: float
    pair: Annotated[LaneArray, 2]
    last: bool


@inlined
def mix_operations(a: float, b: float) -> float:
    """Compute a value from `a` and `b` with every operator; both are numbers, or both are lanes
    (vectors of numbers).
    """
    total = 0.0
    for k in range(3):
        total += k * a
    total -= min(a, 0.5) / max(b, 0.25)
    total *= 2 - -b
    near = (a < b) & (a <= 2.0) | (a > 1.5) & (b >= 0.0)
    return select(near, math.sqrt(abs(total)) + floor(a), total - b)


@nogil
def run_lanes(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    for i in range(a.shape[0]):
        put_lanes(out, i, mix_operations(lanes_at(a, i), lanes_at(b, i)))


@nogil
def run_numbers(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    for i in range(a.shape[0]):
        for lane in range(a.shape[1]):
            out[i, lane] = mix_operations(a[i, lane], b[i, lane])


@nogil
def run_functions(x: FloatArray, powers: FloatArray, logs: FloatArray) -> None:
    for i in range(x.shape[0]):
        put_lanes(powers, i, exp_lanes(lanes_at(x, i)))
        put_lanes(logs, i, log_lanes(abs(lanes_at(x, i))))


@nogil
def run_inverses(x: FloatArray, inverses: FloatArray, roots: FloatArray) -> None:
    for i in range(x.shape[0]):
        put_lanes(inverses, i, inverse_of(lanes_at(x, i)))
        put_lanes(roots, i, inverse_root_of(lanes_at(x, i)))


@nogil
def read_table(table: FloatArray, places: FloatArray, out: FloatArray) -> None:
    first, second = gather_pair(table, lanes_at(places, 0))
    put_lanes(out, 0, first)
    put_lanes(out, 1, second)


@nogil
def reduce_lanes(values: FloatArray) -> tuple[float, float, bool, bool]:
    value = lanes_at(values, 0)
    return sum_lanes(value), largest_lane(value), any_lane(value > 6.5), any_lane(value > 8.5)


def numbers(scale: float) -> FloatArray:
    return np.random.default_rng(0).normal(0.0, scale, (ROWS, LANES))


def test_operators_on_lanes_equal_those_on_numbers() -> None:
    a = numbers(2.0)
    b = numbers(1.0)[::-1].copy()
    lanes = np.empty_like(a)
    single = np.empty_like(a)
    run_lanes(a, b, lanes)
    run_numbers(a, b, single)
    assert lanes == pytest.approx(single, rel=1e-14, abs=1e-14)


def test_nan_and_infinity_keep_their_meaning() -> None:
    a = np.array([[math.nan, math.inf, -math.inf, 0.0, 1.0, -1.0, 2.0, 3.0]])
    lanes = np.empty_like(a)
    single = np.empty_like(a)
    run_lanes(a, np.ones_like(a), lanes)
    run_numbers(a, np.ones_like(a), single)
    assert np.array_equal(np.isnan(lanes), np.isnan(single))
    assert np.array_equal(np.isinf(lanes), np.isinf(single))


@pytest.mark.parametrize("scale", [1e-9, 0.1, 1.0, 100.0])
def test_exponential_and_logarithm_are_exact_to_rounding(scale: float) -> None:
    x = numbers(scale)
    powers = np.empty_like(x)
    logs = np.empty_like(x)
    run_functions(x, powers, logs)
    assert np.abs(powers / np.exp(x) - 1.0).max() < EXACT
    expected = np.log(np.abs(x))
    assert (np.abs(logs - expected) / np.maximum(np.abs(expected), 1.0)).max() < EXACT


@pytest.mark.parametrize("scale", [1e-9, 1.0, 100.0])
def test_inverse_and_inverse_root_are_exact_to_rounding(scale: float) -> None:
    x = np.exp(numbers(scale))
    inverses = np.empty_like(x)
    roots = np.empty_like(x)
    run_inverses(x, inverses, roots)
    assert np.abs(inverses * x - 1.0).max() < EXACT
    assert np.abs(roots * np.sqrt(x) - 1.0).max() < EXACT


def test_zero_times_its_inverse_root_is_zero() -> None:
    x = np.zeros((1, LANES))
    roots = np.empty_like(x)
    run_inverses(x, np.empty_like(x), roots)
    assert np.all(x * roots == 0.0)


def test_exponential_ends_at_its_limits() -> None:
    x = np.full((1, LANES), 1e4)
    x[0, ::2] = -math.inf
    powers = np.empty_like(x)
    run_functions(x, powers, np.empty_like(x))
    assert powers[0, 1] == pytest.approx(math.exp(700.0))
    assert 0.0 < powers[0, 0] < 1e-300


def test_lanes_are_read_from_a_table_and_reduced() -> None:
    table = np.arange(20.0) ** 2
    places = np.array([[0.0, 3.0, 18.0, 7.0, 7.0, 1.0, 2.0, 8.0]])
    out = np.empty((2, LANES))
    read_table(table, places, out)
    assert np.array_equal(out[:1], places**2)
    assert np.array_equal(out[1:], (places + 1.0) ** 2)
    assert reduce_lanes(np.arange(1.0, 9.0)[None]) == (36.0, 8.0, True, False)


def test_fields_of_lanes_begin_at_a_cache_line() -> None:
    rows = records(LaneRecord, 3)
    assert rows["pair"].shape == (3, 2, LANES)
    assert [row["pair"].ctypes.data % 64 for row in rows] == [0, 0, 0]
