"""Covariances of the filters of a group of nodes (friction hypotheses), computed together: factor,
measurement update, prediction and mixing. Only the lower half of a covariance P (n, n, LANES) is
read and written; LANES is the number of nodes in a group.

Legend
    m, P     means (n,) and covariances (n, n) of the states
    h        covariance of the states with one measurement, P*H'                   (n,)
    a, nu    variance of the innovation (measurement minus prediction), and innovation
    z        share of a node's state that is replaced by that of the whole mixture [1]

The update is P <- P - h*h'/a. The difference loses digits: rounding is 1e-16, so ten digits remain
if the measurements reduce a variance by a factor of 1e6. The measurements of one block (0.05 s)
never reduce it more. Between blocks the process noise restores the rank, and a pivot (squared
diagonal element) of the factor is never below a limit.
"""

from __future__ import annotations

import math

from edge_agent.dynamics.tyres import TINY
from edge_agent.estimators.friction_mixture.state.constants import CURVED, NodeState
from edge_agent.estimators.friction_mixture.state.memory import VelocityGain
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled, inlined
from schemas.runtime.lanes import lanes_at, put_lanes


@inlined
def symmetric_at(covariance: FloatArray, i: int, j: int) -> float:
    """Return element (i, j) of the covariances, of which only the lower half is stored."""
    if i < j:
        return lanes_at(covariance, (j, i))
    return lanes_at(covariance, (i, j))


@compiled
def factorize_first(covariance: FloatArray, root: FloatArray) -> None:
    """Compute the first CURVED columns of the lower-triangular (Cholesky) factors of the state
    covariances, one factor per node. Write them to `root` (n, CURVED, LANES), with n states and
    LANES nodes.

    The measurements are nonlinear only in the first CURVED states. A pivot is at least TINY.
    """
    for j in range(CURVED):
        total = lanes_at(covariance, (j, j))
        for k in range(j):
            part = lanes_at(root, (j, k))
            total -= part * part
            put_lanes(root, (k, j), 0.0)
        pivot = math.sqrt(max(total, TINY))
        put_lanes(root, (j, j), pivot)
        per = 1.0 / pivot
        for i in range(j + 1, root.shape[0]):
            total = lanes_at(covariance, (i, j))
            for k in range(j):
                total -= lanes_at(root, (i, k)) * lanes_at(root, (j, k))
            put_lanes(root, (i, j), total * per)


@compiled
def subtract_row(
    mean: FloatArray, covariance: FloatArray, h: FloatArray, per: float, step: float
) -> None:
    """Apply one scalar measurement to the filters of a group of nodes: m += h*step and P -=
    h*h'*per, with the means m and the covariances P. Here `h` (n, LANES) is the covariance of the
    states with the measurement, `step` is nu/a (innovation over its variance) and `per` is 1/a.
    """
    for i in range(mean.shape[0]):
        own = lanes_at(h, i)
        put_lanes(mean, i, lanes_at(mean, i) + own * step)
        scaled = own * per
        for j in range(i + 1):
            left = lanes_at(covariance, (i, j)) - scaled * lanes_at(h, j)
            put_lanes(covariance, (i, j), left)


@compiled
def mix_states(
    mean: FloatArray,
    covariance: FloatArray,
    z: float,
    overall_mean: FloatArray,
    overall_covariance: FloatArray,
) -> None:
    """Replace the share z of the state of each node by the state of the whole mixture (moment
    matching). `mean` (n, LANES) and `covariance` are changed in place.
    """
    for i in range(mean.shape[0]):
        scaled_difference = z * (1.0 - z) * (overall_mean[i] - lanes_at(mean, i))
        for j in range(i + 1):
            own = lanes_at(covariance, (i, j))
            foreign = z * (overall_covariance[i, j] - own)
            mixed = own + foreign + scaled_difference * (overall_mean[j] - lanes_at(mean, j))
            put_lanes(covariance, (i, j), mixed)
    for i in range(mean.shape[0]):
        own = lanes_at(mean, i)
        put_lanes(mean, i, own + z * (overall_mean[i] - own))


@compiled
def predict_covariance(
    covariance: FloatArray,
    turned: FloatArray,
    gain: VelocityGain,
    turn: tuple[float, float],
    keep: FloatArray,
    noise: FloatArray,
) -> None:
    """Replace the covariances by F*P*F' + diag(noise), where F is the matrix of the prediction over
    a block.

    F rotates the velocity by the yaw angle (cosine and sine `turn`), and adds the effect of the
    accelerometer offsets on the velocity (`gain`). The other states decay by the factors `keep`
    (n,).

    `turned` (2, n, LANES) is scratch memory for the covariance of the new velocity with the old
    states.
    """
    n = covariance.shape[0]
    for k in range(n):
        ahead, left = _turn_column(
            gain,
            turn,
            (symmetric_at(covariance, NodeState.VX, k), symmetric_at(covariance, NodeState.VY, k)),
            symmetric_at(covariance, NodeState.LEAK_Y, k),
            symmetric_at(covariance, NodeState.BIAS_X, k)
            + symmetric_at(covariance, NodeState.SLOPE, k),
            symmetric_at(covariance, NodeState.BIAS_Y, k)
            + symmetric_at(covariance, NodeState.BANK, k),
        )
        put_lanes(turned, (NodeState.VX, k), ahead)
        put_lanes(turned, (NodeState.VY, k), left)
    for axis in range(2):
        row = turned[axis]
        ahead, left = _turn_column(
            gain,
            turn,
            (lanes_at(row, NodeState.VX), lanes_at(row, NodeState.VY)),
            lanes_at(row, NodeState.LEAK_Y),
            lanes_at(row, NodeState.BIAS_X) + lanes_at(row, NodeState.SLOPE),
            lanes_at(row, NodeState.BIAS_Y) + lanes_at(row, NodeState.BANK),
        )
        if axis == NodeState.VX:
            put_lanes(covariance, (NodeState.VX, NodeState.VX), ahead + noise[NodeState.VX])
        else:
            put_lanes(covariance, (NodeState.VY, NodeState.VX), ahead)
            put_lanes(covariance, (NodeState.VY, NodeState.VY), left + noise[NodeState.VY])
    for i in range(NodeState.LN_KX, n):
        for axis in range(2):
            put_lanes(covariance, (i, axis), keep[i] * lanes_at(turned, (axis, i)))
        for j in range(NodeState.LN_KX, i + 1):
            kept = keep[i] * keep[j] * lanes_at(covariance, (i, j))
            put_lanes(covariance, (i, j), kept + noise[i] if i == j else kept)


@inlined
def _turn_column(
    gain: VelocityGain,
    turn: tuple[float, float],
    velocity: tuple[float, float],
    leak_y: float,
    bias_x: float,
    bias_y: float,
) -> tuple[float, float]:
    """Return the first two elements of F*c, where F is the prediction matrix and c a column of a
    covariance. The arguments are those elements of c that affect the result: velocity (v_x, v_y),
    leak (share of a_y that is gravity) and accelerometer offsets.
    """
    cos, sin = turn
    vx, vy = velocity
    unit = gain.unit
    return (
        cos * vx + sin * vy - leak_y * gain.leak_y.x - bias_x * unit.x + bias_y * unit.y,
        cos * vy - sin * vx - leak_y * gain.leak_y.y - bias_x * unit.y - bias_y * unit.x,
    )
