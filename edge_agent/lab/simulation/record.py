"""Record of the true values of one vehicle at one sample. The sensors are simulated from these
records, and estimates are compared with them.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Final

from edge_agent.dynamics.parameters import Parameter
from edge_agent.lab.simulation.plant import body_accelerations, gravity, is_held, wheel_forces
from edge_agent.lab.simulation.state import Control, Motion, TrueParameter, Wheel
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.thresholds import GRAVITY


class RecordColumn(IntEnum):
    """Index of a quantity in the record that contains all true values of one simulated sample."""

    # [m/s^2] reading of an accelerometer at the centre of gravity, in the plane of the road
    AX = 0
    AY = 1
    # [m/s^2] reading of an accelerometer that is fixed to the rolling and pitching body
    AX_FELT = 2
    AY_FELT = 3
    YAW_RATE = 4
    DELTA = 5  # DELTA, OMEGA and TORQUE have four columns each, one per wheel
    OMEGA = 9
    TORQUE = 13
    X = 17
    Y = 18
    YAW = 19
    VX = 20
    VY = 21
    MU = 22
    UTILISATION = 26  # |F| / (μ F_z)
    SLOPE = 30  # rise of the road per metre ahead
    BANK = 31  # rise of the road per metre to the left
    THETA = 32  # four wheels: normalised slip; beyond about 2.6 a wheel slides
    ABS = 36  # 1 while the controller is active
    TCS = 37
    ESC = 38


RECORD: Final = 39


@compiled
def observe(
    x: FloatArray, p: FloatArray, u: FloatArray, wheels: FloatArray, record: FloatArray
) -> None:
    """Fill `record` (RECORD,) with the true values of the vehicle at this instant, from its state
    `x`, parameters `p` and inputs `u`. The function also fills `wheels`, the forces and slips of
    the wheels.
    """
    wheel_forces(x, p, u, wheels)
    ax, ay, _ = body_accelerations(x, p, u, wheels)
    record[RecordColumn.AX] = ax
    record[RecordColumn.AY] = ay
    record[RecordColumn.AX_FELT] = ax + p[TrueParameter.PITCH_LEAK] * x[Motion.AX_LAGGED]
    record[RecordColumn.AY_FELT] = ay + p[TrueParameter.ROLL_LEAK] * x[Motion.AY_LAGGED]
    record[RecordColumn.YAW_RATE] = x[Motion.YAW_RATE]
    record[RecordColumn.VX] = x[Motion.VX]
    record[RecordColumn.VY] = x[Motion.VY]
    record[RecordColumn.X] = x[Motion.X]
    record[RecordColumn.Y] = x[Motion.Y]
    record[RecordColumn.YAW] = x[Motion.YAW]
    for i in range(4):
        record[RecordColumn.DELTA + i] = u[Control.STEER, i]
        record[RecordColumn.OMEGA + i] = x[Motion.OMEGA + i]
        record[RecordColumn.TORQUE + i] = wheels[Wheel.TORQUE, i]
        record[RecordColumn.MU + i] = u[Control.MU, i]
        record[RecordColumn.UTILISATION + i] = math.hypot(
            wheels[Wheel.FX, i], wheels[Wheel.FY, i]
        ) / (u[Control.MU, i] * wheels[Wheel.FZ, i])
        record[RecordColumn.THETA + i] = wheels[Wheel.THETA, i]
    record[RecordColumn.ABS] = 1.0 if x[Motion.ABS_LEFT] > 0.0 else 0.0
    record[RecordColumn.TCS] = 1.0 if x[Motion.TCS_LEFT] > 0.0 else 0.0
    record[RecordColumn.ESC] = 1.0 if x[Motion.ESC_LEFT] > 0.0 else 0.0
    record[RecordColumn.SLOPE] = u[Control.TILT, 0]
    record[RecordColumn.BANK] = u[Control.TILT, 1]
    if is_held(x, p, u):
        _observe_held(x, p, u, record)


@compiled
def _observe_held(x: FloatArray, p: FloatArray, u: FloatArray, record: FloatArray) -> None:
    """Fill `record` with the true values of a standing vehicle that its brakes hold. Brakes and
    tyres then balance the force of the slope.
    """
    along, across, share = gravity(u)
    record[RecordColumn.AX] = -along
    record[RecordColumn.AY] = -across
    record[RecordColumn.AX_FELT] = -along + p[TrueParameter.PITCH_LEAK] * x[Motion.AX_LAGGED]
    record[RecordColumn.AY_FELT] = -across + p[TrueParameter.ROLL_LEAK] * x[Motion.AY_LAGGED]
    record[RecordColumn.YAW_RATE] = 0.0
    record[RecordColumn.VX] = 0.0
    record[RecordColumn.VY] = 0.0
    for i in range(4):
        brake_share = p[TrueParameter.BRAKE_FRONT] if i < 2 else 1.0 - p[TrueParameter.BRAKE_FRONT]
        record[RecordColumn.OMEGA + i] = 0.0
        record[RecordColumn.THETA + i] = 0.0
        record[RecordColumn.TORQUE + i] = (
            -0.5 * brake_share * p[Parameter.MASS] * along * p[Parameter.RADIUS]
        )
        record[RecordColumn.UTILISATION + i] = math.hypot(along, across) / (
            u[Control.MU, i] * GRAVITY * share
        )
