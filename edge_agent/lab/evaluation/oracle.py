"""Best possible accuracy with these sensors for two targets of the papers, computed by an oracle
(an ideal observer) that knows almost everything.

An oracle is a Bayesian estimator that gets the noisy readings of the sensors, and the true value of
everything that is not listed as unknown. Unknown are the quantities that the vehicle file and the
sensors' data sheet leave open. The equations are linearised around the true values, so the oracle's
estimate is least squares with a Gaussian prior.

The body of a car rolls and pitches with a lag after the acceleration. Its tilt adds a share of
gravity to the readings of the accelerometers.

`speed_rmse`: v_x in sine steering with acceleration. Wheel speeds have no noise: W = (1 + ρ) v.

    a_y − v_y' = (1 − ρ) W r + κ_y a_l + τ a_l' + c (v_y − l_r r)' + b_y
    ΔW (1 − ρ) = ∫(a_x + r v_y − κ_x a_p − c r (v_y − l_r r) − b_x)      over stretches of STRETCH_S
    a_x, a_y   readings of the accelerometers [m/s^2]
    v, v_y, r  true v_x and v_y [m/s], true yaw rate [rad/s]; ' is the time derivative
    W, ΔW      speed of the car by the wheels [m/s], its change over a stretch
    l_r        distance from the centre of gravity to the rear axle [m]
    a_l, a_p   a_y and a_x with the lag of roll and pitch [m/s^2]; a_l' includes the share of
               gravity that roll adds
    unknown    ρ    relative error of the wheel radius
               c    error of ln of the cornering stiffness
               κ_y  error of the share of gravity that roll adds to a_y
               κ_x  error of the share of gravity that pitch adds to a_x
               τ    error of the lag of roll [s]
               b    offsets of the accelerometers [m/s^2]

`friction_errors`: μ at the end of a drive with .6 g. The oracle gets the mean speed of the four
wheels and the force of every tyre. It knows the vehicle's speed except for the errors that an
offset of a_x and pitch cause.

    R ω = (1 + ρ)(v + b t + κ (v − v(0)) + v_0)(1 + s e^{−k} g(μ, shape))
    R, ω       wheel radius of the vehicle file [m], mean wheel speed [rad/s]
    s          true slip
    g          slip at which the forces arise for this μ and this shape of the tyre curve, divided
               by the true slip
    unknown    μ    friction; all values are equally likely
               k    error of ln of the longitudinal stiffness
               v_0  error of the initial speed [m/s]
               ρ, b, κ  as above, for a_x
               shape  shape of the tyre curve, distributed as in the fleet
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import product
from typing import Final, NamedTuple

import numpy as np

from edge_agent.dynamics.tyres import magic_formula
from edge_agent.lab.evaluation.batch import USUAL, DriveSet, simulate_realistic
from edge_agent.lab.evaluation.scenarios import PAPERS
from edge_agent.lab.simulation.presets import KNOWN
from edge_agent.lab.simulation.sensors import SENSORS, Sensors
from schemas.mugrid import UPPER
from schemas.numeric import FloatArray
from schemas.signals import S, per_wheel

STRETCH_S: Final = 0.5
# Standard deviation of the share of gravity that roll adds to a_y per a_y. Its mean is 0.07; the
# suspensions of a fleet differ by 17 %.
ROLL_LEAK_STD: Final = 0.012
# Standard deviation of the share of gravity that pitch adds to a_x per a_x; its mean is 0.03.
PITCH_LEAK_STD: Final = 0.005
ROLL_LAG_STD: Final = 0.03  # [s] standard deviation of the lag of the roll angle; its mean is 0.1 s
START_STD: Final = 0.05  # [m/s] uncertainty of the initial speed from the wheels
# frictions considered; a drive at 0.6 g excludes lower ones
LIKELY: Final = np.linspace(0.62, UPPER, 59)
# Shape and curvature of the tyre curves as drawn by `one_of_a_fleet`.
SHAPES: Final = tuple(product(np.linspace(1.38, 1.62, 5), np.linspace(-0.5, 0.1, 5)))
THETA: Final = np.linspace(0.0, 4.0, 2001)
LEAST: Final = 1e-3  # normalised slip below which a wheel rolls freely


class OracleSignals(NamedTuple):
    """Data for the oracle from drives with sine steering while the speed rises (paper 002):
    readings and true values (`batch`), and effects of the body's tilt.

    The body rolls with a lag after a_y, and pitches with a lag after a_x. `rolled` and `pitched`
    (T,) are a_y and a_x with this lag [m/s^2]. `body_acceleration` (T, 2) are the readings of
    a_x and a_y [m/s^2] by accelerometers whose only error is the gravity that this tilt adds.
    """

    batch: DriveSet
    rolled: FloatArray
    pitched: FloatArray
    body_acceleration: FloatArray  # (T, 2), from accelerometers without other errors


def speed_rmse(seeds: Sequence[int]) -> FloatArray:
    """Return the RMSE of v_x [m/s] as estimated by the oracle, one value per seed. The drive is
    that of paper 002: sine steering while the speed rises from 20 to 25 m/s.
    """
    scenario = PAPERS["002.sine"]
    car = scenario.vehicle
    batch = simulate_realistic(scenario, seeds)
    readings = simulate_realistic(scenario, seeds[:1], Sensors(leak=True)).signals[
        :, 0, S.AX : S.AY + 1
    ]
    leaked = readings - np.stack(
        [batch.truth["true_ax"][:, 0], batch.truth["true_ay"][:, 0]], axis=-1
    )
    oracle_signals = OracleSignals(
        batch, leaked[:, 1] / car.roll_leak, leaked[:, 0] / car.pitch_leak, readings
    )
    known = [vehicle.wheel_radius / car.vehicle.wheel_radius - 1.0 for vehicle in batch.vehicles]
    return np.array([_oracle_speed_rmse(oracle_signals, n, rho) for n, rho in enumerate(known)])


class _Regression(NamedTuple):
    """Readings of one drive as linear functions of the oracle's unknowns: left = table · unknowns,
    for a_y (`across`) and a_x (`along`) at each of T samples [m/s²].

    Unknowns, in the order of `_PRIOR_STD`: error of the wheel radius, roll leak, lag of the roll
    leak, cornering stiffness, offset of a_y, pitch leak, offset of a_x.
    """

    across: FloatArray  # (T,)
    across_table: FloatArray  # (T, 7)
    along: FloatArray  # (T,)
    along_table: FloatArray  # (T, 7)


_WHITE_STD, _OFFSET_STD = SENSORS[USUAL].acceleration
_PRIOR_STD: Final = np.array(
    [
        KNOWN["wheel_radius"],
        ROLL_LEAK_STD,
        ROLL_LAG_STD,
        KNOWN["cornering_stiffness"],
        _OFFSET_STD,
        PITCH_LEAK_STD,
        _OFFSET_STD,
    ]
)


def _oracle_speed_rmse(signals: OracleSignals, n: int, rho: float) -> float:
    """Return the RMSE of the oracle's speed for drive n [m/s].

    `rho` is the true relative error of the wheel radius, unknown to the oracle (ideal observer).
    After each second, the oracle estimates this error from all readings so far, and corrects the
    wheel speeds by its estimate.
    """
    batch = signals.batch
    v = batch.truth["true_vx"][:, n]
    wheels = (1.0 + rho) * v
    dt = float(batch.t[1, n] - batch.t[0, n])
    regression = _make_regression(signals, n, wheels, dt)
    stretch = round(STRETCH_S / dt)
    information = np.diag(_PRIOR_STD**-2)
    vector = np.zeros(len(_PRIOR_STD))
    error = np.empty(len(v))
    estimate = 0.0
    for first in range(0, len(v), round(1.0 / dt)):
        now = slice(first, first + round(1.0 / dt))
        error[now] = wheels[now] / (1.0 + estimate) - v[now]
        starts = range(now.start, min(now.stop, len(v)) - stretch + 1, stretch)
        table = np.stack([regression.along_table[k : k + stretch].mean(axis=0) for k in starts])
        along = np.array([regression.along[k : k + stretch].mean() for k in starts])
        root = np.sqrt(stretch)
        rows = np.concatenate([regression.across_table[now], root * table]) / _WHITE_STD
        readings = np.concatenate([regression.across[now], root * along]) / _WHITE_STD
        information = information + rows.T @ rows
        vector = vector + rows.T @ readings
        estimate = float(np.linalg.solve(information, vector)[0])
    return float(np.sqrt(np.mean(error**2)))


def _make_regression(signals: OracleSignals, n: int, wheels: FloatArray, dt: float) -> _Regression:
    """Return the linear equations of drive n. `wheels` (T,) is the speed of the wheels [m/s] with
    the nominal radius, and `dt` the time between samples [s].
    """
    batch = signals.batch
    car = PAPERS["002.sine"].vehicle
    v = batch.truth["true_vx"][:, n]
    vy = batch.truth["true_vy"][:, n]
    r = batch.truth["true_yaw_rate"][:, n]
    slipping = vy - car.vehicle.cg_to_rear_axle * r
    across = batch.signals[:, n, S.AY] - signals.body_acceleration[:, 1] + (v - wheels) * r
    along = (
        batch.signals[:, n, S.AX] - signals.body_acceleration[:, 0] + np.gradient(v - wheels, dt)
    )
    none = np.zeros_like(v)
    one = np.ones_like(v)
    rolling = (signals.rolled, car.roll_leak * np.gradient(signals.rolled, dt))
    across_table = np.stack(
        [-wheels * r, *rolling, np.gradient(slipping, dt), one, none, none], axis=1
    )
    along_table = np.stack(
        [-np.gradient(wheels, dt), none, none, r * slipping, none, signals.pitched, one], axis=1
    )
    return _Regression(across, across_table, along, along_table)


def friction_errors(seeds: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Return two arrays with one value per seed: the friction error of the oracle, and the error
    that the oracle itself expects.

    The drive is an acceleration of .6 g on dry road (paper 003). At the end of the drive, the
    oracle's estimate of friction is the median of its posterior. The first array is the distance of
    this median from the true friction. The second is the mean distance of friction from the median
    under the posterior.
    """
    scenario = PAPERS["003.accel"]
    exact = simulate_realistic(scenario, seeds[:1], "ideal")
    batch = simulate_realistic(scenario, seeds)
    car = scenario.vehicle
    v = exact.truth["true_vx"][:, 0]
    truth = float(exact.mu[0, 0])
    slip = car.vehicle.wheel_radius * exact.signals[:, 0, S.OMEGA : S.OMEGA + 4] / v[:, None] - 1.0
    used = np.stack([exact.truth[name][:, 0] for name in per_wheel("true_utilisation")], axis=-1)
    here = np.maximum(_normalised_slips(used, car.shape, car.curvature) * truth, LEAST)
    slips = {
        (mu, *shape): (
            slip
            * np.where(here > LEAST, mu * _normalised_slips(used * truth / mu, *shape) / here, 1.0)
        ).mean(axis=1)
        for mu in LIKELY
        for shape in SHAPES
    }
    errors = []
    expected = []
    for n, vehicle in enumerate(batch.vehicles):
        measured = vehicle.wheel_radius * batch.signals[:, n, S.OMEGA : S.OMEGA + 4].mean(axis=1)
        stiff = float(np.log(vehicle.longitudinal_stiffness / car.vehicle.longitudinal_stiffness))
        cost = np.array(
            [
                _negative_log_likelihood(measured, v, slip, vehicle.wheel_radius, stiff)
                for slip in slips.values()
            ]
        )
        weight = np.exp(cost.min() - cost).reshape(len(LIKELY), -1).sum(axis=1)
        median = float(np.interp(0.5, np.cumsum(weight) / weight.sum(), LIKELY))
        errors.append(abs(median - truth))
        expected.append(float(np.abs(LIKELY - median) @ weight / weight.sum()))
    return np.array(errors), np.array(expected)


