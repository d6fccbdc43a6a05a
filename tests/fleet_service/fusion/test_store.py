"""Tests of the memory of a fusion (beliefs about all cells). Its hash tables must find every stored
key, whatever their length, and rows that are no longer used must become free.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_service.fusion import Fusion
from fleet_service.fusion.store import store
from fleet_service.fusion.store.growth import settle_pairs
from fleet_service.fusion.store.records import (
    ENTRY,
    NONE,
    PAIRS,
    REPORTERS_USED,
    VEHICLE,
    Side,
)
from fleet_service.fusion.store.settled import remove_settling_pairs
from fleet_service.fusion.store.table import LEAST, PLACES_MOST, fill_table, pair_place, rows_of
from schemas import mugrid
from schemas.numeric import FloatArray
from tests.fleet_service.examples import CELL, SECOND, START, at_least, belief, observations, value
from tests.fleet_service.fusion.test_order import delay_arrivals, drive

LATENESS_S = 120.0
HOUR = 3600.0


@pytest.mark.parametrize("places", [1024, 1500, 2047])
def test_a_table_of_any_length_finds_every_row_and_no_other(places: int) -> None:
    keys = np.unique(np.random.default_rng(places).integers(0, 1 << 40, 1000))
    rows = np.zeros(len(keys), VEHICLE)
    rows["key"] = keys
    table = np.full(places, NONE, np.int64)
    fill_table(table, rows, len(rows))
    np.testing.assert_array_equal(rows_of(table, rows, keys), np.arange(len(keys)))
    absent = np.setdiff1d(keys + 1, keys)
    assert (rows_of(table, rows, absent) == NONE).all()


def test_pairs_keep_their_share_and_are_found_after_every_growth() -> None:
    fusion = Fusion(LATENESS_S)
    vehicles = 3000
    for step in range(3):
        fusion.update(
            observations(
                [10.0 * step + 0.001 * k for k in range(vehicles)],
                np.arange(vehicles),
                at_least([0.3] * vehicles),
            )
        )
    state = fusion.store.state
    assert state.used[PAIRS] == vehicles <= PLACES_MOST * len(state.pairs)
    assert fusion.live.vehicles[0] == vehicles
    assert fusion.live.visits[0] == 3 * vehicles


@pytest.mark.parametrize("seed", range(20))
def test_pairs_that_stay_are_found_after_others_settle(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(PLACES_MOST * LEAST)
    known = rng.permutation(50 * count)[:count]
    entries = np.zeros(count, ENTRY)
    entries["before"] = NONE
    state = Fusion(LATENESS_S).store.state._replace(entries=entries)
    waits = rng.random(count) < 0.5
    for row, (slot, vehicle) in enumerate(zip(known // count, known % count, strict=True)):
        place = pair_place(state.pairs, slot, vehicle)
        state.pairs[place]["slot"] = slot
        state.pairs[place]["vehicle"] = vehicle
        state.pairs[place]["last"] = row if waits[row] else NONE
        entries[row]["pair"] = place
    state.used[PAIRS] = count
    settling = remove_settling_pairs(state, np.zeros(count, VEHICLE), 50, 1)
    settled = settling.records[settling.order]
    np.testing.assert_array_equal(
        np.int64(settled["slot"]) * count + settled["vehicle"], np.sort(known[~waits])
    )
    assert state.used[PAIRS] == waits.sum() == (state.pairs["slot"] != NONE).sum()
    for row in np.flatnonzero(waits).tolist():
        place = pair_place(state.pairs, known[row] // count, known[row] % count)
        assert state.pairs[place]["last"] == row
        assert entries[row]["pair"] == place


def test_reporters_and_sources_of_hours_ago_are_dropped_and_reused() -> None:
    fusion = Fusion(LATENESS_S)
    cells = CELL + np.arange(40)
    fusion.update(observations(np.arange(40.0), np.arange(40), value([0.2] * 40), cells))
    slots = fusion.slots_of(cells, np.zeros(40, np.int64))
    assert (fusion.sources(slots, Side.ICE, START - 1) > 0).sum(axis=1).tolist() == [1] * 40
    fusion.update(observations([4 * HOUR], [1], value([0.8]), CELL))
    # Only the reporter in the time window has a record.
    assert fusion.store.state.used[REPORTERS_USED] == 1
    before = belief(fusion, CELL + 7)
    fusion.update(
        observations([4 * HOUR + 10.0, 4 * HOUR + 20.0], [50, 51], value([0.8, 0.8]), CELL + 7)
    )
    assert fusion.store.state.used[REPORTERS_USED] == 2
    assert (fusion.sources(slots[7:8], Side.GRIP, START - 1) > 0).sum() == 2
    assert (fusion.sources(slots[8:9], Side.GRIP, START - 1) > 0).sum() == 0
    assert not np.allclose(belief(fusion, CELL + 7), before)


def test_old_cells_back_at_the_prior_are_dropped_without_other_effect() -> None:
    """A fusion (beliefs about all cells) may drop cells that are unused and back at the prior. It
    must then compute the same results from later observations as a fusion that dropped none.
    """
    fusion = Fusion(LATENESS_S)
    whole = Fusion(LATENESS_S)
    cells = CELL + np.arange(40)
    week = 7 * 24 * HOUR
    visits = [
        observations(np.arange(40.0), np.arange(40), value([0.2] * 40), cells),
        observations(week + np.arange(10.0), np.arange(10), value([0.7] * 10), cells[:10]),
        observations(week + HOUR * np.arange(1.0, 6.0), [1] * 5, value([0.7] * 5), cells[5:10]),
    ]
    for one in visits:
        fusion.update(one)
        whole.update(one)
    now = START + int(week * 1e9)
    gone = fusion.untouched(now - SECOND)
    np.testing.assert_array_equal(np.flatnonzero(gone), np.arange(10, 40))
    prior = fusion.beliefs(np.flatnonzero(gone), now)
    np.testing.assert_allclose(prior, np.tile(mugrid.PRIOR, (30, 1)), atol=1e-4)
    place = fusion.drop(gone)
    np.testing.assert_array_equal(place, [*range(10), *[NONE] * 30])
    assert fusion.size == 10
    assert (fusion.slots_of(cells[10:], np.zeros(30, np.int64)) == NONE).all()
    after = observations(
        week + 6 * HOUR + np.arange(20.0), np.arange(20), value([0.3] * 20), cells[:20]
    )
    for other in (fusion, whole):
        other.update(after)
    for cell in cells[:10].tolist():
        np.testing.assert_allclose(belief(fusion, cell), belief(whole, cell), atol=1e-12)
    for cell in cells[10:20].tolist():
        # A cell at rest stores 16 bits per bin.
        np.testing.assert_allclose(belief(fusion, cell), belief(whole, cell), atol=1e-3)
    assert fusion.live.vehicles[: fusion.size].max() < 40


def count_pairs_after(evidence: FloatArray, hours: float) -> tuple[int, int]:
    """Let vehicle 1 visit a cell once, while vehicle 2 drives elsewhere. Return the number of pairs
    (vehicle and cell) remembered for the cell after `hours`. Return also the number of vehicles
    counted in the cell after a second visit of vehicle 1.
    """
    fusion = Fusion(LATENESS_S)
    fusion.update(observations([0.0], [1], evidence, CELL))
    times = np.arange(60.0, hours * HOUR, 60.0)
    for time in times.tolist():
        fusion.update(observations([time], [2], at_least([0.3]), CELL + 1))
    slot = fusion.slots_of(np.array([CELL]), np.array([0]))[0]
    active = fusion.store.state.pairs["slot"] == slot
    settled = np.diff(fusion.store.state.settled_begin[:, 0])[slot]
    found = int(active.sum() + settled)
    fusion.update(observations([hours * HOUR], [1], evidence, CELL))
    return found, int(fusion.live.vehicles[0])


@pytest.mark.parametrize(
    ("evidence", "kept_h", "gone_h"),
    [(at_least([0.5]), 1.0, 1.4), (value([0.5]), 3.0, 3.4)],
    ids=["bound", "value"],
)
def test_bounds_are_remembered_for_an_hour_and_values_for_three(
    evidence: FloatArray, kept_h: float, gone_h: float
) -> None:
    assert count_pairs_after(evidence, kept_h) == (1, 1)
    assert count_pairs_after(evidence, gone_h) == (0, 1), "forgotten, and not counted twice"


def repeat_after_settling(evidence: FloatArray, *, forgets: bool) -> Fusion:
    """Let 300 vehicles pass a cell, and vehicle 0 repeat its report 40 minutes later. Return the
    fusion (beliefs about all cells). A settled pair is a compact record of one vehicle's earlier
    reports in a cell. If `forgets`, all settled pairs are deleted before the repetition.
    """
    fusion = Fusion(LATENESS_S)
    fusion.update(observations(0.1 * np.arange(300), np.arange(300), evidence.repeat(300, 0), CELL))
    fusion.update(observations([1200.0], [500], at_least([0.3]), CELL + 1))
    assert len(fusion.store.state.settled) == 300
    assert fusion.store.state.used[PAIRS] == 1
    if forgets:
        fusion.store.state.settled_begin[:] = 0
    fusion.update(observations([2400.0], [0], evidence, CELL))
    return fusion


@pytest.mark.parametrize("evidence", [at_least([0.5]), value([0.5])], ids=["bound", "value"])
def test_a_vehicle_with_a_settled_pair_stays_one_witness(evidence: FloatArray) -> None:
    fusion = repeat_after_settling(evidence, forgets=False)
    control = repeat_after_settling(evidence, forgets=True)
    assert fusion.live.vehicles[0] == 300
    assert control.live.vehicles[0] == 301
    power, whole = (
        float(f.store.state.entries["power"][f.store.state.windows["tail"][f.live.window[0]]])
        for f in (fusion, control)
    )
    assert power == pytest.approx(1.0 - np.exp(-2400.0 / 3600.0), abs=1e-3)
    assert whole == 1.0


@settings(max_examples=10)
@given(st.integers(0, 10**6), st.integers(1, 400))
def test_settling_has_no_effect_on_any_cell_in_any_order(seed: int, parts: int) -> None:
    """A pair (vehicle and cell) settles when it moves into a compact table. In one fusion pairs
    settle after each batch, in the other never. All cells must have the same belief in both.
    """
    o = drive(seed, 1500, 3000.0)
    straight = Fusion(LATENESS_S)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store, "settle_pairs", lambda state, *_: state)
        straight.update(o)
    assert not len(straight.store.state.settled)
    mixed = Fusion(LATENESS_S)
    for rows in np.array_split(delay_arrivals(o, 110.0, seed), parts):
        mixed.update(o.take(rows))
        kept = mixed.store
        if kept.forgotten_at:
            kept.state = settle_pairs(kept.state, kept.names, mixed.size, kept.forgotten_at)
    assert len(mixed.store.state.settled) > 50
    slots = mixed.slots_of(straight.cell[: straight.size], straight.sector[: straight.size])
    for name in ("belief", "visits", "vehicles", "values", "untrusted"):
        np.testing.assert_array_equal(
            getattr(straight.live, name)[: straight.size], getattr(mixed.live, name)[slots]
        )


def test_pairs_that_never_meet_take_a_few_bytes() -> None:
    fusion = Fusion(LATENESS_S)
    vehicles = 20_000
    evidence = at_least([0.3] * vehicles)
    evidence[::7] = value([0.7])
    fusion.update(observations(np.linspace(0.0, 60.0, vehicles), np.arange(vehicles), evidence))
    fusion.update(observations([1200.0], [vehicles], at_least([0.3])))
    state = fusion.store.state
    arrays = (state.settled, state.settled_keys, state.settled_std)
    assert state.used[PAIRS] == 1
    assert len(state.settled) == vehicles
    assert sum(array.nbytes for array in arrays) <= 10.3 * vehicles


def test_a_vehicle_that_repeats_its_bound_within_the_hour_adds_little() -> None:
    once, often, others = (Fusion(LATENESS_S) for _ in range(3))
    once.update(observations([0.0], [1], at_least([0.6]), CELL))
    for k in range(6):
        often.update(observations([60.0 * k], [1], at_least([0.6]), CELL))
        others.update(observations([60.0 * k], [k], at_least([0.6]), CELL))
    now = START + int(HOUR * 1e9)
    low = [belief(fusion, now=now)[mugrid.CENTRES < 0.5].sum() for fusion in (once, often, others)]
    assert low[2] < low[1] <= low[0]
    assert low[0] - low[1] < 0.25 * (low[0] - low[2])
