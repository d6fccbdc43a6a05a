"""`compensated-wckf`: weighted square-root cubature filters on the electric drive wheel, with force compensation (002).

Chen, Cai, Chen, Xu, Jiang, Sun, "Design of vehicle running states-fused estimation strategy using Kalman filters and
tire force compensation method", IEEE Access 2019, doi 10.1109/ACCESS.2019.2925370 (paper 002).

WCKF-A: 19 states [v_x, v_y, r, tau x 4, omega x 4, F_x x 4, F_x' x 4], measurement [r, tau x 4, omega x 4] (30) to
(32), see `drive_wheel`. Forces: Magic Formula (12), compensated by (33). WCKF-B: [v_x, v_y, r], measurement
[r, a_x, a_y] (35), (36). Both with R from a weighted moving window (25), see `adaptation.windows`.

Friction is no state: it is set by hand, here to DRY, and the prior is told of it.

Departures, after the errata: 1/m on the whole bracket (4), (5); loads and half tracks (13), (14), (16) as in
`dynamics`; weights 1/(2n) and points scaled once (20); deviations from the mean (23), (27); bounded diagonal R (24),
(25). The tyre model of B is evaluated at its points: with forces as plain inputs nothing would observe v_x and v_y, and
A's own v_x and v_y are integrals without a correction. The lateral compensation (34) is left out: it adds a
longitudinal force to a lateral one, with the same sign on both sides and gains that are not given.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from edge_agent.adaptation.windows import push, weighted_noise
from edge_agent.dynamics.body import accelerations
from edge_agent.dynamics.chassis import turned, tyre_forces
from edge_agent.dynamics.drive_wheel import blended, drive_wheel, slip_share
from edge_agent.dynamics.parameters import P, parameter_table
from edge_agent.dynamics.slip import wheel_velocity
from edge_agent.estimators import flags
from edge_agent.estimators.adaptive_federated_ckf import DRY
from edge_agent.estimators.friction_mixture.sample import rolling_speed
from edge_agent.estimators.gaussian.bank import (
    FIRST_V_STD,
    UNKNOWN_V_STD,
    GaussianBank,
    Stretch,
    lost,
    prior_interval,
    sliding,
    tell_motion,
    tell_nothing,
    variance,
)
from edge_agent.estimators.gaussian.intake import BEGUN, STEPPED, Track, grip_used, take
from edge_agent.filters.sigma import cubature
from edge_agent.filters.squareroot import deviations, predict, sigma_points, update, weighted_mean
from schemas.numeric import FloatArray, compiled, released
from schemas.signals import S
from schemas.vehicle import Vehicle

A_STATES, A_ROWS, B_STATES = 19, 9, 3
SHAPE = 1.4  # c of the Magic Formula (12): between the usual lateral 1.3 and longitudinal 1.65
WINDOW = 25  # samples; the paper's N is not given
LEAST, LARGEST = 0.5, 20.0  # of the nominal R
# process standard deviations per s^.5: offsets of the accelerometers, yaw model error, then torque, speed, force
A_PROCESS = np.array([0.05, 0.05, 0.2, *[20.0] * 4, *[0.5] * 4, *[100.0] * 4, *[2e4] * 4])
A_NOISE = np.array([1e-4, *[25.0] * 4, *[1e-3] * 4])  # variances of r, tau, omega
B_PROCESS = np.array([0.1, 0.1, 0.1])
B_NOISE = np.array([1e-4, 0.04, 0.04])  # variances of r, a_x, a_y, with some model error


class X(IntEnum):
    """Index of a state of both filters; of a wheel quantity of A, its first wheel."""

    VX = 0
    VY = 1
    YAW_RATE = 2
    TORQUE = 3
    OMEGA = 7
    FORCE = 11
    SLOPE = 15


class Memory(NamedTuple):
    """State of N pairs of filters."""

    mean: FloatArray  # (N, 19)
    root: FloatArray  # (N, 19, 19)
    window: FloatArray  # (N, 9, WINDOW) innovations
    fused: FloatArray  # (N, 3)
    fused_root: FloatArray  # (N, 3, 3)
    fused_window: FloatArray  # (N, 3, WINDOW)
    told: FloatArray  # (N, 3) NIS, log-likelihood, largest factor on R
    friction: FloatArray  # (4,)
    xi: FloatArray  # (38, 19)
    weight: FloatArray  # (38,)
    fused_xi: FloatArray  # (6, 3)
    fused_weight: FloatArray  # (6,)


def bank(vehicles: Sequence[Vehicle], friction: float = DRY) -> GaussianBank[Memory]:
    """N of these filters on a road whose friction is set."""
    n, large, small = len(vehicles), cubature(A_STATES), cubature(B_STATES)
    memory = Memory(
        np.zeros((n, A_STATES)), np.zeros((n, A_STATES, A_STATES)), np.full((n, A_ROWS, WINDOW), np.nan),
        np.zeros((n, B_STATES)), np.zeros((n, B_STATES, B_STATES)), np.full((n, B_STATES, WINDOW), np.nan),
        np.zeros((n, 3)), np.full(4, friction), large.xi, large.w_cov, small.xi, small.w_cov,
    )  # fmt: skip
    return GaussianBank(parameter_table(vehicles), memory, _advance)


@released
def _advance(memory: Memory, track: Track, stretch: Stretch, first: int, last: int) -> None:
    rows, t, signals, out, _wheels, health = stretch
    points, work = np.empty((2 * A_STATES, A_STATES)), np.empty((A_ROWS + A_STATES, 4 * A_STATES))
    force_y = np.empty(4)
    for n in range(first, last):
        for k in range(t.shape[0]):
            memory.told[n, 1] = 0.0
            told, kind, gone = take(track, rows[n], n, t[k, n], signals[k, n])
            if kind == STEPPED:
                _preliminary(memory, track, rows[n], n, gone, force_y, points, work)
                _fuse(memory, track, rows[n], n, gone, work)
                if lost(memory.fused[n], memory.fused_root[n], X.VX, X.VY, X.YAW_RATE) or lost(
                    memory.mean[n], memory.root[n], X.VX, X.VY, X.YAW_RATE
                ):
                    told, kind = told | flags.RESET, BEGUN
            if kind == BEGUN:
                _begin(memory, track, rows[n], n, signals[k, n])
            if track.started[n]:
                x, root = memory.fused[n], memory.fused_root[n]
                tell_motion(
                    out[:, k, n], x[X.VX], x[X.VY], x[X.YAW_RATE],
                    variance(root, X.VX), variance(root, X.VY), variance(root, X.YAW_RATE),
                )  # fmt: skip
                prior_interval(out[8:11, k, n])
                out[11, k, n], out[12, k, n] = grip_used(track, n), memory.told[n, 0]
                out[13, k, n], out[14, k, n] = memory.told[n, 2], memory.told[n, 1]
                health[k, n] = told | sliding(rows[n], track.use[n], x[X.VX], x[X.VY], memory.friction[0])
            else:
                health[k, n] = told
                tell_nothing(out[:, k, n])


@compiled
def _begin(memory: Memory, track: Track, row: FloatArray, n: int, sample: FloatArray) -> None:
    mean, root, use = memory.mean[n], memory.root[n], track.use[n]
    speed = rolling_speed(row, sample)
    known = not math.isnan(speed)
    mean[:] = 0.0
    root[:, :] = 0.0
    mean[X.VX], mean[X.YAW_RATE] = speed if known else 0.0, use[S.YAW_RATE]
    for wheel in range(4):
        omega = use[S.OMEGA + wheel]
        mean[X.TORQUE + wheel] = use[S.TORQUE + wheel]
        mean[X.OMEGA + wheel] = mean[X.VX] / row[P.RADIUS] if math.isnan(omega) else omega
        mean[X.FORCE + wheel] = use[S.TORQUE + wheel] / row[P.RADIUS]
        root[X.TORQUE + wheel, X.TORQUE + wheel], root[X.OMEGA + wheel, X.OMEGA + wheel] = 20.0, 0.3
        root[X.FORCE + wheel, X.FORCE + wheel], root[X.SLOPE + wheel, X.SLOPE + wheel] = 200.0, 1000.0
    root[X.VX, X.VX], root[X.VY, X.VY] = FIRST_V_STD if known else UNKNOWN_V_STD, FIRST_V_STD
    root[X.YAW_RATE, X.YAW_RATE] = 0.1
    memory.fused[n], memory.fused_root[n] = mean[:B_STATES], root[:B_STATES, :B_STATES]
    memory.window[n], memory.fused_window[n] = math.nan, math.nan
    memory.told[n, 0], memory.told[n, 1], memory.told[n, 2] = 0.0, 0.0, 1.0


@compiled
def _forces(
    row: FloatArray, x: FloatArray, use: FloatArray, mu: FloatArray, observed: FloatArray, force_x: FloatArray,
    force_y: FloatArray,
) -> None:  # fmt: skip
    """Compensated forces (4,) [N] in the motion x (3,), from the tyre model and the forces `observed` by A."""
    motion = np.array([x[X.VX], x[X.VY], x[X.YAW_RATE], use[S.AX], use[S.AY]])
    delta, omega, share = use[S.DELTA : S.DELTA + 4], use[S.OMEGA : S.OMEGA + 4], np.empty(4)
    tyre_forces(row, motion, turned(delta), omega, mu, SHAPE, force_x, force_y)
    for wheel in range(4):
        along, _ = wheel_velocity(row, wheel, x[X.VX], x[X.VY], x[X.YAW_RATE], delta[wheel])
        # a wheel whose speed is missing has no slip to judge by: its force is the observed one
        share[wheel] = 0.0 if math.isnan(omega[wheel]) else slip_share(row[P.RADIUS], omega[wheel], along)
    blended(share, force_x, observed, force_x)


@compiled
def _preliminary(
    memory: Memory, track: Track, row: FloatArray, n: int, gone: float, force_y: FloatArray, points: FloatArray,
    work: FloatArray,
) -> None:  # fmt: skip
    """WCKF-A: lateral forces come from the tyre model in B's last motion."""
    mean, root, use, now = memory.mean[n], memory.root[n], track.before[n], track.now[n]
    force_x, noise = np.empty(4), np.zeros((A_STATES, A_STATES))
    _forces(row, memory.fused[n], use, memory.friction, mean[X.FORCE : X.FORCE + 4], force_x, force_y)
    delta = use[S.DELTA : S.DELTA + 4]
    sigma_points(mean, root, memory.xi, points)
    for p in range(points.shape[0]):
        x = points[p]
        _, _, turn = accelerations(row, x[X.FORCE : X.FORCE + 4], force_y, delta)
        vx, vy, rate = x[X.VX], x[X.VY], x[X.YAW_RATE]
        x[X.VX], x[X.VY] = vx + gone * (use[S.AX] + rate * vy), vy + gone * (use[S.AY] - rate * vx)
        x[X.YAW_RATE] = rate + gone * turn
        for w in range(4):
            x[X.TORQUE + w], x[X.OMEGA + w], x[X.FORCE + w], x[X.SLOPE + w] = drive_wheel(
                x[X.TORQUE + w], x[X.OMEGA + w], x[X.FORCE + w], x[X.SLOPE + w], use[S.TORQUE + w],
                row[P.WHEEL_INERTIA], row[P.RADIUS], gone,
            )  # fmt: skip
    for i in range(A_STATES):
        noise[i, i] = A_PROCESS[i] * math.sqrt(gone)
    predict(points, memory.weight, memory.weight, noise, mean, root, work)
    innovation, std, rows = np.empty(A_ROWS), np.empty(A_ROWS), np.empty((A_ROWS, A_STATES))
    for r in range(A_ROWS):
        place = X.YAW_RATE + r
        reading = now[S.YAW_RATE] if r == 0 else now[S.TORQUE + r - 1] if r < 5 else now[S.OMEGA + r - 5]
        rows[r] = root[place]
        innovation[r] = reading - mean[place]
        if not math.isnan(innovation[r]):
            push(memory.window[n, r], innovation[r])
        std[r] = math.sqrt(weighted_noise(memory.window[n, r], variance(root, place), A_NOISE[r], LEAST, LARGEST))
    update(mean, root, root.copy(), rows, innovation, std, work)


