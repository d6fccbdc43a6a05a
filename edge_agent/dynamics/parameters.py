"""Parameters of a vehicle as an array of numbers for the compiled functions."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple, TypeAlias

import numpy as np

from schemas.numeric import FloatArray
from schemas.runtime.jit import inlined
from schemas.thresholds import GRAVITY
from schemas.vehicle import Vehicle


class Parameter(IntEnum):
    """Index of a vehicle parameter in a parameter row (array of all parameters of one vehicle)."""

    MASS = 0  # [kg]
    YAW_INERTIA = 1  # [kg m^2]
    TO_FRONT = 2  # [m] distance from centre of gravity to front axle
    TO_REAR = 3  # [m] distance from centre of gravity to rear axle
    TRACK_FRONT = 4  # [m]
    TRACK_REAR = 5  # [m]
    CG_HEIGHT = 6  # [m]
    RADIUS = 7  # [m] wheel radius
    WHEEL_INERTIA = 8  # [kg m^2]
    SLOPE_X = 9  # [1] longitudinal slip stiffness per wheel load
    SLOPE_Y = 10  # [1/rad] cornering stiffness per wheel load
    DRIVE_FRONT = 11  # [1] share of the driving force on the front axle; NaN if unknown
    # The next three change the stiffness as in the papers' tyre models; 0, 0 and 1 change nothing.
    PROPORTIONAL = 12  # 1 if stiffness is proportional to friction (000, 003, 004 as printed)
    # [1] e of K = slope*F_z*(1 + e - e*F_z/F_0), the polynomial (14) of 001; F_0 = m*g/4
    QUADRATIC = 13
    # [1] ratio of rear to front cornering stiffness per load (002, table 1)
    REAR_SLOPE = 14
    REAR_LOCKED = 15  # 1 if the rear wheels turn as one (locked differential), else 0


def parameter_row(vehicle: Vehicle) -> FloatArray:
    """Return the parameters of `vehicle`, shape (16,), indexed by `Parameter`.

    The stiffnesses in the vehicle file are means over the four wheels at static load. The row
    contains stiffness per newton of load, which is valid for lightly and heavily loaded wheels.

    If the file gives a separate rear cornering stiffness, that value is used for all wheels. The
    front axle appears softer, because steering column and bushings yield. The default estimator
    estimates this effect separately, by its state `compliance`.
    """
    static_load = vehicle.mass * GRAVITY / 4.0
    rear = vehicle.cornering_stiffness_rear
    rear_load = 0.5 * vehicle.mass * GRAVITY * vehicle.cg_to_front_axle
    rear_load /= vehicle.cg_to_front_axle + vehicle.cg_to_rear_axle
    drive = vehicle.drive_split_front
    return np.array(
        [
            vehicle.mass,
            vehicle.yaw_inertia,
            vehicle.cg_to_front_axle,
            vehicle.cg_to_rear_axle,
            vehicle.track_front,
            vehicle.track_rear,
            vehicle.cg_height,
            vehicle.wheel_radius,
            vehicle.wheel_inertia,
            vehicle.longitudinal_stiffness / static_load,
            vehicle.cornering_stiffness / static_load if rear is None else rear / rear_load,
            np.nan if drive is None else drive,
            0.0,
            0.0,
            1.0,
            float(vehicle.rear_axle_locked),
        ]
    )


def parameter_table(vehicles: Sequence[Vehicle]) -> FloatArray:
    """Return the parameters of all vehicles, one row each, shape (N, 16). A vehicle that occurs
    several times is converted once.
    """
    models = {id(vehicle): vehicle for vehicle in vehicles}
    place = {model: k for k, model in enumerate(models)}
    rows = np.stack([parameter_row(vehicle) for vehicle in models.values()])
    return np.asarray(rows[[place[id(vehicle)] for vehicle in vehicles]])


class Body(NamedTuple):
    """Parameters of the vehicle that the equations of body and tyres use. They are scalars instead
    of an array, because compiled code handles scalars faster.
    """

    mass: float
    yaw_inertia: float
    to_front: float
    to_rear: float
    track_front: float
    track_rear: float
    cg_height: float
    radius: float
    slope_x: float
    slope_y: float
    proportional: float
    quadratic: float
    rear_slope: float


@inlined
def body_of(row: FloatArray) -> Body:
    """Return those parameters of a parameter row (15,) that the equations of body and tyres use."""
    p = Parameter
    return Body(
        row[p.MASS],
        row[p.YAW_INERTIA],
        row[p.TO_FRONT],
        row[p.TO_REAR],
        row[p.TRACK_FRONT],
        row[p.TRACK_REAR],
        row[p.CG_HEIGHT],
        row[p.RADIUS],
        row[p.SLOPE_X],
        row[p.SLOPE_Y],
        row[p.PROPORTIONAL],
        row[p.QUADRATIC],
        row[p.REAR_SLOPE],
    )


Four: TypeAlias = tuple[float, float, float, float]
"""One number per wheel, in the order fl, fr, rl, rr."""


@inlined
def as_four(values: FloatArray) -> Four:
    """Return an array (4,) of values per wheel as a tuple of four scalars, because compiled code
    handles scalars faster.
    """
    return values[0], values[1], values[2], values[3]
