"""The driver of a simulated vehicle, who follows an endless route and brakes before junctions.
Black ice surprises the driver, because it looks like the road around it.

The driver steers to a point ahead on the lane (pure pursuit). The target speed follows from the
lane's speed profile and the budget q. The budget is an acceleration: a share of the *believed*
grip, limited to a comfortable value. The believed grip follows the appearance of the road ahead,
falls fast when wheels slide, and recovers slowly. At random times, traffic ahead makes the driver
brake. Other vehicles are not seen: each vehicle drives as if it were alone, so that a drive does
not depend on the number of vehicles.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from edge_agent.dynamics.parameters import Parameter
from edge_agent.lab.simulation.counter_rng import uniform
from edge_agent.lab.simulation.friction import PatchColumn, look_up
from edge_agent.lab.simulation.plant import strongest_pull
from edge_agent.lab.simulation.roads import LanePoint
from edge_agent.lab.simulation.state import Motion, Wheel
from schemas.numeric import FloatArray, IntArray
from schemas.runtime.jit import compiled
from schemas.thresholds import GRAVITY

Lanes: TypeAlias = tuple[FloatArray, IntArray, IntArray, FloatArray, IntArray]
"""The arrays of a `Network`, in this order: points, first, size, spacing, ways."""
Key: TypeAlias = np.uint64
KeyArray: TypeAlias = NDArray[np.uint64]


class Driver(IntEnum):
    """Index of a state variable of one simulated driver (an array of float64)."""

    STEER = 0  # [rad] mean road-wheel angle, delayed by the driver's arms
    FORCE = 1  # [N] longitudinal force, delayed by the driver's foot
    BELIEF = 2  # grip that the driver believes in
    STYLE = 3  # share of the believed grip that the driver uses
    COMFORT = 4  # [m/s^2] largest acceleration that the driver accepts
    CRUISE = 5  # [m/s] speed on a dry open road
    WOBBLE = 6  # [m] amplitude of the lateral movement in the lane
    SHORT = 7  # [m] distance to the next point of the lane
    STOPS = 8  # share of the windows ALERT_S in which the driver stops and waits
    # rise of the road to the left [1]; it changes gradually from one bend to the next
    CROSS_SLOPE = 9
    WARNED_IN = 10  # [s] remaining time until the driver reacts to a warning
    WARNED_START = 11  # [m] distance to the start of the stretch with a warning
    WARNED_END = 12  # [m] distance to the end of the stretch; 0 or less: no warning
    WARNED_SPEED = 13  # [m/s] advised speed on the stretch with a warning
    WARNED_MU = 14  # expected grip on the stretch with a warning


class Route(IntEnum):
    """Index of a variable of one driver's position on the route (int64)."""

    LANE = 0
    POINT = 1  # next point of the lane
    WAY = 2  # index of the lane that follows this one
    TURNS = 3  # number of completed lanes


