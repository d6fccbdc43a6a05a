"""Vehicle file: nominal parameters of a vehicle. The estimator assumes that they are known to a few
per cent.
"""

from __future__ import annotations

import difflib
import json
import logging
import math
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from schemas.config import explain_validation_error, require_unique_names
from schemas.errors import InputError
from schemas.thresholds import GRAVITY
from schemas.vehicle_classes import PREFIX, fields_of_class

Metres = Annotated[float, Field(gt=0.0, lt=20.0, allow_inf_nan=False)]
# Accepted range of the radius of gyration about the vertical axis, divided by the wheelbase. Cars
# have .43 to .5 (Heydinger et al., SAE 1999-01-1336). A mass in tonnes would give a ratio thirty
# times too large.
LEAST_GYRATION: Final = 0.1
MOST_GYRATION: Final = 2.0
# Similarity (difflib) from which an unknown name is a misspelt one. "weel_radius" has .96.
MISSPELT: Final = 0.75

log = logging.getLogger(__name__)


Spread = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Learned = tuple[Annotated[float, Field(allow_inf_nan=False)], Spread]
"""A value and its standard deviation."""


class Calibration(BaseModel):
    """Sensor and wheel errors learned from a car's own drives. Each error is a pair (value,
    standard deviation), or None if it was not learned.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: Literal[1] = 1
    drives: Annotated[int, Field(ge=1, description="amount of driving that it was learned from")]
    radius_fl: Annotated[
        Learned | None,
        Field(description="relative excess of its speed over the mean of the four wheels [1]"),
    ] = None
    radius_fr: Annotated[Learned | None, Field(description="as radius_fl")] = None
    radius_rl: Annotated[Learned | None, Field(description="as radius_fl")] = None
    radius_rr: Annotated[Learned | None, Field(description="as radius_fl")] = None
    ax: Annotated[
        Learned | None, Field(description="reading on a level road at constant speed [m/s^2]")
    ] = None
    ay: Annotated[Learned | None, Field(description="as ax [m/s^2]")] = None
    yaw_rate: Annotated[
        Learned | None, Field(description="reading when driving straight [rad/s]")
    ] = None
    steer_offset: Annotated[
        Learned | None, Field(description="reading when driving straight [rad]")
    ] = None
    steer_gain: Annotated[
        Learned | None, Field(description="ratio of the reading to the road wheels' true angle [1]")
    ] = None
    force_gain: Annotated[
        Learned | None,
        Field(
            description="ratio of torque over radius to the force that accelerates the file's "
            "mass [1]"
        ),
    ] = None
    wheel_lag: Annotated[
        Learned | None,
        Field(description="delay of the wheel speeds behind the inertial unit [s]"),
    ] = None
    steer_lag: Annotated[
        Learned | None,
        Field(description="delay of the steering angle behind the inertial unit [s]"),
    ] = None
    understeer: Annotated[
        Learned | None,
        Field(description="steering angle needed in addition to L r/v [rad per m/s^2]"),
    ] = None


class Vehicle(BaseModel):
    """Nominal parameters of one vehicle, as in its vehicle file, in SI units."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Annotated[str, Field(min_length=1, max_length=64, description="name of the vehicle")]
    mass: Annotated[float, Field(gt=0.0, lt=100_000.0, allow_inf_nan=False, description="[kg]")]
    yaw_inertia: Annotated[
        float, Field(gt=0.0, lt=1e7, allow_inf_nan=False, description="[kg m^2]")
    ]
    cg_to_front_axle: Annotated[Metres, Field(description="[m]")]
    cg_to_rear_axle: Annotated[Metres, Field(description="[m]")]
    track_front: Annotated[Metres, Field(description="[m]")]
    track_rear: Annotated[Metres, Field(description="[m]")]
    cg_height: Annotated[float, Field(gt=0.0, lt=5.0, allow_inf_nan=False, description="[m]")]
    wheel_radius: Annotated[
        float, Field(gt=0.0, lt=2.0, allow_inf_nan=False, description="[m], effective")
    ]
    wheel_inertia: Annotated[
        float, Field(gt=0.0, lt=1000.0, allow_inf_nan=False, description="[kg m^2], one wheel")
    ]
    longitudinal_stiffness: Annotated[
        float,
        Field(
            gt=0.0,
            lt=1e7,
            allow_inf_nan=False,
            description="[N per unit slip], one wheel at static load",
        ),
    ]
    cornering_stiffness: Annotated[
        float,
        Field(gt=0.0, lt=1e7, allow_inf_nan=False, description="[N/rad], one wheel at static load"),
    ]
    wheel_radius_front: Annotated[
        Metres | None, Field(description="[m], where the axles' tyres differ")
    ] = None
    wheel_radius_rear: Annotated[Metres | None, Field(description="[m], as wheel_radius_front")] = (
        None
    )
    cornering_stiffness_front: Annotated[
        float | None,
        Field(gt=0.0, lt=1e7, description="[N/rad], one front wheel, bushes and steering included"),
    ] = None
    cornering_stiffness_rear: Annotated[
        float | None,
        Field(gt=0.0, lt=1e7, description="[N/rad], one rear wheel, bushes and steering included"),
    ] = None
    steering_compliance: Annotated[
        float | None,
        Field(
            ge=-0.1,
            le=0.1,
            description="angle that the front wheels lose to steering, bushes and roll [rad per g]",
        ),
    ] = None
    rear_axle_locked: Annotated[
        bool, Field(description="true if the rear wheels turn as one (no differential)")
    ] = False
    drive_split_front: Annotated[
        float | None,
        Field(
            ge=0.0, le=1.0, description="share of the driving torque at the front axle, where known"
        ),
    ] = None
    steering_ratio: Annotated[
        float | None,
        Field(
            gt=1.0,
            lt=60.0,
            description="ratio of the steering wheel's angle to the road wheels', where known",
        ),
    ] = None
    calibration: Annotated[
        Calibration | None, Field(description="learned by edge-agent calibrate")
    ] = None

    def axle_radius(self, axle: int) -> float:
        """Return the wheel radius [m] of the front (0) or rear (1) axle."""
        own = self.wheel_radius_front if axle == 0 else self.wheel_radius_rear
        return self.wheel_radius if own is None else own

    def understeer_per_g(self) -> float | None:
        """Return the understeer gradient [rad per g]: the steering angle beyond L·r/v (wheelbase ×
        yaw rate / speed) that the axle stiffnesses in the file imply. Return None if the vehicle
        file contains no axle stiffness and no steering compliance.

        The slip angles of the axles at 1 g differ by 1/k_f - 1/k_r, where k is the cornering
        stiffness of a wheel divided by its static load.
        """
        wheelbase = self.cg_to_front_axle + self.cg_to_rear_axle
        per_axle = 0.5 * self.mass * GRAVITY / wheelbase
        front = self.cornering_stiffness_front
        rear = self.cornering_stiffness_rear
        if front is None and rear is None:
            return self.steering_compliance
        usual = self.cornering_stiffness / (0.25 * self.mass * GRAVITY)
        slip_front = 1.0 / usual if front is None else per_axle * self.cg_to_rear_axle / front
        slip_rear = 1.0 / usual if rear is None else per_axle * self.cg_to_front_axle / rear
        return slip_front - slip_rear + (self.steering_compliance or 0.0)


