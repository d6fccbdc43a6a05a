"""Tests of manoeuvres. The simulated car must complete each of them, use as much friction as
intended, and drive the same way each time.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from edge_agent.lab.simulation import (
    MANOEUVRES,
    PRESETS,
    DriveSetup,
    jump,
    simulate_manoeuvre,
    split,
)
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, per_wheel


def column(log: pa.Table, name: str) -> FloatArray:
    return np.asarray(log[name].to_numpy(zero_copy_only=False), dtype=np.float64)


def wheels(log: pa.Table, name: str) -> FloatArray:
    return np.column_stack([column(log, n) for n in per_wheel(name)])


@pytest.mark.parametrize("name", MANOEUVRES)
def test_a_log_has_every_signal_and_its_truth_fits(name: str) -> None:
    log, vehicle = simulate_manoeuvre(name, setup=DriveSetup(sensors="ideal"))
    row = MANOEUVRES[name]
    assert log.column_names[: 1 + len(CHANNELS)] == ["t", *CHANNELS]
    assert log.num_rows == round(row.duration * 100)
    np.testing.assert_allclose(np.diff(column(log, "t")), 0.01, atol=1e-9)
    assert np.isfinite([column(log, n) for n in log.column_names if n.startswith("true_")]).all()
    if not callable(row.friction):
        assert (wheels(log, "true_mu") == row.friction).all()
    used = wheels(log, "true_utilisation")
    assert ((used >= 0) & (used <= 1 + 1e-9)).all()
    assert column(log, "true_vx")[0] == row.speed
    idle = used.max(axis=1) < 0.02
    rolling = wheels(log, "omega")[idle] * vehicle.wheel_radius
    np.testing.assert_allclose(
        rolling, np.repeat(column(log, "true_vx")[idle, None], 4, axis=1), rtol=0.02, atol=1e-3
    )


@pytest.mark.parametrize("name", MANOEUVRES)
@pytest.mark.parametrize("vehicle", PRESETS)
def test_position_is_the_integral_of_speed(name: str, vehicle: str) -> None:
    log, _ = simulate_manoeuvre(name, setup=DriveSetup(vehicle=vehicle, sensors="ideal"))
    speed = np.hypot(column(log, "true_vx"), column(log, "true_vy"))
    path = np.hypot(np.diff(column(log, "true_x")), np.diff(column(log, "true_y"))).sum()
    assert path == pytest.approx(np.trapezoid(speed, dx=0.01), rel=1e-3)


def test_straight_driving_at_constant_speed_excites_nothing() -> None:
    log, _ = simulate_manoeuvre("straight", setup=DriveSetup(sensors="ideal"))
    assert wheels(log, "true_utilisation").max() < 0.05


def test_a_double_lane_change_ends_in_the_lane_where_it_began() -> None:
    log, _ = simulate_manoeuvre("double-lane-change")
    y = column(log, "true_y")
    assert y.max() > 3.0
    assert abs(y[-1]) < 0.2


def test_friction_may_jump_along_the_road_and_differ_from_side_to_side() -> None:
    log, _ = simulate_manoeuvre("braking", mu=jump(0.8, 0.3, at=40.0))
    x = column(log, "true_x")
    mu = wheels(log, "true_mu")
    assert (mu[x < 35] == 0.8).all()
    assert (mu[x > 45] == 0.3).all()
    log, _ = simulate_manoeuvre("braking", mu=split(0.8, 0.3), duration_s=2.0)
    assert wheels(log, "true_mu")[0].tolist() == [0.8, 0.3, 0.8, 0.3]
    # The brake forces of the side with grip turn the car.
    assert np.abs(column(log, "true_yaw")).max() > 0.01


def test_a_driver_keeps_a_split_stop_straight() -> None:
    log, _ = simulate_manoeuvre("split-braking")
    assert np.abs(column(log, "true_y")).max() < 0.75  # every wheel is still on its own side
    assert column(log, "true_vx")[-1] < 3.0
    assert np.abs(column(log, "delta_fl")).max() > 0.01


def test_the_same_seed_drives_the_same_and_another_does_not() -> None:
    log, vehicle = simulate_manoeuvre("sine", seed=3)
    again, same = simulate_manoeuvre("sine", seed=3)
    other, different = simulate_manoeuvre("sine", seed=4)
    assert log.equals(again)
    assert vehicle == same
    assert not log.equals(other)
    assert vehicle != different


@pytest.mark.parametrize(
    ("field", "arguments"),
    [
        ("manoeuvre", {"name": "wheelie"}),
        ("speed", {"name": "slalom", "speed": 1e9}),
        ("duration_s", {"name": "slalom", "setup": DriveSetup(rate_hz=1e9)}),
        ("mu", {"name": "sine", "mu": -0.1}),
        ("speed", {"name": "sine", "speed": 0.0}),
        ("rate_hz", {"name": "sine", "setup": DriveSetup(rate_hz=float("nan"))}),
        ("duration_s", {"name": "sine", "duration_s": -1.0}),
        ("vehicle", {"name": "sine", "setup": DriveSetup(vehicle="tram")}),
        ("seed", {"name": "sine", "seed": -1}),
    ],
)
def test_bad_arguments_are_refused_by_name(field: str, arguments: dict[str, object]) -> None:
    with pytest.raises(InputError, match=f"^{field}: "):
        simulate_manoeuvre(**arguments)  # type: ignore[arg-type]
