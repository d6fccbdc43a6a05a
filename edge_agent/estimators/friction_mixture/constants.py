"""Every number of the filter family, with unit and reason: one table, one row for the kernels.

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
PAIRS = 30  # hypotheses of unlike sides: a low and a high friction, either way round
CURVED = 4  # states in which the rows of measurement bend
ACTIVE = 8  # states that the rows see within a block
STATES = 11


class X(IntEnum):
    """Index of a state of a node."""

    VX = 0  # [m/s]
    VY = 1  # [m/s], at the centre of gravity
    LN_KX = 2  # log of true over nominal longitudinal stiffness
    LN_KY = 3  # the same for cornering stiffness
    STEER = 4  # offset of the front steering against the rear axle [rad]
    LEAK_Y = 5  # share of measured lateral acceleration that is gravity felt by the rolled body
    BEND = 6  # shape of the tyre: spreads by which it is sharper than the usual one
    GAIN = 7  # error of the longitudinal force over load, relative: torque gain and mass
    LEAK_X = 8  # as LEAK_Y, of longitudinal acceleration and pitch
    BIAS_X = 9  # of a_x: offset and slope [m/s^2]
    BIAS_Y = 10  # of a_y: offset, and yaw-rate offset times speed [m/s^2]


class C(IntEnum):
    """Index of a constant in its row."""

    BLOCK = 0
    CORRELATION = 1
    HAZARD = 2
    DIFFUSION = 3
    DEMAND_HALF = 4
    DEMAND_POWER = 5
    PLAUSIBLE = 6
    LARGEST_LOSS = 7
    HUBER = 8
    FARTHEST = 9
    LOST_X = 10
    LOST_Y = 11
    FLAT = 12
    SLIDING_PRICE = 13
    AXLE_PRICE = 14
    SHAPE = 15
    STIFFNESS_STD = 16
    STIFFNESS_TIME = 17
    STIFFNESS_SHARE_X = 18
    STIFFNESS_SHARE_Y = 19
    TELLING_X = 20
    TELLING_Y = 21
    LEAK_Y_MEAN = 22
    LEAK_Y_STD = 23
    LEAK_X_MEAN = 24
    LEAK_X_STD = 25
    LEAK_TIME = 26
    BIAS_STD = 27
    BIAS_TIME = 28
    STEER_STD = 29
    DRIFT_X = 30
    DRIFT_Y = 31
    LEAK_WANDER = 32
    GYRO_WANDER = 33
    OMEGA_NOISE = 34
    ANGLE_STD = 35
    GYRO_STD = 36
    FLOOR_X = 37
    FLOOR_Y = 38
    FORCE_SHARE = 39
    AXLE_SHARE = 40
    BEND_SHARE = 41
    LAG = 42
    NO_TORQUE_SHARE = 43
    WINDOW = 44
    STEADY_TIME = 45
    STEADY_HALF = 46
    STEADY_SHARE = 47
    CURVATURE = 48
    BEND_STD = 49
    BEND_TIME = 50
    GAIN_STD = 51
    UNLIKE = 52
    UNLIKE_HAZARD = 53
    ASYMMETRY = 54
    RADIUS_STD = 55
    ANGLE_SHARE = 56


class Constant(NamedTuple):
    """One constant: its place, value, unit and reason."""

    place: C
    value: float
    unit: str
    reason: str


CONSTANTS = (
    Constant(
        C.BLOCK, 0.05, "s", "one measurement update per block: model error is correlated over more, so nothing is lost"
    ),
    Constant(
        C.CORRELATION,
        0.2,
        "s",
        "one independent look at the tyre per so much time: R is inflated by it over a block (errata)",
    ),
    Constant(C.HAZARD, 1 / 190, "1/m", "one road change to anywhere per 190 m (errata)"),
    Constant(C.DIFFUSION, 0.003, "1/m", "slow change to a neighbouring node"),
    Constant(C.DEMAND_HALF, 0.12, "1", "force over load at which half of the evidence on mu is taken (errata)"),
    Constant(C.DEMAND_POWER, 4.0, "1", "steepness of that"),
    Constant(
        C.PLAUSIBLE, 2.0, "nat", "a larger loss in a block counts whatever the demand: the node has lost the motion"
    ),
    Constant(C.LARGEST_LOSS, 3.0, "nat", "most that a block may take from a node: a spike is forgiven within two"),
    Constant(C.HUBER, 2.0, "1", "innovation in standard deviations beyond which a row is trusted less"),
    Constant(C.FARTHEST, 3.0, "1", "prior standard deviations within which stiffness, leaks and offsets are kept"),
    Constant(
        C.LOST_X,
        0.7,
        "m/s",
        "a node farther than this from the most probable one has lost the motion: accelerometers forbid it",
    ),
    Constant(C.LOST_Y, 1.0, "m/s", "the same across"),
    Constant(C.FLAT, 0.3, "1", "slope of the tyre curve below which a wheel counts as sliding"),
    Constant(
        C.SLIDING_PRICE,
        0.3,
        "1",
        "weight of the density that sliding spreads over slip: not every braking car slides on all wheels",
    ),
    Constant(
        C.AXLE_PRICE,
        0.45,
        "1",
        "weight of ln det S of the axles: none favours the flexible node, all of it the saturated one",
    ),
    Constant(
        C.SHAPE, 1.45, "1", "Magic Formula c between the lateral 1.3 and the longitudinal 1.65 of passenger tyres"
    ),
    Constant(C.STIFFNESS_STD, 0.12, "1", "log stiffness factors (vehicle)"),
    Constant(C.STIFFNESS_TIME, 300.0, "s", "return of the stiffness factors to their prior"),
    Constant(
        C.STIFFNESS_SHARE_X,
        1.0,
        "1",
        "power of the stiffness factor that divides a wheel's residual: slip is noisy, force is quiet",
    ),
    Constant(C.STIFFNESS_SHARE_Y, 0.3, "1", "the same for an axle, where both are"),
    Constant(
        C.TELLING_X,
        0.06,
        "1",
        "demand at which a wheel says half of what it could about stiffness: below, noise of slip does",
    ),
    Constant(C.TELLING_Y, 0.1, "1", "the same for an axle"),
    Constant(C.LEAK_Y_MEAN, 0.06, "1", "gravity leak of a rolling body, in measured a_y (errata: .07 of true a_y)"),
    Constant(C.LEAK_Y_STD, 0.05, "1", "its spread (errata)"),
    Constant(C.LEAK_X_MEAN, 0.02, "1", "gravity leak of a pitching body, in measured a_x: pitch is stiffer than roll"),
    Constant(C.LEAK_X_STD, 0.025, "1", "its spread"),
    Constant(C.LEAK_TIME, 600.0, "s", "return of the leaks to their prior"),
    Constant(C.BIAS_STD, 0.04, "m/s^2", "offsets of the accelerometers, .03 each, and of the yaw rate (vehicle)"),
    Constant(C.BIAS_TIME, 60.0, "s", "return of the offsets to their prior"),
    Constant(C.STEER_STD, 0.0007, "rad", "offset of steering and toe (vehicle)"),
    Constant(C.DRIFT_X, 0.02, "m/s/s^.5", "white noise of a_x and what is not constant in its offset (vehicle)"),
    Constant(C.DRIFT_Y, 0.02, "m/s/s^.5", "the same for a_y"),
    Constant(C.LEAK_WANDER, 0.01, "s^.5", "what is not constant in the pitch leak, share of a_x"),
    Constant(C.GYRO_WANDER, 0.0005, "rad/s^.5", "wander of the yaw rate's offset; times speed an error of a_y"),
    Constant(C.OMEGA_NOISE, 0.03, "rad/s", "white noise of a wheel speed sample (vehicle)"),
    Constant(C.ANGLE_STD, 0.0003, "rad", "white noise of steering in a block (vehicle)"),
    Constant(
        C.GYRO_STD,
        0.0013,
        "rad/s",
        "offset and white noise of the yaw rate in a block: turns an axle's slip, most at low speed (vehicle)",
    ),
    Constant(C.FLOOR_X, 0.006, "1", "radius differences and rolling resistance, in force over load"),
    Constant(C.FLOOR_Y, 0.008, "1", "offset of a_y, crossfall and toe, in force over load"),
    Constant(C.FORCE_SHARE, 0.04, "1", "torque gain 3 %, mass 3 %, load 3 % (vehicle)"),
    Constant(C.AXLE_SHARE, 0.03, "1", "load transfer between axles and inertia (vehicle)"),
    Constant(C.BEND_SHARE, 0.05, "1", "shape error of the tyre curve at full demand, in force over load"),
    Constant(C.LAG, 0.02, "s", "side force behind slip (relaxation, roll), times its rate"),
    Constant(C.NO_TORQUE_SHARE, 0.3, "1", "how badly the total force is shared out when torque is missing"),
    Constant(C.WINDOW, 1.0, "s", "window of the innovation variances"),
    Constant(C.STEADY_TIME, 2.0, "s", "memory of the usual force, against which a new one is told"),
    Constant(C.STEADY_HALF, 0.03, "1", "change of force over load from the usual at which half of the evidence is new"),
    Constant(
        C.STEADY_SHARE,
        0.15,
        "1",
        "evidence left where nothing changes: the error of curve and offsets is then the same again",
    ),
    Constant(C.CURVATURE, -0.1, "1", "Magic Formula e, as c"),
    Constant(C.BEND_STD, 1.0, "1", "tyres between round and sharp: most of them"),
    Constant(C.BEND_TIME, 100.0, "s", "return of the shape to its prior: it changes with the road as well"),
    Constant(C.GAIN_STD, 0.045, "1", "torque gain 3 %, mass 3 %, load and radius (vehicle)"),
    Constant(C.UNLIKE, 0.05, "1", "share of roads whose two sides differ"),
    Constant(C.UNLIKE_HAZARD, 1 / 60, "1/m", "end of such a road"),
    Constant(C.ASYMMETRY, 0.12, "1", "left against right, in force over load, that wakes the nodes of unlike sides"),
    Constant(C.RADIUS_STD, 0.002, "1", "wheel radius (vehicle)"),
    Constant(C.ANGLE_SHARE, 0.01, "1", "steering ratio, compliance and how the wheels of an axle point, of the angle"),
)


def constant_row(**changes: float) -> FloatArray:
    """The constants as the kernels read them, (len(C),); `changes` by lower-case name replace values in studies."""
    row = np.full(len(C), np.nan)
    for constant in CONSTANTS:
        row[constant.place] = constant.value
    for name, value in changes.items():
        row[C[name.upper()]] = value
    return row


def nominal_states(constants: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Prior (mean, std) of the states and the time [s] of their return to it, (STATES,) each; velocity has none."""
    mean, std, time = np.zeros(STATES), np.ones(STATES), np.full(STATES, np.inf)
    for state, spread, back in (
        (X.LN_KX, C.STIFFNESS_STD, C.STIFFNESS_TIME),
        (X.LN_KY, C.STIFFNESS_STD, C.STIFFNESS_TIME),
        (X.LEAK_Y, C.LEAK_Y_STD, C.LEAK_TIME),
        (X.STEER, C.STEER_STD, C.STIFFNESS_TIME),
        (X.BEND, C.BEND_STD, C.BEND_TIME),
        (X.GAIN, C.GAIN_STD, C.STIFFNESS_TIME),
        (X.LEAK_X, C.LEAK_X_STD, C.LEAK_TIME),
        (X.BIAS_X, C.BIAS_STD, C.BIAS_TIME),
        (X.BIAS_Y, C.BIAS_STD, C.BIAS_TIME),
    ):
        std[state], time[state] = constants[spread], constants[back]
    mean[X.LEAK_Y], mean[X.LEAK_X] = constants[C.LEAK_Y_MEAN], constants[C.LEAK_X_MEAN]
    return mean, std, time
