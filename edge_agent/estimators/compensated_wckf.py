"""Estimator `compensated-wckf`: the two filters of paper 002, WCKF-A for the wheels and WCKF-B for
the vehicle. Both are weighted square-root cubature Kalman filters. Numbers in brackets are the
paper's equations.

Chen, Cai, Chen, Xu, Jiang, Sun, "Design of vehicle running states-fused estimation strategy using
Kalman filters and tire force compensation method", IEEE Access 2019, doi
10.1109/ACCESS.2019.2925370 (paper 002).

WCKF-A estimates 19 states: v_x, v_y, yaw rate r, and for each wheel motor torque tau, speed omega,
longitudinal force F_x and its derivative F_x'. It measures r, tau and omega, by equations (30) to
(32). The module `drive_wheel` contains its model of a driven wheel.

Tyre force compensation (33) blends two longitudinal forces per wheel: the estimate F_x of WCKF-A
and the force of the tyre model, the Magic Formula (12).

WCKF-B estimates v_x, v_y and r from the compensated forces. It measures r, a_x and a_y, by
equations (35) and (36). Both filters compute R from a weighted moving window (25), see
`adaptation.windows`.

The filters do not estimate friction: they assume a constant, here DRY (a dry road). Therefore the
friction that the estimator reports is the prior distribution.

For plots like the paper's figures, which compare both filters, `EstimatorBank.memory("mean")`
returns the states of WCKF-A and `memory("compensated")` the compensated forces. ELEMENTS lists each
element of the paper and every departure with its reason.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import Annotated, Final

import numpy as np

from edge_agent.adaptation.windows import push_innovation, weighted_noise
from edge_agent.dynamics.body import planar_accelerations
from edge_agent.dynamics.chassis import tyre_forces, wheel_inputs
from edge_agent.dynamics.drive_wheel import WheelState, blend_forces, drive_wheel, slip_share
from edge_agent.dynamics.parameters import Parameter
from edge_agent.dynamics.slip import wheel_velocity
from edge_agent.estimators.adaptive_federated_ckf import DRY
from edge_agent.estimators.bank import EstimatorBank
from edge_agent.estimators.common.motion import FIRST_V_STD, UNKNOWN_V_STD, has_diverged
from edge_agent.estimators.common.output import write_prior, write_states
from edge_agent.estimators.common.readings import rolling_speed
from edge_agent.estimators.common.run import PaperMemory, kernel_of, new_filters
from edge_agent.estimators.common.tyre_option import TyreOption
from edge_agent.estimators.elements import Element
from edge_agent.estimators.estimates import Column
from edge_agent.filters.cholesky import variance
from edge_agent.filters.householder import Measurement, predict, update
from edge_agent.filters.points import centred_deviations, sigma_points, weighted_mean
from edge_agent.filters.sigma import cubature_rule
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.runtime.records import records
from schemas.signals import S
from schemas.vehicle import Vehicle

A_STATES = 19
A_ROWS = 9
B_STATES = 3
B_POINTS = 2 * B_STATES
A_XI = cubature_rule(A_STATES).xi
A_WEIGHT = cubature_rule(A_STATES).w_cov
B_XI = cubature_rule(B_STATES).xi
B_WEIGHT = cubature_rule(B_STATES).w_cov
# [1] c of the Magic Formula (12), between the usual 1.3 (lateral) and 1.65 (longitudinal)
SHAPE = 1.4
WINDOW = 25  # number of samples in the moving window; the paper does not give its N
# [1] limits of R over its nominal value
LEAST = 0.5
LARGEST = 20.0
# Process standard deviations per s^.5, in the order of the states: v_x and v_y (offsets of the
# accelerometers), yaw rate (model error), torque, wheel speed, force and its derivative
A_PROCESS = np.array([0.05, 0.05, 0.2, *[20.0] * 4, *[0.5] * 4, *[100.0] * 4, *[2e4] * 4])
# Standard deviations of the states at the first sample, in the same order and in SI units
A_FIRST_STD = np.array(
    [FIRST_V_STD, FIRST_V_STD, 0.1, *[20.0] * 4, *[0.3] * 4, *[200.0] * 4, *[1000.0] * 4]
)
A_NOISE = np.array([1e-4, *[25.0] * 4, *[1e-3] * 4])  # variances of measured r, tau and omega
B_PROCESS = np.array([0.1, 0.1, 0.1])  # process of v_x, v_y and r per s^.5
B_NOISE = np.array([1e-4, 0.04, 0.04])  # variances of measured r, a_x and a_y, with model errors


class DriveWheelState(IntEnum):
    """Index of a state in the state vectors of paper 002's filters: WCKF-A for the wheels and
    WCKF-B for the vehicle. WCKF-B has only the first three states.

    TORQUE, OMEGA, FORCE and SLOPE (derivative of the force) exist once per wheel. Their index is
    that of the front left wheel; the other three wheels (fr, rl, rr) follow.
    """

    VX = 0
    VY = 1
    YAW_RATE = 2
    TORQUE = 3
    OMEGA = 7
    FORCE = 11
    SLOPE = 15


class CompensatedMemory(PaperMemory):
    """State of paper 002's filters for one vehicle, kept from one sample to the next: WCKF-A for
    the wheels and WCKF-B for the vehicle.
    """

    mean: Annotated[FloatArray, A_STATES]
    root: Annotated[FloatArray, A_STATES, A_STATES]
    window: Annotated[FloatArray, A_ROWS, WINDOW]  # latest innovations
    fused: Annotated[FloatArray, B_STATES]
    fused_root: Annotated[FloatArray, B_STATES, B_STATES]
    fused_window: Annotated[FloatArray, B_STATES, WINDOW]
    compensated: Annotated[FloatArray, 4]  # [N] longitudinal forces (33) at the motion of WCKF-B


class FrictionSet:
    """Friction of the four wheels, a constant that is set by hand (`friction`), and scratch arrays.
    A step of the filter writes each scratch array before it reads it.
    """

    friction: Annotated[FloatArray, 4]
    points: Annotated[FloatArray, 2 * A_STATES, A_STATES]
    work: Annotated[FloatArray, A_ROWS + A_STATES, 4 * A_STATES]


def make_bank(
    vehicles: Sequence[Vehicle], friction: float = DRY, tyre: TyreOption | None = None
) -> EstimatorBank:
    """Return a bank of paper 002's filters, one per vehicle, which assume a road with the friction
    coefficient `friction`.

    `tyre` selects the tyre model. For the vehicle of paper 002, `tyre` must contain `rear_slope`,
    the ratio of the cornering stiffnesses in the paper's table 1.
    """
    context = records(FrictionSet, 1)
    context["friction"] = friction
    return EstimatorBank(new_filters(CompensatedMemory, vehicles, tyre), context, KERNEL)


@compiled
# `context` is unused, because all filters have this signature.
def _begin_filter(memory: CompensatedMemory, context: FrictionSet) -> None:  # noqa: ARG001
    row = memory.row
    mean = memory.mean
    root = memory.root
    use = memory.track.inputs
    index = DriveWheelState
    speed = rolling_speed(row, memory.track.now)
    known = not math.isnan(speed)
    mean[:] = 0.0
    mean[index.VX] = speed if known else 0.0
    mean[index.YAW_RATE] = use[S.YAW_RATE]
    for wheel in range(4):
        omega = use[S.OMEGA + wheel]
        rolling = mean[index.VX] / row[Parameter.RADIUS]
        mean[index.TORQUE + wheel] = use[S.TORQUE + wheel]
        mean[index.OMEGA + wheel] = rolling if math.isnan(omega) else omega
        mean[index.FORCE + wheel] = use[S.TORQUE + wheel] / row[Parameter.RADIUS]
    root[:, :] = 0.0
    for i in range(A_STATES):
        root[i, i] = A_FIRST_STD[i]
    if not known:
        root[index.VX, index.VX] = UNKNOWN_V_STD
    memory.fused[:] = mean[:B_STATES]
    memory.fused_root[:] = root[:B_STATES, :B_STATES]
    memory.window[:] = math.nan
    memory.fused_window[:] = math.nan


@compiled
def _step_filter(memory: CompensatedMemory, context: FrictionSet, dt: float) -> bool:
    _predict_wheels(memory, context, dt)
    _update_wheels(memory, context)
    _predict_motion(memory, context, dt)
    _update_motion(memory, context)
    rate = DriveWheelState.YAW_RATE
    return not (
        has_diverged(memory.fused, memory.fused_root, rate)
        or has_diverged(memory.mean, memory.root, rate)
    )


@compiled
def _compensated_forces(
    row: FloatArray,
    velocity: FloatArray,
    use: FloatArray,
    friction: FloatArray,
    observed: FloatArray,
    forces: tuple[FloatArray, FloatArray],
) -> None:
    """Compute the compensated longitudinal forces (4,) [N] of the wheels at the motion `velocity`
    (v_x, v_y, yaw rate), by equation (33) of paper 002.

    For each wheel, the result is the weighted mean of the tyre model's force and of the force
    `observed`, which the wheel filter WCKF-A estimates. The weight of the tyre model is
    `slip_share`. The result is written into the first array of `forces`. The second array receives
    the lateral forces of the tyre model.
    """
    index = DriveWheelState
    vx = velocity[index.VX]
    vy = velocity[index.VY]
    rate = velocity[index.YAW_RATE]
    motion = np.array([vx, vy, rate, use[S.AX], use[S.AY]])
    delta = use[S.DELTA : S.DELTA + 4]
    omega = use[S.OMEGA : S.OMEGA + 4]
    share = np.empty(4)
    tyre_forces(row, motion, wheel_inputs(delta, omega), friction, SHAPE, forces)
    for wheel in range(4):
        along, _ = wheel_velocity(row, wheel, vx, vy, rate, delta[wheel])
        # A wheel without a speed reading has no known slip. Its force is then the observed one.
        if math.isnan(omega[wheel]):
            share[wheel] = 0.0
        else:
            share[wheel] = slip_share(row[Parameter.RADIUS], omega[wheel], along)
    blend_forces(share, forces[0], observed, forces[0])


@compiled
def _predict_wheels(memory: CompensatedMemory, context: FrictionSet, dt: float) -> None:
    """Predict the state of WCKF-A, the filter of the wheels, over `dt` [s]. The lateral forces come
    from the tyre model at the last motion that WCKF-B, the filter of the vehicle, has estimated.
    """
    row = memory.row
    mean = memory.mean
    points = context.points
    use = memory.track.inputs_before
    index = DriveWheelState
    force_x = np.empty(4)
    force_y = np.empty(4)
    noise = np.zeros((A_STATES, A_STATES))
    observed = mean[index.FORCE : index.FORCE + 4]
    _compensated_forces(row, memory.fused, use, context.friction, observed, (force_x, force_y))
    delta = use[S.DELTA : S.DELTA + 4]
    sigma_points(mean, memory.root, A_XI, points)
    for p in range(points.shape[0]):
        state = points[p]
        forces = state[index.FORCE : index.FORCE + 4]
        _, _, turn = planar_accelerations(row, forces, force_y, delta)
        _advance_motion(state, use[S.AX], use[S.AY], turn, dt)
        for k in range(4):
            wheel = drive_wheel(
                WheelState(
                    state[index.TORQUE + k],
                    state[index.OMEGA + k],
                    state[index.FORCE + k],
                    state[index.SLOPE + k],
                ),
                use[S.TORQUE + k],
                row[Parameter.WHEEL_INERTIA],
                row[Parameter.RADIUS],
                dt,
            )
            state[index.TORQUE + k] = wheel.torque
            state[index.OMEGA + k] = wheel.omega
            state[index.FORCE + k] = wheel.force
            state[index.SLOPE + k] = wheel.slope
    for i in range(A_STATES):
        noise[i, i] = A_PROCESS[i] * math.sqrt(dt)
    predict(points, (A_WEIGHT, A_WEIGHT), noise, mean, memory.root, context.work)


@compiled
def _advance_motion(state: FloatArray, ax: float, ay: float, turn: float, dt: float) -> None:
    """Advance v_x, v_y and yaw rate of a state vector in place over `dt` [s], with the
    accelerations `ax` and `ay` [m/s^2] and the yaw acceleration `turn` [rad/s^2].
    """
    index = DriveWheelState
    vx = state[index.VX]
    vy = state[index.VY]
    rate = state[index.YAW_RATE]
    state[index.VX] = vx + dt * (ax + rate * vy)
    state[index.VY] = vy + dt * (ay - rate * vx)
    state[index.YAW_RATE] = rate + dt * turn


@compiled
def _update_wheels(memory: CompensatedMemory, context: FrictionSet) -> None:
    """Update WCKF-A, the filter of the wheels, with the measured yaw rate, torques and wheel
    speeds. Each of them is a state, so the measurement is linear.
    """
    mean = memory.mean
    root = memory.root
    now = memory.track.now
    readings = np.empty(A_ROWS)
    readings[0] = now[S.YAW_RATE]
    readings[1:5] = now[S.TORQUE : S.TORQUE + 4]
    readings[5:9] = now[S.OMEGA : S.OMEGA + 4]
    deviations = np.empty((A_ROWS, A_STATES))
    innovation = np.empty(A_ROWS)
    std = np.empty(A_ROWS)
    for i in range(A_ROWS):
        state = DriveWheelState.YAW_RATE + i
        deviations[i] = root[state]
        innovation[i] = readings[i] - mean[state]
        if not math.isnan(innovation[i]):
            push_innovation(memory.window[i], innovation[i])
        std[i] = math.sqrt(
            weighted_noise(memory.window[i], variance(root, state), A_NOISE[i], LEAST, LARGEST)
        )
    update(mean, root, root.copy(), Measurement(deviations, innovation, std), context.work)


@compiled
def _predict_motion(memory: CompensatedMemory, context: FrictionSet, dt: float) -> None:
    """Predict the vehicle's motion, the state of WCKF-B, over `dt` [s] from the compensated tyre
    forces.
    """
    row = memory.row
    use = memory.track.inputs_before
    index = DriveWheelState
    observed = memory.mean[index.FORCE : index.FORCE + 4]
    points = np.empty((B_POINTS, B_STATES))
    noise = np.zeros((B_STATES, B_STATES))
    force_x = np.empty(4)
    force_y = np.empty(4)
    # The steering angles are those of the new sample.
    delta = memory.track.inputs[S.DELTA : S.DELTA + 4]
    sigma_points(memory.fused, memory.fused_root, B_XI, points)
    for p in range(B_POINTS):
        state = points[p]
        _compensated_forces(row, state, use, context.friction, observed, (force_x, force_y))
        ax, ay, turn = planar_accelerations(row, force_x, force_y, delta)
        _advance_motion(state, ax, ay, turn, dt)
    for i in range(B_STATES):
        noise[i, i] = B_PROCESS[i] * math.sqrt(dt)
    weights = (B_WEIGHT, B_WEIGHT)
    predict(points, weights, noise, memory.fused, memory.fused_root, context.work)


@compiled
def _update_motion(memory: CompensatedMemory, context: FrictionSet) -> None:
    """Update WCKF-B, the filter of the vehicle's motion, with the measured yaw rate and
    accelerations. Store the compensated forces at the new motion.
    """
    row = memory.row
    mean = memory.fused
    use = memory.track.inputs
    now = memory.track.now
    index = DriveWheelState
    observed = memory.mean[index.FORCE : index.FORCE + 4]
    points = np.empty((B_POINTS, B_STATES))
    outcomes = np.empty((B_POINTS, B_STATES))
    predicted = np.empty(B_STATES)
    state_deviations = np.empty((B_STATES, B_POINTS))
    deviations = np.empty((B_STATES, B_POINTS))
    force_x = np.empty(4)
    force_y = np.empty(4)
    delta = use[S.DELTA : S.DELTA + 4]
    sigma_points(mean, memory.fused_root, B_XI, points)
    for p in range(B_POINTS):
        state = points[p]
        _compensated_forces(row, state, use, context.friction, observed, (force_x, force_y))
        ax, ay, _ = planar_accelerations(row, force_x, force_y, delta)
        outcomes[p, 0] = state[index.YAW_RATE]
        outcomes[p, 1] = ax
        outcomes[p, 2] = ay
    weighted_mean(outcomes, B_WEIGHT, predicted)
    centred_deviations(points, mean, B_WEIGHT, state_deviations, 0)
    centred_deviations(outcomes, predicted, B_WEIGHT, deviations, 0)
    innovation = np.array([now[S.YAW_RATE], now[S.AX], now[S.AY]]) - predicted
    measurement = Measurement(
        deviations, innovation, _adapted_noise(memory, deviations, innovation)
    )
    used, log_likelihood, square = update(
        mean, memory.fused_root, state_deviations, measurement, context.work
    )
    _compensated_forces(row, mean, use, context.friction, observed, (memory.compensated, force_y))
    memory.nis = square / max(used, 1)
    memory.log_likelihood = log_likelihood


@compiled
def _adapted_noise(
    memory: CompensatedMemory, deviations: FloatArray, innovation: FloatArray
) -> FloatArray:
    """Return the standard deviations (3,) of the measurement noise of WCKF-B, computed from the
    moving window of innovations, to which the new `innovation` (3,) is added. `deviations`
    (3, points) are those of the predicted readings. Store the largest factor on the nominal
    variance.
    """
    std = np.empty(B_STATES)
    largest = 0.0
    for i in range(B_STATES):
        spread = 0.0
        for p in range(B_POINTS):
            spread += deviations[i, p] ** 2
        if not math.isnan(innovation[i]):
            push_innovation(memory.fused_window[i], innovation[i])
        adapted = weighted_noise(memory.fused_window[i], spread, B_NOISE[i], LEAST, LARGEST)
        std[i] = math.sqrt(adapted)
        largest = max(largest, adapted / B_NOISE[i])
    memory.adaptation = largest
    return std


@compiled
def _write_estimates(memory: CompensatedMemory, context: FrictionSet, output: FloatArray) -> float:
    write_states(output, memory.fused, memory.fused_root, DriveWheelState.YAW_RATE)
    write_prior(output, Column.MU)
    return float(context.friction[0])


KERNEL = kernel_of(_begin_filter, _step_filter, _write_estimates)

ELEMENTS: Final[tuple[Element, ...]] = (
    Element("(1) to (3)", "3-DOF model", "as printed", where="dynamics.body"),
    Element(
        "(4), (5)",
        "accelerations from wheel forces",
        "corrected",
        "1/m belongs on the whole bracket",
        "dynamics.body.planar_accelerations",
    ),
    Element("(6)", "sideslip angle beta", "as printed", where="common.output.write_motion"),
    Element(
        "(7) to (11)",
        "electric drive wheel: current, voltage, back-EMF K_a, damping b",
        "corrected",
        "torque stands for current, because cars send no current and voltage; K_a = .06 and K_t "
        "= 11.43 are not of one machine; K_a*omega and b*omega are losses inside the torque that "
        "is measured at the wheel",
        "dynamics.drive_wheel",
    ),
    Element("(12)", "Magic Formula", "as printed", where="dynamics.tyres.combined_magic"),
    Element(
        "(13), (14)",
        "loads and slip angles",
        "corrected",
        "lateral sign reversed against (2), (3); /l missing behind; half a half-track",
        "dynamics.loads, slip",
    ),
    Element("(15)", "slip", "as printed", where="dynamics.drive_wheel.slip_share"),
    Element("(16)", "coupling of the wheel speeds", "left out", "no equation of the paper uses it"),
    Element(
        "(18) to (23), (26) to (29)",
        "weighted square-root cubature filter",
        "corrected",
        "weights 1/(2n), points scaled once, deviations from the mean",
        "filters.householder",
    ),
    Element(
        "(24), (25)",
        "R from a weighted window of innovations",
        "corrected",
        "1/N lacks in (24), weights are not normalised, one half makes it right for normal errors; "
        "bounded, N = 25",
        "adaptation.windows",
    ),
    Element(
        "(30), (32)",
        "WCKF-A: 19 states, 9 measurements",
        "as printed",
        where="compensated_wckf._predict_wheels",
    ),
    Element(
        "(31)",
        "second-order sliding mode for F_x",
        "corrected",
        "the derivative of F' is meant; sgn mixes units: tanh",
        "dynamics.drive_wheel",
    ),
    Element("(33)", "compensation of F_x", "as printed", where="dynamics.drive_wheel.blend_forces"),
    Element(
        "(34)",
        "compensation of F_y",
        "left out",
        "it adds a longitudinal force to a lateral one, with the same sign on both sides and gains "
        "that are not given",
    ),
    Element(
        "(35), (36)",
        "WCKF-B: v_x, v_y, yaw rate",
        "corrected",
        "the tyre model is evaluated at its points: with forces as plain inputs nothing observes "
        "v_x and v_y",
        "compensated_wckf._update_motion",
    ),
    Element(
        "(37), (38)",
        "measures PRE and ERMS",
        "corrected",
        "relative error of the peak, as a share: its unit is not given",
        "lab.evaluation.papers.reproduction_002",
    ),
    Element(
        "III.A",
        "P_0, Q, R and length N of the window",
        "corrected",
        "no value is given; those used are sizes of noise and of model error",
        "compensated_wckf.A_PROCESS, A_NOISE, B_PROCESS, B_NOISE, WINDOW",
    ),
    Element(
        "table 1",
        "m, I_z, l_f, l_r, half tracks, radius",
        "as printed",
        where="lab.evaluation.scenarios.SMALL",
    ),
    Element(
        "table 1", "C_f, C_r and J", "as printed", where="lab.evaluation.papers.conditions.IN_WHEEL"
    ),
    Element("table 1", "R, L of the motor", "as printed", where="dynamics.drive_wheel.ELECTRIC_S"),
    Element(
        "tables 2 to 5",
        "PRE and ERMS of F_x1 to F_x4, v_x, v_y, beta, both filters",
        "as printed",
        where="lab.evaluation.papers.reproduction_002",
    ),
    Element(
        "figures 4 to 9",
        "sine and J-turn: forces, v_x, v_y, beta of both filters",
        "as printed",
        where="lab.evaluation.papers.reproduction_002",
    ),
    Element(
        "figures 10 to 15, tables 6, 7",
        "bench and road test",
        "left out",
        "no data; the tables repeat those of the simulation digit for digit",
    ),
)
"""Elements of the paper, and the treatment of each one in the code."""
