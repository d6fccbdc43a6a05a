"""Tests of the dynamics of a car body on four tyres, of the brush tyre curve and of the electric
drive wheel, by limits and balances that must hold exactly.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_agent.dynamics.body import planar_accelerations
from edge_agent.dynamics.chassis import (
    DUGOFF,
    PlanarMotion,
    WheelInputs,
    planar_response,
    tyre_forces,
    wheel_inputs,
)
from edge_agent.dynamics.drive_wheel import (
    ELECTRIC_S,
    WheelState,
    blend_forces,
    drive_wheel,
    slip_share,
)
from edge_agent.dynamics.loads import wheel_loads
from edge_agent.dynamics.parameters import Parameter, as_four, body_of, parameter_row
from edge_agent.dynamics.tyres import brush
from edge_agent.lab.simulation.presets import PRESETS
from schemas.numeric import FloatArray

ROW = parameter_row(PRESETS["sedan"].vehicle)
MOTION = np.array([20.0, 0.3, 0.2, 0.5, 3.0])
DELTA = np.array([0.04, 0.04, 0.0, 0.0])
UNKNOWN = np.full(4, np.nan)


def forces(shape: float, mu: float, omega: FloatArray) -> tuple[FloatArray, FloatArray]:
    x = np.empty(4)
    y = np.empty(4)
    tyre_forces(ROW, MOTION, wheel_inputs(DELTA, omega), np.full(4, mu), shape, (x, y))
    return x, y


@pytest.mark.parametrize("shape", [DUGOFF, 1.4])
def test_no_wheel_has_more_than_its_friction_and_stiff_ones_have_it_almost(shape: float) -> None:
    loads = np.array(wheel_loads(body_of(ROW), MOTION[3], MOTION[4]))
    x, y = forces(shape, 0.1, np.full(4, 80.0))
    used = np.hypot(x, y) / (0.1 * loads)
    assert (used <= 1.0).all()
    assert (used > 0.8).all()


def test_the_shape_of_the_curve_matters() -> None:
    assert not np.allclose(
        forces(DUGOFF, 0.5, np.full(4, 57.0))[1], forces(1.4, 0.5, np.full(4, 57.0))[1]
    )


def test_a_wheel_without_speed_rolls_freely() -> None:
    assert forces(DUGOFF, 0.8, UNKNOWN)[0] == pytest.approx(np.zeros(4), abs=1e-9)


def test_the_response_is_that_of_the_tyres_unless_a_force_is_known() -> None:
    omega = np.full(4, 57.0)
    inputs = wheel_inputs(DELTA, omega)

    def compute_response(known: FloatArray) -> tuple[float, float, float]:
        cos = as_four(inputs[:, 0])
        sin = as_four(inputs[:, 1])
        mu = (0.8, 0.8, 0.8, 0.8)
        return planar_response(
            body_of(ROW),
            PlanarMotion(*MOTION),
            WheelInputs(cos, sin, as_four(omega), as_four(known), mu),
        )

    tyre_x, tyre_y = forces(DUGOFF, 0.8, omega)
    assert compute_response(UNKNOWN) == pytest.approx(
        planar_accelerations(ROW, tyre_x, tyre_y, DELTA), rel=1e-12, abs=1e-12
    )
    tyre_x[:2] = 100.0, 200.0
    known = np.array([100.0, 200.0, np.nan, np.nan])
    assert compute_response(known) == pytest.approx(
        planar_accelerations(ROW, tyre_x, tyre_y, DELTA), rel=1e-12, abs=1e-12
    )


def test_brush_curve_begins_with_slope_one_and_saturates_at_three() -> None:
    assert brush(1e-6) == pytest.approx(1e-6, rel=1e-5)
    assert brush(3.0) == pytest.approx(1.0)
    assert brush(30.0) == pytest.approx(1.0)
    assert brush(-1.2) == -brush(1.2)


def test_in_balance_the_drive_wheel_rests() -> None:
    radius = float(ROW[Parameter.RADIUS])
    rest = WheelState(300.0, 50.0, 300.0 / radius, 0.0)
    assert drive_wheel(rest, 300.0, 1.2, radius, 0.01) == pytest.approx(rest)


def test_motor_settles_with_its_time_constant_and_force_is_constant() -> None:
    torque = 0.0
    slope = 5000.0
    for _ in range(1000):
        state = WheelState(torque, 50.0, 0.0, slope)
        torque, _, _, slope = drive_wheel(state, 100.0, 1.2, 0.3, ELECTRIC_S / 1000)
    assert torque == pytest.approx(100.0 * (1.0 - math.exp(-1.0)), rel=1e-2)
    assert abs(slope) < 1000.0


def test_compensation_is_even_at_ordinary_slip_and_model_only_when_sliding() -> None:
    assert slip_share(0.3, 20.0 / 0.3, 20.0) == 0.5
    assert slip_share(0.3, 0.9 * 20.0 / 0.3, 20.0) == pytest.approx(0.5, abs=1e-2)
    assert slip_share(0.3, 0.0, 20.0) == 1.0
    out = np.empty(4)
    blend_forces(np.array([0.0, 1.0, 0.5, 0.5]), np.full(4, 10.0), np.full(4, 20.0), out)
    assert out.tolist() == [20.0, 10.0, 15.0, 15.0]
