"""Estimator `federated-ckf`: the joint filters of paper 000 for vehicle motion and for the friction
of four wheels. Both are federated cubature Kalman filters: a master fuses the results of two
sub-filters. Numbers in brackets are the paper's equations.

Wu, Li, Fan, "Joint estimation of driving state and road adhesion coefficient for distributed drive
electric vehicle", IEEE Access 2021, doi 10.1109/ACCESS.2021.3081443.

The motion filter is described in `gaussian/federated_motion`. The friction filter has the state
[mu_fl, mu_fr, mu_rl, mu_rr], which the paper models as a random walk (28). Its first sub-filter
measures [a_x, a_y, r] and its second [a_y, r], by equations (40) to (48). The master fuses both by
(51) and (52). The information shares of the sub-filters follow from (54). The friction filter uses
the estimated motion, and the tyre model of the motion filter uses the estimated friction (figure
3).

The paper's values Q = I and R = 10 000 (57) suit a tyre whose slip stiffness is proportional to
friction; `literal.federated_friction` contains the friction filter as printed. The stiffness of a
real tyre does not depend on friction, so here R is sensor noise plus model error. The estimate
returns to the prior with the distance driven, because the road may change. ELEMENTS lists each
element of the paper and every departure with its reason.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Final

import numpy as np

from edge_agent.dynamics.chassis import PlanarMotion, WheelInputs, planar_response
from edge_agent.dynamics.parameters import as_four, body_of
from edge_agent.estimators.bank import EstimatorBank
from edge_agent.estimators.common.inputs import wheel_force
from edge_agent.estimators.common.motion import has_diverged
from edge_agent.estimators.common.output import (
    PRIOR_MU,
    PRIOR_MU_STD,
    limit_friction,
    write_friction,
    write_states,
)
from edge_agent.estimators.common.run import kernel_of, new_filters
from edge_agent.estimators.common.tyre_option import TyreOption
from edge_agent.estimators.elements import Element
from edge_agent.estimators.estimates import FOUR_FRICTIONS, Column
from edge_agent.estimators.gaussian.federated_motion import (
    LEAST_BETA,
    FederatedMemory,
    MotionSetting,
    begin_motion,
    set_motion,
    step_motion,
)
from edge_agent.estimators.gaussian.planar import PlanarState
from edge_agent.estimators.gaussian.wheel_friction import (
    PRIOR_ROOT,
    dependence_factor,
    mean_friction,
    return_to_prior,
)
from edge_agent.filters.cholesky import variance
from edge_agent.filters.federated import fuse_estimates, share_information
from edge_agent.filters.householder import Measurement, update
from edge_agent.filters.points import axis_points, centred_deviations, weighted_mean
from edge_agent.filters.sigma import cubature_rule
from schemas.mugrid import LOWER, UPPER
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.runtime.records import EmptyRecord, records
from schemas.signals import S
from schemas.thresholds import GRAVITY
from schemas.vehicle import Vehicle

WHEELS = 4
ROWS = 3
RULE = cubature_rule(WHEELS)
XI = RULE.xi
WEIGHT = RULE.w_cov
# [m/s^2, m/s^2, rad/s] errors of a_x, a_y and r according to the tyre model, for one measurement
# per INDEPENDENT_S
NOISE_STD = np.array([0.15, 0.15, 0.004])
AY_SHARE = 0.05  # [1] relative error of a_y according to the tyre model


class JointMemory(FederatedMemory):
    """State of paper 000's joint filter for one vehicle, kept from one sample to the next."""

    mean: Annotated[FloatArray, WHEELS]  # friction
    root: Annotated[FloatArray, WHEELS, WHEELS]
    beta: float  # [1] information share of friction sub-filter 1
    yaw_rate: float  # [rad/s] of the master at the previous sample


def make_bank(
    vehicles: Sequence[Vehicle],
    tyre: TyreOption | None = None,
    motion: MotionSetting | None = None,
) -> EstimatorBank:
    """Return a bank of paper 000's estimators, one per vehicle. Each estimator consists of two
    filters: one for planar motion, and one for the friction of the four wheels. `tyre` replaces the
    default options of the tyre model. `motion` replaces the default variances of the motion filter.
    """
    filters = new_filters(JointMemory, vehicles, tyre)
    set_motion(filters, MotionSetting() if motion is None else motion)
    return EstimatorBank(filters, records(EmptyRecord, 1), KERNEL, columns=FOUR_FRICTIONS)


@compiled
# An argument is unused, because all filters have this signature.
def _begin_filter(memory: JointMemory, unused: EmptyRecord) -> None:  # noqa: ARG001
    begin_motion(memory)
    memory.mean[:] = PRIOR_MU
    memory.root[:] = PRIOR_ROOT
    memory.beta = 0.5


