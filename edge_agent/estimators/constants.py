"""Every number of the default filter family, with unit and reason: one table, one row for the kernels.

`C` indexes the row that the kernels read; `CONSTANTS` is what fills it. Figures marked (vehicle) follow from how well a
vehicle and its sensors are known (mass 3 %, inertia 5 %, stiffness 10 to 12 %, torque 3 %, white noise and offsets of
ordinary inertial sensors), figures marked (errata) from measured wisdom.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from schemas.numeric import FloatArray

NODES = 20  # friction hypotheses, equidistant in the square root of mu: fine where mu is small
STATES = 9


class X(IntEnum):
    """Index of a state of a node."""

    VX = 0  # [m/s]
    VY = 1  # [m/s], at the centre of gravity
    LN_KX = 2  # log of true over nominal longitudinal stiffness
    LN_KY = 3  # the same for cornering stiffness
    LEAK_Y = 4  # share of measured lateral acceleration that is gravity felt by the rolled body
    LEAK_X = 5  # the same of longitudinal acceleration and pitch
    BIAS_X = 6  # of a_x: offset and slope [m/s^2]
    LN_KR = 8  # log of rear over front cornering stiffness, relative to nominal: roll steer, camber, compliance
    BIAS_Y = 7  # of a_y: offset, and yaw-rate offset times speed [m/s^2]


class C(IntEnum):
    """Index of a constant in its row."""

    BLOCK = 0
    CORRELATION = 1
    HAZARD = 2
    DIFFUSION = 3
    DEMAND_HALF = 4
    DEMAND_POWER = 5
    LARGEST_LOSS = 6
    SHAPE = 7
    STIFFNESS_STD = 8
    STIFFNESS_TIME = 9
    LEAK_MEAN = 10
    LEAK_STD = 11
    LEAK_TIME = 12
    DRIFT_X = 13
    DRIFT_Y = 14
    AX_SHARE = 15
    YAW_RATE_OFFSET = 16
    OMEGA_NOISE = 17
    ANGLE_STD = 18
    FLOOR_X = 19
    FLOOR_Y = 20
    FORCE_SHARE = 21
    AXLE_SHARE = 22
    BEND_SHARE = 23
    NO_TORQUE_SHARE = 24
    WINDOW = 25
    LEAK_X_MEAN = 26
    LEAK_X_STD = 27
    BIAS_STD = 28
    BIAS_TIME = 29
    OCCAM_X = 30
    OCCAM_Y = 31
    NOVEL_TIME = 32
    NOVEL_HALF = 33
    NOVEL_LEAST = 34
    REAR_STD = 35
    LAG = 36


class Constant(NamedTuple):
    """One constant: its place, value, unit and reason."""

    index: C
    value: float
    unit: str
    reason: str


CONSTANTS = (
    Constant(
        C.BLOCK, 0.05, "s", "one measurement update per block: model error is correlated over more, so nothing is lost"
    ),
    Constant(C.CORRELATION, 0.2, "s", "one independent look at the tyre per so much time (errata: R inflated)"),
    Constant(C.HAZARD, 1 / 190, "1/m", "one road change to anywhere per 190 m (errata)"),
    Constant(C.DIFFUSION, 0.003, "1/m", "slow change to a neighbouring node"),
    Constant(
        C.DEMAND_HALF, 0.12, "1", "demand (force over load) at which half of the evidence on mu is taken (errata)"
    ),
    Constant(C.DEMAND_POWER, 4.0, "1", "steepness of that"),
    Constant(C.LARGEST_LOSS, 3.0, "nat", "most that one block may take from a node: a spike is forgiven within two"),
    Constant(C.SHAPE, 1.4, "1", "Magic Formula c between the lateral 1.3 and the longitudinal 1.65 of passenger tyres"),
    Constant(C.STIFFNESS_STD, 0.12, "1", "log stiffness factors (vehicle)"),
    Constant(C.STIFFNESS_TIME, 300.0, "s", "return of the stiffness factors to their prior"),
    Constant(C.LEAK_MEAN, 0.06, "1", "gravity leak of a rolling body, in measured a_y (errata: .07 of true a_y)"),
    Constant(C.LEAK_STD, 0.05, "1", "its spread (errata)"),
    Constant(C.LEAK_TIME, 600.0, "s", "return of the leak to its prior"),
    Constant(C.DRIFT_X, 0.02, "m/s/s^.5", "offset .03 m/s^2 and white noise of a_x as a random walk (vehicle)"),
    Constant(C.DRIFT_Y, 0.02, "m/s/s^.5", "the same for a_y"),
    Constant(C.AX_SHARE, 0.01, "s^.5", "what is not constant in the pitch leak, share of a_x"),
    Constant(
        C.YAW_RATE_OFFSET, 0.0005, "rad/s/s^.5", "wander of the yaw rate's offset, times speed an error of a_y"
    ),
    Constant(C.OMEGA_NOISE, 0.03, "rad/s", "white noise of a wheel speed sample (vehicle)"),
    Constant(C.ANGLE_STD, 0.0008, "rad", "steering offset and toe (vehicle)"),
    Constant(C.FLOOR_X, 0.012, "1", "radius differences and rolling resistance, in force over load"),
    Constant(C.FLOOR_Y, 0.012, "1", "offset of a_y, crossfall and toe, in force over load"),
    Constant(C.FORCE_SHARE, 0.04, "1", "torque gain 3 %, mass 3 %, load 3 % (vehicle)"),
    Constant(C.AXLE_SHARE, 0.03, "1", "load transfer between axles and inertia (vehicle)"),
    Constant(C.BEND_SHARE, 0.08, "1", "shape error of the tyre curve at full demand, in force over load"),
    Constant(C.NO_TORQUE_SHARE, 0.3, "1", "how badly the total force is shared out when torque is missing"),
    Constant(C.WINDOW, 1.0, "s", "window of the innovation variances"),
    Constant(C.LEAK_X_MEAN, 0.02, "1", "gravity leak of a pitching body, in measured a_x: pitch is stiffer than roll"),
    Constant(C.LEAK_X_STD, 0.025, "1", "its spread"),
    Constant(C.BIAS_STD, 0.04, "m/s^2", "offsets of the accelerometers, .03 each, and of the yaw rate (vehicle)"),
    Constant(C.OCCAM_X, 0.0, "1", "weight of ln det S, wheels"),
    Constant(C.OCCAM_Y, 0.0, "1", "weight of ln det S, axles"),
    Constant(C.NOVEL_TIME, 1.0, "s", "novel"),
    Constant(C.NOVEL_HALF, 0.03, "1", "novel"),
    Constant(C.NOVEL_LEAST, 1.0, "1", "novel"),
    Constant(C.REAR_STD, 0.05, "1", "spread of the rear over the front log stiffness"),
    Constant(C.LAG, 0.02, "s", "lag of side force behind slip (relaxation, roll), times its rate"),
    Constant(C.BIAS_TIME, 60.0, "s", "return of the offsets to their prior"),
)


def constant_row(**changes: float) -> FloatArray:
    """The constants as the kernels read them, (len(C),); `changes` by lower-case name replace values in studies."""
    row = np.full(len(C), np.nan)
    for constant in CONSTANTS:
        row[constant.index] = constant.value
    for name, value in changes.items():
        row[C[name.upper()]] = value
    return row
