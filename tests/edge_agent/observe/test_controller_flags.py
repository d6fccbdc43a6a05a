"""Tests of the flags of slip controllers (ABS and others). Implausible flags must be set to
unknown, and others must be passed on unchanged.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from edge_agent.observe.controller_flags import (
    OFF_S,
    STANDING_S,
    doubted_flags,
    new_flag_records,
    trusted_context,
)
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, CONTEXT, FLAGS, C, S

RATE = 100


def drive(
    on: FloatArray, omega: FloatArray | float = 50.0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return times (T, 1) [s], signals (T, 1, 18) and context signals (controllers, surroundings)
    of one car whose ABS flag is `on` (T,).
    """
    t = np.arange(len(on))[:, None] / RATE
    signals = np.full((len(on), 1, len(CHANNELS)), np.nan)
    signals[..., S.OMEGA : S.OMEGA + 4] = np.broadcast_to(omega, len(on))[:, None, None]
    context = np.full((len(on), 1, len(CONTEXT)), np.nan)
    context[:, 0, C.ABS] = on
    context[:, 0, C.AIR_TEMPERATURE] = -2.0
    return t, signals, context


def seconds(*parts: tuple[float, float]) -> FloatArray:
    """Return the values (T,) of a controller flag over time, computed from pairs (duration [s],
    value): the flag has each value for this duration.
    """
    return np.concatenate([np.full(round(length * RATE), value) for length, value in parts])


def test_context_has_the_flags_first() -> None:
    assert CONTEXT[: len(FLAGS)] == FLAGS
    assert [int(c) for c in (C.ABS, C.ESC, C.TCS)] == [0, 1, 2]


def test_interventions_of_a_winter_drive_are_passed_on_as_they_are() -> None:
    on = seconds(
        (30.0, 0.0), (2.0, 1.0), (20.0, 0.0), (25.0, 1.0), (60.0, 0.0), (4.0, 1.0), (5.0, 0.0)
    )
    given = drive(on)
    records, found = trusted_context(new_flag_records(1), *given)
    assert np.array_equal(found, given[2], equal_nan=True)
    assert doubted_flags(records) == []


def test_a_flag_that_never_was_off_is_unknown() -> None:
    records, found = trusted_context(new_flag_records(1), *drive(np.ones(20 * RATE)))
    assert np.isnan(found[..., C.ABS]).all()
    assert (found[..., C.AIR_TEMPERATURE] == -2.0).all()
    assert doubted_flags(records) == [(0, "abs_active", "has been on since the start")]
    on = seconds((5.0, 1.0), (OFF_S + 0.1, 0.0), (2.0, 1.0))
    _, found = trusted_context(new_flag_records(1), *drive(on))
    assert (found[-RATE:, 0, C.ABS] == 1.0).all(), "it can be off after all"


def test_a_flag_that_sticks_is_unknown_until_it_is_seldom_on_again() -> None:
    on = seconds((60.0, 0.0), (100.0, 1.0), (600.0, 0.0), (2.0, 1.0))
    records, found = trusted_context(new_flag_records(1), *drive(on))
    stuck = found[60 * RATE : 160 * RATE, 0, C.ABS]
    first = int(np.flatnonzero(np.isnan(stuck))[0]) / RATE
    assert first == pytest.approx(30.0, abs=2.0)
    assert np.isnan(stuck[round(first * RATE) :]).all()
    assert (found[-2 * RATE :, 0, C.ABS] == 1.0).all()
    assert doubted_flags(records) == []


def test_a_flag_on_while_the_car_stands_is_unknown_until_it_was_off() -> None:
    on = seconds((5.0, 0.0), (10.0, 1.0), (5.0, 1.0), (2.0, 0.0), (1.0, 1.0))
    omega = seconds((5.0, 50.0), (10.0, 0.0), (8.0, 50.0))
    records, found = trusted_context(new_flag_records(1), *drive(on, omega))
    flag = found[:, 0, C.ABS]
    assert (flag[5 * RATE : round((5.0 + STANDING_S - 0.1) * RATE)] == 1.0).all(), (
        "locked wheels look like this at first"
    )
    assert np.isnan(flag[round((5.0 + STANDING_S + 0.1) * RATE) : 20 * RATE]).all()
    assert (flag[-RATE:] == 1.0).all()
    assert doubted_flags(records) == []


@pytest.mark.parametrize("seed", range(3))
def test_any_split_of_the_samples_gives_the_same_flags(seed: int) -> None:
    rng = np.random.default_rng(seed)
    on = np.repeat(rng.choice([0.0, 1.0, np.nan], 60, p=[0.3, 0.6, 0.1]), RATE)
    t, signals, context = drive(on, np.repeat(rng.choice([0.0, 40.0], 60), RATE))
    _, whole = trusted_context(new_flag_records(1), t, signals, context)
    cuts = [0, *np.sort(rng.choice(np.arange(1, len(on)), 9, replace=False)).tolist(), len(on)]
    records = new_flag_records(1)
    parts = []
    for a, b in pairwise(cuts):
        records, part = trusted_context(records, t[a:b], signals[a:b], context[a:b])
        parts.append(part)
    assert np.array_equal(np.concatenate(parts), whole, equal_nan=True)
    assert np.isnan(whole[..., C.ABS]).sum() > np.isnan(on).sum()
