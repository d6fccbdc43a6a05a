"""Names of indices into the arrays of the simulated vehicle: state, parameters, inputs, wheels."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from edge_agent.dynamics.parameters import Parameter


class Motion(IntEnum):
    """Index of a variable in the state of one simulated vehicle."""

    VX = 0  # [m/s]
    VY = 1
    YAW_RATE = 2  # [rad/s]
    OMEGA = 3  # [rad/s] of the four wheels
    AX_LAGGED = 7  # [m/s^2] acceleration that the suspension has followed
    AY_LAGGED = 8
    X = 9  # [m] east
    Y = 10  # [m] north
    YAW = 11  # [rad], not wrapped
    # The following variables are used in vehicles with tyre relaxation and simulated controllers.
    # In other vehicles they are 0.
    SLIP_X = 12  # slip that the tyre has built up, four wheels
    SLIP_Y = 16
    LIMIT = 20  # [N·m] brake torque that ABS allows, four wheels; 0: no limit
    HELD = 24  # [N·m] brake torque of traction control and ESC, four wheels
    CUT = 28  # share of the engine torque that traction control removes
    # [s] time for which the yaw rate has differed from the one expected from steering
    DEVIATES = 29
    ABS_LEFT = 30  # [s] remaining time for which the controller counts as active
    TCS_LEFT = 31
    ESC_LEFT = 32
    # [N·m] brake torque at which ABS last reduced it, four wheels; negative while ABS increases the
    # torque again
    PEAK = 33

    # [rad/s] yaw rate expected from steering, delayed by the response of a car
    ASKED = 37


STATES: Final = 38


class TrueParameter(IntEnum):
    """Index of a parameter that only the true vehicle has. In a row of parameters, these parameters
    come after those of `edge_agent.dynamics.parameters.Parameter`.
    """

    SHAPE = len(Parameter)  # shape c and curvature e of the tyre curve
    CURVATURE = len(Parameter) + 1
    DEGRESSION = len(Parameter) + 2  # ε: relative loss of stiffness per relative increase of load
    LAG = len(Parameter) + 3  # [s] time constant of the sprung body
    # share of gravity that an accelerometer measures in the rolled body per a_y, and in the pitched
    # body per a_x
    ROLL_LEAK = len(Parameter) + 4
    PITCH_LEAK = len(Parameter) + 5
    DRAG = len(Parameter) + 6  # D [N per (m/s)^2]: air drag over squared speed
    ROLLING = len(Parameter) + 7  # k_r: rolling resistance over load
    # slip at which anti-lock and traction control begin to act; inf: no control
    SLIP_LIMIT = len(Parameter) + 8
    BRAKE_FRONT = len(Parameter) + 9  # share of the brake torque at the front axle
    POWER = len(Parameter) + 10  # [W] of the engine
    CURVE = len(Parameter) + 11  # tyre model: 0 Magic Formula, 1 brush model, 2 Dugoff
    # exponent with which the stiffness decreases with friction, (mu/FIRM)^softening; 0: no
    # dependence
    SOFTENING = len(Parameter) + 12
    # angle of the rear wheels over that of the front wheels; 0: not steered
    REAR_STEER = len(Parameter) + 13
    RELAXATION = len(Parameter) + 14  # [m] relaxation length of a tyre; 0: slip acts at once
    # cycles of ABS per second; 0: slip control is smooth and not reported
    ABS_HZ = len(Parameter) + 15
    TCS = len(Parameter) + 16  # 1: traction control, for vehicles with ABS_HZ
    ESC = len(Parameter) + 17  # 1: stability control, for vehicles with ABS_HZ
    # [m/s^2] braking by engine or generator at the driven wheels
    REGENERATION = len(Parameter) + 18


PARAMETERS: Final = len(Parameter) + len(TrueParameter)


class Control(IntEnum):
    """Index of a row of the simulated vehicle's inputs (6, 4): rows with one input per wheel, and a
    row with the slope of the road under the vehicle.
    """

    STEER = 0  # [rad] at the road wheel
    DRIVE = 1  # [N·m] demanded; slip control may allow less
    BRAKE = 2  # [N·m] demanded, positive
    MU = 3  # friction under the wheel
    # rise of the road per metre ahead of the vehicle, and to its left; the last two numbers are
    # unused
    TILT = 4
    SWING = 5  # change of the wheel's load by an uneven road, over its static load


INPUTS: Final = len(Control)


class Wheel(IntEnum):
    """Index of a row of the array (8, 4) with forces and motion of the four wheels at one
    instant.
    """

    FX = 0  # [N] in the wheel's axes
    FY = 1
    FZ = 2
    SPEED = 3  # [m/s] of the wheel's centre, along the wheel
    SLIP = 4  # longitudinal slip
    THETA = 5  # normalised slip; a wheel slides beyond about 2.6
    SLOPE = 6  # dF_x/dω along the secant [N·s/rad]
    TORQUE = 7  # [N·m] effective torque, positive when driving