ARMS_S: Final = 0.12  # [s] lag of the steering
FOOT_S: Final = 0.2  # [s] lag of the pedals
LOOKING_S: Final = 0.6  # [s] travel time to the place whose appearance the driver judges
# Time constants of the believed grip if the road ahead looks worse, or better.
WORSE_S: Final = 0.5
BETTER_S: Final = 2.5
ALARM_S: Final = 0.7  # [s] time constant with which the believed grip falls while wheels slide
SLIDING: Final = 3.5  # normalised slip, well beyond the peak, that a driver notices
LEAST_BELIEF: Final = 0.12
# [s] travel time before a stretch with a warning at which the driver assumes its grip: three times
# WORSE_S.
PREPARED_S: Final = 1.5
# [m/s^2] deceleration towards a stretch with a warning: only engine braking, because the stretch
# may begin earlier.
WARNED_BRAKES: Final = 1.0
# Factor for the used share of the grip on a stretch with a warning, where the driver hardly uses
# the pedals. Braking on one axle, or an unequal distribution of braking, reaches the limit at half
# of the available grip.
CAREFUL: Final = 0.5
SLOWEST: Final = 3.0  # [m/s] minimum target speed, unless the driver stops
LARGEST_STEER: Final = 0.55  # [rad]
# [rad] largest slip angle of the front wheels; more steering gives no more lateral force.
LARGEST_SLIP_ANGLE: Final = 0.09
# Traffic ahead makes the driver brake at the beginning of a window of ALERT_S, with the probability
# ALERT_SHARE, for ALERT_LENGTH_S.
ALERT_S: Final = 7.0
ALERT_SHARE: Final = 0.45
ALERT_LENGTH_S: Final = 1.5
STOP_LENGTH_S: Final = 5.0  # [s] duration of braking and waiting, within a window of ALERT_S
STOPPING: Final = 0.6  # share of the budget with which the driver brakes to a stop
RESTING: Final = 0.3  # [m/s] below this speed, the driver holds the car by the brake on any slope
LEAST_BRAKING: Final = 0.35  # share of the budget that remains for braking in the tightest bend
# [m/s^2] minimum braking demand of a driver whose speed is much too high, on any road
FRIGHT: Final = 2.5
TOO_FAST: Final = 1.4  # squared speed over squared target speed from which FRIGHT applies
PULL: Final = 0.85  # share of the driven wheels' grip that the driver uses for driving
WOBBLE_HZ: Final = 0.11
ROUTE_STREAM: Final = 10
ALERT_STREAM: Final = 11
# First counter, in the random stream of alerts, of the numbers that decide in which windows the
# driver stops.
STOP_DRAW: Final = 1 << 32


@compiled
def ways_of(ways: IntArray, lane: int) -> int:
    """Return the number of lanes that continue from the end of lane number `lane`. `ways` has the
    numbers of these lanes, one row per lane.
    """
    count = 0
    while count < ways.shape[1] and ways[lane, count] >= 0:
        count += 1
    return count


@compiled
def follow(x: FloatArray, route: IntArray, lanes: Lanes, key: Key) -> float:
    """Advance the route state `route` (lane and point on it) to the position of the vehicle with
    the state `x`. At the end of a lane, the next lane is chosen at random.

    Return the distance [m] from the vehicle to the next point of the lane, at most the distance
    between two points.
    """
    points, first, size, spacing, ways = lanes
    while True:
        lane = route[Route.LANE]
        point = route[Route.POINT]
        row = points[first[lane] + point]
        along = (x[Motion.X] - row[LanePoint.X]) * row[LanePoint.COS] + (
            x[Motion.Y] - row[LanePoint.Y]
        ) * row[LanePoint.SIN]
        if not along > 0.0:
            return float(min(-along, spacing[lane]))
        if point + 1 < size[lane]:
            route[Route.POINT] = point + 1
            continue
        route[Route.LANE] = ways[lane, route[Route.WAY]]
        route[Route.POINT] = 0
        route[Route.TURNS] += 1
        route[Route.WAY] = int(uniform(key, route[Route.TURNS]) * ways_of(ways, route[Route.LANE]))


@compiled
def place_ahead(
    driver: FloatArray, route: IntArray, lanes: Lanes, distance: float
) -> tuple[int, float]:
    """Return the position `distance` [m] ahead of the vehicle on its route: the row of a lane point
    in the table of points, and the metres beyond that point. `driver` is the driver's state,
    `route` the vehicle's place on the route.

    The random choice of the route is made only one lane in advance. Beyond the end of the next
    lane, the function assumes the first continuation of each lane.
    """
    _, first, size, spacing, ways = lanes
    lane = route[Route.LANE]
    way = route[Route.WAY]
    left = max(distance - driver[Driver.SHORT] + route[Route.POINT] * spacing[lane], 0.0)
    while True:
        length = (size[lane] - 1) * spacing[lane]
        if left <= length:
            point = int(left / spacing[lane])
            return int(first[lane] + point), float(left - point * spacing[lane])
        left -= length
        lane = ways[lane, way]
        way = 0


@compiled
def budget(driver: FloatArray) -> float:
    """Return the budget q: the acceleration [m/s^2] that the driver with the state `driver` is
    ready to demand from the tyres.
    """
    style = driver[Driver.STYLE] * (
        CAREFUL if heeds_warning(driver) and driver[Driver.WARNED_START] <= 0.0 else 1.0
    )
    return float(min(style * driver[Driver.BELIEF] * GRAVITY, driver[Driver.COMFORT]))


