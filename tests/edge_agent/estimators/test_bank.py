"""Tests of properties that every available estimator must have.

The estimates must depend on past samples only. They must be the same bit by bit if a caller passes
the samples in one call or in many. If a drive needs little grip, the friction intervals must be
wide. No output may be NaN.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators import Estimates, create
from edge_agent.estimators.estimates import COLUMNS
from schemas.errors import InputError
from schemas.mugrid import CENTRES
from schemas.numeric import FloatArray
from schemas.signals import Health, S
from tests.edge_agent.estimators.drives import drive, join_drives

PRIOR_WIDTH = 0.9 * 1.15


def run(
    name: str, t: FloatArray, signals: FloatArray, vehicle: object, closes: FloatArray | None = None
) -> Estimates:
    bank = create(name, [vehicle], memberships=Memberships())  # type: ignore[list-item]
    ends = None if closes is None else closes.astype(bool)[:, None]
    return bank.advance(t[:, None], signals[:, None], ends)


@pytest.mark.parametrize("name", ["aco-fckf", "fckf", "ckf"])
def test_a_drive_that_excites_finds_its_friction_and_its_velocity(name: str) -> None:
    t, signals, vehicle = drive("j-turn", 0.5)
    reported = run(name, t, signals, vehicle)
    assert reported.mu_lower[-1, 0] < 0.5 < reported.mu_upper[-1, 0]
    assert reported.mu_upper[-1, 0] - reported.mu_lower[-1, 0] < 0.4
    assert reported.mu_utilised[-1, 0] > 0.35


def test_interval_keeps_the_width_of_the_prior_without_excitation() -> None:
    t, signals, vehicle = drive("straight", 0.85)
    reported = run("fckf", t, signals, vehicle)
    assert (reported.mu_upper - reported.mu_lower)[-1, 0] >= 0.8 * PRIOR_WIDTH


def test_estimate_is_forgotten_over_metres_without_excitation() -> None:
    turn = drive("j-turn", 0.5)
    straight = drive("straight", 0.5, seconds=40.0)
    t, signals = join_drives(turn, straight)
    reported = run("fckf", t, signals, turn[2])
    width = (reported.mu_upper - reported.mu_lower)[:, 0]
    assert width[len(turn[0]) - 1] < 0.4
    assert width[-1] >= 0.8 * PRIOR_WIDTH


def test_a_vehicle_has_the_same_numbers_alone_and_among_many() -> None:
    t, signals, vehicle = drive("slalom", 0.3, seconds=6.0)
    many = 7
    alone = run("fckf", t, signals, vehicle)
    bank = create("fckf", [vehicle] * many, memberships=Memberships())
    crowd = np.repeat(signals[:, None], many, axis=1)
    crowd[:, 1:] += 0.01 * np.random.default_rng(0).normal(size=(1, many - 1, crowd.shape[2]))
    together = bank.advance(np.repeat(t[:, None], many, axis=1), crowd)
    for name in COLUMNS:
        assert np.array_equal(getattr(together, name)[:, 0], getattr(alone, name)[:, 0]), name


def test_however_the_samples_are_cut_the_numbers_are_the_same() -> None:
    t, signals, vehicle = drive("slalom", 0.3, seconds=6.0)
    whole = run("fckf", t, signals, vehicle)
    bank = create("fckf", [vehicle], memberships=Memberships())
    cuts = [0, 1, 2, 5, 6, 83, 200, 201, 599, len(t)]
    parts = [bank.advance(t[a:b, None], signals[a:b, None]) for a, b in pairwise(cuts)]
    for name in COLUMNS:
        assert np.array_equal(
            np.concatenate([getattr(p, name) for p in parts]), getattr(whole, name)
        ), name


def test_closing_visits_does_not_change_the_estimates() -> None:
    t, signals, vehicle = drive("slalom", 0.3, seconds=6.0)
    closes = np.arange(len(t)) % 100 == 50
    plain = run("fckf", t, signals, vehicle)
    closed = run("fckf", t, signals, vehicle, closes)
    for name in COLUMNS:
        assert np.array_equal(getattr(plain, name), getattr(closed, name)), name
    assert closed.evidence is not None
    assert np.isfinite(closed.evidence[closes]).all()
    assert np.isnan(closed.evidence[~closes]).all()
    assert (closed.evidence[closes].max(axis=-1) == 0.0).all()


def test_evidence_of_a_cell_is_independent_of_the_belief_at_entry() -> None:
    visit = drive("slalom", 0.3, seconds=8.0)
    reported = []
    for before in (0.3, 0.85):
        lead = drive("j-turn", before)
        t, signals = join_drives(lead, visit)
        closes = np.zeros(len(t), bool)
        closes[[len(lead[0]) + 300, -1]] = True
        estimates = run("fckf", t, signals, visit[2], closes)
        assert estimates.evidence is not None
        reported.append(estimates.evidence[-1, 0])
    output = np.maximum(reported[0], reported[1]) > -3.0
    assert np.abs(reported[0] - reported[1])[output].max() < 0.55


def test_a_visit_straight_on_is_flat() -> None:
    t, signals, vehicle = drive("straight", 0.85)
    closes = np.zeros(len(t), bool)
    closes[[300, 500]] = True
    reported = run("fckf", t, signals, vehicle, closes)
    assert reported.evidence is not None
    assert np.ptp(reported.evidence[500, 0]) < 0.2


def test_gentle_braking_excludes_only_friction_below_the_grip_used() -> None:
    t, signals, vehicle = drive("gentle-braking", 0.85)
    closes = np.zeros(len(t), bool)
    end = int(np.searchsorted(t, 4.0))
    closes[[50, end]] = True
    reported = run("fckf", t, signals, vehicle, closes)
    assert reported.evidence is not None
    used = float(reported.mu_utilised[:end].max())
    output = reported.evidence[end, 0]
    assert np.ptp(output[1.5 * used < CENTRES]) < 2.0
    assert output[0.7 * used > CENTRES].max() < -4.0


def _without(*channels: int) -> Callable[[FloatArray, FloatArray], None]:
    def fault(_: FloatArray, signals: FloatArray) -> None:
        signals[200:, list(channels)] = np.nan

    return fault


def _spikes(_: FloatArray, signals: FloatArray) -> None:
    signals[::97, :15] = 1e9
    signals[::89, :15] = np.inf


def _gap(t: FloatArray, _: FloatArray) -> None:
    t[300:] += 3.0


def _backwards(t: FloatArray, _: FloatArray) -> None:
    t[300:330] -= 1.0
    t[400] = np.nan


def _all_gone(_: FloatArray, signals: FloatArray) -> None:
    signals[:] = np.nan


FOUR = range(4)
FAULTS = {
    "no torque": (_without(*(S.TORQUE + w for w in FOUR)), Health.NO_TORQUE),
    "no wheel speed": (_without(*(S.OMEGA + w for w in FOUR)), Health.NO_WHEEL_SPEED),
    "one wheel speed lost": (_without(S.OMEGA + 2), Health.NO_WHEEL_SPEED),
    "no accelerometers": (_without(S.AX, S.AY), Health.NO_INERTIAL),
    "no gyroscope": (_without(S.YAW_RATE), Health.NO_INERTIAL),
    "no steering": (_without(*(S.DELTA + w for w in FOUR)), Health.NO_STEERING),
    "no position": (_without(S.LATITUDE, S.LONGITUDE, S.YAW), Health.NO_POSITION),
    "spikes and infinities": (_spikes, Health.OUTLIER),
    "a gap of three seconds": (_gap, Health.TIME_GAP),
    "time going backwards and missing": (_backwards, Health.TIME_GAP),
    "nothing at all": (_all_gone, Health.NO_INERTIAL),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_cause_no_nan_and_are_shown_in_health(fault: str) -> None:
    t, signals, vehicle = drive("slalom", 0.3, seconds=6.0)
    t = t.copy()
    signals = signals.copy()
    harm, flag = FAULTS[fault]
    harm(t, signals)
    reported = run("fckf", t, signals, vehicle)
    for name in COLUMNS:
        assert np.isfinite(getattr(reported, name)).all(), name
    assert (reported.health & int(flag)).any()
    assert (reported.mu_lower <= reported.mu).all()
    assert (reported.mu <= reported.mu_upper).all()


@pytest.mark.parametrize("fault", ["no torque", "no steering", "no accelerometers"])
def test_interval_is_right_with_fewer_signals(fault: str) -> None:
    t, signals, vehicle = drive("slalom", 0.3)
    broken = signals.copy()
    FAULTS[fault][0](t, broken)
    reported = run("fckf", t, broken, vehicle)
    right = (reported.mu_lower[200:, 0] <= 0.3) & (reported.mu_upper[200:, 0] >= 0.3)
    assert right.mean() > 0.8


def test_a_time_that_is_not_a_number_at_first_is_waited_out() -> None:
    t, signals, vehicle = drive("slalom", 0.3, seconds=2.0)
    late = t.copy()
    late[:10] = np.nan
    reported = run("fckf", late, signals, vehicle)
    assert np.isfinite(reported.mu).all()
    assert (reported.health[:10] & int(Health.TIME_GAP)).all()


def test_only_the_fuzzy_estimator_adapts_r() -> None:
    t, signals, vehicle = drive("slalom", 0.3, seconds=6.0)
    fuzzy = run("fckf", t, signals, vehicle)
    plain = run("ckf", t, signals, vehicle)
    assert (plain.adaptation == 1.0).all()
    assert (fuzzy.adaptation != 1.0).any()
    assert not np.array_equal(fuzzy.mu, plain.mu)


def test_noisier_scales_give_wider_velocities() -> None:
    t, signals, vehicle = drive("slalom", 0.3, seconds=6.0)
    wide = create("ckf", [vehicle], memberships=Memberships(ln_scales=(1.0, 1.0))).advance(
        t[:, None], signals[:, None]
    )
    assert wide.vx_std[-1, 0] > run("ckf", t, signals, vehicle).vx_std[-1, 0]


@pytest.mark.parametrize(
    ("name", "shape", "field"),
    [
        ("aco-fckf-2", (3, 1, 18), "estimator"),
        ("ckf", (3, 2, 18), "signals"),
        ("ckf", (3, 1, 17), "signals"),
    ],
)
def test_misuse_is_refused_by_name(name: str, shape: tuple[int, ...], field: str) -> None:
    vehicle = drive("slalom", 0.3, seconds=2.0)[2]
    with pytest.raises(InputError, match=field):
        create(name, [vehicle], memberships=Memberships()).advance(
            np.zeros((3, 1)), np.zeros(shape)
        )


def test_a_bank_of_no_vehicles_is_refused() -> None:
    with pytest.raises(InputError, match="vehicles"):
        create("ckf", [])


def test_sides_of_a_split_road_are_distinguished() -> None:
    t, signals, vehicle = drive("split-braking", None)
    reported = run("fckf", t, signals, vehicle)
    assert reported.mu_wheel is not None
    braking = (t > 2.0) & (t < 4.0)
    left = reported.mu_wheel[braking, 0, 0]
    right = reported.mu_wheel[braking, 0, 1]
    assert ((left[:, 1] <= 0.8) & (left[:, 2] >= 0.8)).mean() > 0.85
    assert np.abs(right[:, 0] - 0.3).mean() < 0.12
    assert (right[:, 2] < left[:, 1]).all()
    assert (reported.mu_wheel[:, 0, 0] == reported.mu_wheel[:, 0, 2]).all()


def test_on_a_road_of_one_friction_the_wheels_have_it() -> None:
    t, signals, vehicle = drive("slalom", 0.3)
    reported = run("fckf", t, signals, vehicle)
    assert reported.mu_wheel is not None
    assert np.abs(reported.mu_wheel[..., 0] - reported.mu[..., None]).mean() < 0.02


@pytest.mark.parametrize("name", ["gaining-lane-changes", "gaining-slalom"])
def test_gentle_acceleration_reports_no_ice(name: str) -> None:
    """During gentle acceleration the estimator must report no ice, although four sliding wheels
    with a suitable stiffness or sensor offset would also explain the slip.
    """
    for seed in range(6):
        t, signals, vehicle = drive(name, 0.9, seed)
        reported = bank_of("aco-fckf", [vehicle]).advance(t[:, None], signals[:, None])
        assert reported.mu_upper.min() > 0.7


@pytest.mark.parametrize("size", [60.0, 5.0])
def test_single_false_acceleration_is_flagged_and_bridged(size: float) -> None:
    t, signals, vehicle = drive("slalom", 0.3)
    broken = signals.copy()
    broken[200::10, [S.AX, S.AY]] += size
    plain = run("fckf", t, signals, vehicle)
    reported = run("fckf", t, broken, vehicle)
    assert (reported.health[200::10] & Health.OUTLIER).all()
    assert not (reported.health[201::10] & Health.OUTLIER).any()
    assert np.abs(reported.vy - plain.vy).max() < 0.05
    assert (reported.vy_std < 1.5 * plain.vy_std).all()


def test_lasting_jump_of_acceleration_is_accepted_at_the_second_reading() -> None:
    t, signals, vehicle = drive("straight", None)
    signals = signals.copy()
    signals[300:, S.AX] += 5.0
    refused = np.flatnonzero(run("fckf", t, signals, vehicle).health[:, 0] & Health.OUTLIER)
    assert refused.tolist() == [300]


def test_creeping_after_a_hard_stop_reports_no_ice() -> None:
    t, signals, vehicle = drive("braking", 0.85)
    reported = run("fckf", t, signals, vehicle)
    assert reported.vx[-1, 0] < 2.0
    assert (reported.mu_upper[t > 2.0] > 0.7).all()


def test_implausibly_spinning_wheels_cause_no_false_estimate() -> None:
    t, signals, vehicle = drive("acceleration", 0.3)
    broken = signals.copy()
    broken[300:, S.OMEGA : S.OMEGA + 4] = 600.0
    reported = run("fckf", t, broken, vehicle)
    assert (reported.mu_lower[300:] <= 0.3).mean() > 0.85
    assert (reported.mu_upper[300:] >= 0.3).mean() > 0.85
