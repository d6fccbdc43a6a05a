"""Vehicle files of common classes, for a car whose own parameters are unknown.

The values are typical of production cars with one or two persons. Cornering stiffness is per wheel,
at static load, relative to the angle of the rim. It includes the compliance of steering and
suspension bushes, and the effect of roll. Therefore the front axle is softer than the rear axle and
every car understeers, by 20 to 35 mrad per g.

Six cars, such as Volvo S90 and VW Golf, were measured. Their cornering stiffness per radian is 10
to 17 times the wheel load at the front axle, and 15 to 25 times at the rear axle. Masses and
dimensions follow manufacturers' data sheets of cars of each class.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from schemas.errors import InputError
from schemas.thresholds import GRAVITY

PREFIX: Final = "class:"
FRONT_PER_LOAD: Final = 13.0  # [1/rad] cornering stiffness per wheel load; slip angle at the rim
REAR_PER_LOAD: Final = 20.0
ALONG_PER_LOAD: Final = 20.0  # [1] longitudinal slip stiffness per wheel load
WHEEL_INERTIA: Final = 1.3  # [kg m^2] of one wheel
# [1] yaw inertia over (mass x front arm x rear arm): .9 to 1.05 in Heydinger et al., SAE
# 1999-01-1336.
INERTIA_SHARE: Final = 0.97


class Size(NamedTuple):
    """Dimensions of a vehicle class: mass [kg], distances of the axles from the centre of gravity
    [m], track [m], height of the centre of gravity [m], wheel radius [m] and steering ratio.

    `drive_front` is the share of the driving torque at the front axle; None for a class that has
    cars with front, rear and all-wheel drive.
    """

    mass: float
    to_front: float
    to_rear: float
    track: float
    height: float
    radius: float
    steering_ratio: float
    drive_front: float | None


CLASSES: Final = {
    "small-car": Size(1180.0, 1.01, 1.50, 1.48, 0.53, 0.298, 15.0, 1.0),
    "compact": Size(1450.0, 1.09, 1.55, 1.54, 0.54, 0.315, 15.0, 1.0),
    "sedan": Size(1700.0, 1.28, 1.52, 1.58, 0.55, 0.330, 15.5, None),
    "large-sedan": Size(2000.0, 1.42, 1.55, 1.62, 0.56, 0.345, 16.0, None),
    "electric-sedan": Size(1900.0, 1.40, 1.48, 1.58, 0.46, 0.335, 10.5, None),
    "suv": Size(1850.0, 1.22, 1.46, 1.60, 0.66, 0.350, 15.5, None),
    "large-suv": Size(2350.0, 1.45, 1.50, 1.66, 0.72, 0.375, 16.5, None),
    "van": Size(2350.0, 1.50, 1.75, 1.69, 0.76, 0.340, 17.5, None),
    "pickup": Size(2250.0, 1.40, 1.80, 1.62, 0.72, 0.375, 17.5, 0.0),
    "sports-car": Size(1500.0, 1.35, 1.12, 1.57, 0.46, 0.335, 14.5, 0.0),
}


def fields_of_class(name: str) -> dict[str, str | float | None]:
    """Return the fields of the vehicle file for the vehicle class `name`, such as "compact".

    Raises:
        InputError: there is no class of this name.
    """
    if name not in CLASSES:
        raise InputError(
            "vehicle", f"there is no class {name!r}", f"choose one of {', '.join(CLASSES)}"
        )
    size = CLASSES[name]
    load = 0.5 * size.mass * GRAVITY / (size.to_front + size.to_rear)
    wheel_load = 0.25 * size.mass * GRAVITY
    mean_compliance = 0.5 * (1.0 / FRONT_PER_LOAD + 1.0 / REAR_PER_LOAD)
    return {
        "name": name,
        "mass": size.mass,
        "yaw_inertia": round(INERTIA_SHARE * size.mass * size.to_front * size.to_rear, 1),
        "cg_to_front_axle": size.to_front,
        "cg_to_rear_axle": size.to_rear,
        "track_front": size.track,
        "track_rear": size.track,
        "cg_height": size.height,
        "wheel_radius": size.radius,
        "wheel_inertia": WHEEL_INERTIA,
        "longitudinal_stiffness": round(ALONG_PER_LOAD * wheel_load),
        "cornering_stiffness": round(wheel_load / mean_compliance),
        "cornering_stiffness_front": round(FRONT_PER_LOAD * load * size.to_rear),
        "cornering_stiffness_rear": round(REAR_PER_LOAD * load * size.to_front),
        "drive_split_front": size.drive_front,
        "steering_ratio": size.steering_ratio,
    }
