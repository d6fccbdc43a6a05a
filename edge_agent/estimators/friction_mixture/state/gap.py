"""Continuation of a vehicle's filter after a gap in time without samples, and restart of its motion
estimate.
"""

from __future__ import annotations

import math

from edge_agent.estimators import flags
from edge_agent.estimators.common.motion import FIRST_V_STD, UNKNOWN_V_STD
from edge_agent.estimators.common.readings import rolling_speed
from edge_agent.estimators.friction_mixture.state.constants import (
    ALL_NODES,
    GROUPS,
    NODES,
    STATES,
    NodeState,
)
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from schemas.runtime.jit import compiled
from schemas.runtime.lanes import put_lanes
from schemas.signals import S

UNKNOWN_YAW_VAR = 1.0  # [rad^2/s^2] variance of the yaw rate without a gyroscope
YAW_STD = 0.002  # [rad/s] white noise and offset of a gyroscope sample
# [m/s/s^.5] random walk of the velocity where the accelerometers are missing
LOST_WALK = 2.0
# [m/s] speed of vehicle and wheels below which slip is not used as evidence, because it is a
# quotient of small numbers. Wheel-speed differences are divided by at least this speed.
SLOWEST_M_S = 1.5
SLOW_M_S = 2.0 * SLOWEST_M_S  # [m/s] speed from which slip counts in full


@compiled
def spread_moments(memory: MixtureMemory) -> None:
    """Set mean and covariance of all nodes (filters of one friction hypothesis each) to those of
    the whole mixture.
    """
    for group in range(GROUPS):
        for i in range(STATES):
            put_lanes(memory.mean, (group, i), memory.overall_mean[i])
            for j in range(i + 1):
                put_lanes(memory.covariance, (group, i, j), memory.overall_covariance[i, j])


@compiled
def put_split_to_sleep(memory: MixtureMemory) -> None:
    """Deactivate the nodes of split roads (different friction left and right), and normalise the
    weights of the other nodes.
    """
    if not memory.split:
        return
    memory.split = False
    for weight in (memory.weight, memory.visit_weight):
        total = 0.0
        for j in range(NODES):
            total += weight[j]
        for j in range(ALL_NODES):
            weight[j] = weight[j] / total if j < NODES else 0.0


@compiled
def restart_motion(memory: MixtureMemory, speed: float, spread: float) -> None:
    """Restart the velocity of all nodes: v_x is `speed` [m/s] and v_y zero.

    If `speed` is NaN, all nodes keep the mixture's v_x with standard deviation `spread` [m/s].
    """
    if not math.isnan(speed):
        memory.overall_mean[NodeState.VX] = speed
        spread = FIRST_V_STD
    memory.overall_mean[NodeState.VY] = 0.0
    covariance = memory.overall_covariance
    for i in range(covariance.shape[0]):
        for axis in range(2):
            covariance[i, axis] = 0.0
            covariance[axis, i] = 0.0
    covariance[NodeState.VX, NodeState.VX] = spread**2
    covariance[NodeState.VY, NodeState.VY] = FIRST_V_STD**2
    spread_moments(memory)


@compiled
def bridge_gap(memory: MixtureMemory, design: MixtureDesign, dt: float) -> int:
    """Continue the filter after a gap of dt [s] without samples; return the health flag RESET.

    The friction estimate moves towards the prior, more after more metres driven during the gap. The
    motion estimate restarts.
    """
    last = memory.last
    now = memory.last.now
    prior = design.prior
    hazard = 1.0 - math.exp(
        -abs(memory.overall_mean[NodeState.VX]) * dt * design.constants.physical.hazard
    )
    put_split_to_sleep(memory)
    for j in range(NODES):
        memory.weight[j] += hazard * (prior[j] - memory.weight[j])
        memory.visit_weight[j] += hazard * (prior[j] - memory.visit_weight[j])
    restart_motion(
        memory, rolling_speed(memory.row, now), min(LOST_WALK * math.sqrt(dt), UNKNOWN_V_STD)
    )
    rate = now[S.YAW_RATE]
    if not math.isnan(rate):
        last.yaw_rate = rate
        last.yaw_rate_var = YAW_STD**2
    for wheel in range(4):
        last.omega[wheel] = now[S.OMEGA + wheel]
    return flags.RESET
