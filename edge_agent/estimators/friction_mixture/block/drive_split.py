"""Split of the longitudinal force between front and rear axle where torque is missing.

The filter learns from the slip of the axles which axles are driven. When a car accelerates, its
driven axle turns faster than the other one, by the slip that its force needs. Brisk driving
distinguishes front, rear and all-wheel drive within a second. When a car brakes, the front axle
takes the larger share on all cars. A kind of drive (front, rear, all-wheel) predicts the slip of
each axle. On low friction a wheel slips more than its force requires. Therefore less slip than
predicted is evidence against a kind of drive, but more slip is not.
"""

from __future__ import annotations

import math

from edge_agent.dynamics.parameters import Parameter
from edge_agent.estimators.friction_mixture.state.constants import Constants
from edge_agent.estimators.friction_mixture.state.gap import SLOW_M_S
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from edge_agent.estimators.friction_mixture.state.workspace import BlockFeatures
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.thresholds import GRAVITY

# [1] share of the front axle in the driving force with rear, all-wheel and front drive
DRIVES = (0.0, 0.45, 1.0)
FIRST_ODDS = (0.35, 0.3, 0.35)  # initial probabilities of rear, all-wheel and front drive
BRAKES_FRONT = 0.64  # [1] share of the front axle in the brake force
BRAKES_STD = 0.06  # [1] standard deviation of BRAKES_FRONT between cars
# [m/s^2] scale of engine braking, which acts on the driven axle only: from twice this deceleration
# all force counts as brake force
ENGINE_BRAKE = 1.5
# [1] a_x over g from which the slip shows the driven axle, if the lateral acceleration is smaller
PULLS = 0.05
UNLIKE = 0.3  # [1] relative error of the predicted slip, from stiffness and load
LEAST_ODDS = 1e-4  # smallest probability of a kind, so that an error is corrected within seconds


@compiled
def front_share(row: FloatArray, odds: FloatArray, ax: float) -> tuple[float, float]:
    """Return the front axle's share of the longitudinal force at acceleration `ax` [m/s^2], and the
    standard deviation of the share. `odds` (3,) are the probabilities that the car has rear,
    all-wheel and front drive.
    """
    front = row[Parameter.DRIVE_FRONT]
    spread = 0.0
    if math.isnan(front):
        front = 0.0
        square = 0.0
        for kind in range(3):
            front += odds[kind] * DRIVES[kind]
            square += odds[kind] * DRIVES[kind] ** 2
        spread = math.sqrt(max(square - front * front, 0.0))
    if ax >= 0.0:
        return front, spread
    brakes = min(-0.5 * ax / ENGINE_BRAKE, 1.0)  # weight of the brakes, 0 to 1
    between_variance = brakes * (1.0 - brakes) * (BRAKES_FRONT - front) ** 2
    variance = brakes * BRAKES_STD**2 + (1.0 - brakes) * spread**2 + between_variance
    return brakes * BRAKES_FRONT + (1.0 - brakes) * front, math.sqrt(variance)


@compiled
def free_axle(row: FloatArray, odds: FloatArray, ax: float) -> int:
    """Return the index of the axle whose wheels roll freely: 0 front, 1 rear; -1 if none does so
    for certain.

    The wheels of an axle that is not driven roll freely while the car accelerates, because it does
    not brake then. The kind of drive is that of the vehicle file (`row`), or else the learned one,
    once its probability in `odds` (3,) leaves little doubt. `ax` [m/s^2] is the acceleration.
    """
    if not ax > PULLS * GRAVITY:
        return -1
    front = row[Parameter.DRIVE_FRONT]
    doubt = 100.0 * LEAST_ODDS
    if front == 0.0 or (math.isnan(front) and odds[0] > 1.0 - doubt):
        return 0
    if front == 1.0 or (math.isnan(front) and odds[2] > 1.0 - doubt):
        return 1
    return -1


@compiled
def learn_drive(memory: MixtureMemory, constants: Constants, features: BlockFeatures) -> None:
    """Update the probabilities that a car has front, rear or all-wheel drive, from the slip of its
    axles in the block (the samples within 0.05 s).
    """
    row = memory.row
    odds = memory.drive_odds
    rolling = features.rolling
    pull = features.change / GRAVITY
    speed = 0.25 * (rolling[0] + rolling[1] + rolling[2] + rolling[3])
    turns = abs(features.yaw_rate) * speed > features.change
    if not (pull > PULLS and speed > SLOW_M_S) or turns:
        return
    slip_difference = 0.5 * (rolling[2] + rolling[3] - rolling[0] - rolling[1]) / speed
    rear_load = row[Parameter.TO_FRONT] / (row[Parameter.TO_FRONT] + row[Parameter.TO_REAR])
    per_force = pull / row[Parameter.SLOPE_X]
    look = min(features.duration / constants.physical.correlation_time, 1.0)
    total = 0.0
    for kind in range(3):
        expected = per_force * ((1.0 - DRIVES[kind]) / rear_load - DRIVES[kind] / (1.0 - rear_load))
        spread = constants.physical.wheel_std + UNLIKE * (per_force + abs(expected))
        off = (slip_difference - expected) / spread
        one_axle = DRIVES[kind] in (0.0, 1.0)
        if one_axle and off * expected > 0.0:
            off = 0.0
        odds[kind] *= math.exp(
            -look
            * (
                min(0.5 * off * off, constants.guards.largest_loss)
                + math.log(spread / constants.physical.wheel_std)
            )
        )
        total += odds[kind]
    for kind in range(3):
        odds[kind] = max(odds[kind] / total, LEAST_ODDS)