@compiled
def cruise(driver: FloatArray) -> float:
    """Return the speed that the driver with the state `driver` chooses on an open road [m/s]; the
    speed is lower where the driver believes that the road is slippery.
    """
    return float(driver[Driver.CRUISE] * math.sqrt(min(1.0, 0.25 + 1.1 * driver[Driver.BELIEF])))


@compiled
def update_belief(driver: FloatArray, looks: float, wheels: FloatArray, dt: float) -> None:
    """Update the grip that the driver believes in (part of the state `driver`) after `dt` [s]. This
    grip depends on `looks`, the friction that the road ahead seems to have, and on whether wheels
    slide, as `wheels` (forces and slips of the wheels) shows.
    """
    lag = WORSE_S if looks < driver[Driver.BELIEF] else BETTER_S
    driver[Driver.BELIEF] += (looks - driver[Driver.BELIEF]) * -math.expm1(-dt / lag)
    for i in range(4):
        if wheels[Wheel.THETA, i] > SLIDING:
            driver[Driver.BELIEF] *= math.exp(-dt / ALARM_S)
            break
    driver[Driver.BELIEF] = max(driver[Driver.BELIEF], LEAST_BELIEF)


@compiled
def advance_warning(driver: FloatArray, vx: float, dt: float) -> None:
    """Advance the warning stored in the driver's state `driver` by `dt` [s]: reduce the remaining
    reaction time by `dt`, and the distances to the stretch's start and end by `vx` * `dt`.
    """
    if driver[Driver.WARNED_END] > 0.0:
        driver[Driver.WARNED_IN] -= dt
        driver[Driver.WARNED_START] -= vx * dt
        driver[Driver.WARNED_END] -= vx * dt


@compiled
def heeds_warning(driver: FloatArray) -> bool:
    """Return True if the driver with the state `driver` takes a warning into account now: there is
    a warning, and the reaction time has passed.
    """
    return bool(driver[Driver.WARNED_END] > 0.0 and driver[Driver.WARNED_IN] <= 0.0)


@compiled
def traffic_braking(t: float, key: Key) -> float:
    """Return the braking that traffic ahead demands at time t [s], as a share of the driver's
    budget (acceleration that the driver accepts). The share is 0 most of the time; `key` is the
    random key of the traffic.
    """
    window = int(t / ALERT_S)
    if t - window * ALERT_S > ALERT_LENGTH_S or uniform(key, 2 * window) > ALERT_SHARE:
        return 0.0
    return 0.6 + 0.4 * uniform(key, 2 * window + 1)


@compiled
def is_stopping(t: float, share: float, key: Key) -> bool:
    """Return True if the driver is stopping or waiting now.

    The driver stops at the beginning of some time windows of length ALERT_S. These windows are
    chosen at random; each is chosen with probability `share`.
    """
    window = int(t / ALERT_S)
    return bool(
        share > 0.0
        and t - window * ALERT_S < STOP_LENGTH_S
        and uniform(key, STOP_DRAW + window) < share
    )


@compiled
def warned_square(driver: FloatArray, route: IntArray, lanes: Lanes) -> float:
    """Return the square of the driver's target speed [m^2/s^2] at the start of a stretch of which
    the driver was warned.

    The target speed is the smaller of two speeds, but at least SLOWEST. One is the advised speed.
    The other is the speed that the bends and junctions ahead allow with the grip that the warning
    announces.
    """
    points, first, size, _, _ = lanes
    row = place_ahead(driver, route, lanes, max(driver[Driver.WARNED_START], 0.0))[0]
    lane = route[Route.LANE]
    stays = first[lane] <= row < first[lane] + size[lane]
    profile = points[row, LanePoint.PROFILE + (route[Route.WAY] if stays else 0)]
    q = min(
        CAREFUL * driver[Driver.STYLE] * max(driver[Driver.WARNED_MU], LEAST_BELIEF) * GRAVITY,
        driver[Driver.COMFORT],
    )
    return float(max(min(driver[Driver.WARNED_SPEED] ** 2, q * profile), SLOWEST**2))