def load_vehicle(path: Path | str) -> Vehicle:
    """Read a vehicle file (JSON), or return the parameters of a vehicle class for a path such as
    "class:compact". A name that resembles no known one, such as a note of the owner, is ignored
    with a warning.

    Raises:
        InputError: the file cannot be read, a name is misspelt, a field is missing or out of range,
            or fields do not fit together: mass and yaw inertia, or a stiffness and the wheel's
            load. The error names the field and the fix.
    """
    if str(path).startswith(PREFIX):
        return Vehicle.model_validate(fields_of_class(str(path).removeprefix(PREFIX)))
    try:
        vehicle = Vehicle.model_validate_json(_drop_foreign_names(Path(path)))
    except OSError as error:
        fix = f"name a vehicle file; of a simulated drive, simulate --vehicle-out {path} writes it"
        raise InputError("vehicle", f"cannot read {path} ({error.strerror})", fix) from error
    except ValidationError as error:
        raise explain_validation_error(error, f"vehicle file {path}", Vehicle) from error
    wheelbase = vehicle.cg_to_front_axle + vehicle.cg_to_rear_axle
    gyration = math.sqrt(vehicle.yaw_inertia / vehicle.mass)
    if not LEAST_GYRATION < gyration / wheelbase < MOST_GYRATION:
        of_both = f"{vehicle.mass:g} with yaw_inertia {vehicle.yaw_inertia:g}"
        problem = f"{of_both} has a radius of gyration of {gyration:.3g} m"
        fix = f"give kg and kg m^2: that of cars is half the wheelbase, here {wheelbase:.3g} m"
        raise InputError("mass", problem, fix)
    # A tyre reaches the force of its load far below a slip of 1. In kN or per degree it does not.
    load = 0.25 * vehicle.mass * GRAVITY
    for name, value in vehicle:
        if "stiffness" in name and value is not None and value < load:
            problem = f"{value:g} is less than the load of a wheel, {load:.0f} N"
            unit = "N per unit slip" if name == "longitudinal_stiffness" else "N/rad"
            fix = f"give {unit} of one wheel; a car's is 10 to 30 times the load"
            raise InputError(name, problem, fix)
    return vehicle


def _drop_foreign_names(path: Path) -> bytes:
    """Return the content of a vehicle file without names that resemble no known one. Log a warning
    for each of them.
    """
    content = path.read_bytes()
    require_unique_names(content, f"vehicle file {path}")
    try:
        given = json.loads(content)
    except ValueError:
        return content  # the validation then reports invalid JSON
    known = list(Vehicle.model_fields)
    foreign = [
        name
        for name in (given if isinstance(given, dict) else ())
        if name not in known and not difflib.get_close_matches(name, known, 1, MISSPELT)
    ]
    for name in foreign:
        log.warning("vehicle file %s: %s is not a known name; it is ignored", path, name)
    if not foreign:
        return content
    return json.dumps({name: given[name] for name in given if name not in foreign}).encode()