@compiled
def _step_filter(memory: JointMemory, unused: EmptyRecord, dt: float) -> bool:  # noqa: ARG001
    motion = memory.motion
    memory.yaw_rate = motion.mean[PlanarState.YAW_RATE]
    step_motion(memory, memory.mean, dt)
    if has_diverged(motion.mean, motion.root, PlanarState.YAW_RATE):
        return False
    motion.beta = share_by_information(motion.size[0], motion.size[1])
    _step_friction(memory, dt)
    return True


@compiled
def share_by_information(first: float, second: float) -> float:
    """Return the information share of sub-filter 1 [1]. `first` and `second` are the traces of the
    covariances of sub-filters 1 and 2.

    The sub-filter with the smaller trace gets the larger share. Equation (54) of paper 000 as
    printed does the opposite, so its ratio is inverted here.
    """
    return min(max(second / (first + second), LEAST_BETA), 1.0 - LEAST_BETA)


@compiled
def _step_friction(memory: JointMemory, dt: float) -> None:
    x = memory.motion.mean
    metres = abs(x[PlanarState.VX]) * dt
    mean = np.empty(WHEELS)
    root = np.empty((WHEELS, WHEELS))
    first_mean = np.empty(WHEELS)
    first_root = np.empty((WHEELS, WHEELS))
    work = np.empty((2 * WHEELS, 4 * WHEELS))
    sizes = np.ones(2)
    return_to_prior(memory.mean, memory.root, metres, work)
    for sub in range(2):
        share_information(memory.root, memory.beta if sub == 0 else 1.0 - memory.beta, root)
        mean[:] = memory.mean
        _update_sub_filter(memory, sub, dt, mean, root, work)
        sizes[sub] = 0.0
        for i in range(WHEELS):
            sizes[sub] += variance(root, i)
        if sub == 0:
            first_mean[:] = mean
            first_root[:] = root
    fuse_estimates(first_mean, first_root, mean, root, work)
    for i in range(WHEELS):
        limit_friction(first_mean, first_root, i, PRIOR_MU_STD)
    memory.mean[:] = first_mean
    memory.root[:] = first_root
    memory.beta = share_by_information(sizes[0], sizes[1])


@compiled
def _update_sub_filter(
    memory: JointMemory, sub: int, dt: float, mean: FloatArray, root: FloatArray, work: FloatArray
) -> None:
    row = memory.row
    track = memory.track
    x = memory.motion.mean
    now = track.now
    use = track.inputs
    points = np.empty((2 * WHEELS, WHEELS))
    outcomes = np.empty((2 * WHEELS, ROWS))
    predicted = np.empty(ROWS)
    state = np.empty((WHEELS, 2 * WHEELS))
    measured = np.empty((ROWS, 2 * WHEELS))
    force_x = np.empty(4)
    mu = np.empty(4)
    innovation = np.empty(ROWS)
    std = np.empty(ROWS)
    for wheel in range(4):
        force_x[wheel] = wheel_force(row, track, wheel, dt)
    axis_points(mean, root, XI, points)
    cos = as_four(track.steering[0])
    sin = as_four(track.steering[1])
    omega = as_four(use[S.OMEGA : S.TORQUE])
    motion = PlanarMotion(
        x[PlanarState.VX],
        x[PlanarState.VY],
        x[PlanarState.YAW_RATE],
        x[PlanarState.AX],
        x[PlanarState.AY],
    )
    for p in range(points.shape[0]):
        for wheel in range(4):
            mu[wheel] = min(max(points[p, wheel], LOWER), UPPER)
        ax, ay, turn = planar_response(
            body_of(row), motion, WheelInputs(cos, sin, omega, as_four(force_x), as_four(mu))
        )
        outcomes[p, 0] = ax
        outcomes[p, 1] = ay
        outcomes[p, 2] = memory.yaw_rate + dt * turn
    weighted_mean(outcomes, WEIGHT, predicted)
    centred_deviations(points, mean, WEIGHT, state, 0)
    centred_deviations(outcomes, predicted, WEIGHT, measured, 0)
    inflation = dependence_factor(math.hypot(use[S.AX], use[S.AY]) / GRAVITY, dt)
    for r in range(ROWS):
        innovation[r] = now[r] - predicted[r]
        std[r] = inflation * NOISE_STD[r] * (1.0 if r == 0 else math.sqrt(2.0))
    std[1] = math.hypot(std[1], inflation * AY_SHARE * use[S.AY])
    if sub == 1:
        innovation[0] = math.nan
    update(mean, root, state, Measurement(measured, innovation, std), work)