@compiled
def profile_ahead(driver: FloatArray, route: IntArray, lanes: Lanes, distance: float) -> float:
    """Return the lane's speed profile `distance` [m] ahead of the vehicle: the squared speed that
    bends and junctions allow per unit of the driver's budget [m].
    """
    points, first, size, spacing, _ = lanes
    lane = route[Route.LANE]
    row, beyond = place_ahead(driver, route, lanes, distance)
    last = first[lane] + size[lane] - 1
    stays = first[lane] <= row <= last
    column = LanePoint.PROFILE + route[Route.WAY]
    if not stays:
        here = points[first[lane] + route[Route.POINT], column]
        return float(min(here, points[row, LanePoint.PROFILE]))
    profile = points[row, column]
    if row < last:
        profile += (points[row + 1, column] - profile) * beyond / spacing[lane]
    return float(profile)


@compiled
def wished_acceleration(
    x: FloatArray,
    driver_and_route: tuple[FloatArray, IntArray],
    lanes: Lanes,
    p: FloatArray,
    t: float,
    key: Key,
) -> float:
    """Return the longitudinal acceleration [m/s^2] that the driver demands at time `t` [s]. `x` is
    the vehicle's state, `driver_and_route` the driver's state and place on the route, `p` the
    vehicle's parameters, and `key` the random key of the traffic.
    """
    driver, route = driver_and_route
    vx = x[Motion.VX]
    q = budget(driver)
    reach = max(2.0, 0.5 * vx)
    aim = min(q * profile_ahead(driver, route, lanes, reach), cruise(driver) ** 2)
    if heeds_warning(driver):
        aim = min(
            aim,
            warned_square(driver, route, lanes)
            + 2.0 * WARNED_BRAKES * max(driver[Driver.WARNED_START] - reach, 0.0),
        )
    wish = (max(aim, SLOWEST**2) - vx * vx) / (2.0 * reach)
    across = min(abs(vx * x[Motion.YAW_RATE]) / q, 1.0)
    longitudinal = math.sqrt(1.0 - across * across)  # share of the budget left by cornering
    # Share of the driving force on the axle that drives more; this axle carries half of the weight.
    driven = max(p[Parameter.DRIVE_FRONT], 1.0 - p[Parameter.DRIVE_FRONT])
    gas = min(
        PULL * driver[Driver.BELIEF] * GRAVITY * min(1.0, 0.5 / driven),
        0.8 * q,
        strongest_pull(p, vx) / p[Parameter.MASS],
    )
    alarm = traffic_braking(t, key)
    if alarm > 0.0 and vx > SLOWEST + 1.0:
        wish = min(wish, -alarm * q)
    if is_stopping(t, driver[Driver.STOPS], key):
        wish = -STOPPING * q
    hardest = max(q, FRIGHT) if vx * vx > TOO_FAST * aim else q
    return float(min(max(wish, -max(longitudinal, LEAST_BRAKING) * hardest), longitudinal * gas))


@compiled
def wished_force(
    p: FloatArray, driver: FloatArray, vx: float, acceleration: float, along: float
) -> float:
    """Return the longitudinal force [N] that a driver demands to reach an `acceleration` [m/s^2] at
    the speed `vx` [m/s], limited by tyres and engine. `p` are the vehicle's parameters, and
    `driver` is the driver's state. `along` [m/s^2] is the acceleration by gravity along the road.
    """
    driven = max(p[Parameter.DRIVE_FRONT], 1.0 - p[Parameter.DRIVE_FRONT])
    most = min(
        PULL * driver[Driver.BELIEF] * GRAVITY * min(1.0, 0.5 / driven),
        strongest_pull(p, vx) / p[Parameter.MASS],
    )
    return float(p[Parameter.MASS] * min(acceleration - along, max(most, acceleration)))


