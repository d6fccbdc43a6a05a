"""Tests of drives with one measured front angle, such as that of the steering wheel. In tight turns
the inner wheel turns more than the outer one. If both had the same angle, the estimator would take
the difference for slip, and the lower bound of friction would lie above the truth.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from edge_agent.app.library import estimate
from edge_agent.inputs.doctor.adopt import prepare_log
from edge_agent.inputs.log_columns import FRONT_STEERING
from edge_agent.inputs.names import draft_profile
from edge_agent.inputs.profile import load_profile, shipped_profiles
from edge_agent.inputs.signal_log import SignalLog, read_log
from edge_agent.lab.simulation import simulate_manoeuvre
from schemas.numeric import FloatArray
from schemas.signals import S
from schemas.vehicle import Vehicle

LEFT, RIGHT = FRONT_STEERING


def turn_at_corners(tmp_path: Path, mu: float) -> tuple[SignalLog, FloatArray, Vehicle]:
    """Simulate turns at street corners. Return a log that contains only the mean of the two front
    angles, the angles of both wheels (T, 2) [rad], and the vehicle.
    """
    table, vehicle = simulate_manoeuvre("street-corners", mu=mu, seed=2)
    both = np.stack([table[name].to_numpy() for name in (LEFT, RIGHT)], axis=-1)
    mean = both.mean(axis=1)
    path = tmp_path / "log.parquet"
    table = table.set_column(table.column_names.index(LEFT), LEFT, [mean])
    pq.write_table(table.drop_columns([RIGHT]), path)
    return read_log(path), both, vehicle


def test_both_wheels_get_their_angles_once(tmp_path: Path) -> None:
    log, both, vehicle = turn_at_corners(tmp_path, 0.85)
    prepared = prepare_log(log, vehicle).log
    assert np.ptp(both, axis=1).max() > 0.1
    # The simulated sensors' noise is part of the difference.
    assert prepared.signals[:, S.DELTA : S.DELTA + 2] == pytest.approx(both, abs=0.012)
    again = prepare_log(prepared, vehicle).log
    assert np.array_equal(again.signals, prepared.signals, equal_nan=True)


def test_tight_turns_with_one_angle_give_no_false_grip_and_no_false_ice(tmp_path: Path) -> None:
    log, _, vehicle = turn_at_corners(tmp_path, 0.85)
    dry = estimate(log, vehicle)
    assert dry["mu_lower"].to_numpy().max() < 0.85
    assert dry["p_slippery"].to_numpy().max() < 0.9
    log, _, vehicle = turn_at_corners(tmp_path, 0.15)
    icy = estimate(log, vehicle)
    assert icy["p_slippery"].to_numpy().max() > 0.95


@pytest.mark.parametrize("name", shipped_profiles())
def test_shipped_profiles_have_one_front_angle(name: str) -> None:
    profile, _ = load_profile(name)
    assert (LEFT in profile.channels, RIGHT in profile.channels) == (True, False)


def test_same_signal_for_both_wheels_is_one_angle() -> None:
    profile = draft_profile({"SteeringWheelAngle": "deg", "AccX": "g"}, "own")
    assert RIGHT not in profile.channels
    twice = profile.channels | {RIGHT: profile.channels[LEFT]}
    copied = type(profile).model_validate(profile.model_dump() | {"channels": twice})
    assert RIGHT not in copied.channels
