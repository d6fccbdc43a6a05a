"""Simulation of one manoeuvre of one vehicle. The result is a signal log with the true values, and
a vehicle file.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa

from edge_agent.dynamics.parameters import Parameter
from edge_agent.lab.simulation.counter_rng import checked_seed
from edge_agent.lab.simulation.faults import Fault, apply_faults
from edge_agent.lab.simulation.manoeuvres import (
    MANOEUVRES,
    Friction,
    Manoeuvre,
    Moment,
    TimedFriction,
)
from edge_agent.lab.simulation.motor import at_rest, turn_motor
from edge_agent.lab.simulation.place import GOTHENBURG, Origin
from edge_agent.lab.simulation.plant import (
    advance,
    command,
    gravity,
    ground_velocity,
    regenerate,
    start_at,
    strongest_pull,
    substeps_of,
    wheel_place,
)
from edge_agent.lab.simulation.presets import TrueVehicle, nominal, true_vehicle
from edge_agent.lab.simulation.record import RECORD, RecordColumn, observe
from edge_agent.lab.simulation.relief import (
    Relief,
    cross_slope,
    gradient,
    road_named,
    slope_in_body,
)
from edge_agent.lab.simulation.sensors import (
    SENSORS,
    Sensors,
    error_row,
    noise_keys,
    sense,
    sensors_named,
)
from edge_agent.lab.simulation.state import STATES, Control, Motion, TrueParameter, Wheel
from edge_agent.lab.simulation.unevenness import load_swing
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, per_wheel
from schemas.vehicle import Vehicle

TRUTH: Final = (
    ("true_vx", RecordColumn.VX),
    ("true_vy", RecordColumn.VY),
    ("true_yaw_rate", RecordColumn.YAW_RATE),
    ("true_x", RecordColumn.X),
    ("true_y", RecordColumn.Y),
    ("true_yaw", RecordColumn.YAW),
    ("true_ax", RecordColumn.AX),
    ("true_ay", RecordColumn.AY),
    *((name, RecordColumn.MU + i) for i, name in enumerate(per_wheel("true_mu"))),
    *((name, RecordColumn.UTILISATION + i) for i, name in enumerate(per_wheel("true_utilisation"))),
    ("true_slope", RecordColumn.SLOPE),
    ("true_bank", RecordColumn.BANK),
    ("true_abs_active", RecordColumn.ABS),
    ("true_tcs_active", RecordColumn.TCS),
    ("true_esc_active", RecordColumn.ESC),
)
STEERING_LAG_S: Final = 0.1  # [s] from the driver's demand to the road wheel
PEDAL_LAG_S: Final = 0.15
FASTEST_M_S: Final = 120.0  # [m/s] maximum speed at the start; no road car is faster
MOST_SAMPLES: Final = 5_000_000  # 1.6 GB of true values


@dataclass(frozen=True)
class DriveSetup:
    """Vehicle, sensors and road of a simulated manoeuvre.

    Attributes:
        rate_hz: sampling rate [Hz].
        vehicle: a key of PRESETS, or the true vehicle itself.
        sensors: a key of SENSORS, or a sensor set.
        faults: sensor faults that are applied to the readings.
        road: a key of ROADS, drawn by the seed, or a relief.
        slope: rise per metre along the track [1] that is added to the road.
        origin: position of the start on earth.
    """

    rate_hz: float = 100.0
    vehicle: str | Vehicle | TrueVehicle = "sedan"
    sensors: str | Sensors = "mems"
    faults: tuple[Fault, ...] = ()
    road: str | Relief = "level"
    slope: float = 0.0
    origin: Origin = GOTHENBURG


USUAL_SETUP: Final = DriveSetup()


def simulate_manoeuvre(
    name: str,
    *,
    mu: Friction | None = None,
    speed: float | None = None,
    seed: int = 0,
    duration_s: float | None = None,
    setup: DriveSetup = USUAL_SETUP,
) -> tuple[pa.Table, Vehicle]:
    """Simulate a manoeuvre and return (log, vehicle file).

    The log has one row per sample: `t` [s], the CHANNELS of `schemas.signals` (null where missing),
    and the true values (`true_vx`, `true_mu_fl`, `true_utilisation_fl`, … in the units of the
    signals). The vehicle file is nominal: the true vehicle differs from it by the errors in
    `presets.KNOWN`. With sensors "ideal" the vehicle file is exact.

    Args:
        name: a key of MANOEUVRES.
        mu: friction; by default that of the manoeuvre.
        speed: initial speed [m/s]; by default that of the manoeuvre.
        seed: seed of all random numbers, not negative.
        duration_s: duration [s]; by default that of the manoeuvre.
        setup: vehicle, sensors and road.

    Raises:
        InputError: an argument is out of range or unknown.
    """
    manoeuvre = _manoeuvre_of(name)
    chosen = sensors_named(setup.sensors)
    truth = true_vehicle(setup.vehicle)
    seed = checked_seed(seed)
    _check_positive(speed=speed, rate_hz=setup.rate_hz, duration_s=duration_s)
    speed = manoeuvre.speed if speed is None else speed
    if speed > FASTEST_M_S:
        raise InputError("speed", f"{speed:g} m/s is no car's", f"give at most {FASTEST_M_S:g}")
    duration = manoeuvre.duration if duration_s is None else duration_s
    if duration * setup.rate_hz > MOST_SAMPLES:
        problem = f"{duration:g} s at {setup.rate_hz:g} Hz are more than {MOST_SAMPLES} samples"
        raise InputError("duration_s", problem, "give a lower rate or duration")
    road = road_named(setup.road, seed, setup.slope)
    world = ProvingGround(
        _friction_field(manoeuvre.friction if mu is None else mu), road.table, road.surface_table
    )
    records = _drive_manoeuvre(
        manoeuvre, truth, world, speed, setup.rate_hz, max(1, round(duration * setup.rate_hz))
    )
    signals = _sense_records(records, chosen, setup.origin, seed, setup.rate_hz)
    t = np.arange(len(records)) / setup.rate_hz
    signals = apply_faults(t, signals, setup.faults)
    file = (
        truth.vehicle
        if chosen == SENSORS["ideal"]
        else nominal(truth, np.random.default_rng([seed, 0]))
    )
    return _log_table(t, signals, records), file


def _manoeuvre_of(name: str) -> Manoeuvre:
    if name not in MANOEUVRES:
        raise InputError(
            "manoeuvre", f"there is no manoeuvre {name!r}", f"choose one of {', '.join(MANOEUVRES)}"
        )
    return MANOEUVRES[name]


def _check_positive(**positive: float | None) -> None:
    for name, value in positive.items():
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise InputError(name, f"{value} is not possible", "give a positive number")


def _friction_field(mu: Friction) -> Callable[[float, float, float], float]:
    if isinstance(mu, TimedFriction):
        return lambda t, _x, _y: mu.value(t)
    if callable(mu):
        return lambda _t, x, y: mu(x, y)
    if not 0.0 < mu <= 2.0:
        raise InputError("mu", f"{mu} is not a friction", "give a number in (0, 2]")
    return lambda _t, _x, _y: mu


class ProvingGround(NamedTuple):
    """The test track: a function that returns the friction at time t [s] and place (x, y) [m], and
    the tables of the relief (slopes) and of the unevenness of its surface.
    """

    friction: Callable[[float, float, float], float]
    relief: FloatArray
    surface: FloatArray


def _drive_manoeuvre(
    manoeuvre: Manoeuvre,
    truth: TrueVehicle,
    world: ProvingGround,
    speed: float,
    rate_hz: float,
    samples: int,
) -> FloatArray:
    """Simulate the drive and return the records of its true values (T, RECORD). On a slope, the
    simulated driver demands additional force to balance gravity.
    """
    p = truth.row()
    x = np.zeros(STATES)
    u = np.zeros((len(Control), 4))
    w = np.zeros((len(Wheel), 4))
    records = np.empty((samples, RECORD))
    substeps = substeps_of(rate_hz)
    dt = 1.0 / rate_hz
    start_at(x, p, (0.0, 0.0, 0.0), speed)
    across = cross_slope(world.relief, 0.0)
    steer = 0.0  # [rad] steering angle, which lags behind the driver's wish
    force = 0.0  # [N] pedal force
    lost = 0.0  # [m] integral of the speed error over time
    currents = at_rest()
    for k in range(samples):
        east, north = gradient(world.relief, (x[Motion.X], x[Motion.Y]), (1.0, 0.0), across)
        u[Control.TILT, :2] = slope_in_body(east, north, x[Motion.YAW])
        now = replace(_moment_of(k * dt, x, speed), lost=lost, motors=truth.motors)
        now = replace(now, gain=float(records[k - 1, RecordColumn.AX]) if k else 0.0)
        lost += dt * (speed - now.vx)
        wish, acceleration = manoeuvre.control(now)
        acceleration -= gravity(u)[0]
        if k == 0 and speed == 0.0:
            # In a standing car, the driver has pressed the pedal before the drive begins.
            force = float(p[Parameter.MASS]) * acceleration
        steer += (wish - steer) * -math.expm1(-dt / STEERING_LAG_S)
        demanded_force = float(p[Parameter.MASS]) * acceleration
        force += (demanded_force - force) * (
            1.0 if truth.motors else -math.expm1(-dt / PEDAL_LAG_S)
        )
        force = min(force, strongest_pull(p, float(x[Motion.VX])))
        command(p, u, steer, force)
        if p[TrueParameter.REGENERATION] > 0.0:
            regenerate(x, p, u)
        if truth.motors is not None:
            for i in range(4):
                demanded_torque = float(u[Control.DRIVE, i] - u[Control.BRAKE, i])
                u[Control.DRIVE, i] = turn_motor(
                    currents[i], truth.motors, demanded_torque, float(x[Motion.OMEGA + i]), dt
                )
                u[Control.BRAKE, i] = 0.0
        _set_road(x, p, u, world, k * dt)
        observe(x, p, u, w, records[k])
        advance(x, p, u, w, dt / substeps, substeps)
    return records


def _set_road(x: FloatArray, p: FloatArray, u: FloatArray, world: ProvingGround, t: float) -> None:
    """Write to the controls `u` the friction and the load swing of the road under each wheel at the
    time t [s]. `x` is the state of the car, and `p` its parameters.
    """
    velocity = ground_velocity(x)
    for i in range(4):
        place = wheel_place(x, p, i)
        u[Control.MU, i] = world.friction(t, *place)
        u[Control.SWING, i] = load_swing(world.surface, place, velocity)


def _moment_of(t: float, x: FloatArray, speed: float) -> Moment:
    return Moment(
        t, float(x[Motion.X]), float(x[Motion.Y]), float(x[Motion.YAW]), float(x[Motion.VX]), speed
    )


def _sense_records(
    records: FloatArray, sensors: Sensors, origin: Origin, seed: int, rate_hz: float
) -> FloatArray:
    """Simulate the sensors: return readings (T, 18) for the records of true values (T, RECORD) of
    one vehicle.
    """
    errors = error_row(sensors, origin, seed, 0)[None]
    place = np.array([origin.latitude, origin.longitude, *origin.per_metre])
    keys = tuple(np.array([key]) for key in noise_keys(seed, 0))
    return sense(
        records[:, None], errors, np.zeros((1, 3)), place, (keys[0], keys[1]), (0, rate_hz, 0)
    )[:, 0]


def _log_table(t: FloatArray, signals: FloatArray, records: FloatArray) -> pa.Table:
    """Return a simulated drive as the table of a signal log, with true values. NaN readings become
    null; true values are never null.
    """
    columns = {"t": pa.array(t)}
    columns |= {name: pa.array(signals[:, i], from_pandas=True) for i, name in enumerate(CHANNELS)}
    return pa.table(columns | {name: pa.array(records[:, column]) for name, column in TRUTH})
