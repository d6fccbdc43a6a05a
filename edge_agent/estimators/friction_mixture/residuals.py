"""The measurement equations of one node: residuals between slip and force by total least squares.

Legend
    mu          friction of the node under the wheel's side [1]
    g_x, g_y    linear force over load, slope*stiffness factor*slip [1]
    theta       hypot(g_x, g_y)/mu, normalised slip
    e_b         force minus the tyre's force at the measured slip, over load [1]
    e_a         slip at the measured force by the inverse tyre, minus the measured slip, as linear force over load [1]
    e           sign(e_b)*|e_a*e_b|/sqrt(e_a^2 + e_b^2): distance to the tyre curve [1]

Rows: the four wheels along, then the two axles across. In the linear range e weighs slip and force alike; on the flat
and beyond the peak it is the force that decides, so a sliding wheel says what its friction is (errata, what made the
difference, 1). An axle takes one mean slip; its wheels share the side force by load.
What a node believes of the vehicle (leak, gain of torque, shape of the tyre) corrects the measured force.
"""

from __future__ import annotations

import math
from enum import IntEnum

from edge_agent.dynamics.parameters import P
from edge_agent.dynamics.slip import SLOWEST_M_S, wheel_position
from edge_agent.dynamics.tyres import TINY
from edge_agent.estimators.friction_mixture.block import F
from edge_agent.estimators.friction_mixture.constants import C, X
from edge_agent.estimators.friction_mixture.curve import Curve, looked_up, ratio_at, theta_at
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

ROWS = 6
FLATTEST = 0.03  # a sliding wheel's slip is not quite arbitrary: its inertia holds it for a block


class L(IntEnum):
    """Index in the slips of a node; of what every wheel or axle has, the index of its first."""

    ALONG = 0  # g_x of the four wheels
    ACROSS = 4  # g_y
    SCALE_X = 8  # what a wheel's residual is multiplied by, per axle
    SCALE_Y = 10
    LENGTH = 12


@compiled
def distance(along: float, across: float) -> float:
    """e of e_a = along and e_b = across; an infinite e_a (force beyond the peak) leaves e_b."""
    if math.isinf(along):
        return across
    size = math.sqrt(along * along + across * across)
    return 0.0 if size < TINY else across * abs(along) / size


@compiled
def gained(gains: FloatArray, first: int, x: FloatArray, axis: int) -> float:
    """Velocity gained [m/s] along `axis` (0 ahead, 1 left): gains of memory.G from index `first`, two axes each.

    An offset of a_y gains what one of a_x does, turned by a quarter.
    """
    ahead, left = gains[first + 6], gains[first + 7]
    unit_x, unit_y = (ahead, -left) if axis == 0 else (left, ahead)
    total = (
        gains[first + axis]
        - x[X.LEAK_X] * gains[first + 2 + axis]
        - x[X.LEAK_Y] * gains[first + 4 + axis]
        - x[X.BIAS_X] * unit_x
        - x[X.BIAS_Y] * unit_y
    )
    return float(total)


@compiled
def steepness(curve: Curve, g_x: float, g_y: float, mu: float) -> float:
    """Change of the force along by the linear force along, at least FLATTEST: 1 at small slip, 0 on the flat."""
    square = g_x * g_x + g_y * g_y
    if square < TINY:
        return 1.0
    theta = math.sqrt(square) / mu
    u = theta / (1.0 + theta)
    return max((looked_up(curve.slope, u) * g_x * g_x + ratio_at(curve, theta) * g_y * g_y) / square, FLATTEST)


