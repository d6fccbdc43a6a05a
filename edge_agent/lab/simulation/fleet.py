"""Simulation of a fleet of vehicles that drive endlessly on a road network, computed by one
compiled function.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from edge_agent.lab.simulation.counter_rng import checked_seed, key_of, uniform
from edge_agent.lab.simulation.driver import (
    ALERT_STREAM,
    ROUTE_STREAM,
    Driver,
    KeyArray,
    Lanes,
    Route,
    drive,
    ways_of,
)
from edge_agent.lab.simulation.friction import PatchColumn, look_up
from edge_agent.lab.simulation.misaligned import memory_of
from edge_agent.lab.simulation.plant import (
    advance,
    command,
    gravity,
    ground_velocity,
    regenerate,
    start_at,
    substeps_of,
    wheel_place,
)
from edge_agent.lab.simulation.presets import nominal, one_of_a_fleet, winter_equipped
from edge_agent.lab.simulation.record import RECORD, RecordColumn, observe
from edge_agent.lab.simulation.relief import cross_slope, gradient, slope_in_body
from edge_agent.lab.simulation.roads import LanePoint, Network
from edge_agent.lab.simulation.scenarios import Scenario, scenario_named
from edge_agent.lab.simulation.sensors import (
    ROUGH_FLEET,
    ErrorColumn,
    error_row,
    noise_keys,
    sense,
    sensors_named,
)
from edge_agent.lab.simulation.state import INPUTS, STATES, Control, Motion, TrueParameter, Wheel
from edge_agent.lab.simulation.unevenness import load_swing
from schemas.errors import InputError
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.runtime.jit import compiled

ORDINARY = "mems-patchy"  # sensors of accurate vehicles, a key of SENSORS
TURN_OVER_M = 6.0  # [m] length over which the crossfall of a road changes its sign
VEHICLE_STREAM = 0
WINTER_STREAM = 4
# Largest fleet of one process in real time. Each vehicle has a session, which needs an open file,
# and systems allow 1024 by default.
LIVE_VEHICLES = 999
# Share of the windows of 7 s in which the driver of a rough (inaccurate) vehicle stops: two or
# three stops per minute.
STOPS = 0.3
# [s] time from a warning to the start of braking (Green, Transportation Human Factors 2, 2000: 1.2
# to 1.5 s).
TOLD_S = 1.5
# Multiples of this number, modulo 1, are evenly distributed for any number of vehicles.
GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True)
class Truth:
    """True values of a block of T samples, shapes (T, N) or (T, N, 4).

    Attributes:
        x, y, yaw: pose [m, m, rad].
        vx, vy: velocity [m/s].
        mu_wheel: friction at each wheel.
        utilisation: |F|/(μ F_z) of each wheel.
        yaw_rate: [rad/s].
        ax, ay: acceleration that an accelerometer measures [m/s^2].
        slope: rise of the road per metre ahead.
        theta: normalised slip of each wheel; beyond about 2.6 the wheel slides.
        abs, tcs, esc: True while this controller acts. Always False without winter equipment,
            because only winter equipment includes these controllers.
        air_temperature: outside temperature [degrees Celsius].
    """

    x: FloatArray
    y: FloatArray
    yaw: FloatArray
    vx: FloatArray
    vy: FloatArray
    mu_wheel: FloatArray
    utilisation: FloatArray
    yaw_rate: FloatArray
    ax: FloatArray
    ay: FloatArray
    slope: FloatArray
    theta: FloatArray
    abs: BoolArray
    tcs: BoolArray
    esc: BoolArray
    air_temperature: FloatArray


@compiled
def run(
    states: tuple[FloatArray, FloatArray, IntArray, FloatArray],
    parameters: FloatArray,
    ground: tuple[Lanes, FloatArray, FloatArray, FloatArray],
    keys: tuple[KeyArray, KeyArray],
    samples: tuple[int, int],
    timing: tuple[float, int],
) -> FloatArray:
    """Simulate the next T samples of N vehicles. Return records with the true values (T, N,
    RECORD), and advance the states in place.

    `states` are the states of the vehicles (N, STATES), drivers (N, len(Driver)), routes (N, 4) and
    wheels (N, 8, 4); `parameters` are those of the vehicles. `ground` is the lanes, and the tables
    of friction, relief and unevenness. `keys` are the random keys of routes and of traffic (N,).
    `samples` is the index of the first sample, and the count of samples. `timing` is the sample
    period [s], and the integration steps per sample.
    """
    vehicles, drivers, routes, all_wheels = states
    lanes, friction, relief, surface = ground
    first, steps = samples
    period, substeps = timing
    records = np.empty((steps, vehicles.shape[0], RECORD))
    u = np.zeros((INPUTS, 4))
    for n in range(vehicles.shape[0]):
        x = vehicles[n]
        driver = drivers[n]
        route = routes[n]
        wheels = all_wheels[n]
        p = parameters[n]
        for k in range(steps):
            t = (first + k) * period
            lane = lanes[0][lanes[1][route[Route.LANE]] + route[Route.POINT]]
            turned = -math.expm1(-abs(x[Motion.VX]) * period / TURN_OVER_M)
            driver[Driver.CROSS_SLOPE] += (
                cross_slope(relief, lane[LanePoint.CURVATURE]) - driver[Driver.CROSS_SLOPE]
            ) * turned
            heading = (math.cos(x[Motion.YAW]), math.sin(x[Motion.YAW]))
            east, north = gradient(
                relief, (x[Motion.X], x[Motion.Y]), heading, driver[Driver.CROSS_SLOPE]
            )
            u[Control.TILT, 0], u[Control.TILT, 1] = slope_in_body(east, north, x[Motion.YAW])
            now = (t, period, gravity(u)[0])
            drive((x, p, wheels), (driver, route), (lanes, friction), now, (keys[0][n], keys[1][n]))
            command(p, u, driver[Driver.STEER], driver[Driver.FORCE])
            if p[TrueParameter.REGENERATION] > 0.0:
                regenerate(x, p, u)
            velocity = ground_velocity(x)
            for i in range(4):
                px, py = wheel_place(x, p, i)
                u[Control.MU, i] = look_up(friction, PatchColumn.MU, t, px, py)
                u[Control.SWING, i] = load_swing(surface, (px, py), velocity)
            observe(x, p, u, wheels, records[k, n])
            advance(x, p, u, wheels, period / substeps, substeps)
    return records


def vehicle_names(vehicles: int) -> list[str]:
    """Return the names of the vehicles of a simulated fleet: sim-001, sim-002 and so on."""
    return [f"sim-{k + 1:03d}" for k in range(vehicles)]


def check_live_fleet(vehicles: int) -> None:
    """Check that one process can run a fleet of this number of vehicles in real time.

    Raises:
        InputError: the number is not from 1 to LIVE_VEHICLES.
    """
    if not 1 <= vehicles <= LIVE_VEHICLES:
        raise InputError(
            "vehicles",
            f"{vehicles} vehicles cannot drive on one machine",
            f"give a number from 1 to {LIVE_VEHICLES}",
        )


def _check_arguments(vehicles: int, rate_hz: float, rough: float, winter: float) -> None:
    if vehicles < 1:
        raise InputError("vehicles", f"{vehicles} vehicles cannot drive", "give a positive number")
    if not (math.isfinite(rate_hz) and rate_hz > 0.0):
        raise InputError("rate_hz", f"{rate_hz} is not possible", "give a positive number")
    for name, share in (("rough", rough), ("winter", winter)):
        if not 0.0 <= share <= 1.0:
            raise InputError(name, f"{share} is not a share", "give a number from 0 to 1")


class SimulatedFleet:
    """N vehicles on the roads of a scenario. A vehicle's drive depends only on its index and the
    other arguments, not on how many vehicles there are.

    Args:
        scenario: a key of SCENARIOS, or a Scenario.
        vehicles: number of vehicles.
        seed: seed of all random numbers, non-negative.
        rate_hz: sampling rate [Hz].
        rough: share of the vehicles with realistic errors: ROUGH_FLEET sensors instead of
            ORDINARY ones, and drivers who stop now and then.
        winter: share of the vehicles with `winter_equipped` tyres and controllers. If half of all
            vehicles are rough, half of those with winter equipment are rough too.

    Raises:
        InputError: an argument is out of range or unknown.
    """

    def __init__(
        self,
        scenario: str | Scenario,
        vehicles: int,
        seed: int,
        rate_hz: float,
        rough: float = 0.0,
        winter: float = 0.0,
    ) -> None:
        _check_arguments(vehicles, rate_hz, rough, winter)
        seed = checked_seed(seed)
        self.scenario = scenario_named(scenario)
        self.rate_hz = rate_hz
        self.names = vehicle_names(vehicles)
        rngs = [np.random.default_rng([seed, k, VEHICLE_STREAM]) for k in range(vehicles)]
        truths = [
            one_of_a_fleet(k, name, rng)
            for k, (name, rng) in enumerate(zip(self.names, rngs, strict=True))
        ]
        self.vehicles = [nominal(truth, rng) for truth, rng in zip(truths, rngs, strict=True)]
        self.winter = winter_ones(vehicles, winter)
        for k in np.flatnonzero(self.winter):
            truths[k] = winter_equipped(
                truths[k], np.random.default_rng([seed, int(k), WINTER_STREAM])
            )
        self._parameters = np.stack([truth.row() for truth in truths])
        self.rough = rough_ones(vehicles, rough)
        ordinary = sensors_named(ORDINARY)
        origin = self.scenario.origin
        self._errors = np.stack(
            [
                error_row(ROUGH_FLEET if self.rough[k] else ordinary, origin, seed, k)
                for k in range(vehicles)
            ]
        )
        noise = [noise_keys(seed, k) for k in range(vehicles)]
        self._noise = (
            np.array([white for white, _ in noise]),
            np.array([silence for _, silence in noise]),
        )
        self._keys = (
            np.array([key_of(seed, k, ROUTE_STREAM) for k in range(vehicles)]),
            np.array([key_of(seed, k, ALERT_STREAM) for k in range(vehicles)]),
        )
        self._states = _start_states(self.scenario.network, self._parameters, rngs)
        self._states[1][:, Driver.STOPS] = np.where(self.rough, STOPS, 0.0)
        self._states[1][:, Driver.CROSS_SLOPE] = self.scenario.relief.crossfall
        # Earlier records, which sensors with late clocks still report.
        self._previous_records = np.empty((0, vehicles, RECORD))
        self._wander = np.zeros((vehicles, 3))
        self._relief = self.scenario.relief.table
        self._surface = self.scenario.relief.surface_table
        self._next = 0
        self.truth = _truth(np.empty((0, vehicles, RECORD)), self.scenario.air_temperature)

    def step(self, steps: int) -> tuple[FloatArray, FloatArray]:
        """Simulate the next `steps` samples; return t (T, N) [s] from 0 and signals (T, N, 18).
        Afterwards the attribute `truth` has the true values of these samples.
        """
        if steps < 1:
            raise InputError(
                "steps", f"{steps} samples cannot be simulated", "give a positive number"
            )
        network = self.scenario.network
        origin = self.scenario.origin
        lanes = (network.points, network.first, network.size, network.spacing, network.ways)
        timing = (1.0 / self.rate_hz, substeps_of(self.rate_hz))
        ground = (lanes, self.scenario.table, self._relief, self._surface)
        samples = (self._next, steps)
        records = run(self._states, self._parameters, ground, self._keys, samples, timing)
        place = np.array([origin.latitude, origin.longitude, *origin.per_metre])
        known = np.concatenate([self._previous_records, records])
        lead = len(self._previous_records)
        clock = (self._next, self.rate_hz, lead)
        signals = sense(known, self._errors, self._wander, place, self._noise, clock)
        memory = memory_of(self._errors[:, ErrorColumn.MOUNTED :], self.rate_hz)
        self._previous_records = known[len(known) - min(memory, len(known)) :]
        t = np.repeat(
            (np.arange(self._next, self._next + steps) / self.rate_hz)[:, None],
            len(self.names),
            axis=1,
        )
        self._next += steps
        self.truth = _truth(records, self.scenario.air_temperature)
        return t, signals

    def route_ahead(self, k: int, length: float) -> tuple[FloatArray, FloatArray]:
        """Return the path that vehicle k will drive, at least `length` [m] long, as two arrays:
        latitudes and longitudes [deg] of points about a metre apart.
        """
        network = self.scenario.network
        key = self._keys[0][k]
        lane, point, way, turns = (int(value) for value in self._states[2][k])
        parts = []
        run = 0.0
        while run < length:
            part = network.lane(lane)[point:, [LanePoint.X, LanePoint.Y]]
            parts.append(part)
            run += len(part) * float(network.spacing[lane])
            lane = int(network.ways[lane, way])
            point = 0
            turns = turns + 1
            way = int(uniform(key, turns) * ways_of(network.ways, lane))
        line = np.concatenate(parts)
        return self.scenario.to_latlon(line[:, 0], line[:, 1])

    def warn(self, k: int, stretch: tuple[float, float], speed: float, mu: float) -> None:
        """Warn the driver of vehicle k of a slippery stretch of road. The driver responds after a
        reaction time.

        `stretch` is the start and the end of the slippery stretch as distances ahead [m]; (0, 0)
        cancels the warning. `speed` [m/s] is the advised speed and `mu` the friction to expect.
        """
        driver = self._states[1][k]
        if driver[Driver.WARNED_END] <= 0.0:
            driver[Driver.WARNED_IN] = TOLD_S
        driver[Driver.WARNED_START], driver[Driver.WARNED_END] = stretch
        driver[Driver.WARNED_SPEED] = speed
        driver[Driver.WARNED_MU] = mu


def rough_ones(vehicles: int, share: float) -> BoolArray:
    """Return an array (N,) that is True for "rough" vehicles, which have large sensor errors, as
    real cars have. They are the share `share` of all, evenly distributed over the indices. The
    value for vehicle k does not depend on N.
    """
    number = np.arange(vehicles)
    return np.asarray(np.floor((number + 1) * share) > np.floor(number * share))


def winter_ones(vehicles: int, share: float) -> BoolArray:
    """Return an array (N,) that is True for vehicles with winter equipment.

    Vehicles 0 and 1 have the same equipment, and so on in pairs. Therefore, if every second vehicle
    is "rough" (large sensor errors), so is every second one with winter equipment.
    """
    return np.repeat(rough_ones((vehicles + 1) // 2, share), 2)[:vehicles]


def _truth(records: FloatArray, air_temperature: float) -> Truth:
    x, y, yaw, vx, vy = (
        records[..., column]
        for column in (
            RecordColumn.X,
            RecordColumn.Y,
            RecordColumn.YAW,
            RecordColumn.VX,
            RecordColumn.VY,
        )
    )
    return Truth(
        x,
        y,
        yaw,
        vx,
        vy,
        mu_wheel=records[..., RecordColumn.MU : RecordColumn.MU + 4],
        utilisation=records[..., RecordColumn.UTILISATION : RecordColumn.UTILISATION + 4],
        yaw_rate=records[..., RecordColumn.YAW_RATE],
        ax=records[..., RecordColumn.AX],
        ay=records[..., RecordColumn.AY],
        slope=records[..., RecordColumn.SLOPE],
        theta=records[..., RecordColumn.THETA : RecordColumn.THETA + 4],
        abs=records[..., RecordColumn.ABS] > 0.0,
        tcs=records[..., RecordColumn.TCS] > 0.0,
        esc=records[..., RecordColumn.ESC] > 0.0,
        air_temperature=np.full(records.shape[:2], air_temperature),
    )


def _start_states(
    network: Network, parameters: FloatArray, rngs: list[np.random.Generator]
) -> tuple[FloatArray, FloatArray, IntArray, FloatArray]:
    """Return the initial states of N vehicles as arrays with N rows: motion, drivers, routes and
    wheels. Each vehicle starts at 5 m/s on a lane of the road network, with a driver whose habits
    are drawn at random.
    """
    count = len(rngs)
    vehicles = np.zeros((count, STATES))
    wheels = np.zeros((count, len(Wheel), 4))
    drivers = np.zeros((count, len(Driver)))
    routes = np.zeros((count, len(Route)), dtype=np.int64)
    end = np.cumsum(network.size[: network.roads])
    for k, rng in enumerate(rngs):
        place = int((k + 0.5) * GOLDEN % 1.0 * end[-1])
        if network.starts is not None:
            place = int(network.first[network.starts[k]])
        lane = int(np.searchsorted(end, place, side="right"))
        point = network.points[place]
        routes[k] = (lane, place - network.first[lane], 0, 0)
        start_at(
            vehicles[k],
            parameters[k],
            (
                point[LanePoint.X],
                point[LanePoint.Y],
                math.atan2(point[LanePoint.SIN], point[LanePoint.COS]),
            ),
            5.0,
        )
        drivers[k, Driver.BELIEF] = 0.3
        drivers[k, Driver.STYLE] = rng.uniform(0.65, 0.88)
        drivers[k, Driver.COMFORT] = rng.uniform(4.0, 6.5)
        drivers[k, Driver.CRUISE] = rng.uniform(12.0, 15.5)
        drivers[k, Driver.WOBBLE] = rng.uniform(0.1, 0.3)
    return vehicles, drivers, routes, wheels
