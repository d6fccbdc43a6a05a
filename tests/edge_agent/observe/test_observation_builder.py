"""Tests of the observation builder. It must make one observation per visit (pass through a cell),
and one state per reporting interval, for any division of the drive into blocks of samples.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest

from edge_agent.inputs.context import context_block
from edge_agent.observe.cell_tracker import NOWHERE, locate_vehicles
from edge_agent.observe.observation_builder import (
    FELT_STD,
    WHEEL_SHARE,
    BlockReadings,
    OpenVisits,
    RecordBlock,
    build_records,
)
from edge_agent.observe.visit_likelihood import weigh_by_use
from schemas import grid, mugrid
from schemas.config import AgentConfig
from schemas.signals import S
from schemas.thresholds import GRAVITY
from schemas.wire import Kind, column_types
from tests.edge_agent.fakes import START_NS, Watch, estimates, ground, part, wanderers

if TYPE_CHECKING:
    from edge_agent.estimators import Estimates


def join_records(records: list[RecordBlock]) -> dict[str, np.ndarray]:
    """Join the records of several blocks of samples, and return their columns by name. The
    additional columns are the vehicle numbers (`vehicle`) and the flags `urgent`.
    """
    columns = {
        name: np.concatenate([r.columns[name] for r in records]) for name in records[0].columns
    }
    whose = {
        name: np.concatenate([getattr(r, name) for r in records]) for name in ("vehicle", "urgent")
    }
    return columns | whose


def test_one_observation_for_each_finished_visit() -> None:
    block = wanderers(400, 5)
    reported = estimates(400, 5)
    located, observations, _ = Watch.of(5).step(block, reported)
    visits = 0
    for n in range(5):
        cells = located.cell[np.flatnonzero(located.closes[:, n]), n]
        visits += np.count_nonzero(cells != NOWHERE) - (located.cell[-1, n] != NOWHERE)
    assert len(observations.vehicle) == visits > 100


@pytest.mark.parametrize("seed", range(5))
def test_any_split_of_the_samples_gives_the_same_records(seed: int) -> None:
    rng = np.random.default_rng(seed)
    block = wanderers(300, 4, seed)
    reported = estimates(300, 4, seed)
    _, *whole = Watch.of(4).step(block, reported)
    cuts = [0, *np.sort(rng.choice(np.arange(1, 300), 12, replace=False)).tolist(), 300]
    watch = Watch.of(4)
    rows = [slice(a, b) for a, b in pairwise(cuts)]
    pieces = [watch.step(part(block, r), reported.part(r))[1:] for r in rows]
    for kind in (0, 1):
        expected = join_records([whole[kind]])
        found = join_records([piece[kind] for piece in pieces])
        for name, column in expected.items():
            assert np.array_equal(column, found[name], equal_nan=column.dtype.kind == "f"), name


def test_observation_describes_its_visit() -> None:
    """A car drives east through three cells at 10 m/s. The observation of each visit (pass through
    a cell) must have the times, pose and speed of the visit, and the friction estimated at its end.
    """
    samples = 25
    east = np.arange(samples)[:, None] * 1.0
    block = ground(east, np.zeros_like(east), np.zeros_like(east))
    reported = estimates(samples, 1)
    located, observations, _ = Watch.of(1).step(block, reported)
    first, second = np.flatnonzero(located.closes[:, 0])[1:3]
    columns = observations.columns
    assert columns["enter_time"][1] == START_NS + first * 100_000_000
    assert columns["leave_time"][1] == START_NS + (second - 1) * 100_000_000
    assert columns["mu"][1] == np.float32(reported.mu[second - 1, 0])
    assert columns["mu_upper"][1] == np.float32(reported.mu_upper[second - 1, 0])
    assert columns["speed"][1] == pytest.approx(
        np.hypot(reported.vx, reported.vy)[first:second].mean(), rel=1e-6
    )
    assert columns["health"][1] == np.bitwise_or.reduce(reported.health[first:second, 0])
    assert reported.evidence is not None
    of_visit = weigh_by_use(reported.evidence[second], columns["mu_utilised"][1:2].astype(float))
    assert np.array_equal(columns["log_likelihood"][1], mugrid.encode_log_likelihood(of_visit)[0])
    assert columns["sector"].tolist() == [0] * len(columns["sector"])


def test_pose_of_an_observation_is_in_its_cell() -> None:
    _, observations, _ = Watch.of(6).step(wanderers(500, 6, 8), estimates(500, 6))
    columns = observations.columns
    assert np.array_equal(grid.cell_of(columns["latitude"], columns["longitude"]), columns["cell"])


def test_columns_have_the_types_of_the_wire() -> None:
    _, observations, states = Watch.of(3).step(wanderers(100, 3), estimates(100, 3))
    for records in (observations, states):
        assert {n: c.dtype for n, c in records.columns.items()} == column_types(records.kind)
        assert {len(c) for c in records.columns.values()} == {len(records.vehicle)}


def test_a_bank_without_evidence_sends_no_likelihood() -> None:
    block = wanderers(100, 2)
    reported = estimates(100, 2)
    bare = type(reported)(**{**vars(reported), "evidence": None})
    _, observations, _ = Watch.of(2).step(block, bare)
    assert observations.columns["log_likelihood"].shape == (len(observations.vehicle), 0)


def test_a_visit_that_the_bank_could_not_follow_is_flat() -> None:
    block = wanderers(100, 2)
    reported = estimates(100, 2)
    unknown = type(reported)(
        **{**vars(reported), "evidence": np.full_like(reported.evidence, np.nan)}
    )
    _, observations, _ = Watch.of(2).step(block, unknown)
    assert not observations.columns["log_likelihood"].any()
    assert observations.columns["log_likelihood"].shape[1] == mugrid.BINS


@pytest.mark.parametrize(
    ("mu", "used", "urgent"),
    [(0.30, 0.05, True), (0.36, 0.05, False), (0.36, 0.25, True), (0.9, 0.8, False)],
    ids=["upper bound slippery", "only the median", "median with excitation", "dry"],
)
def test_only_slippery_visits_are_urgent(mu: float, used: float, urgent: bool) -> None:
    """An urgent observation is sent at once. The observation of a visit (pass through a cell) must
    be urgent only if it shows a slippery road (μ below 0.4) in one of two ways:

    - The upper end of its interval lies below 0.4. In this test the upper end is mu + 0.05.
    - Its median mu lies below 0.4, and the vehicle used at least the share EXCITED_SHARE of this
      friction.
    """
    _, observations, states = Watch.of(3).step(
        wanderers(150, 3), estimates(150, 3, mu=mu, used=used)
    )
    assert set(observations.urgent.tolist()) == {urgent}
    assert not states.urgent.any()


def test_grip_used_in_the_previous_cell_is_not_reported_again() -> None:
    """The estimator reports the largest grip of the last second. A car stops braking just before it
    enters the next cell. The braking must not count as grip used in this cell.
    """
    samples = 60
    east = np.arange(samples)[:, None] * 0.5
    block = ground(east, np.zeros_like(east), np.zeros_like(east))
    reported = estimates(samples, 1, mu=0.9)
    used = np.full((samples, 1), 0.1)
    located, *_ = Watch.of(1).step(block, reported)
    border = np.flatnonzero(located.closes[:, 0])[1]
    used[border - 5 : border + 9] = 0.7
    _, observations, _ = Watch.of(1).step(
        block, type(reported)(**{**vars(reported), "mu_utilised": used})
    )
    assert observations.columns["mu_utilised"][:2].tolist() == pytest.approx([0.7, 0.1])


def test_grip_not_felt_in_a_cell_belongs_to_the_cell_before() -> None:
    """The estimator reports the largest grip of the last second. If a car brakes before a cell with
    ice and crosses this cell in less than a second, this grip is too large for the cell. It must be
    limited by the acceleration in the cell, if that is known.
    """
    samples = 30
    east = np.arange(samples)[:, None] * 1.4
    block = ground(east, np.zeros_like(east), np.zeros_like(east))
    reported = estimates(samples, 1, mu=0.9)
    used = type(reported)(**{**vars(reported), "mu_utilised": np.full((samples, 1), 0.8)})
    utilised = []
    for used_grip in (0.1, 0.8, np.nan):
        signals = block.signals.copy()
        signals[..., S.AX] = -used_grip * GRAVITY
        signals[..., S.AY] = 0.0
        _, located = locate_vehicles(Watch.of(1).tracks, block.t, block.signals)
        reading = cast("Estimates", used)
        _, records, _ = build_records(
            OpenVisits.before_any(1),
            block.time,
            located,
            reading,
            AgentConfig(),
            BlockReadings(signals),
        )
        utilised.append(float(records.columns["mu_utilised"][0]))
    assert utilised == pytest.approx([WHEEL_SHARE * 0.1 + FELT_STD, 0.8, 0.8])


def observe_grip(observed: np.ndarray, east: np.ndarray, fix_every: int = 10) -> list[float]:
    """Return the used grip reported for each visit (passage of a cell) of a car. The car drives
    east along `east` (T, 1) [m] at 100 samples per second, and every `fix_every`-th sample has a
    position; its acceleration shows a used grip of `observed` (T,).
    """
    flat = np.zeros_like(east)
    block = ground(east, flat, flat, rate_hz=100.0, fix_every=fix_every)
    reported = estimates(len(east), 1, used=0.9)
    signals = block.signals.copy()
    signals[:, 0, S.AX] = -GRAVITY * observed
    signals[..., S.AY] = 0.0
    _, located = locate_vehicles(Watch.of(1).tracks, block.t, signals)
    reading = cast("Estimates", type(reported)(**{**vars(reported), "vx": flat + 10.0, "vy": flat}))
    _, records, _ = build_records(
        OpenVisits.before_any(1),
        block.time,
        located,
        reading,
        AgentConfig(),
        BlockReadings(signals),
    )
    return [float(used) for used in records.columns["mu_utilised"]]


def test_grip_felt_at_the_border_of_a_cell_may_be_of_its_neighbour() -> None:
    """Braking that is closer to the border of two cells than the position error must count for
    neither cell. Braking further inside a cell must count for this cell.
    """
    east = np.arange(450)[:, None] * 0.1
    flat = np.zeros_like(east)
    block = ground(east, flat, flat, rate_hz=100.0, fix_every=10)
    _, located = locate_vehicles(Watch.of(1).tracks, block.t, block.signals)
    border = int(np.flatnonzero(located.closes[:, 0])[1])
    gentle = np.full(450, 0.1)
    at_border = np.full(450, 0.1)
    inside = np.full(450, 0.1)
    at_border[border : border + 8] = 0.6
    inside[border + 30 : border + 60] = 0.6
    plain, near, far = (observe_grip(observed, east)[1] for observed in (gentle, at_border, inside))
    assert plain == pytest.approx(WHEEL_SHARE * 0.1 + FELT_STD, abs=1e-3)
    assert near == pytest.approx(plain, abs=0.15)
    assert far > WHEEL_SHARE * 0.55


def test_first_visit_with_one_fix_reports_the_grip_used_near_the_fix() -> None:
    """A receiver of 1 Hz gives one position per cell. The time before the first visit, or without
    reception, must not count as a way driven since that position.
    """
    east = np.arange(450)[:, None] * 0.1
    first, second, *_ = observe_grip(np.full(450, 0.6), east, fix_every=100)
    assert first == pytest.approx(second)
    assert second > WHEEL_SHARE * 0.55


def test_the_noise_of_accelerometers_is_no_grip() -> None:
    east = np.arange(450)[:, None] * 0.1
    rng = np.random.default_rng(3)
    noisy = 0.1 + 0.05 * rng.normal(size=450)
    assert (
        max(observe_grip(noisy, east)) < WHEEL_SHARE * 0.16 + FELT_STD < WHEEL_SHARE * noisy.max()
    )


@pytest.mark.parametrize("cut", [None, 31, 33])
def test_visit_with_a_friction_jump_reports_both_and_grip_of_the_lesser(
    cut: int | None,
) -> None:
    """The road changes from ice to dry while the car passes through the second cell. The
    observation of this cell must allow both frictions. Its used grip must be that of the ice,
    although the estimator reports a used grip of 0.7.
    """
    samples = 40
    east = np.arange(samples)[:, None] * 0.5
    block = ground(east, np.zeros_like(east), np.zeros_like(east))
    reported = estimates(samples, 1, mu=0.8)
    located, *_ = Watch.of(1).step(block, reported)
    first, second = np.flatnonzero(located.closes[:, 0])[1:3]
    ice, dry = (-0.5 * np.square((mugrid.CENTRES - mu) / 0.05) for mu in (0.15, 0.8))
    evidence = np.full((samples, 1, mugrid.BINS), np.nan)
    jumps = np.zeros((samples, 1), np.bool_)
    evidence[located.closes[:, 0], 0] = dry
    jump = (first + second) // 2
    evidence[jump, 0] = ice
    jumps[jump] = True
    made = {"evidence": evidence, "jumps": jumps, "mu_utilised": np.full((samples, 1), 0.7)}
    reported = type(reported)(**{**vars(reported), **made})
    watch = Watch.of(1)
    likelihoods = []
    used = []
    for rows in [slice(None)] if cut is None else [slice(0, cut), slice(cut, None)]:
        _, observations, _ = watch.step(part(block, rows), reported.part(rows))
        likelihoods += list(observations.columns["log_likelihood"])
        used += observations.columns["mu_utilised"].tolist()
    assert np.array_equal(likelihoods[1], mugrid.encode_log_likelihood(np.maximum(ice, dry)))
    assert used[1] == pytest.approx(mugrid.CENTRES[ice >= -3.0].max())
    assert used[0] == pytest.approx(0.7)


@pytest.mark.parametrize("rate", [0.5, 2.0, 10.0])
def test_states_come_at_the_set_rate(rate: float) -> None:
    east = np.zeros((3_001, 2))
    block = ground(east, east, east, rate_hz=100.0)
    _, _, states = Watch.of(2, AgentConfig(state_rate_hz=rate)).step(block, estimates(3_001, 2))
    per_vehicle = np.bincount(states.vehicle)
    assert per_vehicle.tolist() == [round(30 * rate) + 1] * 2
    times = states.columns["time"][states.vehicle == 0]
    assert np.allclose(np.diff(times) / 1e9, 1 / rate, atol=0.011)


def test_without_position_there_is_no_state() -> None:
    east = np.zeros((100, 1))
    block = ground(east, east, east)
    block.signals[..., -3] = np.nan
    _, observations, states = Watch.of(1).step(block, estimates(100, 1))
    assert not len(states.vehicle)
    assert not len(observations.vehicle)
    assert states.kind is Kind.STATE


def test_observation_contains_controller_flags_and_context_of_its_visit() -> None:
    """A car drives east through cells at 10 m/s. The observation of each visit (pass through a
    cell) must contain the ABS flag and the context (controllers, temperature, wipers) read during
    the visit. A value with hardly any reading must be "unknown".
    """
    samples = 40
    east = np.arange(samples)[:, None] * 1.0
    block = ground(east, np.zeros_like(east), np.zeros_like(east))
    reported = estimates(samples, 1)
    _, located = locate_vehicles(Watch.of(1).tracks, block.t, block.signals)
    first, second = np.flatnonzero(located.closes[:, 0])[1:3]
    given = {
        "abs_active": np.zeros((samples, 1)),
        "air_temperature": np.linspace(-2.0, 0.0, samples)[:, None],
    }
    given["abs_active"][first - 1] = 1.0
    given["abs_active"][first + 1 : second] = np.nan
    given["wiper"] = np.where(np.arange(samples)[:, None] < first, 0.5, np.nan)
    context = context_block(samples, 1, given)
    reading = cast("Estimates", reported)
    _, observations, _ = build_records(
        OpenVisits.before_any(1),
        block.time,
        located,
        reading,
        AgentConfig(),
        BlockReadings(block.signals, context),
    )
    columns = observations.columns
    assert columns["abs_active"][:2].tolist() == [1, -1]
    assert (
        columns["esc_active"].tolist()
        == columns["tcs_active"].tolist()
        == [-1] * len(observations.vehicle)
    )
    expected = [
        given["air_temperature"][rows, 0].mean() for rows in (slice(0, first), slice(first, second))
    ]
    assert columns["air_temperature"][:2].tolist() == pytest.approx(expected)
    assert columns["wiper"][0] == 0.5
    assert np.isnan(columns["wiper"][1])
    _, plain, _ = build_records(
        OpenVisits.before_any(1),
        block.time,
        located,
        reading,
        AgentConfig(),
        BlockReadings(block.signals),
    )
    same = columns.keys() - {"abs_active", "air_temperature", "wiper"}
    for name in same:
        assert np.array_equal(
            columns[name], plain.columns[name], equal_nan=columns[name].dtype.kind == "f"
        ), name
    assert plain.columns["abs_active"].tolist() == [-1] * len(observations.vehicle)
    assert np.isnan(plain.columns["air_temperature"]).all()
