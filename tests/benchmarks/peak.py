"""Floating-point peak of one core, and the operations that the default estimator needs."""

from __future__ import annotations

import time

import numpy as np

from edge_agent.estimators.friction_mixture.state.constants import (
    ACTIVE,
    CURVED,
    NODES,
    ROWS,
    STATES,
    Constants,
)
from schemas.numeric import FloatArray
from schemas.runtime.jit import nogil
from schemas.runtime.lanes import lanes_at, sum_lanes
from schemas.runtime.records import LANES
from tests.benchmarks.measure import ROUNDS

CHAINS = 10  # independent sums; a core has fewer multiply-adds in flight
TURNS = 1_000_000
FUSED = 2  # a multiply-add counts as two operations
WHEELS = 4
AXLES = 2
EXPONENTIAL = 33  # operations of `exp_lanes`: range reduction, polynomial, power of two
CURVE = 6  # operations of an interpolation in a table
DISTANCE = 10  # operations of a measurement row's distance from the tyre curve
INVERSE = 8 + CURVE  # operations of computing the slip that gives a force


def measure_peak() -> float:
    """Measure the double-precision peak of one core [GFLOP/s]. The core runs a loop of independent
    fused multiply-adds in registers. Return the result of the fastest of ROUNDS rounds.
    """
    values = np.full((2, LANES), 0.5)
    add_products(values, 1)
    spent = []
    for _ in range(ROUNDS):
        began = time.perf_counter()
        add_products(values, TURNS)
        spent.append(time.perf_counter() - began)
    return TURNS * CHAINS * LANES * FUSED / min(spent) / 1e9


@nogil
def add_products(values: FloatArray, turns: int) -> float:
    """Run CHAINS independent recursions x <- factor*x + term in registers, `turns` times each.
    `values` (2, LANES) has the factor in its first row and the term in its second.
    """
    factor = lanes_at(values, 0)
    term = lanes_at(values, 1)
    a = term + 0.0
    b = term + 1.0
    c = term + 2.0
    d = term + 3.0
    e = term + 4.0
    f = term + 5.0
    g = term + 6.0
    h = term + 7.0
    i = term + 8.0
    j = term + 9.0
    for _ in range(turns):
        a = factor * a + term
        b = factor * b + term
        c = factor * c + term
        d = factor * d + term
        e = factor * e + term
        f = factor * f + term
        g = factor * g + term
        h = factor * h + term
        i = factor * i + term
        j = factor * j + term
    return sum_lanes(a + b + c + d + e + f + g + h + i + j)


def count_operations(interval: float) -> float:
    """Return the floating-point operations per sample of the default estimator at a sampling
    `interval` [s].

    The numbers were counted in the estimator's source code (`friction_mixture/node`), for a car
    with torque signals. They cover the NODES nodes (filters of one friction hypothesis each). A
    division or root counts as one operation.

    Four parts are not counted: unused SIMD lanes, mixing after a road change, the sums over a block
    of samples, and the output. The share of the peak that is computed from this count is therefore
    a lower limit.
    """
    samples = round(Constants().chosen.block_time / interval)
    return NODES * (_count_rows() + _count_covariances()) / samples


def _count_rows() -> int:
    """Return the number of floating-point operations that one node (filter of one friction
    hypothesis) needs for its six measurement residuals and their derivatives.

    Slips and residuals are computed at the mean, at the cubature points, with a changed steering
    angle, and with changed wheel radii. Forces are computed at the mean, and once for each of three
    changed states.
    """
    stiffness = 4 * (EXPONENTIAL + 1) + 8
    slip = 8 + AXLES * stiffness + WHEELS * 15
    ratio = WHEELS * (10 + CURVE)
    force = WHEELS * (9 + INVERSE) + AXLES * (8 + INVERSE)
    noise = WHEELS * (2 * CURVE + 30)
    points = 3 + 2 * CURVED
    moved = 3
    residuals = ROWS * DISTANCE
    return points * (slip + ratio + residuals) + moved * residuals + (1 + moved) * force + noise


def _count_covariances() -> int:
    """Return the number of floating-point operations that one node (filter of one friction
    hypothesis) needs for its covariance.

    The steps are Cholesky factor, covariance of states and measurements, update, and prediction.
    The update uses six measurements and two velocities of the rolling wheels. A last step adds the
    node to the covariance of the whole mixture.
    """
    half = STATES * (STATES + 1) // 2
    factor = FUSED * STATES * CURVED * (CURVED - 1) // 2
    linear = ACTIVE - CURVED
    rows = FUSED * (STATES * ROWS * ACTIVE + ROWS * CURVED * linear)
    rows += FUSED * ACTIVE * ROWS * (ROWS + 1) // 2
    conditioned = FUSED * STATES * (ROWS * (ROWS - 1) // 2 + ROWS)
    update = FUSED * half * ROWS + STATES * ROWS
    velocities = 2 * (FUSED * half + 6 * STATES)
    prediction = 2 * half + 22 * STATES
    moments = 2 * FUSED * half
    return factor + rows + conditioned + update + velocities + prediction + moments
