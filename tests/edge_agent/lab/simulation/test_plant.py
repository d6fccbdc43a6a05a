"""Tests that the simulated vehicle (plant) obeys mechanics: Newton's laws, the friction circle, the
energy balance, and the centripetal acceleration in a steady circle. Steering and acceleration must
change motion and wheel loads in the right direction. Further tests check standstill, locked wheels
and the time step.
"""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from edge_agent.dynamics.parameters import Parameter
from edge_agent.lab.simulation import PRESETS, DriveSetup, simulate_manoeuvre
from edge_agent.lab.simulation.motor import Pmsm
from edge_agent.lab.simulation.plant import (
    advance,
    body_accelerations,
    command,
    start_at,
    substeps_of,
    wheel_forces,
)
from edge_agent.lab.simulation.presets import TrueVehicle
from edge_agent.lab.simulation.state import STATES, Control, Motion, TrueParameter, Wheel
from schemas.numeric import FloatArray
from schemas.thresholds import GRAVITY

ROUNDING = 1e-9


def some_instant(
    rng: np.random.Generator, mu: float = 0.6
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the arrays of a simulated vehicle at a random instant of a violent manoeuvre: state,
    parameters, inputs, and forces of the wheels.
    """
    p = PRESETS["sedan"].row()
    x = np.zeros(STATES)
    u = np.zeros((len(Control), 4))
    w = np.zeros((len(Wheel), 4))
    x[Motion.VX] = rng.uniform(3, 30)
    x[Motion.VY] = rng.normal(0, 1)
    x[Motion.YAW_RATE] = rng.normal(0, 0.4)
    x[Motion.OMEGA : Motion.OMEGA + 4] = (
        x[Motion.VX] / p[Parameter.RADIUS] * rng.uniform(0.8, 1.2, 4)
    )
    x[Motion.AX_LAGGED], x[Motion.AY_LAGGED] = rng.uniform(-4, 4, 2)
    u[Control.STEER] = rng.normal(0, 0.1, 4)
    u[Control.MU] = mu
    wheel_forces(x, p, u, w)
    return x, p, u, w


def rolling(
    speed: float, mu: float, vehicle: TrueVehicle | None = None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the arrays of a simulated vehicle that rolls straight ahead at `speed` [m/s]: state,
    parameters and inputs.
    """
    p = (vehicle or PRESETS["sedan"]).row()
    x = np.zeros(STATES)
    u = np.zeros((len(Control), 4))
    start_at(x, p, (0.0, 0.0, 0.0), speed)
    u[Control.MU] = mu
    return x, p, u


def run(
    x: FloatArray, p: FloatArray, u: FloatArray, seconds: float, dt: float = 1e-3
) -> FloatArray:
    """Simulate a vehicle for `seconds` from the state `x`, with parameters `p` and constant inputs
    `u`. Return the last outputs of its four wheels, shape (columns of `Wheel`, 4).
    """
    w = np.zeros((len(Wheel), 4))
    advance(x, p, u, w, dt, round(seconds / dt))
    return w


def kinetic_energy(x: FloatArray, p: FloatArray) -> float:
    wheels = p[Parameter.WHEEL_INERTIA] * (x[Motion.OMEGA : Motion.OMEGA + 4] ** 2).sum()
    body = (
        p[Parameter.MASS] * (x[Motion.VX] ** 2 + x[Motion.VY] ** 2)
        + p[Parameter.YAW_INERTIA] * x[Motion.YAW_RATE] ** 2
    )
    return float(0.5 * (body + wheels))


@pytest.mark.parametrize("seed", range(20))
def test_accelerations_are_the_wheel_forces_over_mass_and_inertia(seed: int) -> None:
    x, p, u, w = some_instant(np.random.default_rng(seed))
    # Forces as complex numbers: real part forward, imaginary part to the left.
    force = (w[Wheel.FX] + 1j * w[Wheel.FY]) * np.exp(1j * u[Control.STEER])
    half = 0.5 * np.repeat([p[Parameter.TRACK_FRONT], p[Parameter.TRACK_REAR]], 2) * [1, -1, 1, -1]
    place = np.repeat([p[Parameter.TO_FRONT], -p[Parameter.TO_REAR]], 2) + 1j * half
    ax, ay, yaw_acceleration = body_accelerations(x, p, u, w)
    total = force.sum() - p[TrueParameter.DRAG] * x[Motion.VX] ** 2
    assert complex(ax, ay) == pytest.approx(total / p[Parameter.MASS], rel=ROUNDING)
    assert yaw_acceleration == pytest.approx(
        (place.conj() * force).imag.sum() / p[Parameter.YAW_INERTIA], rel=ROUNDING
    )


@pytest.mark.parametrize("mu", [0.05, 0.2, 0.6, 1.2])
def test_no_wheel_pulls_more_than_its_grip(mu: float) -> None:
    for seed in range(50):
        _, _, _, w = some_instant(np.random.default_rng(seed), mu)
        assert (np.hypot(w[Wheel.FX], w[Wheel.FY]) <= mu * w[Wheel.FZ] * (1 + ROUNDING)).all()


def test_loads_add_up_to_the_weight_whatever_the_accelerations() -> None:
    for seed in range(20):
        _, p, _, w = some_instant(np.random.default_rng(seed))
        assert w[Wheel.FZ].sum() == pytest.approx(p[Parameter.MASS] * GRAVITY, rel=ROUNDING)


def test_small_slip_does_not_know_the_friction() -> None:
    forces = []
    for mu in (0.3, 0.9):
        x, p, u = rolling(20.0, mu)
        x[Motion.OMEGA : Motion.OMEGA + 4] *= 1.0005
        w = np.zeros((len(Wheel), 4))
        wheel_forces(x, p, u, w)
        forces.append(w[Wheel.FX].sum())
    assert forces[0] == pytest.approx(forces[1], rel=0.01)


@pytest.mark.parametrize("seed", range(10))
def test_without_driving_torque_energy_only_falls(seed: int) -> None:
    x, p, u, _ = some_instant(np.random.default_rng(seed))
    before = kinetic_energy(x, p)
    for _ in range(200):
        run(x, p, u, 0.01)
        after = kinetic_energy(x, p)
        assert after <= before
        before = after


def test_steering_left_turns_left_and_loads_the_right_wheels() -> None:
    x, p, u = rolling(15.0, 0.9)
    command(p, u, 0.04, 0.0)
    w = run(x, p, u, 2.0)
    assert x[Motion.YAW_RATE] > 0.1
    assert x[Motion.Y] > 1.0
    assert x[Motion.AY_LAGGED] > 1.0
    assert w[Wheel.FZ, 1] > w[Wheel.FZ, 0]
    assert w[Wheel.FZ, 3] > w[Wheel.FZ, 2]
    assert u[Control.STEER, 0] > u[Control.STEER, 1]  # the inner wheel turns by a larger angle


@pytest.mark.parametrize("share", [-0.4, 0.3])
def test_rear_wheels_that_steer_keep_the_circle_and_swing_the_tail(share: float) -> None:
    """At walking pace the yaw rate must be the one that follows from the directions of the wheels,
    for every ratio of rear to front steering.
    """
    circles = []
    for rear in (0.0, share):
        p = replace(PRESETS["sedan"], rear_steer=rear).row()
        x = np.zeros(STATES)
        u = np.zeros((len(Control), 4))
        w = np.zeros((len(Wheel), 4))
        start_at(x, p, (0.0, 0.0, 0.0), 2.0)
        u[Control.MU] = 0.9
        command(p, u, 0.1, 0.0)
        assert u[Control.STEER, 2:] == pytest.approx(rear * u[Control.STEER, :2])
        for _ in range(1000):
            advance(x, p, u, w, 1e-3, 1)
        circles.append((x[Motion.YAW_RATE] / x[Motion.VX], x[Motion.VY] / x[Motion.VX]))
    assert circles[1][0] == pytest.approx(circles[0][0], rel=0.02)
    assert (circles[1][1] - circles[0][1]) * share > 0.0


def test_acceleration_moves_forward_and_loads_the_rear() -> None:
    x, p, u = rolling(10.0, 0.9)
    command(p, u, 0.0, 4000.0)
    w = run(x, p, u, 1.0)
    assert x[Motion.VX] > 11.0
    assert (
        w[Wheel.FZ, 2:].sum() > w[Wheel.FZ, :2].sum() * p[Parameter.TO_FRONT] / p[Parameter.TO_REAR]
    )
    assert (w[Wheel.TORQUE] > 0).all()


@pytest.mark.parametrize("mu", [0.15, 0.5, 0.9])
def test_an_anti_lock_stop_uses_most_of_the_grip_and_never_more(mu: float) -> None:
    x, p, u = rolling(20.0, mu)
    command(p, u, 0.0, -1.2 * p[Parameter.MASS] * GRAVITY)
    run(x, p, u, 0.3)
    fast = x[Motion.VX]
    run(x, p, u, 0.5)
    deceleration = (fast - x[Motion.VX]) / 0.5
    assert (
        0.7 * mu * GRAVITY
        < deceleration
        < mu * GRAVITY + p[TrueParameter.DRAG] * fast**2 / p[Parameter.MASS]
    )
    assert (x[Motion.OMEGA : Motion.OMEGA + 4] > 0.5 * x[Motion.VX] / p[Parameter.RADIUS]).all()


def test_without_slip_control_the_wheels_lock_and_brake_less() -> None:
    stops = {}
    for limit in (0.08, np.inf):
        x, p, u = rolling(20.0, 0.4, replace(PRESETS["sedan"], slip_limit=limit))
        command(p, u, 0.0, -1.0 * p[Parameter.MASS] * GRAVITY)
        run(x, p, u, 1.5)
        stops[limit] = x[Motion.VX], x[Motion.OMEGA]
    assert abs(stops[np.inf][1]) < 0.5
    assert stops[np.inf][0] > stops[0.08][0] + 0.2


def test_a_steady_circle_has_its_centripetal_acceleration() -> None:
    log, _ = simulate_manoeuvre("constant-radius", mu=0.8, setup=DriveSetup(sensors="ideal"))
    truth = {
        name: log[name].to_numpy()[-500:]
        for name in ("true_vx", "true_vy", "true_ay", "true_yaw_rate")
    }
    speed = np.hypot(truth["true_vx"], truth["true_vy"])
    # The radius of the driven circle is not exactly 40 m.
    assert truth["true_ay"].mean() == pytest.approx((speed**2).mean() / 40.0, rel=0.05)
    assert truth["true_ay"].mean() == pytest.approx(
        (truth["true_yaw_rate"] * truth["true_vx"]).mean(), rel=0.01
    )


def test_a_stopped_vehicle_stays_where_it_is() -> None:
    x, p, u = rolling(3.0, 0.9)
    command(p, u, 0.05, -8000.0)
    run(x, p, u, 3.0)
    place = x[[Motion.X, Motion.Y, Motion.YAW]].copy()
    run(x, p, u, 5.0)
    assert abs(x[Motion.VX]) < 1e-3
    np.testing.assert_allclose(x[[Motion.X, Motion.Y, Motion.YAW]], place, atol=1e-3)


def test_a_wheel_has_the_inertia_that_it_has() -> None:
    """The simulation must not make a wheel's inertia J larger than stated, even at low speed.
    Estimators compute the tyre force F_x from J ω̇ = T − R F_x, so a wrong J would make this force
    wrong.
    """
    vehicle = replace(PRESETS["sedan"], drag=0.0, rolling=0.0)
    for speed in (4.0, 20.0):
        x, p, u = rolling(speed, 0.9, vehicle)
        command(p, u, 0.0, 3000.0)
        run(x, p, u, 0.3)
        before = x.copy()
        run(x, p, u, 0.1)
        heavy = p[Parameter.MASS] + 4 * p[Parameter.WHEEL_INERTIA] / p[Parameter.RADIUS] ** 2
        assert (x[Motion.VX] - before[Motion.VX]) / 0.1 == pytest.approx(3000.0 / heavy, rel=2e-3)


def test_finer_steps_give_the_same_drive() -> None:
    ends = []
    for dt in (1e-3, 1.25e-4):
        x, p, u = rolling(12.0, 0.5)
        command(p, u, 0.06, -1500.0)
        run(x, p, u, 1.5, dt)
        ends.append(x)
    np.testing.assert_allclose(ends[0], ends[1], rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("rate", [10.0, 50.0, 100.0, 128.0, 400.0, 2000.0])
def test_a_sample_is_cut_into_steps_of_a_millisecond_at_most(rate: float) -> None:
    assert 1.0 / (rate * substeps_of(rate)) <= 1e-3 * (1 + ROUNDING)


OTHER_OPTIONS = {"curve": "dugoff", "stiffness": "proportional-to-friction", "motors": Pmsm()}


@pytest.mark.parametrize("name", [f.name for f in fields(TrueVehicle) if f.name != "vehicle"])
def test_every_parameter_of_the_true_vehicle_matters(name: str) -> None:
    # Only vehicles with slip controllers have these parameters.
    of_controllers = name in ("tcs", "esc")
    usual = replace(PRESETS["van"], abs_hz=8.0) if of_controllers else PRESETS["van"]
    mu = 0.3 if of_controllers else None
    if name in OTHER_OPTIONS:
        changed = replace(usual, **{name: OTHER_OPTIONS[name]})  # type: ignore[arg-type]
    else:
        changed = replace(usual, **{name: getattr(usual, name) * 0.8 + 0.01})
    logs = []
    for vehicle in (usual, changed):
        drives = [
            simulate_manoeuvre(m, mu=mu, setup=DriveSetup(vehicle=vehicle, sensors="mems-leak"))[0]
            for m in ("acceleration", "braking")
        ]
        drives.append(
            simulate_manoeuvre(
                "j-turn", mu=mu, setup=DriveSetup(vehicle=vehicle, sensors="mems-leak")
            )[0]
        )
        drives += (
            [simulate_manoeuvre("double-lane-change", mu=mu, setup=DriveSetup(vehicle=vehicle))[0]]
            if of_controllers
            else []
        )
        logs.append(
            np.concatenate(
                [drive[c].to_numpy() for drive in drives for c in ("ax", "ay", "omega_fl")]
            )
        )
    assert np.abs(logs[0] - logs[1]).max() > 1e-3