@compiled
def wished_steer(
    x: FloatArray, driver: FloatArray, route: IntArray, lanes: Lanes, p: FloatArray, t: float
) -> float:
    """Return the mean road-wheel angle [rad] with which the driver steers on a circle to a point
    ahead. `x` is the vehicle's state, `driver` the driver's state, `p` the vehicle's parameters and
    `route` the place on the route. The angle is limited to the angles that the front tyres can
    follow.
    """
    vx = max(x[Motion.VX], SLOWEST)
    base = p[Parameter.TO_FRONT] + p[Parameter.TO_REAR]
    number, beyond = place_ahead(driver, route, lanes, 2.5 + 0.45 * vx)
    row = lanes[0][number]
    offset = driver[Driver.WOBBLE] * math.sin(
        2.0 * math.pi * WOBBLE_HZ * t + 1e3 * driver[Driver.WOBBLE]
    )
    dx = row[LanePoint.X] + row[LanePoint.COS] * beyond - row[LanePoint.SIN] * offset - x[Motion.X]
    dy = row[LanePoint.Y] + row[LanePoint.SIN] * beyond + row[LanePoint.COS] * offset - x[Motion.Y]
    c = math.cos(x[Motion.YAW])
    s = math.sin(x[Motion.YAW])
    forward = c * dx + s * dy + p[Parameter.TO_REAR]
    left = c * dy - s * dx
    # After a spin, turn the car around. Otherwise the point would stay straight behind it.
    if forward < 0.0:
        return math.copysign(LARGEST_STEER, left)
    steer = math.atan(2.0 * base * left / max(forward * forward + left * left, 1.0))
    drift = math.atan2(x[Motion.VY] + p[Parameter.TO_FRONT] * x[Motion.YAW_RATE], vx)
    steer = min(max(steer, drift - LARGEST_SLIP_ANGLE), drift + LARGEST_SLIP_ANGLE)
    return min(max(steer, -LARGEST_STEER), LARGEST_STEER)


@compiled
def drive(
    vehicle: tuple[FloatArray, FloatArray, FloatArray],
    driver_and_route: tuple[FloatArray, IntArray],
    world: tuple[Lanes, FloatArray],
    now: tuple[float, float, float],
    keys: tuple[Key, Key],
) -> None:
    """Advance a driver and the place on the route by one sample. Afterwards the driver's state
    contains the road-wheel angle (STEER) and the force (FORCE) that the driver now demands.

    `vehicle` is the vehicle's state, its parameters, and the forces and slips of its wheels at the
    last sample. `driver_and_route` is the driver's state and the place on the route. `world` is the
    lanes and the friction table. `now` is the time [s], the length of the sample [s] and the
    acceleration by gravity along the road [m/s^2]. `keys` are the random keys of route and traffic.
    """
    x, p, wheels = vehicle
    driver, route = driver_and_route
    lanes, friction = world
    t, dt, along = now
    driver[Driver.SHORT] = follow(x, route, lanes, keys[0])
    number, _ = place_ahead(driver, route, lanes, max(LOOKING_S * x[Motion.VX], 0.0))
    point = lanes[0][number]
    looks = look_up(friction, PatchColumn.LOOKS, t, point[LanePoint.X], point[LanePoint.Y])
    advance_warning(driver, x[Motion.VX], dt)
    if heeds_warning(driver) and driver[Driver.WARNED_START] <= PREPARED_S * x[Motion.VX]:
        looks = min(looks, driver[Driver.WARNED_MU])
    update_belief(driver, looks, wheels, dt)
    acceleration = wished_acceleration(x, driver_and_route, lanes, p, t, keys[1])
    force = wished_force(p, driver, x[Motion.VX], acceleration, along)
    if x[Motion.VX] < RESTING and is_stopping(t, driver[Driver.STOPS], keys[1]):
        force = -p[Parameter.MASS] * (STOPPING * budget(driver) + abs(along))
    driver[Driver.FORCE] += (force - driver[Driver.FORCE]) * -math.expm1(-dt / FOOT_S)
    driver[Driver.STEER] += (
        wished_steer(x, driver, route, lanes, p, t) - driver[Driver.STEER]
    ) * -math.expm1(-dt / ARMS_S)
