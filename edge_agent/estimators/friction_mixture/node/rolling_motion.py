"""Velocity of the car without a tyre model, in three cases: all wheels stand, all wheels roll
alike, or the rear axle does not slide.

- Rolling wheels: if the wheel speeds agree for a second, the wheels do not slide. The speed of the
  car is computed from them, corrected for the slip that their force needs. Reason: a tyre beyond
  its peak locks or spins up within a tenth of a second unless a controller acts. Four tyres never
  do so alike. While the car accelerates with one driven axle, only the wheels of the other axle
  count. They roll freely, even if the driven wheels spin.
- Rear axle: with little lateral force, the rear axle does not slide sideways. The lateral velocity
  of the car is computed from its yaw rate and the small slip of the rear axle.

Without these rules, a lasting accelerometer offset could lead the filter to assume that all four
wheels slide on ice. This assumption fits any data, so the filter would keep it forever.
"""

from __future__ import annotations

import math

from edge_agent.dynamics.parameters import Parameter
from edge_agent.estimators.common.readings import GAP_S
from edge_agent.estimators.friction_mixture.block.block_features import ROUNDING, at_centre, mean_or
from edge_agent.estimators.friction_mixture.block.drive_split import free_axle
from edge_agent.estimators.friction_mixture.block.wheel_readings import STEP_LEAST
from edge_agent.estimators.friction_mixture.node.covariance import subtract_row, symmetric_at
from edge_agent.estimators.friction_mixture.node.residuals import gained_by
from edge_agent.estimators.friction_mixture.state.constants import Constants, NodeState
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign
from edge_agent.estimators.friction_mixture.state.gap import SLOW_M_S
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from edge_agent.estimators.friction_mixture.state.workspace import BlockFeatures, Scratch
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.runtime.lanes import lanes_at, put_lanes
from schemas.signals import S
from schemas.thresholds import GRAVITY

# [m/s] smallest error of a velocity that follows from the wheels: their sensors do not detect
# creeping wheels. At its first sample, a car slower than this counts as standing.
SMALLEST_STD = 0.05
# [1] limit of v*r over the limit of a_y: both must be small, so that the rear axle cannot slide
TURNING = 1.5
# [m/s^2] smallest deceleration of a car with locked wheels, except on the most slippery ice. With
# less deceleration, wheels that stand at an estimated speed above SLOW_M_S mean a wrong estimate.
SLIDES_M_S2 = 1.0
# [1] Wheels slower than this share of the speed count as locked while the car decelerates.
LOCKED_SHARE = 0.1
# [s] longest slide with locked wheels: after it, standing wheels mean that the car stands
LONGEST_SLIDE_S = 10.0


@compiled
def watch_wheels(memory: MixtureMemory, constants: Constants, features: BlockFeatures) -> None:
    """Update memory.rolling, the motion that follows if the wheels roll, with the wheel speeds of
    the block (the samples within 0.05 s). A block without them changes nothing if they were read
    within the last GAP_S.
    """
    rolling = memory.rolling
    row = memory.row
    time = memory.last.time
    rolling.ahead = math.nan
    rolling.left = math.nan
    least = math.inf
    most = -math.inf
    total = 0.0
    seen = 0
    recent = 0
    step = 0.0
    fastest = 0.0
    free = free_axle(row, memory.drive_odds, features.change)
    needed = 3 if free < 0 else 2
    for wheel in range(4):
        speed = features.rolling[wheel]
        counts = free < 0 or wheel // 2 == free
        if counts and time - memory.last.reading_time[S.OMEGA + wheel] < GAP_S:
            recent = recent + 1
        if math.isnan(speed):
            continue
        fastest = max(fastest, abs(speed))
        if not counts:
            continue
        ahead = at_centre(row, features, wheel)
        least = min(least, ahead)
        most = max(most, ahead)
        total = total + ahead
        seen = seen + 1
        step = max(step, memory.last.omega_step[wheel] * ROUNDING * row[Parameter.RADIUS])
    if seen < needed <= recent:
        return
    still = seen >= needed and fastest < STEP_LEAST * row[Parameter.RADIUS]
    _update_standstill(memory, constants, features, still)
    held = fastest < LOCKED_SHARE * features.speed and abs(features.change) > SLIDES_M_S2
    locked = features.speed >= SLOW_M_S and (held or (still and not rolling.stands))
    if seen < needed or locked:
        rolling.disagreed_time = time
        return
    middle = total / seen
    error = constants.physical.wheel_std * abs(middle) + SMALLEST_STD + step
    if not most - least <= 2.0 * error:
        rolling.disagreed_time = time
    unsure = memory.trust.distrust > 0.0
    if unsure and seen == 4:
        middle = 0.5 * (total - least - most)
    if unsure or time - rolling.disagreed_time >= constants.chosen.window:
        pull = features.change / GRAVITY if free < 0 else 0.0
        _compute_velocities(memory, constants, features, (middle, step, pull))