@compiled
def _write_estimates(
    memory: JointMemory,
    unused: EmptyRecord,  # noqa: ARG001 all filters have this signature
    output: FloatArray,
) -> float:
    write_states(output, memory.motion.mean, memory.motion.root, PlanarState.YAW_RATE)
    for wheel in range(WHEELS):
        std = math.sqrt(variance(memory.root, wheel))
        write_friction(output, Column.WHEELS + 3 * wheel, memory.mean[wheel], std)
    mu, std = mean_friction(memory.mean, memory.root, 0)
    write_friction(output, Column.MU, mu, std)
    return float(output[Column.MU])


KERNEL = kernel_of(_begin_filter, _step_filter, _write_estimates)

ELEMENTS: Final[tuple[Element, ...]] = (
    Element(
        "(1) to (3)", "3-DOF model, four steered wheels", "as printed", where="dynamics.chassis"
    ),
    Element(
        "(4) to (6)",
        "accelerations from wheel forces",
        "corrected",
        "rear axle: a_x takes -F_y*sin(delta), a_y takes +F_x*sin(delta) + F_y*cos(delta), arms "
        "accordingly",
        "dynamics.chassis.planar_response",
    ),
    Element(
        "(7)",
        "slip angles",
        "corrected",
        "rear arm is -b*r; half a track times r is reversed on the left",
        "dynamics.slip",
    ),
    Element(
        "(8)",
        "wheel-centre speeds",
        "corrected",
        "r is missing beside half the track",
        "dynamics.slip",
    ),
    Element(
        "(9)",
        "wheel loads",
        "corrected",
        "static loads need b/l in front, a/l behind; sign of lateral transfer",
        "dynamics.loads",
    ),
    Element("(10)", "F_x from wheel torque", "as printed", where="common.inputs.wheel_force"),
    Element(
        "(11) to (13)",
        "Dugoff lateral force, proportional to mu",
        "option",
        "mu*F_z*C_y counts the load twice; 1/2 and mu*F_z are missing in (13). By default "
        "stiffness does not depend on mu, because that of a real tyre does not",
        "common.tyre_option, literal.wheel_forces",
    ),
    Element(
        "table 1",
        "stiffness over load",
        "corrected",
        "two entries are not monotone; here in proportion to load",
        "dynamics.parameters",
    ),
    Element("(14)", "longitudinal slip", "as printed", where="dynamics.slip"),
    Element(
        "(15) to (20)",
        "information shares of the sub-filters",
        "as printed",
        where="filters.federated.share_information",
    ),
    Element(
        "(21), (22), (26), (27)",
        "cubature points by singular values",
        "as printed",
        where="filters.points",
    ),
    Element(
        "(28)",
        "friction as a random walk",
        "option",
        "by default it returns to the prior over 190 m, so that it is not believed where nothing "
        "shows it; as printed in the literal filter",
        "gaussian.wheel_friction, literal.federated_friction",
    ),
    Element(
        "(29) to (48)", "time and measurement updates", "as printed", where="filters.householder"
    ),
    Element(
        "(49) to (52)",
        "fusion in the master",
        "corrected",
        "P_f, printed is its inverse; a_y and r, used by both sub-filters, have twice the variance "
        "in each",
        "filters.federated.fuse_estimates",
    ),
    Element(
        "(53)",
        "states, measurements and inputs",
        "corrected",
        "sub-filter 1 also measures the wheels' speed: nothing printed observes u. Off by "
        "wheel_speed=False",
        "gaussian.federated_motion",
    ),
    Element(
        "(54)",
        "shares beta_i by traces",
        "option",
        "printed, the worse filter gets more, and beta = 0 divides by zero: turned round, from "
        "one half; as printed from one half in the literal filter",
        "share_by_information, literal.federated_friction",
    ),
    Element(
        "(55), (56)",
        "P_0, Q, R of the motion",
        "left out",
        "u is lost with them (error 14 m/s), whichever way (54) is read; MotionSetting takes any "
        "others",
    ),
    Element(
        "(57)",
        "P_0 = Q = I, R = 10^4*diag(.009, 1, 1), 10^4*I, mu_0 = 1",
        "as printed",
        where="literal.federated_friction.AS_PRINTED",
    ),
    Element("table 2", "vehicle", "as printed", where="lab.evaluation.scenarios.LIGHT"),
    Element(
        "section IV",
        "two lane changes at 30 km/h, .5 for 110 m, then .3; 10 ms",
        "as printed",
        where="lab.simulation.manoeuvres",
    ),
    Element("figure 4", "sensor signals", "as printed", where="lab.evaluation.papers"),
    Element(
        "figure 5",
        "v_x, v_y, sideslip beta, mu of four wheels",
        "as printed",
        where="lab.evaluation.papers",
    ),
)
"""Elements of the paper, and the treatment of each one in the code."""
