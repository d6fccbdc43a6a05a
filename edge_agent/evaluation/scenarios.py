"""The scenarios: the papers' manoeuvres with the papers' vehicles, and those of the default estimator's bars.

What a paper does not give (tyres, wheel inertia, the vehicle of 003) is that of the simulator's sedan or of an ordinary
car; all four wheels drive, as in the papers.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

from edge_agent.evaluation.batch import Scenario
from edge_agent.simulation.manoeuvres import jump, kmh, split
from edge_agent.simulation.presets import PRESETS, TrueVehicle, car

SEDAN: Final = PRESETS["sedan"]  # paper 004, table 1
# papers 000 and 001, table 2
LIGHT: Final = TrueVehicle(car("light", 830.0, 1110.0, (1.17, 1.17), (1.416, 1.416), 0.54, 0.278, 0.5), power=60e3)
# paper 002, table 1; the height of the centre of gravity is not given
SMALL: Final = TrueVehicle(car("in-wheel", 710.0, 1000.0, (0.795, 0.975), (1.55, 1.55), 0.50, 0.245, 0.5), power=60e3)
STRONG: Final = replace(SEDAN, power=400e3)  # .6 g at 25 m/s
LOOSE: Final = replace(STRONG, slip_limit=math.inf)  # no slip control: wheels spin

# The vehicle of 004 without what its model leaves out (drag, rolling resistance, lagging loads, degressive tyres). Its
# tyres are not given; the curve is a Magic Formula as steep in the middle as Dugoff's.
MATCHED: Final = replace(SEDAN, shape=1.5, curvature=-1.0, degression=0.0, lag=1e-3, drag=0.0, rolling=0.0)

PAPERS: Final = {
    "004.dlc": Scenario("double-lane-change", SEDAN, 0.85, kmh(80), 50.0, about="double lane change, 80 km/h"),
    "000.jump": Scenario("two-lane-changes", LIGHT, about="lane changes at 30 km/h, .5 to .3"),
    "001.dlc": Scenario("double-lane-change", LIGHT, 0.85, kmh(40), 50.0, 14.0, "double lane change, 40 km/h"),
    "001.sine": Scenario("sine", LIGHT, 0.50, kmh(70), 50.0, about="sine steering, 70 km/h"),
    "001.slalom": Scenario("slalom", LIGHT, 0.30, kmh(30), 50.0, about="slalom, 30 km/h"),
    "002.sine": Scenario("accelerating-sine", SMALL, 0.70, 20.0, about="sine steering, 20 to 25 m/s"),
    "002.jturn": Scenario("j-turn", SMALL, 1.00, 15.0, about="J-turn, 15 m/s"),
    "003.accel": Scenario("firm-acceleration", STRONG, 0.85, about="acceleration of .6 g"),
    "003.turn": Scenario("low-turn", SEDAN, 0.35, about="turn on snow, 40 km/h"),
    "003.split": Scenario("firm-acceleration", STRONG, split(0.30, 0.85), about="acceleration on split friction"),
    "003.jump": Scenario("brisk-acceleration", STRONG, jump(0.85, 0.50, 30.0), about="acceleration, .85 to .5"),
}

OTHERS: Final = {
    "default.dlc": Scenario("double-lane-change", SEDAN, 0.85, kmh(80), about="as 004, realistic"),
    "default.jump.accel": Scenario("brisk-acceleration", STRONG, jump(0.85, 0.50, 30.0), about=".85 to .5 at .45 g"),
    "default.jump.brake": Scenario("moderate-braking", SEDAN, jump(0.85, 0.30, 60.0), about=".85 to .3 at .28 g"),
    "default.steady": Scenario("pulses", SEDAN, 0.60, duration_s=90.0, about="town traffic, one road"),
    "default.straight": Scenario("straight", SEDAN, 0.85, kmh(60), duration_s=20.0, about="19 s at constant speed"),
    "default.abs.dry": Scenario("braking", SEDAN, 0.85, about="anti-lock stop, dry"),
    "default.abs.snow": Scenario("braking", SEDAN, 0.30, about="anti-lock stop, snow"),
    "default.spin": Scenario("firm-acceleration", LOOSE, 0.35, about="spinning wheels on snow"),
}

# tyres that are not of the estimators' family or shape; "all scenarios" are driven with each in turn
FOREIGN: Final = {
    "brush": {"brush": True},
    "sharp": {"shape": 1.65, "curvature": -0.6},
    "round": {"shape": 1.30, "curvature": 0.1},
    "softening": {"softening": 0.3},
}


def foreign(scenario: Scenario, kind: str) -> Scenario:
    """The scenario with tyres of a kind of FOREIGN."""
    return replace(scenario, vehicle=replace(scenario.vehicle, **FOREIGN[kind]))  # type: ignore[arg-type]