def _normalised_slips(force: FloatArray, shape: float, curvature: float) -> FloatArray:
    """Return the normalised slips (n,) at which a tyre uses the shares `force` (n,) of its grip.
    The slips lie on the rising branch of the force curve with this `shape` and `curvature` (Magic
    Formula).
    """
    curve = _force_curve(shape, curvature)
    return np.interp(force, curve, THETA[: len(curve)])


@cache
def _force_curve(shape: float, curvature: float) -> FloatArray:
    """Return the force curve of a tyre (Magic Formula with `shape` and `curvature`): an array of
    force over peak force at the normalised slips THETA, up to the peak.
    """
    curve = np.array([magic_formula(x, shape, curvature) for x in THETA])
    return curve[: int(np.argmax(curve)) + 1]


def _negative_log_likelihood(
    measured: FloatArray, v: FloatArray, slip: FloatArray, radius: float, stiff: float
) -> float:
    """Return −ln of the likelihood of one pair of friction and tyre curve, given the mean wheel
    speed in a drive, `measured` (T,) [m/s]. `slip` (T,) are the slips that this pair predicts.
    """
    t = np.arange(len(v)) / 100.0
    std = np.array(
        [
            KNOWN["longitudinal_stiffness"],
            KNOWN["wheel_radius"],
            SENSORS[USUAL].acceleration[1],
            PITCH_LEAK_STD,
            START_STD,
        ]
    )
    white = 0.5 * SENSORS[USUAL].wheel_speed * radius
    z = np.array([-stiff, 0.0, 0.0, 0.0, 0.0])
    centre = z.copy()
    for _ in range(3):
        k, rho, offset, leak, start = z
        ground = v + offset * t + leak * (v - v[0]) + start
        turned = 1.0 + slip * np.exp(-k)
        off = measured - (1.0 + rho) * ground * turned
        slopes = np.stack(
            [-ground * slip * np.exp(-k), ground * turned, t * turned, (v - v[0]) * turned, turned],
            axis=1,
        )
        information = slopes.T @ slopes / white**2 + np.diag(std**-2)
        step = np.linalg.solve(information, slopes.T @ off / white**2 + (centre - z) / std**2)
        z = z + step
    k, rho, offset, leak, start = z
    off = measured - (1.0 + rho) * (v + offset * t + leak * (v - v[0]) + start) * (
        1.0 + slip * np.exp(-k)
    )
    squares = float((off @ off) / white**2 + (((z - centre) / std) ** 2).sum())
    return 0.5 * (squares + float(np.linalg.slogdet(information)[1]))
