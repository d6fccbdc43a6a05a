"""Motion without a tyre model, in three cases: all wheels stand, all wheels roll alike, or the rear
axle does not slide.

A tyre beyond its peak does not keep a constant slip: it locks or spins up within a tenth of a
second unless a controller acts, and four tyres never do so alike. Therefore, if four wheels agree
for a second, the speed is computed from them with the slip that their force needs. Without this
rule, the filter could explain a lasting accelerometer offset only by four wheels sliding on ice.
This explanation fits any data, so the filter would keep it forever. In the same way, a rear axle
with hardly any lateral force does not slide sideways, so the lateral velocity is computed from it.
"""

from __future__ import annotations

import math

from edge_agent.dynamics.parameters import Parameter
from edge_agent.estimators.friction_mixture.block.block_features import ROUNDING, at_centre, mean_or
from edge_agent.estimators.friction_mixture.node.residuals import gained_velocity
from edge_agent.estimators.friction_mixture.state.constants import Constants, NodeState
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from edge_agent.estimators.friction_mixture.state.workspace import BlockFeatures, Scratch
from edge_agent.filters.sequential import apply_projection, potter_factors
from schemas.runtime.jit import compiled
from schemas.signals import S
from schemas.thresholds import GRAVITY

STANDING_STD = 0.05  # [m/s] sensors of a wheel that creeps show nothing
STANDING_RAD_S = 0.05  # a wheel that turns slower stands
RESTING_TIME = 1.0  # [s] smoothing of a_x while wheels stand
STARTS = 0.25  # [m/s^2] from there within which the car does not start or stop
SLOW_M_S = 3.0  # a faster car whose wheels stand has locked them, or the filter is lost:
SLIDES_M_S2 = 1.0  # a car with locked wheels decelerates by more on all but the slipperiest ice
LOCKED_SHARE = 0.1  # of the speed: wheels that all turn slower while the car decelerates are locked
LOST_S = 2.0  # [s] until wheels that stand without that are those of a car that stands
LONGEST_SLIDE_S = 10.0  # [s] of a car with locked wheels
AGREE_FLOOR = 0.15  # [m/s] within which wheels always agree
TURN_SHARE = 0.05  # of the speed difference of the sides in a turn: track and yaw rate
SIDE_SHARE = 0.5  # share by which sideslip differs from the side force over nominal stiffness
LEFT_FLOOR = 0.03  # [m/s]
TURNING = 1.5  # v*r against a_y: both must be small
UNSURE = 0.5  # distrust from which the wheels' middle is taken whether they agree or not
FARTHEST_FOLLOWED = 0.8  # a_y over g to which the rear axle is then taken to follow


@compiled
def watch_wheels(memory: MixtureMemory, constants: Constants, features: BlockFeatures) -> None:
    """Update memory.rolling, the motion according to rolling wheels, with the wheel speeds of the
    block (the samples within 0.05 s).
    """
    rolling = memory.rolling
    row = memory.row
    time = memory.last.time
    rolling.ahead = rolling.left = math.nan
    least = math.inf
    most = -math.inf
    total = 0.0
    seen = 0
    step = 0.0
    fastest = 0.0
    for wheel in range(4):
        speed = features.rolling[wheel]
        if math.isnan(speed):
            continue
        ahead = at_centre(row, features, wheel)
        least = min(least, ahead)
        most = max(most, ahead)
        total = total + ahead
        seen = seen + 1
        fastest = max(fastest, abs(speed))
        step = max(step, memory.last.omega_step[wheel] * ROUNDING * row[Parameter.RADIUS])
    still = seen >= 3 and fastest < STANDING_RAD_S * row[Parameter.RADIUS]
    _update_standstill(memory, constants, features, still)
    held = fastest < LOCKED_SHARE * features.speed and abs(features.change) > SLIDES_M_S2
    locked = features.speed >= SLOW_M_S and (held or (still and not rolling.stands))
    if seen < 3 or locked:
        rolling.disagreed_time = time
        return
    middle = total / seen
    turning = TURN_SHARE * abs(features.yaw_rate) * row[Parameter.TRACK_FRONT]
    allowed = constants.agreeing_width * abs(middle) + AGREE_FLOOR + 2.0 * step + turning
    if not (most - least <= allowed and abs(features.change) < constants.agreeing_most):
        rolling.disagreed_time = time
    unsure = memory.trust.distrust > UNSURE
    if unsure and seen == 4:
        middle = 0.5 * (total - least - most)
    if unsure or time - rolling.disagreed_time >= constants.agreeing_time:
        _compute_velocities(memory, constants, features, middle, step)


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
    keep = math.exp(-features.duration / RESTING_TIME)
    rolling.resting_ax = keep * rolling.resting_ax + (1.0 - keep) * features.change
    wait = constants.standing_time
    if features.speed >= SLOW_M_S:
        wait = LOST_S if abs(features.change) < SLIDES_M_S2 else LONGEST_SLIDE_S
    quiet = abs(features.change - rolling.resting_ax) < STARTS
    rolling.stands = still and quiet and time - rolling.moved_time >= wait


