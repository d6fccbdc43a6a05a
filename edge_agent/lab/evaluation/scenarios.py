"""The scenarios of the evaluation: the papers' manoeuvres with the papers' vehicles, the manoeuvres
for the default estimator's targets, and manoeuvres of other vehicles.

If a paper does not give some data (tyres, wheel inertia, the vehicle of paper 003), the scenario
uses those of the simulator's sedan or of an ordinary car. All four wheels are driven, as in the
papers.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

from edge_agent.lab.evaluation.batch import DriveSpec
from edge_agent.lab.simulation.manoeuvres import jump, kmh, split
from edge_agent.lab.simulation.presets import PRESETS, TrueVehicle, car, matched_to_papers

SLOPES: Final = ("longitudinal_stiffness", "cornering_stiffness")
SEDAN: Final = PRESETS["sedan"]  # paper 004, table 1
# Papers 000 and 001, table 2.
LIGHT: Final = TrueVehicle(
    car(
        "light",
        (830.0, 1110.0, 0.54),
        (1.17, 1.17),
        (1.416, 1.416),
        radius=0.278,
        drive_front=0.5,
    ),
    power=60e3,
)
# Paper 002, table 1. The paper does not give the height of the centre of gravity.
SMALL: Final = TrueVehicle(
    car(
        "in-wheel",
        (710.0, 1000.0, 0.50),
        (0.795, 0.975),
        (1.55, 1.55),
        radius=0.245,
        drive_front=0.5,
    ),
    power=60e3,
)
STRONG: Final = replace(SEDAN, power=400e3)  # with enough power for 0.6 g at 25 m/s
LOOSE: Final = replace(STRONG, slip_limit=math.inf)  # without slip control, so that wheels spin

# Vehicle of paper 004 with the vehicle model of its filter. The paper does not give its tyres.
MATCHED: Final = matched_to_papers(SEDAN)


def steered_behind(speed: float) -> TrueVehicle:
    """Return the vehicle of papers 000 and 001 with the rear wheels steered for zero sideslip in a
    steady turn at `speed` [m/s].

    The rear angle over the front angle is (K*m*a*v^2 - b) / (K*m*b*v^2 + a) (paper 001, equation
    53), with mass m and distances a, b from the centre of gravity to the axles. K = 1/(axle
    stiffness*wheelbase) is equal for both axles.
    """
    light = LIGHT.vehicle
    a = light.cg_to_front_axle
    b = light.cg_to_rear_axle
    pull = light.mass * speed * speed / (2.0 * light.cornering_stiffness * (a + b))
    return replace(LIGHT, rear_steer=(pull * a - b) / (pull * b + a))


# Vehicles that differ from the sedan: other driven axle, softer tyres, other load.
HATCHBACK: Final = PRESETS["small"]
VAN: Final = replace(
    PRESETS["van"],
    vehicle=PRESETS["van"].vehicle.model_copy(
        update={name: 0.7 * getattr(PRESETS["van"].vehicle, name) for name in SLOPES}
    ),
)
LOADED: Final = replace(
    SEDAN,
    vehicle=SEDAN.vehicle.model_copy(
        update={
            "mass": 2050.0,
            "yaw_inertia": 2500.0,
            "cg_height": 0.60,
            "cg_to_front_axle": 1.45,
            "cg_to_rear_axle": 1.24,
        }
    ),
)

PAPERS: Final = {
    "004.dlc": DriveSpec(
        "double-lane-change", SEDAN, 0.85, kmh(80), 50.0, about="double lane change, 80 km/h"
    ),
    "000.jump": DriveSpec(
        "two-lane-changes", steered_behind(kmh(30)), about="lane changes at 30 km/h, .5 to .3"
    ),
    "001.dlc": DriveSpec(
        "double-lane-change",
        steered_behind(kmh(40)),
        0.85,
        kmh(40),
        50.0,
        14.0,
        "double lane change, 40 km/h",
    ),
    "001.sine": DriveSpec(
        "sine", steered_behind(kmh(70)), 0.50, kmh(70), 50.0, about="sine steering, 70 km/h"
    ),
    "001.slalom": DriveSpec(
        "slalom", steered_behind(kmh(30)), 0.30, kmh(30), 50.0, about="slalom, 30 km/h"
    ),
    "001.gaining.dlc": DriveSpec(
        "gaining-lane-changes", LIGHT, 0.90, rate_hz=50.0, about="lane changes, 4 to 40 km/h"
    ),
    "001.gaining.slalom": DriveSpec(
        "gaining-slalom", LIGHT, 0.90, rate_hz=50.0, about="slalom, 5 to 30 km/h"
    ),
    "002.sine": DriveSpec(
        "accelerating-sine", SMALL, 0.70, 20.0, about="sine steering, 20 to 25 m/s"
    ),
    "002.jturn": DriveSpec("j-turn", SMALL, 1.00, 15.0, about="J-turn, 15 m/s"),
    "002.serpentine": DriveSpec(
        "slalom", SMALL, 0.85, about="serpentine of the road test, speed not given"
    ),
    "003.accel": DriveSpec("firm-acceleration", STRONG, 0.85, about="acceleration of .6 g"),
    "003.turn": DriveSpec("low-turn", SEDAN, 0.35, about="turn on snow, 40 km/h"),
    "003.split": DriveSpec(
        "firm-acceleration", STRONG, split(0.30, 0.85), about="acceleration on split friction"
    ),
    "003.straight.split": DriveSpec(
        "straight",
        SEDAN,
        split(0.30, 0.85),
        kmh(40),
        duration_s=10.0,
        about="split friction, constant speed",
    ),
    "003.straight.low": DriveSpec(
        "straight", SEDAN, 0.30, kmh(40), duration_s=10.0, about="snow, constant speed"
    ),
    "003.jump": DriveSpec(
        "brisk-acceleration", STRONG, jump(0.85, 0.50, 30.0), about="acceleration, .85 to .5"
    ),
}

OTHERS: Final = {
    "default.dlc": DriveSpec("double-lane-change", SEDAN, 0.85, kmh(80), about="as 004, realistic"),
    "default.jump.accel": DriveSpec(
        "brisk-acceleration", STRONG, jump(0.85, 0.50, 30.0), about=".85 to .5 at .45 g"
    ),
    "default.jump.brake": DriveSpec(
        "moderate-braking", SEDAN, jump(0.85, 0.30, 60.0), about=".85 to .3 at .28 g"
    ),
    "default.steady": DriveSpec(
        "pulses", SEDAN, 0.60, duration_s=90.0, about="town traffic, one road"
    ),
    "default.straight": DriveSpec(
        "straight", SEDAN, 0.85, kmh(60), duration_s=20.0, about="19 s at constant speed"
    ),
    "default.abs.dry": DriveSpec("braking", SEDAN, 0.85, about="anti-lock stop, dry"),
    "default.abs.snow": DriveSpec("braking", SEDAN, 0.30, about="anti-lock stop, snow"),
    "default.spin": DriveSpec("firm-acceleration", LOOSE, 0.35, about="spinning wheels on snow"),
    "default.circle.dry": DriveSpec("constant-radius", SEDAN, 0.85, about="steady circle, dry"),
    "default.circle.ice": DriveSpec("constant-radius", SEDAN, 0.20, about="steady circle, ice"),
    "default.corners.dry": DriveSpec("street-corners", SEDAN, 0.85, about="street corners, dry"),
    "default.corners.ice": DriveSpec("street-corners", SEDAN, 0.20, about="street corners, ice"),
    "default.ramp.dry": DriveSpec("parking-ramp", SEDAN, 0.85, about="parking garage, dry"),
    "default.ramp.ice": DriveSpec("parking-ramp", SEDAN, 0.15, about="parking garage, ice"),
}

# Drives of the default estimator on other vehicles; they are reported without targets.
VEHICLES: Final = {
    f"default.{name}.{drive}": DriveSpec(manoeuvre, vehicle, friction, about=f"{about}, {name}")
    for name, vehicle in (("hatchback", HATCHBACK), ("van", VAN), ("loaded", LOADED))
    for drive, manoeuvre, friction, about in (
        ("abs", "braking", 0.80, "anti-lock stop"),
        ("abs.jump", "jump-braking", None, "anti-lock stop from dry onto snow"),
        ("abs.split", "split-braking", None, "anti-lock stop with one side on snow"),
        ("jump", "brisk-acceleration", jump(0.80, 0.40, 30.0), ".8 to .4 accelerating"),
        ("jturn", "j-turn", 0.60, "J-turn"),
        ("ice", "acceleration", 0.15, "acceleration on ice"),
    )
}

# Tyres whose model or shape differs from the estimators' tyre model. All scenarios are driven
# with each of them.
FOREIGN: Final = {
    "brush": {"curve": "brush"},
    "sharp": {"shape": 1.65, "curvature": -0.6},
    "round": {"shape": 1.30, "curvature": 0.1},
    "softening": {"softening": 0.3},
}


def with_foreign_tyres(scenario: DriveSpec, kind: str) -> DriveSpec:
    """Return the scenario with tyres of the given kind (a key of FOREIGN), which differ from the
    tyre model of the estimators.
    """
    vehicle = replace(scenario.vehicle, **FOREIGN[kind])  # type: ignore[arg-type]
    return replace(scenario, vehicle=vehicle)
