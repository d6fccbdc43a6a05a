"""The measurement equations of one node: residuals between slip and force by total least squares.

Legend
    mu          friction of the node [1]
    g_x, g_y    linear force over load, slope*stiffness factor*slip [1]
    theta       hypot(g_x, g_y)/mu, normalised slip
    e_b         force minus the tyre's force at the measured slip, over load [1]
    e_a         slip at the measured force by the inverse tyre, minus the measured slip, as linear force over load [1]
    e           sign(e_b)*|e_a*e_b|/sqrt(e_a^2 + e_b^2): distance to the tyre curve [1]

Rows: the four wheels along, then the two axles across. In the linear range e weighs slip and force alike; on the flat
and beyond the peak it is the force that decides, so a sliding wheel says what its friction is (errata, what made the
difference, 1). An axle takes one mean slip; its wheels share the side force by load.
"""

from __future__ import annotations

import math

from edge_agent.dynamics.parameters import P
from edge_agent.dynamics.slip import wheel_position
from edge_agent.dynamics.tyres import TINY, magic_formula, magic_formula_inverse
from edge_agent.estimators.friction_mixture.block import F
from edge_agent.estimators.friction_mixture.constants import C, X
from schemas.numeric import FloatArray, compiled

ROWS = 6
FLATTEST = 0.03  # a sliding wheel's slip is not quite arbitrary: its inertia holds it for a block
SLOW_M_S = 0.5  # slip's denominator is kept above it


@compiled
def distance(along: float, across: float) -> float:
    """e of e_a = along and e_b = across; an infinite e_a (force beyond the peak) leaves e_b."""
    if math.isinf(along):
        return across
    size = math.hypot(along, across)
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
def steepness(g_x: float, g_y: float, theta: float, ratio: float, shape: float) -> float:
    """Change of the force along by the linear force along, at least FLATTEST: 1 at small slip, 0 on the flat."""
    square = g_x * g_x + g_y * g_y
    if square < TINY:
        return 1.0
    b = theta / shape
    bend = math.cos(shape * math.atan(b)) / (1.0 + b * b)
    return max((bend * g_x * g_x + ratio * g_y * g_y) / square, FLATTEST)


@compiled
def told(value: float, mean: float, force: float, telling: float) -> float:
    """A log stiffness drawn towards its mean where the force is too small to tell it from noise of the slip."""
    if math.isnan(force):
        return mean
    return mean + (value - mean) * force * force / (force * force + telling * telling)


@compiled
def slips_at_force(mu: float, shape: float, leak: float, features: FloatArray, out: FloatArray) -> None:
    """out (6,): linear force over load at which the tyre of the node gives the measured force of each row."""
    for wheel in range(4):
        force, side = features[F.FORCE + wheel], features[F.SIDE + wheel // 2]
        across = 0.0 if math.isnan(side) else side + leak * features[F.SIDE_LEAK + wheel // 2]
        out[wheel] = _at_force(mu, shape, force, across)
    for axle in range(2):
        first = 2 * axle
        along = (
            features[F.LOAD + first] * features[F.FORCE + first]
            + features[F.LOAD + first + 1] * features[F.FORCE + first + 1]
        )
        side = features[F.SIDE + axle] + leak * features[F.SIDE_LEAK + axle]
        out[4 + axle] = _at_force(mu, shape, side, along)


@compiled
def _at_force(mu: float, shape: float, force: float, other: float) -> float:
    """Linear force over load along `force` where another component acts across it."""
    size = math.hypot(force, other)
    if size < TINY:
        return 0.0
    theta = magic_formula_inverse(size / mu, shape)
    if math.isinf(theta):
        return math.copysign(math.inf, force)
    return mu * theta * force / size


@compiled
def residuals(
    row: FloatArray,
    constants: FloatArray,
    mu: float,
    x: FloatArray,
    mean: FloatArray,
    features: FloatArray,
    at_force: FloatArray,
    out: FloatArray,
    slopes: FloatArray,
) -> None:
    """out (6,) = e of each row at state x (n,) of the beginning of the block; NaN where its readings are missing."""
    cos, sin = features[F.COS], features[F.SIN]
    leak, rate, shape = x[X.LEAK_Y], features[F.YAW_RATE], constants[C.SHAPE]
    vx = cos * x[X.VX] + sin * x[X.VY] + gained(features, F.GAIN, x, 0)
    vy = cos * x[X.VY] - sin * x[X.VX] + gained(features, F.GAIN, x, 1)
    for axle in range(2):
        offset = x[X.STEER] if axle == 0 else 0.0
        blind = math.isnan(features[F.SIDE + axle])  # slip across is then guesswork, and must not bend the force along
        first = 2 * axle
        ln_kx = told(
            x[X.LN_KX],
            mean[X.LN_KX],
            max(abs(features[F.FORCE + first]), abs(features[F.FORCE + first + 1])),
            constants[C.TELLING_X],
        )
        ln_ky = told(x[X.LN_KY], mean[X.LN_KY], features[F.SIDE + axle], constants[C.TELLING_Y])
        slope_x, slope_y = row[P.SLOPE_X] * math.exp(ln_kx), row[P.SLOPE_Y] * math.exp(ln_ky)
        scale_x, scale_y = (
            math.exp(-constants[C.STIFFNESS_SHARE_X] * ln_kx),
            math.exp(-constants[C.STIFFNESS_SHARE_Y] * ln_ky),
        )
        side_model = side_slip = 0.0
        for wheel in range(2 * axle, 2 * axle + 2):
            px, py = wheel_position(row, wheel)
            ahead, left = vx - py * rate, vy + px * rate
            along = features[F.STEER_COS + wheel] * ahead + features[F.STEER_SIN + wheel] * left
            across = features[F.STEER_COS + wheel] * left - features[F.STEER_SIN + wheel] * ahead
            speed = max(abs(along), SLOW_M_S)
            rolling = features[F.ROLL + wheel]
            known = not math.isnan(rolling)
            g_x = slope_x * (rolling - along) / speed if known else features[F.FORCE + wheel]
            g_y = 0.0 if blind else slope_y * (offset - across / speed)
            theta = math.hypot(g_x, g_y) / mu
            ratio = magic_formula(theta, shape, 0.0) / theta if theta > TINY else 1.0
            slopes[wheel] = steepness(g_x, g_y, theta, ratio, shape) if known else 1.0
            share = features[F.LOAD + wheel]
            side_model += share * ratio * g_y
            side_slip += share * g_y
            out[wheel] = (
                scale_x * distance(at_force[wheel] - g_x, features[F.FORCE + wheel] - ratio * g_x)
                if known
                else math.nan
            )
        side = features[F.SIDE + axle] + leak * features[F.SIDE_LEAK + axle]
        out[4 + axle] = (
            math.nan if math.isnan(side) else scale_y * distance(at_force[4 + axle] - side_slip, side - side_model)
        )
