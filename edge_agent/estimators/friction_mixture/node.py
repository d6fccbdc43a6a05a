"""One node of the mixture: the cubature filter of the vehicle, given the friction under its two sides.

Legend
    m, L        mean (n,) and square root of the covariance, L*L' = P          (n, n)
    A           measurement deviations in the axes of L's columns              (6, ACTIVE)
    f, a        row of A that is taken in, and its variance f'f + r^2
    D           derivative of the rows by a state that they depend on linearly

The rows bend with velocity and stiffness only: the third-degree cubature rule is taken in those four dimensions, and
leak, steering, shape and gain enter by D, exactly (a Rao-Blackwellised rule). Rows are taken in one after the other
(Potter 1963): L <- L*(I - g*f*f'), with g such that no covariance is ever subtracted.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from edge_agent.estimators.friction_mixture.block import F
from edge_agent.estimators.friction_mixture.constants import ACTIVE, CURVED, STATES, C, X
from edge_agent.estimators.friction_mixture.curve import Curve
from edge_agent.estimators.friction_mixture.residuals import (
    ROWS,
    L,
    bends,
    forces,
    gained,
    residuals,
    slips,
    steepness,
)
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

LEAST_VARIANCE = 1e-18


class Nominal(NamedTuple):
    """Prior of the states that are properties of vehicle or sensor; velocity has none."""

    mean: Annotated[FloatArray, STATES]
    std: Annotated[FloatArray, STATES]
    time: Annotated[FloatArray, STATES]  # [s] of their return to it


class Room(NamedTuple):
    """Arrays that an update writes before it reads them."""

    slip: Annotated[FloatArray, L.LENGTH]
    bent: Annotated[FloatArray, ROWS]
    force: Annotated[FloatArray, ROWS]
    at_force: Annotated[FloatArray, ROWS]
    base: Annotated[FloatArray, ROWS]
    ahead: Annotated[FloatArray, ROWS]
    behind: Annotated[FloatArray, ROWS]
    even: Annotated[FloatArray, ROWS]
    middle: Annotated[FloatArray, CURVED, ROWS]
    derivative: Annotated[FloatArray, ACTIVE, ROWS]
    deviation: Annotated[FloatArray, ROWS, ACTIVE]
    own: Annotated[FloatArray, ROWS]  # variances of noise
    noise: Annotated[FloatArray, ROWS]
    taken: Annotated[FloatArray, ACTIVE]
    point: Annotated[FloatArray, STATES]


@compiled
def factorize(covariance: FloatArray, root: FloatArray) -> None:
    """root (n, n) = lower-triangular Cholesky factor of covariance (n, n), of which the lower half is read."""
    n = covariance.shape[0]
    for j in range(n):
        total = covariance[j, j]
        for k in range(j):
            total -= root[j, k] * root[j, k]
        diagonal = math.sqrt(max(total, LEAST_VARIANCE))
        root[j, j] = diagonal
        share = 1.0 / diagonal
        for i in range(j + 1, n):
            total = covariance[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            root[i, j] = total * share
            root[j, i] = 0.0


@compiled
def linearize(
    row: FloatArray,
    constants: FloatArray,
    curve: Curve,
    nominal: Nominal,
    pair: FloatArray,
    mean: FloatArray,
    features: FloatArray,
    room: Room,
) -> float:
    """Fill room.derivative, leave room.force and room.at_force as at the mean, and return the price of sliding."""
    gained_x, gained_y = gained(features, F.GAIN, mean, 0), gained(features, F.GAIN, mean, 1)
    price = 0.0
    for i in range(STATES):
        room.point[i] = mean[i]
    for state in range(ACTIVE, CURVED - 1, -1):  # at the mean, then with each moved, STEER last
        step = 0.0 if state == ACTIVE else 0.5 * nominal.std[state]
        room.point[state] += step
        if state == ACTIVE or state == X.STEER:
            slips(row, constants, mean, room.point, gained_x, gained_y, features, room.slip)
        if state == ACTIVE:
            bends(curve, pair, room.slip, features, room.bent)
            price = weigh_slopes(curve, pair, features, room.slip, constants[C.FLAT], room.own)
        forces(
            curve, pair, room.point[X.LEAK_Y], room.point[X.BEND], room.point[X.GAIN], features, room.bent, room.force,
            room.at_force,
        )  # fmt: skip
        told = room.base[:] if state == ACTIVE else room.derivative[state]
        residuals(curve, pair, room.slip, features, room.force, room.at_force, told)
        room.point[state] -= step
        if state < ACTIVE:
            for r in range(ROWS):
                told[r] = (told[r] - room.base[r]) / step
    return price


@compiled
def weigh_slopes(
    curve: Curve, pair: FloatArray, features: FloatArray, slip: FloatArray, flat: float, own: FloatArray
) -> float:
    """Fill own (6,) with the variances of the rows' noise at these slips, and return the price of sliding.

    The price is what wheels on the flat of the curve cost: a sliding wheel may have any slip, so its density is spread
    thin.
    """
    price = 0.0
    for axle in range(2):
        across = 0.0
        for wheel in range(2 * axle, 2 * axle + 2):
            mu, g_x, g_y = pair[wheel % 2], slip[L.ALONG + wheel], slip[L.ACROSS + wheel]
            along = steepness(curve, g_x, g_y, mu)
            across += features[F.LOAD + wheel] * steepness(curve, g_y, g_x, mu)
            own[wheel] = features[F.NOISE + wheel] ** 2 - unfelt(along) * features[F.SLIP_NOISE + wheel]
            if not math.isnan(features[F.ROLL + wheel]):
                price -= min(math.log(along / flat), 0.0)
        own[4 + axle] = features[F.NOISE + 4 + axle] ** 2 - unfelt(across) * features[F.SLIP_NOISE + 4 + axle]
    return price


@compiled
def unfelt(slope: float) -> float:
    """Share of slip noise that a residual on a curve of this slope does not feel, of the half it feels on slope 1.

    Along the normal of a line of slope k, noise of the slip counts by k^2/(1 + k^2) (errors in variables). Taken for as
    large on the flat as on the rise, it would favour nodes whose wheels slide: they do not feel it.
    """
    return 0.5 - slope * slope / (1.0 + slope * slope)


@compiled
def spread(
    row: FloatArray,
    constants: FloatArray,
    curve: Curve,
    pair: FloatArray,
    mean: FloatArray,
    root: FloatArray,
    features: FloatArray,
    room: Room,
) -> None:
    """Fill room.deviation (A), room.base with the predicted rows and room.even with the variance of their bend."""
    gained_x, gained_y = gained(features, F.GAIN, mean, 0), gained(features, F.GAIN, mean, 1)
    scale = math.sqrt(CURVED)
    for r in range(ROWS):
        room.base[r] = room.even[r] = 0.0
    for column in range(CURVED):
        for sign in range(2):
            signed = scale if sign == 0 else -scale
            told = room.ahead[:] if sign == 0 else room.behind[:]
            for i in range(ACTIVE):
                room.point[i] = mean[i] + signed * root[i, column]
            room.point[X.STEER] = mean[X.STEER]
            slips(row, constants, mean, room.point, gained_x, gained_y, features, room.slip)
            residuals(curve, pair, room.slip, features, room.force, room.at_force, told)
        for r in range(ROWS):
            total = 0.5 * (room.ahead[r] - room.behind[r]) / scale
            for state in range(CURVED, ACTIVE):
                total += room.derivative[state, r] * root[state, column]
            room.deviation[r, column] = total
            room.middle[column, r] = 0.5 * (room.ahead[r] + room.behind[r])
            room.base[r] += room.middle[column, r] / CURVED
    for r in range(ROWS):
        for column in range(CURVED):
            room.even[r] += (room.middle[column, r] - room.base[r]) ** 2 / CURVED
        for column in range(CURVED, ACTIVE):
            total = 0.0
            for state in range(CURVED, ACTIVE):
                total += room.derivative[state, r] * root[state, column]
            room.deviation[r, column] = total


@compiled
def update_node(
    row: FloatArray,
    constants: FloatArray,
    curve: Curve,
    nominal: Nominal,
    pair: FloatArray,
    mean: FloatArray,
    root: FloatArray,
    features: FloatArray,
    inflation: float,
    innovation: FloatArray,
    theoretical: FloatArray,
    room: Room,
) -> tuple[float, float, float, float, int]:
    """Cubature update of one node with R times `inflation`; mean (n,) and root (n, n) are changed.

    Writes innovation (6,) and its theoretical variance without the inflation (6,).
    Returns the log-likelihood with the inflated R, the change of `stretch`, the log-likelihood with the plain R (rows
    taken as independent), the normalised innovation squared with the plain R, and the number of rows.
    """
    price = linearize(row, constants, curve, nominal, pair, mean, features, room)
    spread(row, constants, curve, pair, mean, root, features, room)
    plain = square = 0.0
    for r in range(ROWS):
        innovation[r] = -room.base[r]
        own = room.own[r]
        variance = room.even[r]
        for column in range(ACTIVE):
            variance += room.deviation[r, column] ** 2
        theoretical[r] = variance + own
        excess = room.base[r] ** 2 / constants[C.HUBER] ** 2 - variance
        room.noise[r] = max(own * inflation, excess) + room.even[r]
        if not math.isnan(room.base[r]):
            ratio = room.base[r] ** 2 / theoretical[r]
            square += ratio
            plain -= 0.5 * (ratio + math.log(2.0 * math.pi * theoretical[r]))
    for r in range(ROWS):
        room.base[r] = innovation[r]
    before = stretch(mean, nominal)
    loss, used = take_rows(constants, mean, root, room)
    keep_within(mean, constants, nominal)
    moved = stretch(mean, nominal) - before
    return -loss - constants[C.SLIDING_PRICE] / inflation * price, moved, plain, square, used


@compiled
def stretch(mean: FloatArray, nominal: Nominal) -> float:
    """How far what a node believes of vehicle and sensors is from their prior [nat]; mean (n,)."""
    total = 0.0
    for i in range(X.LN_KX, mean.shape[0]):
        total += 0.5 * ((mean[i] - nominal.mean[i]) / nominal.std[i]) ** 2
    return total


@compiled
def take_rows(constants: FloatArray, mean: FloatArray, root: FloatArray, room: Room) -> tuple[float, int]:
    """Take in the innovations room.base (6,) one by one; returns half the normalised square with its price, and rows.

    What ln det S costs is weighed by AXLE_PRICE for the axles and nothing for the wheels.
    """
    n, loss, used = mean.shape[0], 0.0, 0
    for r in range(ROWS):
        if math.isnan(room.base[r]):
            continue
        used += 1
        variance = room.noise[r]
        for c in range(ACTIVE):
            room.taken[c] = room.deviation[r, c]
            variance += room.taken[c] ** 2
        share = 1.0 / variance
        gain = share / (1.0 + math.sqrt(room.noise[r] * share))
        step = room.base[r] * share
        loss += 0.5 * room.base[r] * step
        if r >= 4:
            loss += 0.5 * constants[C.AXLE_PRICE] * math.log(variance)
        for i in range(n):
            along = 0.0
            for c in range(ACTIVE):
                along += root[i, c] * room.taken[c]
            mean[i] += along * step
            along *= gain
            for c in range(ACTIVE):
                root[i, c] -= along * room.taken[c]
        for k in range(r + 1, ROWS):
            along = 0.0
            for c in range(ACTIVE):
                along += room.deviation[k, c] * room.taken[c]
            room.base[k] -= along * step
            along *= gain
            for c in range(ACTIVE):
                room.deviation[k, c] -= along * room.taken[c]
    return loss, used


@compiled
def keep_within(mean: FloatArray, constants: FloatArray, nominal: Nominal) -> None:
    """Keep what is a property of vehicle or sensor within what it can be; mean (n,)."""
    far = constants[C.FARTHEST]
    for i in range(X.LN_KX, mean.shape[0]):
        middle, reach = nominal.mean[i], far * nominal.std[i]
        mean[i] = min(max(mean[i], middle - reach), middle + reach)


@compiled
def predict_node(
    mean: FloatArray,
    root: FloatArray,
    nominal: Nominal,
    turn_cos: float,
    turn_sin: float,
    gain: FloatArray,
    keep: FloatArray,
    noise: FloatArray,
    covariance: FloatArray,
) -> None:
    """Advance one node over a block: exact rotation, gained velocity gains (8,) of memory.G, process variances (n,).

    The map is affine, and the cubature of an affine map is the map itself: covariance <- F*L*(F*L)' + diag(noise).
    What is a property of vehicle or sensor returns to its prior by keep (n,). root is changed to F*L.
    """
    n = mean.shape[0]
    for j in range(n):
        column = root[:, j]
        a, b = column[X.VX], column[X.VY]
        gained_x, gained_y = gained(gain, 0, column, 0) - gain[0], gained(gain, 0, column, 1) - gain[1]
        column[X.VX] = turn_cos * a + turn_sin * b + gained_x
        column[X.VY] = turn_cos * b - turn_sin * a + gained_y
        for i in range(X.LN_KX, n):
            column[i] *= keep[i]
    vx, vy = mean[X.VX], mean[X.VY]
    gained_x, gained_y = gained(gain, 0, mean, 0), gained(gain, 0, mean, 1)
    mean[X.VX] = turn_cos * vx + turn_sin * vy + gained_x
    mean[X.VY] = turn_cos * vy - turn_sin * vx + gained_y
    for i in range(X.LN_KX, n):
        mean[i] = nominal.mean[i] + keep[i] * (mean[i] - nominal.mean[i])
    for i in range(n):
        for j in range(i + 1):
            total = noise[i] if i == j else 0.0
            for k in range(n):
                total += root[i, k] * root[j, k]
            covariance[i, j] = covariance[j, i] = total
