"""Lanes for the simulated vehicles, made from SUMO's traffic: each vehicle has its own lane, with
the speeds that it had in SUMO.

SUMO gives only routes and speeds; our vehicle model simulates the tyres. A driver keeps SUMO's
speed where the driver believes that the road is dry, and drives slower elsewhere. Where a vehicle
stands still in SUMO, our vehicle creeps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from edge_agent.lab.simulation import Scenario
from edge_agent.lab.simulation.driver import SLOWEST
from edge_agent.lab.simulation.friction import DRY, ICE, SNOW, WET, Patch
from edge_agent.lab.simulation.place import Origin
from edge_agent.lab.simulation.roads import Network, network_of, resample_line
from edge_agent.lab.simulation.scenarios import drawn_town
from schemas.numeric import FloatArray
from tests.benchmarks.sumo import Sumo

HELSINKI: Final = Origin(60.17, 24.94)
STEP_S: Final = 0.5
TRIPS: Final = ("--intermediate", "3")  # intermediate places, which make trips of at least 3 km
CHANGE_S: Final = ("--lanechange.duration", "3")  # [s] SUMO's default is instantaneous
LEAP_M: Final = 20.0  # a longer step means that SUMO moved the vehicle out of a jam
SMOOTH_M: Final = 13  # [m] length over which a path is smoothed
# [m/s^2] median acceleration limit of the simulated drivers; such a driver keeps SUMO's speed.
USUAL_Q: Final = 5.0
WET_AREAS = 4
SNOW_AREAS = 2
ICE_PATCHES = 24


class Drive(NamedTuple):
    """One vehicle's path in SUMO's traffic: points a metre apart (n, 2) [m], and its speed at each
    point (n,) [m/s].
    """

    line: FloatArray
    speed: FloatArray


@dataclass(frozen=True)
class Streets(Scenario):
    """Scenario of the vehicle simulation whose lanes are given instead of computed from roads."""

    lanes: Network | None = None

    @property
    def network(self) -> Network:
        """Return the road network of this scenario, which consists of the given lanes."""
        assert self.lanes is not None
        return self.lanes


def simulate_drives(sumo: Sumo, vehicles: int, seconds: int, seed: int) -> list[Drive]:
    """Simulate traffic with SUMO. Return the drives of the first `vehicles` vehicles whose path is
    long enough for a drive of `seconds` seconds.

    Raises:
        RuntimeError: there are too few such vehicles.
    """
    sumo.draw_trips(6 * vehicles, 2.0, seed, *TRIPS)
    fixes = pd.read_parquet(sumo.drive_trips(6 * vehicles + 900, STEP_S, seed, *CHANGE_S))
    found = [_make_drive(rows) for _, rows in fixes.groupby("vehicle_id", sort=False)]
    least = seconds * float(np.quantile(fixes.vehicle_speed[fixes.vehicle_speed > SLOWEST], 0.9))
    long = [one for one in found if one is not None and len(one.line) >= least]
    if len(long) < vehicles:
        raise RuntimeError(f"{len(long)} of {vehicles} trips are {least:.0f} m long")
    return long[:vehicles]


def _make_drive(rows: pd.DataFrame) -> Drive | None:
    """Return the drive of one vehicle, computed from its positions in SUMO's table `rows`. Return
    None if the vehicle jumped or did not move.
    """
    x, y = HELSINKI.from_latlon(rows.vehicle_y.to_numpy(), rows.vehicle_x.to_numpy())
    step = np.hypot(np.diff(x), np.diff(y))
    moves = np.r_[True, step > 0.05]
    if moves.sum() < 10 or step.max() > LEAP_M:
        return None
    line = np.column_stack([x, y])[moves]
    speed = rows.vehicle_speed.to_numpy(float)[moves]
    run = np.r_[0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T))]
    even = np.arange(0.0, run[-1], 1.0)
    window = np.hanning(SMOOTH_M + 2)[1:-1]
    window /= window.sum()
    smooth = [
        np.convolve(
            np.pad(np.interp(even, run, one), SMOOTH_M // 2, mode="edge"), window, mode="valid"
        )
        for one in (*line.T, speed)
    ]
    path = resample_line(np.column_stack(smooth[:2]))
    return Drive(
        path,
        np.interp(np.linspace(0.0, 1.0, len(path)), np.linspace(0.0, 1.0, len(even)), smooth[2]),
    )


def make_streets(found: list[Drive], seed: int) -> Streets:
    """Return a scenario whose lanes are the paths of the drives `found`, on random hills, with some
    wet, snowy and icy parts.
    """
    allowed = [np.maximum(one.speed, SLOWEST) ** 2 / USUAL_Q for one in found]
    lanes = network_of(
        [one.line for one in found], [[k] for k in range(len(found))], len(found), allowed
    )
    usual = drawn_town(seed)
    rng = np.random.default_rng(seed)
    points = np.concatenate([one.line for one in found])
    patches = []
    for kind, mu, count, size in (
        ("wet", WET, WET_AREAS, 500.0),
        ("snow", SNOW, SNOW_AREAS, 300.0),
    ):
        for k in range(count):
            x, y = points[rng.integers(len(points))]
            patches.append(
                Patch(f"{kind} {k}", x, y, size, size, mu * rng.uniform(0.85, 1.15), looks=mu)
            )
    for k in range(ICE_PATCHES):
        line = found[rng.integers(len(found))].line
        at = rng.integers(5, len(line) - 5)
        along = line[at + 3] - line[at - 3]
        (x, y) = line[at]
        angle = float(np.arctan2(along[1], along[0]))
        patches.append(Patch(f"ice {k}", x, y, 40.0, 14.0, ICE * rng.uniform(0.6, 1.1), angle))
    return Streets(
        name="helsinki",
        about="the centre of Helsinki",
        junctions={},
        roads=(),
        background=DRY * rng.uniform(0.9, 1.1),
        patches=tuple(patches),
        relief=usual.relief,
        origin=HELSINKI,
        lanes=replace(lanes, starts=np.arange(len(found))),
    )
