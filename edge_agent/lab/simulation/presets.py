"""The vehicles of the simulator: their true parameters, and the (inexact) vehicle files that
describe them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from edge_agent.dynamics.parameters import Parameter, parameter_row
from edge_agent.lab.simulation.motor import Pmsm
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.thresholds import GRAVITY
from schemas.vehicle import Vehicle

CURVES: Final = {"magic-formula": 0.0, "brush": 1.0, "dugoff": 2.0}  # name -> TrueParameter.CURVE
STIFFNESSES: Final = {"proportional-to-friction": 1.0}  # name -> TrueParameter.SOFTENING


@dataclass(frozen=True)
class TrueVehicle:
    """True parameters of a vehicle, including those that no vehicle file contains.

    The force of a tyre depends on the normalised slip θ: slip times slip stiffness, divided by the
    largest force μ F_z. Shape c and curvature e determine the θ at which the force has its peak.
    For c = 1.6 and e = -.4 the peak is at θ = 2.3, and for c = 1.4 and e = .1 at θ = 3.5. Beyond
    the peak the force decreases. An estimator that assumes the textbook shape has force errors of 5
    to 15 % at these slips.
    """

    vehicle: Vehicle
    shape: float = 1.5
    curvature: float = -0.3
    degression: float = 0.15
    lag: float = 0.1
    # share of gravity that roll adds to a measured a_y per a_y: 4 degrees of roll per g
    roll_leak: float = 0.07
    pitch_leak: float = 0.03
    drag: float = 0.4  # [kg/m] half of 1.2 kg/m^3 · 0.3 · 2.2 m^2
    rolling: float = 0.008
    slip_limit: float = 0.08
    brake_front: float = 0.70
    power: float = 90e3
    curve: str = "magic-formula"  # a key of CURVES
    # power of friction with which the stiffness decreases; 0 to 0.3 for real tyres
    softening: float = 0.0
    # "similarity", or "proportional-to-friction" (power 1) as printed in papers 000, 003 and 004
    stiffness: str = "similarity"
    # cornering stiffness per load of the rear tyres over that of the front tyres
    rear_slope: float = 1.0
    # wheel-hub motors that follow the demanded torque; None: a pedal with a lag
    motors: Pmsm | None = None
    # angle of the rear wheels over that of the front wheels; negative at low speed
    rear_steer: float = 0.0
    relaxation: float = 0.0  # [m] relaxation length of the tyres
    # cycles per second of anti-lock control; 0: smooth slip control that is not reported
    abs_hz: float = 0.0
    tcs: float = 0.0  # 1: traction control, for vehicles with abs_hz
    esc: float = 0.0  # 1: stability control, for vehicles with abs_hz
    # [m/s^2] braking by engine or generator at the driven wheels
    regeneration: float = 0.0

    def __post_init__(self) -> None:
        for field, known in (("curve", CURVES), ("stiffness", ("similarity", *STIFFNESSES))):
            if getattr(self, field) not in known:
                raise InputError(
                    field,
                    f"there is no {getattr(self, field)!r}",
                    f"choose one of {', '.join(known)}",
                )
        if self.stiffness != "similarity" and self.softening:
            raise InputError(
                "softening", "the stiffness is proportional to friction", "leave one of them out"
            )

    def row(self) -> FloatArray:
        """Return the parameters for `plant`, shape (PARAMETERS,), in the order of `Parameter` and
        `TrueParameter`.
        """
        drive = self.vehicle.drive_split_front
        nominal = parameter_row(
            self.vehicle.model_copy(update={"drive_split_front": 1.0 if drive is None else drive})
        )
        nominal[Parameter.REAR_SLOPE] = self.rear_slope
        own = (
            self.shape,
            self.curvature,
            self.degression,
            self.lag,
            self.roll_leak,
            self.pitch_leak,
        )
        return np.array(
            [
                *nominal,
                *own,
                self.drag,
                self.rolling,
                self.slip_limit,
                self.brake_front,
                self.power,
                CURVES[self.curve],
                STIFFNESSES.get(self.stiffness, self.softening),
                self.rear_steer,
                self.relaxation,
                self.abs_hz,
                self.tcs,
                self.esc,
                self.regeneration,
            ]
        )


def car(
    name: str,
    body: tuple[float, float, float],
    axles: tuple[float, float],
    tracks: tuple[float, float],
    *,
    radius: float,
    drive_front: float,
) -> Vehicle:
    """Return a vehicle whose tyres have the usual stiffness for their load: 20 per unit of
    longitudinal slip, and 17 per radian of slip angle.

    `body` is mass [kg], yaw inertia [kg m^2] and height of the centre of gravity [m]; `axles` are
    the distances [m] from the centre of gravity to the front and rear axle, `tracks` the front and
    rear track width [m]. `radius` is the wheel radius [m], and `drive_front` the share of the
    driving force at the front axle.
    """
    mass, yaw_inertia, cg_height = body
    load = mass * GRAVITY / 4.0
    return Vehicle(
        name=name,
        mass=mass,
        yaw_inertia=yaw_inertia,
        cg_to_front_axle=axles[0],
        cg_to_rear_axle=axles[1],
        track_front=tracks[0],
        track_rear=tracks[1],
        cg_height=cg_height,
        wheel_radius=radius,
        wheel_inertia=1.2,
        longitudinal_stiffness=20.0 * load,
        cornering_stiffness=17.0 * load,
        drive_split_front=drive_front,
    )


PRESETS: Final = {
    # Hatchback with front-wheel drive.
    "small": TrueVehicle(
        car(
            "small",
            (1180.0, 1420.0, 0.52),
            (1.02, 1.53),
            (1.48, 1.48),
            radius=0.305,
            drive_front=1.0,
        ),
        shape=1.45,
        power=65e3,
    ),
    # Paper 004, table 1, which does not give stiffnesses and wheel inertia. All wheels are driven.
    "sedan": TrueVehicle(
        car(
            "sedan",
            (1643.0, 1954.0, 0.545),
            (1.287, 1.403),
            (1.581, 1.586),
            radius=0.359,
            drive_front=0.5,
        ),
        shape=1.55,
        power=120e3,
    ),
    # Delivery van with rear-wheel drive and half of its load.
    "van": TrueVehicle(
        car(
            "van",
            (2350.0, 4600.0, 0.74),
            (1.55, 1.75),
            (1.70, 1.68),
            radius=0.345,
            drive_front=0.0,
        ),
        shape=1.40,
        curvature=0.0,
        roll_leak=0.10,
        drag=0.75,
        power=100e3,
    ),
}

# Relative standard deviations of the errors in a vehicle file.
KNOWN: Final = {
    "mass": 0.03,
    "yaw_inertia": 0.05,
    "wheel_radius": 0.002,
    "cg_height": 0.05,
    "longitudinal_stiffness": 0.12,
    "cornering_stiffness": 0.10,
}


def true_vehicle(vehicle: str | Vehicle | TrueVehicle) -> TrueVehicle:
    """Return a preset by name, or a true vehicle with ordinary tyres from the parameters of a
    vehicle file.

    Raises:
        InputError: there is no preset of that name.
    """
    if isinstance(vehicle, TrueVehicle):
        return vehicle
    if isinstance(vehicle, Vehicle):
        return TrueVehicle(vehicle)
    if vehicle not in PRESETS:
        raise InputError(
            "vehicle",
            f"there is no vehicle preset {vehicle!r}",
            f"choose one of {', '.join(PRESETS)}",
        )
    return PRESETS[vehicle]


def matched_to_papers(vehicle: TrueVehicle) -> TrueVehicle:
    """Return the vehicle without the effects that the papers' model leaves out: drag, rolling
    resistance, lag of the loads, tyres whose stiffness grows less than the load.

    The tyre curve of the returned vehicle is a Magic Formula whose middle part is as steep as that
    of the Dugoff model.
    """
    return replace(
        vehicle, shape=1.5, curvature=-1.0, degression=0.0, lag=1e-3, drag=0.0, rolling=0.0
    )


def as_printed(vehicle: TrueVehicle, *, proportional: bool = False) -> TrueVehicle:
    """Return the vehicle without the effects that the papers' model leaves out (see
    `matched_to_papers`), and with Dugoff tyres. With `proportional`, tyre stiffness is proportional
    to friction.
    """
    stiffness = "proportional-to-friction" if proportional else "similarity"
    return replace(matched_to_papers(vehicle), curve="dugoff", stiffness=stiffness)


def nominal(truth: TrueVehicle, rng: np.random.Generator) -> Vehicle:
    """Return the content of the vehicle file: the true parameters, each with a random normal error
    of the size in KNOWN.
    """
    file_values = {
        name: getattr(truth.vehicle, name) * (1.0 + rng.normal(0.0, std))
        for name, std in KNOWN.items()
    }
    return truth.vehicle.model_copy(update=file_values)


def one_of_a_fleet(index: int, name: str, rng: np.random.Generator) -> TrueVehicle:
    """Return vehicle number `index` of a fleet. It is based on the vehicle presets, used in turn;
    load, tyres and suspension of each vehicle are random.
    """
    base = list(PRESETS.values())[index % len(PRESETS)]
    extra = rng.uniform(0.0, 0.12)  # passengers and luggage
    changed = {
        "name": name,
        "mass": base.vehicle.mass * (1.0 + extra),
        "yaw_inertia": base.vehicle.yaw_inertia * (1.0 + extra),
        "longitudinal_stiffness": base.vehicle.longitudinal_stiffness * rng.uniform(0.85, 1.25),
        "cornering_stiffness": base.vehicle.cornering_stiffness * rng.uniform(0.85, 1.20),
    }
    return replace(
        base,
        vehicle=base.vehicle.model_copy(update=changed),
        shape=rng.uniform(1.38, 1.62),
        curvature=rng.uniform(-0.5, 0.1),
        roll_leak=base.roll_leak * rng.uniform(0.7, 1.3),
        rolling=rng.uniform(0.006, 0.011),
    )


def winter_equipped(truth: TrueVehicle, rng: np.random.Generator) -> TrueVehicle:
    """Return the vehicle with winter equipment: tyres with relaxation length, ABS that works in
    cycles, in most cases traction control and ESC, and drag torque when the accelerator is
    released.

    A third of the vehicles recover energy like electric cars when the accelerator is released; the
    others are slowed by the drag of an engine.
    """
    electric = rng.uniform() < 1.0 / 3.0
    return replace(
        truth,
        relaxation=rng.uniform(0.30, 0.60),
        abs_hz=rng.uniform(6.0, 10.0),
        tcs=float(rng.uniform() < 0.85),
        esc=float(rng.uniform() < 0.85),
        regeneration=rng.uniform(1.0, 2.0) if electric else 0.35,
    )