@compiled
def slips(
    row: FloatArray,
    constants: FloatArray,
    mean: FloatArray,
    x: FloatArray,
    gained_x: float,
    gained_y: float,
    features: FloatArray,
    out: FloatArray,
) -> None:
    """out (12,) indexed by L: linear forces over load at state x of the beginning of the block.

    A log stiffness is drawn towards the node's mean where the force is too small to tell it from noise of the slip.
    """
    cos, sin, rate = features[F.COS], features[F.SIN], features[F.YAW_RATE]
    vx = cos * x[X.VX] + sin * x[X.VY] + gained_x
    vy = cos * x[X.VY] - sin * x[X.VX] + gained_y
    for axle in range(2):
        offset = x[X.STEER] if axle == 0 else 0.0
        blind = math.isnan(features[F.SIDE + axle])  # slip across is then guesswork, and must not bend the force along
        ln_kx = mean[X.LN_KX] + features[F.TELL_X + axle] * (x[X.LN_KX] - mean[X.LN_KX])
        ln_ky = mean[X.LN_KY] + features[F.TELL_Y + axle] * (x[X.LN_KY] - mean[X.LN_KY])
        slope_x, slope_y = row[P.SLOPE_X] * math.exp(ln_kx), row[P.SLOPE_Y] * math.exp(ln_ky)
        out[L.SCALE_X + axle] = math.exp(-constants[C.STIFFNESS_SHARE_X] * ln_kx)
        out[L.SCALE_Y + axle] = math.exp(-constants[C.STIFFNESS_SHARE_Y] * ln_ky)
        for wheel in range(2 * axle, 2 * axle + 2):
            px, py = wheel_position(row, wheel)
            ahead, left = vx - py * rate, vy + px * rate
            along = features[F.STEER_COS + wheel] * ahead + features[F.STEER_SIN + wheel] * left
            across = features[F.STEER_COS + wheel] * left - features[F.STEER_SIN + wheel] * ahead
            speed = max(abs(along), SLOWEST_M_S)
            rolling = features[F.ROLL + wheel]
            known = not math.isnan(rolling)
            out[L.ALONG + wheel] = slope_x * (rolling - along) / speed if known else features[F.FORCE + wheel]
            out[L.ACROSS + wheel] = 0.0 if blind else slope_y * (offset - across / speed)


@compiled
def bends(curve: Curve, pair: FloatArray, slip: FloatArray, features: FloatArray, out: FloatArray) -> None:
    """out (6,): force over load of the rows by which a tyre one spread sharper differs at these slips."""
    out[4] = out[5] = 0.0
    for wheel in range(4):
        mu = pair[wheel % 2]
        g_x, g_y = slip[L.ALONG + wheel], slip[L.ACROSS + wheel]
        size = math.sqrt(g_x * g_x + g_y * g_y)
        theta = size / mu
        bend = 0.0 if size < TINY else mu * looked_up(curve.bend, theta / (1.0 + theta)) / size
        out[wheel] = bend * g_x
        out[4 + wheel // 2] += features[F.LOAD + wheel] * bend * g_y


@compiled
def forces(
    curve: Curve,
    pair: FloatArray,
    leak: float,
    bend: float,
    gain: float,
    features: FloatArray,
    bent: FloatArray,
    force: FloatArray,
    at_force: FloatArray,
) -> None:
    """force (6,) over load as the node corrects it, at_force (6,) the linear force over load that gives it."""
    for axle in range(2):
        left, right = 2 * axle, 2 * axle + 1
        side = features[F.SIDE + axle] + leak * features[F.SIDE_LEAK + axle]
        across = 0.0 if math.isnan(side) else side
        mean_along = mean_mu = 0.0
        for wheel in range(left, right + 1):
            mu, load = pair[wheel % 2], features[F.LOAD + wheel]
            along = (1.0 + gain) * features[F.FORCE + wheel]
            mean_along += load * along
            mean_mu += load * mu
            force[wheel] = along - bend * bent[wheel]
            at_force[wheel] = _at_force(curve, mu, force[wheel], across)
        force[4 + axle] = side - bend * bent[4 + axle]
        at_force[4 + axle] = _at_force(curve, mean_mu, force[4 + axle], mean_along)


@compiled
def _at_force(curve: Curve, mu: float, force: float, other: float) -> float:
    """Linear force over load along `force` where another component acts across it."""
    size = math.sqrt(force * force + other * other)
    if math.isnan(size) or size < TINY:
        return force
    theta = theta_at(curve, size / mu)
    return math.copysign(math.inf, force) if math.isinf(theta) else mu * theta * force / size


@compiled
def residuals(
    curve: Curve,
    pair: FloatArray,
    slip: FloatArray,
    features: FloatArray,
    force: FloatArray,
    at_force: FloatArray,
    out: FloatArray,
) -> None:
    """out (6,) = e of each row; NaN where its readings are missing."""
    for axle in range(2):
        side_model = side_slip = 0.0
        for wheel in range(2 * axle, 2 * axle + 2):
            g_x, g_y = slip[L.ALONG + wheel], slip[L.ACROSS + wheel]
            theta = math.sqrt(g_x * g_x + g_y * g_y) / pair[wheel % 2]
            ratio = ratio_at(curve, theta)
            share = features[F.LOAD + wheel]
            side_model += share * ratio * g_y
            side_slip += share * g_y
            out[wheel] = (
                math.nan
                if math.isnan(features[F.ROLL + wheel])
                else slip[L.SCALE_X + axle] * distance(at_force[wheel] - g_x, force[wheel] - ratio * g_x)
            )
        out[4 + axle] = (
            math.nan
            if math.isnan(force[4 + axle])
            else slip[L.SCALE_Y + axle] * distance(at_force[4 + axle] - side_slip, force[4 + axle] - side_model)
        )
