"""Index names for the arrays of the simulated vehicle: state, parameters, inputs, wheels."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from edge_agent.dynamics.parameters import Parameter


class Motion(IntEnum):
    """Index of a variable in the state of one simulated vehicle."""

    VX = 0  # [m/s]
    VY = 1
    YAW_RATE = 2  # [rad/s]
    OMEGA = 3  # four wheels [rad/s]
    AX_LAGGED = 7  # [m/s^2], what the suspension has followed so far
    AY_LAGGED = 8
    X = 9  # [m] east
    Y = 10  # [m] north
    YAW = 11  # [rad], not wrapped
    # of vehicles with relaxing tyres and modulated controllers; else 0
    SLIP_X = 12  # four wheels: slip that the tyre has built up so far
    SLIP_Y = 16
    LIMIT = 20  # four wheels: brake torque that ABS lets through [N·m]; 0: all of it
    HELD = 24  # four wheels: brake torque of traction control and ESC [N·m]
    CUT = 28  # share of the engine's torque that traction control takes away
    DEVIATES = 29  # [s] for which the yaw rate has been off what steering asks for
    ABS_LEFT = 30  # [s] for which the controller still counts as active
    TCS_LEFT = 31
    ESC_LEFT = 32
    # four wheels: brake torque at which ABS last let go [N·m]; negative while it gives back
    PEAK = 33

    ASKED = 37  # [rad/s] yaw rate that steering has asked for, as far as a car follows


STATES: Final = 38


class TrueParameter(IntEnum):
    """Index of a parameter that only the true vehicle has. In a row of parameters, these follow the
    parameters of `edge_agent.dynamics.parameters.Parameter`.
    """

    SHAPE = len(Parameter)  # c and e of the tyre curve
    CURVATURE = len(Parameter) + 1
    DEGRESSION = len(Parameter) + 2  # ε
    LAG = len(Parameter) + 3  # [s] of the sprung body behind the accelerations
    ROLL_LEAK = (
        len(Parameter) + 4
    )  # gravity that an accelerometer feels in the rolled and pitched body, per a_y and per a_x
    PITCH_LEAK = len(Parameter) + 5
    DRAG = len(Parameter) + 6  # D [N per (m/s)^2]
    ROLLING = len(Parameter) + 7  # k_r
    SLIP_LIMIT = (
        len(Parameter) + 8
    )  # slip at which anti-lock and traction control begin to let go; inf: none
    BRAKE_FRONT = len(Parameter) + 9  # share of the braking torque at the front axle
    POWER = len(Parameter) + 10  # [W]
    CURVE = len(Parameter) + 11  # of the tyre: 0 Magic Formula, 1 brush model, 2 Dugoff
    SOFTENING = (
        len(Parameter) + 12
    )  # stiffness falls with friction, as (mu/FIRM)^softening; 0: it does not know friction
    REAR_STEER = (
        len(Parameter) + 13
    )  # angle of the rear wheels over that of the front wheels; 0: they do not steer
    RELAXATION = len(Parameter) + 14  # [m] in which a tyre builds up its slip; 0: at once
    ABS_HZ = (
        len(Parameter) + 15
    )  # cycles of ABS per second; 0: slip control is smooth and not reported
    TCS = len(Parameter) + 16  # 1: traction control, of vehicles with ABS_HZ
    ESC = len(Parameter) + 17  # 1: stability control, likewise
    REGENERATION = (
        len(Parameter) + 18
    )  # [m/s^2] of braking that engine or generator give at the driven wheels


PARAMETERS: Final = len(Parameter) + len(TrueParameter)


class Control(IntEnum):
    """Index of a row of the simulated vehicle's inputs (5, 4): four rows with one input per wheel,
    and a row with the slope of the road under the vehicle.
    """

    STEER = 0  # [rad at the road wheel]
    DRIVE = 1  # [N·m] asked for; slip control may allow less
    BRAKE = 2  # [N·m], positive, asked for
    MU = 3  # friction under the wheel
    # rise of the road per metre ahead of the vehicle, and to its left; two numbers are of no use
    TILT = 4


INPUTS: Final = len(Control)


class Wheel(IntEnum):
    """Index of a row of the array (8, 4) with forces and motion of the four wheels at one
    instant.
    """

    FX = 0  # [N] in the wheel's axes
    FY = 1
    FZ = 2
    SPEED = 3  # [m/s] of the wheel's centre along the wheel
    SLIP = 4  # longitudinal
    THETA = 5  # normalised slip; beyond about 2 the wheel slides
    SLOPE = 6  # dF_x/dω along the secant [N·s/rad]
    TORQUE = 7  # [N·m] that acts, driving positive