@compiled
def _compute_velocities(
    memory: MixtureMemory, constants: Constants, features: BlockFeatures, middle: float, step: float
) -> None:
    """Compute v_x and v_y that rolling wheels at the speed `middle` [m/s] imply, and their standard
    deviations.

    The results are written into memory.rolling.
    """
    rolling = memory.rolling
    row = memory.row
    pull = features.change / GRAVITY
    slip = pull / row[Parameter.SLOPE_X]
    share = (
        constants.agreeing_std
        + constants.agreeing_slip * abs(slip)
        + constants.agreeing_cube * abs(pull) ** 3
    )
    rolling.ahead = (1.0 - slip) * middle
    late = constants.agreeing_lag * features.change
    rolling.ahead_std = math.sqrt(
        (share * middle) ** 2 + constants.agreeing_floor**2 + step * step + late * late
    )
    side = mean_or(memory.block, S.AY, math.nan) / GRAVITY
    most = FARTHEST_FOLLOWED if memory.trust.distrust > UNSURE else constants.following_most
    if abs(side) < most and abs(features.yaw_rate * middle) < TURNING * most * GRAVITY:
        rolling.left = (
            row[Parameter.TO_REAR] * features.yaw_rate - middle * side / row[Parameter.SLOPE_Y]
        )
        share = constants.following_std + SIDE_SHARE * abs(side) / row[Parameter.SLOPE_Y]
        rolling.left_std = share * abs(middle) + LEFT_FLOOR


@compiled
def take_rolling(memory: MixtureMemory, design: MixtureDesign, scratch: Scratch, j: int) -> float:
    """Update node j (friction hypothesis) with the velocity derived from the wheels; return the
    penalty [nat] for the difference from the node's own velocity.
    """
    rolling = memory.rolling
    constants = design.constants
    features = scratch.features
    mean = memory.mean[j]
    if rolling.stands:
        variance = STANDING_STD**2
        _take_velocity(memory, scratch, j, (1.0, 0.0), (-mean[NodeState.VX], variance, math.inf))
        _take_velocity(memory, scratch, j, (0.0, 1.0), (-mean[NodeState.VY], variance, math.inf))
        return 0.0
    cost = 0.0
    cos = features.cos
    sin = features.sin
    look = max(constants.agreeing_look / features.duration, 1.0)
    if not math.isnan(rolling.ahead):
        now = (
            cos * mean[NodeState.VX]
            + sin * mean[NodeState.VY]
            + gained_velocity(features.gain, mean)[0]
        )
        reading = (rolling.ahead - now, rolling.ahead_std**2 * look, constants.huber)
        cost += _take_velocity(memory, scratch, j, (cos, sin), reading)
    if not math.isnan(rolling.left):
        now = (
            cos * mean[NodeState.VY]
            - sin * mean[NodeState.VX]
            + gained_velocity(features.gain, mean)[1]
        )
        reading = (rolling.left - now, rolling.left_std**2 * look, constants.huber)
        cost += _take_velocity(memory, scratch, j, (-sin, cos), reading)
    return cost


@compiled
def _take_velocity(
    memory: MixtureMemory,
    scratch: Scratch,
    j: int,
    direction: tuple[float, float],
    reading: tuple[float, float, float],
) -> float:
    """Update node j (friction hypothesis) with a measured velocity along `direction` (x, y).
    `reading` is (innovation [m/s], variance, threshold of the Huber function that limits outliers).

    Return half of the squared innovation (measurement minus prediction) over its variance [nat].
    """
    root = scratch.root[j]
    row = scratch.velocity_row
    innovation, variance, huber = reading
    own = 0.0
    for k in range(row.shape[0]):
        row[k] = direction[0] * root[NodeState.VX, k] + direction[1] * root[NodeState.VY, k]
        own += row[k] ** 2
    total, gain = potter_factors(row, max(variance, (innovation / huber) ** 2 - own))
    apply_projection(memory.mean[j], root, row, innovation / total, gain)
    return 0.5 * innovation * innovation / total