@compiled
def _update_standstill(
    memory: MixtureMemory, constants: Constants, features: BlockFeatures, still: bool
) -> None:
    rolling = memory.rolling
    time = memory.last.time
    if not still or math.isnan(rolling.resting_ax):
        rolling.resting_ax = features.change
    if not still:
        rolling.moved_time = time
    keep = math.exp(-features.duration / constants.chosen.window)
    rolling.resting_ax = keep * rolling.resting_ax + (1.0 - keep) * features.change
    wait = constants.chosen.window
    if features.speed >= SLOW_M_S:
        wait = (
            2.0 * constants.chosen.window if abs(features.change) < SLIDES_M_S2 else LONGEST_SLIDE_S
        )
    # A larger change of a_x than the usual offset means that the car may start to move.
    quiet = abs(features.change - rolling.resting_ax) < constants.physical.offset_std
    rolling.stands = still and quiet and time - rolling.moved_time >= wait


@compiled
def _compute_velocities(
    memory: MixtureMemory,
    constants: Constants,
    features: BlockFeatures,
    seen: tuple[float, float, float],
) -> None:
    """Compute the velocity (v_x, v_y) that follows if the wheels roll, and its standard deviations.
    The results are written into memory.rolling.

    `seen` contains the forward speed according to the wheels [m/s], the resolution of this speed
    [m/s], and the longitudinal force of these wheels over their load [1].
    """
    rolling = memory.rolling
    row = memory.row
    middle, step, pull = seen
    slip = pull / row[Parameter.SLOPE_X]
    share = constants.physical.wheel_std + constants.physical.agreeing_slip * abs(slip)
    rolling.ahead = (1.0 - slip) * middle
    rolling.ahead_std = math.sqrt((share * middle) ** 2 + SMALLEST_STD**2 + step * step)
    side = mean_or(memory.block, S.AY, math.nan) / GRAVITY
    most = constants.chosen.following_most
    if abs(side) < most and abs(features.yaw_rate * middle) < TURNING * most * GRAVITY:
        rolling.left = (
            row[Parameter.TO_REAR] * features.yaw_rate - middle * side / row[Parameter.SLOPE_Y]
        )
        needed = abs(side) / row[Parameter.SLOPE_Y]
        share = constants.physical.steer_std + constants.physical.agreeing_slip * needed
        rolling.left_std = share * abs(middle) + SMALLEST_STD


@compiled
def take_rolling(
    memory: MixtureMemory, design: MixtureDesign, scratch: Scratch, group: int
) -> float:
    """Update a group of nodes (friction hypotheses) with the velocity that follows from rolling
    wheels. Return a penalty [nat] per node, which grows with the difference of this velocity from
    the node's estimate.
    """
    rolling = memory.rolling
    constants = design.constants
    features = scratch.features
    mean = memory.mean[group]
    covariance = memory.covariance[group]
    row = scratch.node.velocity
    if rolling.stands:
        reading = (SMALLEST_STD**2, math.inf)
        for axis in range(2):
            direction = (1.0 - axis, float(axis))
            _take_velocity(mean, covariance, row, direction, -lanes_at(mean, axis), reading)
        return 0.0 * lanes_at(mean, 0)
    cost = 0.0 * lanes_at(mean, 0)
    cos = features.cos
    sin = features.sin
    look = max(constants.physical.correlation_time / features.duration, 1.0)
    if not math.isnan(rolling.ahead):
        ahead = cos * lanes_at(mean, NodeState.VX) + sin * lanes_at(mean, NodeState.VY)
        innovation = rolling.ahead - (ahead + gained_by(features.gain, mean)[0])
        reading = (rolling.ahead_std**2 * look, constants.guards.huber)
        cost += _take_velocity(mean, covariance, row, (cos, sin), innovation, reading)
    if not math.isnan(rolling.left):
        left = cos * lanes_at(mean, NodeState.VY) - sin * lanes_at(mean, NodeState.VX)
        innovation = rolling.left - (left + gained_by(features.gain, mean)[1])
        reading = (rolling.left_std**2 * look, constants.guards.huber)
        cost += _take_velocity(mean, covariance, row, (-sin, cos), innovation, reading)
    return cost


@compiled
def _take_velocity(
    mean: FloatArray,
    covariance: FloatArray,
    row: FloatArray,
    direction: tuple[float, float],
    innovation: float,
    reading: tuple[float, float],
) -> float:
    """Apply a measured velocity along `direction` (x, y) to the filters of a group of nodes. Return
    half of the squared innovation over its variance [nat].

    Args:
        mean, covariance: means and covariances of the nodes' states, updated in place.
        row: scratch memory (n, LANES).
        direction: unit vector in the vehicle axes.
        innovation: measured velocity minus that of each node [m/s].
        reading: variance of the measured velocity, and threshold of the Huber function. If the
            innovation exceeds this number of standard deviations, the variance is increased.
    """
    x, y = direction
    variance, huber = reading
    for i in range(mean.shape[0]):
        by_x = symmetric_at(covariance, i, NodeState.VX)
        put_lanes(row, i, x * by_x + y * symmetric_at(covariance, i, NodeState.VY))
    own = x * lanes_at(row, NodeState.VX) + y * lanes_at(row, NodeState.VY)
    far = innovation * (1.0 / huber)
    per = 1.0 / (own + max(far * far - own, variance))
    step = innovation * per
    subtract_row(mean, covariance, row, per, step)
    return 0.5 * innovation * step
