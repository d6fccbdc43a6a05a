"""Tests of options of the simulation that the papers need: each option (tyre model, friction that
changes in time, motors, noise per channel) has exactly the stated effect.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_agent.dynamics.tyres import combined_dugoff, dugoff
from edge_agent.lab.simulation import PRESETS, DriveSetup, simulate_manoeuvre
from edge_agent.lab.simulation.manoeuvres import TimedFriction
from edge_agent.lab.simulation.motor import Pmsm, at_rest, speed_demand, turn_motor
from edge_agent.lab.simulation.presets import TrueVehicle, as_printed
from edge_agent.lab.simulation.white import SCHEDULE, add_white, on_ay
from schemas.errors import InputError
from schemas.signals import CHANNELS, S

SEDAN = PRESETS["sedan"]
PRINTED = as_printed(SEDAN, proportional=True)


@pytest.mark.parametrize("theta", [0.2, 0.5, 0.9, 4.0])
def test_dugoff_curve_of_the_plant_is_that_of_the_filters(theta: float) -> None:
    force, _ = combined_dugoff((theta, 0.0), (1000.0, 1000.0), 0.5, 2000.0)
    assert dugoff(theta) * 1000.0 == pytest.approx(force)


def slip_per_force(vehicle: TrueVehicle, mu: float) -> float:
    """Return the slip of a wheel during gentle acceleration, divided by the friction coefficient
    that this wheel uses.
    """
    log, file = simulate_manoeuvre(
        "throttle",
        mu=mu,
        duration_s=2.0,
        setup=DriveSetup(vehicle=replace(vehicle, power=400e3), sensors="ideal"),
    )
    speed = log["true_vx"].to_numpy()[-1]
    slip = file.wheel_radius * log["omega_fl"].to_numpy()[-1] / speed - 1.0
    return float(slip / (mu * log["true_utilisation_fl"].to_numpy()[-1]))


def test_stiffness_of_the_plant_is_proportional_to_friction_if_asked() -> None:
    similar = as_printed(SEDAN)
    assert slip_per_force(similar, 0.9) == pytest.approx(slip_per_force(similar, 0.75), rel=0.02)
    assert slip_per_force(PRINTED, 0.75) / slip_per_force(PRINTED, 0.9) == pytest.approx(
        0.9 / 0.75, rel=0.02
    )


def test_friction_jumps_in_time_under_all_wheels_at_once() -> None:
    log, _ = simulate_manoeuvre(
        "straight",
        mu=TimedFriction(0.8, 0.4, 1.0),
        duration_s=2.0,
        setup=DriveSetup(sensors="ideal"),
    )
    for wheel in ("fl", "fr", "rl", "rr"):
        mu = log[f"true_mu_{wheel}"].to_numpy()
        assert (mu[:100] == 0.8).all()
        assert (mu[100:] == 0.4).all()


def test_motors_give_the_torque_that_is_asked_within_some_milliseconds() -> None:
    motors = Pmsm()
    currents = at_rest()
    early = turn_motor(currents[0], motors, 100.0, 30.0, 5e-4)
    late = turn_motor(currents[0], motors, 100.0, 30.0, 0.05)
    assert 0.0 < early < 60.0
    assert late == pytest.approx(100.0, rel=0.02)


def test_motors_lose_torque_where_the_voltage_ends() -> None:
    motors = Pmsm(voltage=100.0)
    currents = at_rest()
    assert turn_motor(currents[0], motors, 100.0, 100.0, 0.1) < 10.0


def test_speed_control_takes_back_a_lasting_error_by_its_integral() -> None:
    motors = Pmsm()
    assert speed_demand(motors, 1.0, 0.0, 0.0) == pytest.approx(motors.proportional)
    assert speed_demand(motors, 0.0, 2.0, 0.0) == pytest.approx(2.0 * motors.integral)
    assert speed_demand(motors, 0.0, 0.0, 1.0) == pytest.approx(-motors.derivative)


def test_car_with_motors_holds_its_speed_against_drag() -> None:
    dragged = replace(as_printed(SEDAN), drag=2.0, rolling=0.01)
    ends = []
    for vehicle in (dragged, replace(dragged, motors=Pmsm())):
        log, _ = simulate_manoeuvre(
            "straight",
            speed=15.0,
            duration_s=20.0,
            setup=DriveSetup(vehicle=vehicle, sensors="ideal"),
        )
        ends.append(abs(log["true_vx"].to_numpy()[-1] - 15.0))
    assert ends[1] < 0.02 < ends[0]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"curve": "parabola"}, "curve"),
        ({"stiffness": "soft"}, "stiffness"),
        ({"stiffness": "proportional-to-friction", "softening": 0.3}, "softening"),
    ],
)
def test_unknown_tyres_are_refused(change: dict[str, object], field: str) -> None:
    with pytest.raises(InputError, match=field):
        replace(SEDAN, **change)  # type: ignore[arg-type]


def test_variable_noise_is_on_the_lateral_acceleration_alone() -> None:
    t = np.arange(0.0, 6.0, 0.001)
    variance = on_ay(t, 0.05)
    assert (variance[:, [0, 2]] == 0.05).all()
    assert set(variance[:, 1]) == set(SCHEDULE)
    signals = np.zeros((len(t), len(CHANNELS)))
    add_white(signals, variance, np.random.default_rng(0))
    quiet = (t >= 2.0) & (t < 4.0)
    assert signals[quiet, S.AY].var() == pytest.approx(0.01, rel=0.15)
    assert signals[quiet, S.AX].var() == pytest.approx(0.05, rel=0.15)