@compiled
def _fuse(memory: Memory, track: Track, row: FloatArray, n: int, gone: float, work: FloatArray) -> None:
    """WCKF-B: motion by the compensated forces."""
    mean, root, use, now = memory.fused[n], memory.fused_root[n], track.use[n], track.now[n]
    observed, count = memory.mean[n, X.FORCE : X.FORCE + 4], 2 * B_STATES
    points, outcomes, predicted = np.empty((count, B_STATES)), np.empty((count, B_STATES)), np.empty(B_STATES)
    state, measured = np.empty((B_STATES, count)), np.empty((B_STATES, count))
    innovation, std, noise = np.empty(B_STATES), np.empty(B_STATES), np.zeros((B_STATES, B_STATES))
    force_x, force_y = np.empty(4), np.empty(4)
    delta = use[S.DELTA : S.DELTA + 4]
    for act in range(2):
        sigma_points(mean, root, memory.fused_xi, points)
        for p in range(count):
            x = points[p]
            _forces(row, x, track.before[n] if act == 0 else use, memory.friction, observed, force_x, force_y)
            ax, ay, turn = accelerations(row, force_x, force_y, delta)
            if act == 0:
                vx, vy, rate = x[X.VX], x[X.VY], x[X.YAW_RATE]
                x[X.VX], x[X.VY] = vx + gone * (ax + rate * vy), vy + gone * (ay - rate * vx)
                x[X.YAW_RATE] = rate + gone * turn
            else:
                outcomes[p, 0], outcomes[p, 1], outcomes[p, 2] = x[X.YAW_RATE], ax, ay
        if act == 0:
            for i in range(B_STATES):
                noise[i, i] = B_PROCESS[i] * math.sqrt(gone)
            predict(points, memory.fused_weight, memory.fused_weight, noise, mean, root, work)
    weighted_mean(outcomes, memory.fused_weight, predicted)
    deviations(points, mean, memory.fused_weight, state, 0)
    deviations(outcomes, predicted, memory.fused_weight, measured, 0)
    largest = 0.0
    for r in range(B_STATES):
        innovation[r] = (now[S.YAW_RATE] if r == 0 else now[S.AX + r - 1]) - predicted[r]
        spread = 0.0
        for p in range(count):
            spread += measured[r, p] ** 2
        if not math.isnan(innovation[r]):
            push(memory.fused_window[n, r], innovation[r])
        adapted = weighted_noise(memory.fused_window[n, r], spread, B_NOISE[r], LEAST, LARGEST)
        std[r] = math.sqrt(adapted)
        largest = max(largest, adapted / B_NOISE[r])
    used, log_likelihood, square = update(mean, root, state, measured, innovation, std, work)
    memory.told[n, 0], memory.told[n, 1], memory.told[n, 2] = square / max(used, 1), log_likelihood, largest
