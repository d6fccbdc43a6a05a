"""Tyre curves in normalised slip, and their combination in two directions.

Legend
    theta       normalised slip, K*slip/(mu*Fz) [1]
    K           slip stiffness, independent of mu [N] or [N/rad]
    mu          peak adhesion [1]
    Fz          wheel load [N]
    f           curve with f(0) = 0, f'(0) = 1, peak 1; the force is mu*Fz*f(theta)
    c, e        shape and curvature of the Magic Formula [1]

Because K does not depend on mu, the curve has the same initial slope on all roads. Friction shows
only where the curve bends (errata of papers 002 and 004). Sources: Pacejka, Tyre and Vehicle
Dynamics, chapters 3 (brush) and 4; Dugoff, Fancher and Segel, SAE 700377.
"""

from __future__ import annotations

import math

from schemas.runtime.jit import compiled, inlined

TINY = 1e-12  # a smaller slip counts as zero: it has no direction and no force


@compiled
def magic_formula(theta: float, c: float, e: float) -> float:
    """Return the tyre force over its largest value by the Magic Formula, f(theta) = sin(c*atan(b -
    e*(b - atan(b)))) with b = theta/c.

    `theta` is the normalised slip; f is odd in it. c and e are shape and curvature, 1 < c <= 2, e <
    1.
    """
    b = theta / c
    return math.sin(c * math.atan(b - e * (b - math.atan(b))))


@compiled
def brush(theta: float) -> float:
    """Return the tyre force over its largest value by the brush model with parabolic pressure, at
    the normalised slip theta: theta - theta|theta|/3 + theta^3/27 up to theta = 3, then 1. The
    curve is odd in theta.
    """
    size = min(abs(theta), 3.0)
    return math.copysign(size - size * size / 3.0 + size**3 / 27.0, theta)


@compiled
def dugoff(theta: float) -> float:
    """Return the tyre force over its largest value by the Dugoff model, at the normalised slip
    theta >= 0: theta up to one half, then 1 - 1/(4*theta).
    """
    return theta if theta <= 0.5 else 1.0 - 0.25 / theta


@compiled
def combined_magic(
    slip: tuple[float, float],
    stiffness: tuple[float, float],
    mu: float,
    load: float,
    c: float,
    e: float,
) -> tuple[float, float]:
    """Return the forces (Fx, Fy) [N] of one wheel in its own frame at combined slip (longitudinal
    and lateral) with the Magic Formula.

    Similarity method: the normalised slips of both directions form a vector. The Magic Formula
    gives the size of the force for the length of this vector. The force has the vector's direction.

    `slip` is (longitudinal slip, tangent of the slip angle) [1], and `stiffness` (longitudinal [N],
    lateral [N/rad]). `mu` is the friction [1], and `load` the wheel load [N]. `c` and `e` are shape
    and curvature of the Magic Formula [1].
    """
    grip = mu * load
    if grip <= 0.0:
        return 0.0, 0.0
    theta_x = stiffness[0] * slip[0] / grip
    theta_y = stiffness[1] * slip[1] / grip
    theta = math.sqrt(theta_x * theta_x + theta_y * theta_y)
    if theta < TINY:
        return 0.0, 0.0
    gain = grip * magic_formula(theta, c, e) / theta
    return gain * theta_x, gain * theta_y


@inlined
def combined_dugoff(
    slip: tuple[float, float], stiffness: tuple[float, float], mu: float, load: float
) -> tuple[float, float]:
    """Return the forces (Fx, Fy) [N] of one wheel in its own frame at combined slip with the Dugoff
    curve f.

    Similarity method: the normalised slips of both directions form a vector of length theta. The
    force has the direction of this vector and the size mu*load*f(theta). Up to theta = 1/2,
    f(theta) = theta, so that the force is stiffness times slip. Beyond, f(theta) = 1 - 1/(4*theta),
    which has no falling branch.

    `slip` is (longitudinal slip, tangent of the slip angle) [1], and `stiffness` (longitudinal [N],
    lateral [N/rad]). `mu` is the friction [1], and `load` the wheel load [N].
    """
    grip = max(mu * load, 0.0)
    free_x = stiffness[0] * slip[0]
    free_y = stiffness[1] * slip[1]
    free = math.sqrt(free_x * free_x + free_y * free_y)
    share = grip / free  # 1/theta
    gain = 1.0 if 2.0 * free <= grip else share * (1.0 - 0.25 * share)
    return gain * free_x, gain * free_y
