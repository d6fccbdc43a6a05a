"""Estimator `sr-ukf`: the square-root unscented filter of paper 003 for the friction of four
wheels.

Paper 003 is "Road adhesion coefficient estimation method for distributed drive electric vehicles
based on SR-UKF". The equations are lost in the text copy, so the paper's sections are cited. Its
vehicle model has seven degrees of freedom and Dugoff tyres (section 2). Section 3.1 defines the
unscented points, and the time and measurement updates. Section 3.2 computes the factor of the
posterior covariance by downdates.

The state is [v_x, v_y, r, mu_fl, mu_fr, mu_rl, mu_rr]. The four rotational degrees of freedom of
the wheels are torque balances, used as measurements: F_x = (T - J*omega')/R. With these
measurements the friction of each driven wheel is observable. With the paper's a_x, a_y, r alone, at
most two of the four frictions are observable.

`literal.wheel_friction_ukf` is the filter as printed, with four states and given motion. The filter
in this module is for a car, in which v_x and v_y are unknown. Therefore they are states, a_x and
a_y are inputs of the kinematics, and the wheel torques replace the measurement a_x. ELEMENTS lists
each element of the paper and every departure with its reason.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import Annotated, Final

import numpy as np

from edge_agent.dynamics.body import advance_velocity
from edge_agent.dynamics.chassis import (
    DUGOFF,
    PlanarMotion,
    WheelInputs,
    planar_response,
    tyre_forces,
    wheel_inputs,
)
from edge_agent.dynamics.loads import wheel_loads
from edge_agent.dynamics.parameters import Parameter, as_four, body_of
from edge_agent.estimators.bank import EstimatorBank
from edge_agent.estimators.common.inputs import InputTrack, wheel_force
from edge_agent.estimators.common.motion import FIRST_V_STD, UNKNOWN_V_STD, has_diverged
from edge_agent.estimators.common.output import (
    PRIOR_MU,
    PRIOR_MU_STD,
    limit_friction,
    write_friction,
    write_states,
)
from edge_agent.estimators.common.readings import rolling_speed
from edge_agent.estimators.common.run import PaperMemory, kernel_of, new_filters
from edge_agent.estimators.common.tyre_option import TyreOption
from edge_agent.estimators.elements import Element
from edge_agent.estimators.estimates import FOUR_FRICTIONS, Column
from edge_agent.estimators.gaussian.federated_motion import (
    mean_wheel_velocity,
    slip_free_speed,
    widened_speed_std,
)
from edge_agent.estimators.gaussian.wheel_friction import (
    FORGET_M,
    INDEPENDENT_S,
    PRIOR_ROOT,
    mean_friction,
    visible_share,
)
from edge_agent.filters.cholesky import variance
from edge_agent.filters.downdate import update_by_downdate
from edge_agent.filters.householder import Measurement, predict
from edge_agent.filters.points import centred_deviations, sigma_points, weighted_mean
from edge_agent.filters.sigma import unscented_rule
from schemas.mugrid import LOWER, UPPER
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.runtime.records import EmptyRecord, records
from schemas.signals import S
from schemas.thresholds import GRAVITY
from schemas.vehicle import Vehicle

STATES = 7
ROWS = 7  # number of measurements: speed of the wheels, r, a_y, four longitudinal forces
RULE = unscented_rule(STATES, 1.0, 2.0, 0.0)
XI = RULE.xi
POINTS = XI.shape[0]
W_MEAN = RULE.w_mean
W_COV = RULE.w_cov
# [m/s, m/s, rad/s per s^.5] process noise: offsets of the accelerometers, error of the yaw model
DRIFT = np.array([0.05, 0.05, 0.1])
FIRST_RATE_STD = 0.1  # [rad/s] error of the yaw rate at the first sample
RATE_STD = 0.003  # [rad/s] error of the measured yaw rate
SLOWEST_SLIP_M_S = 1.0  # [m/s] smallest speed by which wheel-speed noise is divided
# Error of a_y according to the tyre model, for one measurement per INDEPENDENT_S
AY_STD = 0.15  # [m/s^2]
AY_SHARE = 0.05  # [1] relative
# Error of the longitudinal force
FORCE_STD = 0.01  # [1] over load: rolling resistance
FORCE_SHARE = 0.15  # [1] relative: torque gain and stiffness
# Error of the slip
SLIP_STD = 0.001  # [1] differences of the wheel radii
OMEGA_STD = 0.03  # [rad/s] noise of the wheel speed


class WheelFrictionState(IntEnum):
    """Index of a state in the state vector of the filter `sr-ukf` (unscented filter of paper
    003).
    """

    VX = 0
    VY = 1
    YAW_RATE = 2
    MU = 3  # friction of the first wheel; the other wheels follow


class UnscentedMemory(PaperMemory):
    """State of the filter `sr-ukf` (unscented filter of paper 003) for one vehicle, kept from one
    sample to the next.
    """

    mean: Annotated[FloatArray, STATES]
    root: Annotated[FloatArray, STATES, STATES]
    refused: float  # number of refused downdates


def make_bank(vehicles: Sequence[Vehicle], tyre: TyreOption | None = None) -> EstimatorBank:
    """Return a bank of `sr-ukf` filters, one per vehicle; `tyre` selects the tyre model."""
    return EstimatorBank(
        new_filters(UnscentedMemory, vehicles, tyre),
        records(EmptyRecord, 1),
        KERNEL,
        columns=FOUR_FRICTIONS,
    )


@compiled
# An argument is unused, because all filters have this signature.
def _begin_filter(memory: UnscentedMemory, unused: EmptyRecord) -> None:  # noqa: ARG001
    mean = memory.mean
    root = memory.root
    index = WheelFrictionState
    speed = rolling_speed(memory.row, memory.track.now)
    known = not math.isnan(speed)
    mean[index.VX] = speed if known else 0.0
    mean[index.VY] = 0.0
    mean[index.YAW_RATE] = memory.track.inputs[S.YAW_RATE]
    mean[index.MU :] = PRIOR_MU
    root[:, :] = 0.0
    root[index.VX, index.VX] = FIRST_V_STD if known else UNKNOWN_V_STD
    root[index.VY, index.VY] = FIRST_V_STD
    root[index.YAW_RATE, index.YAW_RATE] = FIRST_RATE_STD
    root[index.MU :, index.MU :] = PRIOR_ROOT
    memory.refused = 0.0


@compiled
def _limit_point_friction(
    point: FloatArray, mean: FloatArray, share: float, mu: FloatArray
) -> None:
    """Compute the friction `mu` (4,) of the wheels at an unscented point (7,) of the state, limited
    to the possible range of friction.

    First multiply the deviation of the point's friction from that of `mean` (7,) by `share` (0 to
    1). `share` is small at small tyre forces. Such forces hardly depend on friction, so the filter
    may learn only little about friction from them.
    """
    for wheel in range(4):
        i = WheelFrictionState.MU + wheel
        mu[wheel] = min(max(mean[i] + share * (point[i] - mean[i]), LOWER), UPPER)


@compiled
def _tyre_accelerations(
    row: FloatArray, state: FloatArray, track: InputTrack, mu: FloatArray
) -> tuple[float, float]:
    """Return (a_y [m/s^2], yaw acceleration [rad/s^2]) that the tyre forces cause at a state (7,)
    with friction mu (4,).
    """
    use = track.inputs
    index = WheelFrictionState
    unknown = (math.nan, math.nan, math.nan, math.nan)
    motion = PlanarMotion(
        state[index.VX], state[index.VY], state[index.YAW_RATE], use[S.AX], use[S.AY]
    )
    cos = as_four(track.steering[0])
    sin = as_four(track.steering[1])
    omega = as_four(use[S.OMEGA : S.TORQUE])
    _, ay, turn = planar_response(
        body_of(row), motion, WheelInputs(cos, sin, omega, unknown, as_four(mu))
    )
    return ay, turn


@compiled
def _step_filter(memory: UnscentedMemory, unused: EmptyRecord, dt: float) -> bool:  # noqa: ARG001
    use = memory.track.inputs
    mean = memory.mean
    root = memory.root
    points = np.empty((POINTS, STATES))
    work = np.empty((ROWS + STATES, POINTS + 2 * STATES))
    share = visible_share(math.hypot(use[S.AX], use[S.AY]) / GRAVITY)
    _predict_filter(memory, dt, share, points, work)
    sigma_points(mean, root, XI, points)
    _update_filter(memory, dt, share, points, work)
    for wheel in range(4):
        limit_friction(mean, root, WheelFrictionState.MU + wheel, PRIOR_MU_STD)
    return not has_diverged(mean, root, WheelFrictionState.YAW_RATE)


@compiled
def _predict_filter(
    memory: UnscentedMemory, dt: float, share: float, points: FloatArray, work: FloatArray
) -> None:
    """Predict the state over `dt` [s]: the accelerometers move the velocity, the tyre forces turn
    the car, and friction returns to its prior over the distance FORGET_M. `share` (0 to 1) is the
    share of a point's deviation in friction that acts on the forces. `points` (15, 7) and `work`
    are scratch memory.
    """
    use = memory.track.inputs
    mean = memory.mean
    index = WheelFrictionState
    mu = np.empty(4)
    noise = np.zeros((STATES, STATES))
    keep = math.exp(-abs(mean[index.VX]) * dt / FORGET_M)
    sigma_points(mean, memory.root, XI, points)
    for p in range(POINTS):
        state = points[p]
        _limit_point_friction(state, mean, share, mu)
        _, turn = _tyre_accelerations(memory.row, state, memory.track, mu)
        rate = state[index.YAW_RATE]
        vx, vy = advance_velocity(state[index.VX], state[index.VY], use[S.AX], use[S.AY], rate, dt)
        state[index.VX] = vx
        state[index.VY] = vy
        state[index.YAW_RATE] = rate + dt * turn
        for wheel in range(index.MU, STATES):
            state[wheel] = PRIOR_MU + keep * (state[wheel] - PRIOR_MU)
    for i in range(len(DRIFT)):
        noise[i, i] = DRIFT[i] * math.sqrt(dt)
    noise[index.MU :, index.MU :] = math.sqrt(max(1.0 - keep * keep, 0.0)) * PRIOR_ROOT
    predict(points, (W_MEAN, W_COV), noise, mean, memory.root, work)


@compiled
def _update_filter(
    memory: UnscentedMemory, dt: float, share: float, points: FloatArray, work: FloatArray
) -> None:
    """Update the state with the measurements of a sample. `points` (15, 7) are the unscented points
    of the predicted state, and `share` and `work` as in `_predict_filter`.
    """
    mean = memory.mean
    outcomes = np.empty((POINTS, ROWS))
    predicted = np.empty(ROWS)
    state_deviations = np.empty((STATES, POINTS))
    deviations = np.empty((ROWS, POINTS))
    readings = np.empty(ROWS)
    std = np.empty(ROWS)
    _predict_readings(memory, share, points, outcomes)
    weighted_mean(outcomes, W_MEAN, predicted)
    centred_deviations(points, mean, W_COV, state_deviations, 0)
    centred_deviations(outcomes, predicted, W_COV, deviations, 0)
    _collect_readings(memory, dt, readings, std)
    innovation = readings - predicted
    std[0] = widened_speed_std(std[0], innovation[0])
    used, log_likelihood, square, refused = update_by_downdate(
        mean, memory.root, state_deviations, Measurement(deviations, innovation, std), work
    )
    memory.nis = square / max(used, 1)
    memory.log_likelihood = log_likelihood
    memory.refused += 1.0 if refused else 0.0


@compiled
def _predict_readings(
    memory: UnscentedMemory, share: float, points: FloatArray, outcomes: FloatArray
) -> None:
    """Write the readings that each unscented point (15, 7) predicts into `outcomes` (15, ROWS):
    speed of the wheels [m/s], yaw rate [rad/s], a_y [m/s^2], four longitudinal forces [N].
    """
    row = memory.row
    track = memory.track
    use = track.inputs
    rate = WheelFrictionState.YAW_RATE
    mu = np.empty(4)
    force_y = np.empty(4)
    wheels = wheel_inputs(use[S.DELTA : S.DELTA + 4], use[S.OMEGA : S.OMEGA + 4])
    motion = np.array([0.0, 0.0, 0.0, use[S.AX], use[S.AY]])
    for p in range(POINTS):
        outcomes[p, 0] = mean_wheel_velocity(row, track, points[p], rate)
        outcomes[p, 1] = points[p, rate]
        _limit_point_friction(points[p], memory.mean, share, mu)
        outcomes[p, 2], _ = _tyre_accelerations(row, points[p], track, mu)
        motion[:3] = points[p, :3]
        tyre_forces(row, motion, wheels, mu, DUGOFF, (outcomes[p, 3:], force_y))


@compiled
def _collect_readings(
    memory: UnscentedMemory, dt: float, readings: FloatArray, std: FloatArray
) -> None:
    """Fill `readings` (ROWS,) with the measurements of a sample, NaN where missing, and `std`
    (ROWS,) with their standard deviations. Errors of the tyre model last for INDEPENDENT_S, so
    their standard deviations are inflated for shorter steps `dt` [s].
    """
    row = memory.row
    track = memory.track
    now = track.now
    use = track.inputs
    speed = abs(memory.mean[WheelFrictionState.VX])
    inflation = math.sqrt(max(INDEPENDENT_S / dt, 1.0))
    readings[0], std[0] = slip_free_speed(row, track, dt)
    readings[1] = now[S.YAW_RATE]
    std[1] = RATE_STD
    readings[2] = now[S.AY]
    std[2] = inflation * math.hypot(AY_STD, AY_SHARE * use[S.AY])
    loads = wheel_loads(body_of(row), use[S.AX], use[S.AY])
    slip_std = SLIP_STD + OMEGA_STD * row[Parameter.RADIUS] / max(speed, SLOWEST_SLIP_M_S)
    for wheel in range(4):
        force = wheel_force(row, track, wheel, dt)
        missing = math.isnan(now[S.OMEGA + wheel]) or math.isnan(now[S.TORQUE + wheel])
        readings[3 + wheel] = math.nan if missing else force
        force_std = math.hypot(FORCE_STD * loads[wheel], FORCE_SHARE * force)
        stiffness = row[Parameter.SLOPE_X] * loads[wheel]
        std[3 + wheel] = inflation * math.hypot(force_std, stiffness * slip_std)


@compiled
def _write_estimates(
    memory: UnscentedMemory,
    unused: EmptyRecord,  # noqa: ARG001 all filters have this signature
    output: FloatArray,
) -> float:
    mean = memory.mean
    root = memory.root
    first = WheelFrictionState.MU
    write_states(output, mean, root, WheelFrictionState.YAW_RATE)
    for wheel in range(4):
        std = math.sqrt(variance(root, first + wheel))
        write_friction(output, Column.WHEELS + 3 * wheel, mean[first + wheel], std)
    mu, std = mean_friction(mean, root, first)
    write_friction(output, Column.MU, mu, std)
    return float(output[Column.MU])


KERNEL = kernel_of(_begin_filter, _step_filter, _write_estimates)

ELEMENTS: Final[tuple[Element, ...]] = (
    Element(
        "section 2",
        "7-DOF model: planar body and four turning wheels",
        "as printed",
        where="literal.wheel_forces, dynamics.chassis",
    ),
    Element(
        "section 2",
        "Dugoff tyre, proportional to mu",
        "option",
        "on a real tyre stiffness does not depend on mu; printed in the literal filter and by "
        "TyreOption",
        "literal.wheel_forces, common.tyre_option",
    ),
    Element(
        "section 2",
        "loads, wheel-centre speeds, slip, slip angles",
        "as printed",
        where="dynamics.loads, slip",
    ),
    Element(
        "3.1", "state mu_fl, mu_fr, mu_rl, mu_rr", "as printed", where="literal.wheel_friction_ukf"
    ),
    Element(
        "3.1",
        "v_x, v_y from the simulator",
        "option",
        "a car does not know them: sr-ukf estimates them; given in the literal filter",
        "literal.given_motion",
    ),
    Element(
        "3.1",
        "measurement [a_x, a_y, r]",
        "option",
        "of rank 2 at most straight on; the wheels' torque balances make each driven wheel visible",
        "literal.wheel_friction_ukf.UnscentedSetting.torque_rows",
    ),
    Element(
        "3.1",
        "unscented points, alpha .001, kappa 0, beta 2",
        "option",
        "alpha = .001 gives the centre a weight of -10^6; sr-ukf uses 1. Both give the same result "
        "in double precision",
        "literal.wheel_friction_ukf.UnscentedSetting.alpha",
    ),
    Element(
        "3.1",
        "UKF in covariance form, the comparator",
        "as printed",
        where="literal.wheel_friction_ukf",
    ),
    Element(
        "3.2",
        "square roots by singular values, clipped at zero; gain by singular values",
        "as printed",
        where="literal.wheel_friction_ukf; sr-ukf: filters.downdate",
    ),
    Element(
        "3.2",
        "Q, R and P_0",
        "corrected",
        "their values are lost in the text; AS_PRINTED has values of the size that the text "
        "describes",
        "literal.wheel_friction_ukf.AS_PRINTED",
    ),
    Element(
        "4.1",
        "Magic Formula in the plant, Dugoff in the filter",
        "option",
        "shown as a row of its own: the mismatch costs .025, stiffness that does not depend on mu "
        "costs .3",
        "lab.evaluation.papers.reproduction_003",
    ),
    Element(
        "4.1",
        "permanent-magnet motor in d-q axes",
        "as printed",
        where="lab.simulation.motor.turn_motor",
    ),
    Element(
        "4.1",
        "PID control of speed, equal torque to the wheels",
        "as printed",
        where="lab.simulation.motor.speed_demand",
    ),
    Element(
        "table 2",
        "vehicle",
        "corrected",
        "its values are lost in the text: the vehicle of paper 004",
        "lab.evaluation.scenarios.SEDAN",
    ),
    Element(
        "4.2.1",
        "acceleration from 20 km/h, throttle .3, mu .85",
        "as printed",
        where="manoeuvres.throttle",
    ),
    Element(
        "4.2.2",
        "turn at 40 km/h on mu .35, 60 degrees within .3 s",
        "as printed",
        where="manoeuvres.low_turn",
    ),
    Element(
        "4.2.3",
        "split .3 and .85 at constant speed",
        "as printed",
        where="lab.evaluation.papers.conditions",
    ),
    Element(
        "4.2.4",
        ".85 for 4 s, then .5, in time, under all wheels",
        "as printed",
        where="manoeuvres.TimedFriction",
    ),
    Element(
        "4.3",
        "constant speed on .2, .25, .3, .35, .4, .45; table 7, figure 9",
        "as printed",
        where="lab.evaluation.papers.reproduction_003",
    ),
    Element(
        "tables 3 to 6",
        "MAE of SR-UKF and UKF",
        "as printed",
        where="lab.evaluation.papers.reproduction_003",
    ),
    Element(
        "figures 5 to 8",
        "mu of four wheels, SR-UKF and UKF",
        "as printed",
        where="lab.evaluation.papers.reproduction_003",
    ),
    Element(
        "figures 1 to 4", "sketches of model, tyre, filter and simulation", "left out", "no results"
    ),
)
"""Elements of the paper, and the treatment of each one in the code."""
