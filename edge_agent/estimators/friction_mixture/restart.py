"""Start and restart of a vehicle's filter: at the first sample, after a gap in time, and when the
wheel speeds contradict every friction hypothesis (node) for a long time.
"""

from __future__ import annotations

import math

from edge_agent.estimators import flags
from edge_agent.estimators.common.arrays import clear_vector
from edge_agent.estimators.common.excitation import begin_excitation
from edge_agent.estimators.common.motion import FIRST_V_STD, UNKNOWN_V_STD
from edge_agent.estimators.common.readings import INPUTS, read_plausible, rolling_speed
from edge_agent.estimators.friction_mixture.block.drive_split import FIRST_ODDS
from edge_agent.estimators.friction_mixture.block.wheel_readings import refuse_jumps
from edge_agent.estimators.friction_mixture.node.rolling_motion import SMALLEST_STD
from edge_agent.estimators.friction_mixture.report.reported_interval import find_interval
from edge_agent.estimators.friction_mixture.state.constants import NODES, NodeState
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign
from edge_agent.estimators.friction_mixture.state.gap import (
    UNKNOWN_YAW_VAR,
    YAW_STD,
    put_split_to_sleep,
    restart_motion,
    spread_moments,
)
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from edge_agent.estimators.friction_mixture.state.workspace import Scratch
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import S

# [1] The motion is reset if it differs by more than this number of standard deviations from the
# velocity that follows from the wheels.
FAR = 10.0


@compiled
def start_vehicle(
    memory: MixtureMemory, design: MixtureDesign, scratch: Scratch, time: float, sample: FloatArray
) -> int:
    """Start the filter of a vehicle at its first sample with a finite time; return the health
    flags. All fields of `memory`, the state of the filter, must be zero before the call.
    """
    if not math.isfinite(time):
        return flags.TIME_GAP
    last = memory.last
    now = memory.last.now
    block = memory.block
    read_plausible(sample, now)
    refuse_jumps(memory.row, now)
    last.time = time
    block.time = time
    for channel in range(INPUTS):
        last.reading[channel] = now[channel]
        last.reading_time[channel] = time
    last.position_time = -math.inf
    last.inertial_time = -math.inf
    last.read_ax = math.nan
    last.read_ay = math.nan
    rate = now[S.YAW_RATE]
    last.yaw_rate = 0.0 if math.isnan(rate) else rate
    block.start_yaw_rate = last.yaw_rate
    last.yaw_rate_var = UNKNOWN_YAW_VAR if math.isnan(rate) else YAW_STD**2
    for wheel in range(4):
        block.start_omega[wheel] = now[S.OMEGA + wheel]
        last.omega[wheel] = block.start_omega[wheel]
        block.start_omega_time[wheel] = time
        angle = now[S.DELTA + wheel]
        last.delta[wheel] = 0.0 if math.isnan(angle) else angle
        last.delta_before[wheel] = last.delta[wheel]
    speed = rolling_speed(memory.row, now)
    known = not math.isnan(speed)
    memory.overall_mean[NodeState.VX] = speed if known else 0.0
    forget_vehicle(memory)
    covariance = memory.overall_covariance
    first = SMALLEST_STD if speed < SMALLEST_STD else FIRST_V_STD
    covariance[NodeState.VX, NodeState.VX] = (first if known else UNKNOWN_V_STD) ** 2
    covariance[NodeState.VY, NodeState.VY] = first**2
    for j in range(NODES):
        memory.weight[j] = design.prior[j]
        memory.visit_weight[j] = memory.weight[j]
    spread_moments(memory)
    for friction in (memory.friction, memory.friction_left, memory.friction_right):
        find_interval(design, design.prior, memory.patch, scratch.blended, 0.0, friction)
    for kind in range(3):
        memory.drive_odds[kind] = FIRST_ODDS[kind]
    rolling = memory.rolling
    rolling.moved_time = -math.inf if speed == 0.0 else time
    rolling.disagreed_time = time
    rolling.ahead = math.nan
    rolling.left = math.nan
    rolling.resting_ax = now[S.AX]
    begin_excitation(memory.excitation)
    memory.trust.strain = 1.0
    memory.started = True
    return flags.OK


@compiled
def forget_vehicle(memory: MixtureMemory) -> None:
    """Reset the vehicle and sensor states (not the motion) to their prior, in the mean and
    covariance of the whole mixture of friction hypotheses.
    """
    nominal = memory.nominal
    covariance = memory.overall_covariance
    for i in range(NodeState.LN_KX, nominal.mean.shape[0]):
        memory.overall_mean[i] = nominal.mean[i]
        for j in range(i + 1):
            covariance[i, j] = 0.0
            covariance[j, i] = 0.0
        covariance[i, i] = nominal.std[i] ** 2
    clear_vector(memory.penalty)


@compiled
def reset_to_wheel_speed(memory: MixtureMemory, design: MixtureDesign) -> int:
    """Reset motion, vehicle states and friction if the motion estimate is far from the speed of
    wheels that have agreed for a long time; return the health flags.

    Without a reset, nodes (friction hypotheses) that assume these wheels slide would not recover:
    the tyre curve is flat there, so the measurements hardly change their velocity.

    The lateral velocity counts only if the filter itself is unsure of it. The rear axle is assumed
    to follow because the lateral acceleration is small, which is always so on ice. In a short slide
    the filter is sure of the lateral velocity, and the assumption is wrong.
    """
    rolling = memory.rolling
    if math.isnan(rolling.ahead):
        return 0
    astray = abs(memory.overall_mean[NodeState.VX] - rolling.ahead) > FAR * rolling.ahead_std
    own_std = math.sqrt(memory.overall_covariance[NodeState.VY, NodeState.VY])
    if not math.isnan(rolling.left) and own_std > rolling.left_std:
        sideways = abs(memory.overall_mean[NodeState.VY] - rolling.left)
        astray = astray or sideways > FAR * rolling.left_std
    return _begin_anew(memory, design, rolling.ahead) if astray else 0


@compiled
def _begin_anew(memory: MixtureMemory, design: MixtureDesign, speed: float) -> int:
    """Restart the motion estimate at `speed` [m/s]. Reset all other states and the friction to the
    prior.
    """
    # The states learned while the motion was wrong are wrong too.
    forget_vehicle(memory)
    restart_motion(memory, speed, FIRST_V_STD)
    memory.actual = memory.theoretical
    memory.factor = 1.0
    put_split_to_sleep(memory)
    clear_vector(memory.patch)
    clear_vector(memory.built_along)
    clear_vector(memory.built_across)
    for j in range(NODES):
        memory.weight[j] = design.prior[j]
        memory.visit_weight[j] = memory.weight[j]
    return flags.RESET
