"""Oracle for visits (passages of a map cell): an ideal observer that measures the slip and the
force of every tyre. From these measurements the oracle computes the likelihood L of each
friction μ.

The measurements contain noise, and the oracle does not know the stiffness of the tyre and the shape
of its force curve. However, the oracle knows more than any estimator. Therefore its likelihood is
an upper limit of the information on friction in a visit.

    f = μ F(k q / μ; c, e)     force curve of a tyre: Magic Formula F with shape c and curvature e
    f        force over load |F| / F_z of a wheel, known with noise of standard deviation FORCE_STD
    q        slip times stiffness per load, known with noise of standard deviation σ_q (from the
             wheel speeds)
    k        stiffness factor of the tyre, random (log-normal)
    slope    df/dq, the slope of the force curve at q
    N(x; m, v)  normal density of x with mean m and variance v
    p(q)     prior density of q

    L(μ) = mean over random tyres of Π over wheels and samples
           N(f; μ F(k q/μ), FORCE_STD² + (slope · σ_q)²) · p(q)

The oracle assumes that all tyre forces are equally likely. A uniform density of f means that the
density of q is proportional to df/dq. Therefore p(q) is the slope of the force curve, at least
LEAST_SLOPE. Only every EACH-th sample is used, because the errors of successive samples are
correlated.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from edge_agent.dynamics.tyres import magic_formula
from schemas.mugrid import BINS, CENTRES
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

FORCE_STD: Final = 0.02
# [m/s] standard deviation of a wheel's speed as assumed by a filter: noise, resolution and unequal
# radii.
SPEED_STD: Final = 0.03
# Stiffness per load of an ordinary tyre; it converts noise of the wheel speeds to noise of q.
STIFF: Final = 20.0
SLOWEST: Final = 0.5  # [m/s] minimum speed for the computation of the slip noise
EACH: Final = 4
TYRES: Final = 128
LEAST_SLOPE: Final = 0.1
LEAST_NATS: Final = 100.0  # largest difference of log-likelihood that is distinguished
SHAPE: Final = (1.5, 0.1)  # mean and standard deviation of c, as drawn by `one_of_a_fleet`
CURVATURE: Final = (-0.2, 0.25)
STIFFNESS_STD: Final = 0.12  # standard deviation of ln k, the same as that of the vehicle file


def tyres_drawn() -> FloatArray:
    """Return a random sample of tyres (TYRES, 3): shape c, curvature e and stiffness factor k. Each
    call returns the same sample.
    """
    rng = np.random.default_rng(0)
    shape = np.clip(rng.normal(*SHAPE, TYRES), 1.2, 1.8)
    curvature = np.clip(rng.normal(*CURVATURE, TYRES), -0.9, 0.6)
    return np.stack([shape, curvature, np.exp(rng.normal(0.0, STIFFNESS_STD, TYRES))], axis=1)


def visit_evidence(
    force: FloatArray, slip: FloatArray, speed: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return the evidence that the oracle (an ideal observer) gets from a visit: the log-likelihood
    ln L (BINS,) on the friction grid, with maximum 0. The function first adds noise to the true
    values that it gets.

    Args:
        force: true force over load (T, 4) [1].
        slip: true slip (T, 4) [1].
        speed: (T,) [m/s].
        rng: random generator of the noise.
    """
    picked = slice(None, None, EACH)
    noise = STIFF * SPEED_STD / np.maximum(speed[picked], SLOWEST)
    read_force = force[picked] + FORCE_STD * rng.standard_normal(force[picked].shape)
    read_slip = slip[picked] + noise[:, None] * rng.standard_normal(force[picked].shape)
    rows = _evidence(
        np.ascontiguousarray(read_force), np.ascontiguousarray(read_slip), noise, tyres_drawn()
    )
    top = rows.max()
    found = top + np.log(np.exp(np.maximum(rows - top, -LEAST_NATS)).mean(axis=0))
    return np.asarray(found - found.max())


@compiled
def _evidence(
    force: FloatArray, slip: FloatArray, noise: FloatArray, tyres: FloatArray
) -> FloatArray:
    """Return the log-likelihood ln L of the oracle's data on the friction grid, assuming each of
    the random tyres in turn, (TYRES, BINS).

    `force` (T, 4) is the force over load of each wheel, and `slip` (T, 4) its slip times stiffness
    per load. Both contain noise. `noise` (T,) is the standard deviation of the noise of `slip`.
    `tyres` (TYRES, 3) is the result of `tyres_drawn`.
    """
    out = np.zeros((tyres.shape[0], BINS))
    for j in range(tyres.shape[0]):
        shape, curvature, stiffness = tyres[j]
        for b in range(BINS):
            total = 0.0
            for k in range(force.shape[0]):
                for i in range(4):
                    x = stiffness * slip[k, i] / CENTRES[b]
                    here = magic_formula(x, shape, curvature)
                    slope = (magic_formula(x + 0.05, shape, curvature) - here) / 0.05 * stiffness
                    variance = FORCE_STD**2 + (slope * noise[k]) ** 2
                    total -= 0.5 * (
                        (force[k, i] - CENTRES[b] * here) ** 2 / variance + np.log(variance)
                    )
                    total += np.log(max(abs(slope), LEAST_SLOPE))
            out[j, b] = total
    return out
