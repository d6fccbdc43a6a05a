"""Slip derived from the wheel speeds alone, without an estimate of friction or motion.

A wheel slides if its speed differs from the other wheels by more than tyre radii explain, or if its
speed changes faster than the car's. Anti-lock and traction control use the same evidence. The
filter uses it in four places: as an input of the rule base (`adaptation/rule_base.py`), as an
explanation of large innovations (`trust.py`), as a sign that the road has just changed or is still
the same (`mixing.py`), and in the measurement update of sliding wheels (`node_filter.py`).
"""

from __future__ import annotations

import math

from edge_agent.dynamics.parameters import Parameter
from edge_agent.dynamics.slip import SLOWEST_M_S as SLOWEST_SLIP_M_S
from edge_agent.estimators.friction_mixture.block.block_features import at_centre
from edge_agent.estimators.friction_mixture.block.wheel_readings import two_smallest
from edge_agent.estimators.friction_mixture.state.constants import Constants, NodeState
from edge_agent.estimators.friction_mixture.state.gap import SLOW_M_S
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from edge_agent.estimators.friction_mixture.state.workspace import BlockFeatures
from schemas.runtime.jit import compiled
from schemas.thresholds import UTILISED_WINDOW_S

# Each membership is 1 from the value below on, 0 up to half of it, and linear between them.
APART_SLIDES = 0.08  # [1] difference of two wheel speeds over the speed
SPIN_SLIDES = 12.0  # [m/s^2] difference of a wheel's acceleration from the car's
SEEN = 0.3  # [1] increase of the membership from which a new slide counts as begun
# [1] mean square of the second smallest of four second differences of independent normal values,
# over the variance of these values
SECOND_SMALLEST = 2.45


@compiled
def update_slip(memory: MixtureMemory, constants: Constants, features: BlockFeatures) -> None:
    """Update the evidence that wheels slide, memory.slip, and the vibration of wheels with the
    wheel speeds of the block (the samples within 0.05 s).
    """
    slip = memory.slip
    seen = slip_membership(memory, features)
    slip.begins = max(seen - slip.held, 0.0)
    slip.held = max(seen, slip.held * math.exp(-features.duration / UTILISED_WINDOW_S))
    slip.ended = slip.held - seen
    learn_vibration(memory, constants, features)
    if slip.begins > SEEN and front_slides_more(memory, features):
        wheelbase = memory.row[Parameter.TO_FRONT] + memory.row[Parameter.TO_REAR]
        # The rear tyres need `abrupt_time` to build up their force at the place of the front axle.
        slip.rear_unlike_until = (
            memory.last.time
            + wheelbase / max(features.speed, SLOW_M_S)
            + constants.physical.abrupt_time
        )


@compiled
def sliding_degree(memory: MixtureMemory) -> float:
    """Return the fuzzy truth value, 0 to 1, of "a wheel slides" in the current block."""
    return float(memory.slip.held - memory.slip.ended)


@compiled
def learn_vibration(memory: MixtureMemory, constants: Constants, features: BlockFeatures) -> None:
    """Update memory.vibration, the standard deviation [rad/s] of the wheel speeds of a block that
    an uneven road causes, while no wheel slides.

    It follows from the second differences of the wheel speeds over three blocks. Only the wheel
    with the second smallest difference counts, because the wheels of one axle may begin to slide.
    For the same reason a large difference counts as `huber` standard deviations.
    """
    earlier = memory.earlier_omega
    smallest = math.inf
    second = math.inf
    for wheel in range(4):
        omega = features.rolling[wheel] / memory.row[Parameter.RADIUS]
        bend = abs(omega - 2.0 * earlier[0, wheel] + earlier[1, wheel])
        earlier[1, wheel] = earlier[0, wheel]
        earlier[0, wheel] = omega
        smallest, second = two_smallest(smallest, second, bend)
    if second < math.inf and features.speed > SLOW_M_S:
        share = 1.0 - math.exp(-features.duration / constants.chosen.window)
        share *= 1.0 - sliding_degree(memory)
        square = memory.vibration**2
        usual = max(memory.vibration, constants.physical.omega_noise)
        found = min(second**2 / SECOND_SMALLEST, (constants.guards.huber * usual) ** 2)
        memory.vibration = math.sqrt(square + share * (found - square))


@compiled
def fastest_speed(features: BlockFeatures, vx: float) -> float:
    """Return the speed [m/s] of the car, `vx`, or that of its fastest wheel if this is larger."""
    fastest = abs(vx)
    for wheel in range(4):
        if not math.isnan(features.rolling[wheel]):
            fastest = max(fastest, abs(features.rolling[wheel]))
    return fastest


@compiled
def slow_noise(fastest: float) -> float:
    """Return the factor by which the measurement noise R of slips is multiplied at the speed
    `fastest` [m/s]. Slip is a speed difference over the speed. Below SLOW_M_S the errors of this
    difference, such as those by steering geometry, do not decrease with the speed any more.
    """
    share = min(max(fastest, SLOWEST_SLIP_M_S) / SLOW_M_S, 1.0)
    return 1.0 / (share * share)


@compiled
def slip_membership(memory: MixtureMemory, features: BlockFeatures) -> float:
    """Compute the fuzzy truth value, 0 to 1, of "a wheel slides" from the wheel speeds of the
    block.
    """
    slowest = math.inf
    fastest = -math.inf
    spin = 0.0
    for wheel in range(4):
        speed = wheel_speed(memory, features, wheel)
        if not math.isnan(speed):
            slowest = min(slowest, speed)
            fastest = max(fastest, speed)
            spin = max(
                spin, abs(memory.row[Parameter.RADIUS] * features.spin[wheel] - features.change)
            )
    # Below this speed the resolution of the wheel speeds looks like slip.
    if fastest < SLOW_M_S:
        return 0.0
    relative_difference = (fastest - slowest) / fastest
    degree = 2.0 * max(relative_difference / APART_SLIDES, spin / SPIN_SLIDES) - 1.0
    return float(min(max(degree, 0.0), 1.0))


@compiled
def front_slides_more(memory: MixtureMemory, features: BlockFeatures) -> bool:
    """Return True if, of all wheels, a front wheel deviates most from the estimated speed of the
    car.
    """
    front = 0.0
    rear = 0.0
    for wheel in range(4):
        deviation = abs(wheel_speed(memory, features, wheel) - memory.overall_mean[NodeState.VX])
        if math.isnan(deviation):
            continue
        if wheel < 2:
            front = max(front, deviation)
        else:
            rear = max(rear, deviation)
    return front > rear


@compiled
def wheel_speed(memory: MixtureMemory, features: BlockFeatures, wheel: int) -> float:
    """Return the forward speed [m/s] of the car computed from one wheel with its estimated radius;
    NaN without a reading.
    """
    radius = 1.0 + memory.overall_mean[NodeState.RADIUS + wheel]
    return float(at_centre(memory.row, features, wheel) * radius)
