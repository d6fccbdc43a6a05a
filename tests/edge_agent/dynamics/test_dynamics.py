"""Tests that the vehicle equations satisfy laws of physics and mathematical identities."""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_agent.dynamics import body, loads, parameters, slip, tyres, wheel
from edge_agent.dynamics.parameters import Parameter, parameter_row
from schemas.thresholds import GRAVITY
from schemas.vehicle import Vehicle

CAR = Vehicle(
    name="car",
    mass=1200.0,
    yaw_inertia=1900.0,
    cg_to_front_axle=1.1,
    cg_to_rear_axle=1.5,
    track_front=1.5,
    track_rear=1.48,
    cg_height=0.55,
    wheel_radius=0.3,
    wheel_inertia=1.2,
    longitudinal_stiffness=6e4,
    cornering_stiffness=5e4,
)
ROW = parameter_row(CAR)


@pytest.mark.parametrize("c", [1.1, 1.4, 1.65, 2.0])
@pytest.mark.parametrize("e", [-0.5, 0.0, 0.5])
def test_a_tyre_curve_starts_with_slope_one_and_peaks_at_one(c: float, e: float) -> None:
    theta = np.linspace(0.0, 60.0, 20_001)
    curve = np.array([tyres.magic_formula(float(x), c, e) for x in theta])
    assert curve[1] / theta[1] == pytest.approx(1.0, abs=1e-4)
    assert curve.max() <= 1.0
    if c >= 1.4 and e >= 0.0:
        assert curve.max() == pytest.approx(1.0, abs=1e-3)


def test_the_dugoff_curve_is_smooth_where_its_pieces_meet_and_odd() -> None:
    def dugoff(theta: float) -> float:
        return tyres.combined_dugoff((theta, 0.0), (1.0, 1.0), 1.0, 1.0)[0]

    step = 1e-7
    assert dugoff(0.5 + step) - dugoff(0.5 - step) == pytest.approx(2 * step, rel=1e-5)
    assert dugoff(-3.0) == -dugoff(3.0)
    assert dugoff(3.0) == pytest.approx(1.0 - 1.0 / 12.0)


def test_slip_stiffness_does_not_depend_on_friction() -> None:
    icy = tyres.combined_magic((1e-6, 2e-6), (6e4, 5e4), 0.1, 3000.0, 1.4, 0.0)
    dry = tyres.combined_magic((1e-6, 2e-6), (6e4, 5e4), 1.0, 3000.0, 1.4, 0.0)
    assert icy == pytest.approx(dry, rel=1e-6)
    assert dry == pytest.approx((0.06, 0.1), rel=1e-6)


def test_no_combination_of_slips_gives_more_than_the_friction_circle() -> None:
    rng = np.random.default_rng(3)
    for x, y in rng.normal(0.0, 0.2, (200, 2)):
        assert math.hypot(
            *tyres.combined_magic((x, y), (6e4, 5e4), 0.4, 3000.0, 1.6, 0.2)
        ) <= 1200.0 * (1 + 1e-12)
        assert math.hypot(*tyres.combined_dugoff((x, y), (6e4, 5e4), 0.4, 3000.0)) <= 1200.0 * (
            1 + 1e-12
        )


def test_wheel_loads_carry_the_weight_and_a_left_turn_loads_the_right() -> None:
    fl, fr, rl, rr = loads.wheel_loads(parameters.body_of(ROW), 2.0, 3.0)
    assert fl + fr + rl + rr == pytest.approx(CAR.mass * GRAVITY)
    assert fr > fl
    assert rr > rl
    assert rl + rr > CAR.mass * GRAVITY * CAR.cg_to_front_axle / 2.6


def test_rolling_wheel_has_no_slip_and_a_left_turn_speeds_outer_wheel() -> None:
    along, across = slip.wheel_velocity(ROW, 3, 10.0, 0.0, 0.2, 0.0)
    assert along == pytest.approx(10.0 + 0.2 * 0.74)
    assert across == pytest.approx(-1.5 * 0.2)
    slip_x, slip_y = slip.wheel_slips(CAR.wheel_radius, along / CAR.wheel_radius, along, across)
    assert slip_x == pytest.approx(0.0, abs=1e-12)
    assert slip_y == pytest.approx(0.3 / along)


def test_axle_forces_and_accelerations_are_inverse() -> None:
    force_x = np.array([100.0, 300.0, -50.0, 80.0])
    force_y = np.array([500.0, 700.0, 400.0, 450.0])
    _, ay, turn = body.planar_accelerations(ROW, force_x, force_y, np.zeros(4))
    moment = 0.5 * CAR.track_front * (300.0 - 100.0) + 0.5 * CAR.track_rear * (80.0 + 50.0)
    assert body.axle_lateral_forces(ROW, ay, turn, moment) == pytest.approx((1200.0, 850.0))


def test_the_exact_rotation_keeps_a_circle_at_constant_speed() -> None:
    vx = 12.0
    vy = 0.5
    rate = 0.4
    for _ in range(1000):
        vx, vy = body.advance_velocity(vx, vy, -rate * 0.5, rate * 12.0, rate, 0.01)
    assert (vx, vy) == pytest.approx((12.0, 0.5), abs=1e-9)


def test_the_rotation_has_no_seam_where_the_yaw_rate_vanishes() -> None:
    above = body.advance_velocity(10.0, 1.0, 2.0, 3.0, 2e-4, 0.01)
    below = body.advance_velocity(10.0, 1.0, 2.0, 3.0, 0.5e-4, 0.01)
    straight = body.advance_velocity(10.0, 1.0, 2.0, 3.0, 0.0, 0.01)
    assert above == pytest.approx(straight, abs=1e-4)
    assert below == pytest.approx(straight, abs=1e-5)


def test_wheel_torque_balance_closes() -> None:
    force = wheel.force_from_torque(400.0, 12.0, CAR.wheel_inertia, CAR.wheel_radius)
    assert wheel.wheel_acceleration(
        400.0, force, CAR.wheel_inertia, CAR.wheel_radius
    ) == pytest.approx(12.0)


def test_every_parameter_of_the_row_has_its_place() -> None:
    assert ROW.shape == (len(Parameter),)
    assert ROW[Parameter.SLOPE_X] == pytest.approx(6e4 / (1200.0 * GRAVITY / 4))
    assert math.isnan(ROW[Parameter.DRIVE_FRONT])
    assert (
        parameter_row(CAR.model_copy(update={"drive_split_front": 0.4}))[Parameter.DRIVE_FRONT]
        == 0.4
    )
