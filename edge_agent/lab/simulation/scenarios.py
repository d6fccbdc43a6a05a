"""Table of the scenarios (simulated areas). Each has a road network, its friction over time, and
its position on earth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np

from edge_agent.lab.simulation.counter_rng import checked_seed, key_of, uniform
from edge_agent.lab.simulation.friction import (
    DRY,
    ICE,
    SNOW,
    WET,
    Patch,
    PatchColumn,
    friction_table,
    look_up_many,
)
from edge_agent.lab.simulation.place import GOTHENBURG, Origin
from edge_agent.lab.simulation.relief import LEVEL, Relief, Wave
from edge_agent.lab.simulation.roads import LanePoint, Network, Road, build_network
from edge_agent.lab.simulation.unevenness import COBBLES, uneven_surface
from schemas.errors import InputError
from schemas.numeric import FloatArray

DRAWN: Final = "hills-"  # prefix of the names of random scenarios; the seed follows
WINTER: Final = "winter-"  # prefix of the names of random scenarios with winter roads
WINTER_STREAM: Final = 22
# Kinds of patches on the lanes of a winter town, which are assigned in random order. On a lane with
# the empty name, the road does not change.
ON_LANES: Final = (
    *("braking",) * 3,
    *("bend",) * 3,
    *("left",) * 2,
    *("right",) * 2,
    *("ruts",) * 3,
    *("",) * 3,
)
TRACK_M: Final = 1.5  # [m] distance between the ruts
DRAWN_STREAM: Final = 21


@dataclass(frozen=True)
class Scenario:
    """A simulated area. `junctions` maps names to positions (x, y) [m]. The road has the friction
    `background`, except on the `patches`; where patches overlap, the last one counts.
    """

    name: str
    about: str
    junctions: dict[str, tuple[float, float]]
    roads: tuple[Road, ...]
    background: float
    patches: tuple[Patch, ...]
    relief: Relief = LEVEL
    origin: Origin = field(default=GOTHENBURG)
    air_temperature: float = 1.0  # outside temperature [degrees Celsius]

    @cached_property
    def network(self) -> Network:
        """Return the road network of the scenario: its lanes and connectors (lanes through
        junctions).
        """
        return build_network(self.junctions, self.roads)

    @cached_property
    def table(self) -> FloatArray:
        """Return the friction table, in which `friction.look_up` finds the friction of a point: one
        row per patch of road surface; the first row is the background.
        """
        return friction_table(self.background, self.patches)

    @property
    def events(self) -> tuple[Patch, ...]:
        """Return the patches of road surface (ice, snow) that appear during the drive, sorted by
        start time.
        """
        return tuple(
            sorted((p for p in self.patches if math.isfinite(p.start)), key=lambda p: p.start)
        )

    def friction(self, t: FloatArray | float, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the friction μ at the times t [s] and points (x, y) [m], in the arrays' common
        shape.
        """
        # Copy the arrays. At its first call, the compiler checks whether they may be written, and
        # numpy warns if a broadcast view is checked.
        t, x, y = (np.array(a, dtype=np.float64, order="C") for a in np.broadcast_arrays(t, x, y))
        return look_up_many(
            self.table, int(PatchColumn.MU), t.ravel(), x.ravel(), y.ravel()
        ).reshape(x.shape)

    def to_latlon(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (latitude, longitude) [deg] of points with local coordinates (x, y) [m]."""
        return self.origin.to_latlon(x, y)

    def from_latlon(
        self, latitude: FloatArray, longitude: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the local coordinates (x, y) [m] of positions [deg]."""
        return self.origin.from_latlon(latitude, longitude)


def demo() -> Scenario:
    """Return the demonstration scenario: four streets from a crossing to a winding ring road. The
    road is dry in the north-east, elsewhere wet, snowy or icy, with slush along one street.

    At 70 s black ice appears on the eastern street, where drivers brake before the crossing and
    accelerate after it.
    """
    return Scenario(
        name="demo",
        about="a crossing and a ring of 2 km; black ice appears at 70 s",
        junctions={
            "centre": (0.0, 0.0),
            "north": (14.0, 140.0),
            "east": (190.0, 16.0),
            "south": (0.0, -140.0),
            "west": (-190.0, -20.0),
        },
        roads=(
            Road("centre", "north", ((0.0, 45.0), (14.0, 95.0)), 45.0),
            Road("centre", "east", ((70.0, 0.0), (130.0, 16.0)), 60.0),
            Road("centre", "south"),
            Road("centre", "west", ((-60.0, 0.0), (-115.0, -20.0)), 45.0),
            Road("north", "east", ((150.0, 150.0), (190.0, 105.0)), 28.0),
            Road("east", "south", ((190.0, -90.0), (140.0, -140.0)), 32.0),
            Road("south", "west", ((-60.0, -160.0), (-120.0, -115.0), (-190.0, -130.0)), 26.0),
            Road("west", "north", ((-190.0, 95.0), (-130.0, 150.0), (-60.0, 122.0)), 30.0),
        ),
        background=DRY,
        patches=(
            Patch("wet north-west", -110.0, 90.0, 220.0, 160.0, WET, looks=WET),
            Patch("snow south-west", -110.0, -80.0, 220.0, 180.0, SNOW, looks=SNOW),
            Patch(
                "slush in the west of the southern street",
                -4.0,
                -75.0,
                70.0,
                4.0,
                SNOW,
                math.pi / 2,
                looks=WET,
            ),
            Patch(
                "slush east of the southern street",
                4.0,
                -75.0,
                70.0,
                4.0,
                SNOW,
                math.pi / 2,
                looks=WET,
            ),
            Patch("ice on the southern street", -33.0, -151.0, 36.0, 14.0, ICE, 0.32, looks=0.25),
            Patch("black ice", 40.0, 0.0, 44.0, 12.0, ICE, start=70.0),
        ),
    )


def hills() -> Scenario:
    """Return the demonstration town with hills: slopes, crossfall, and banked bends.

    Slopes reach 8 %. Slopes on ice are small, because no car could climb steep ice.
    """
    relief = Relief(
        (Wave(0.05, 620.0, 0.6, 1.2), Wave(0.04, 290.0, 2.2, 0.4), Wave(0.03, 150.0, -0.5, 2.0)),
        crossfall=0.025,
        banking=0.5,
    )
    return replace(
        demo(),
        name="hills",
        about="the town of the demo on slopes of up to 8 %, with crossfall",
        relief=relief,
    )


def frost() -> Scenario:
    """Return the hilly town in the first frost: at 35 s black ice appears at five places in its
    eastern half.

    The demonstration uses this town. Every driver meets the new ice several times, so that warned
    and unwarned drivers can be compared.
    """
    town = hills()
    kept = tuple(patch for patch in town.patches if not math.isfinite(patch.start))
    places = (
        ("Brogatan", 40.0, 0.0, 0.0),
        ("Kyrkogatan", 14.0, 112.0, math.pi / 2),
        ("Norra Ringvägen", 66.0, 144.0, 0.0),
        ("Östra Ringvägen", 190.0, 62.0, math.pi / 2),
        ("Östra Ringvägen south", 190.0, -34.0, math.pi / 2),
    )
    ice = tuple(
        Patch(f"black ice on {name}", x, y, 44.0, 12.0, ICE, angle, start=35.0)
        for name, x, y, angle in places
    )
    return replace(
        town,
        name="frost",
        about="the town on hills; at 35 s black ice appears at five places",
        patches=(*kept, *ice),
    )


def drawn_town(seed: int) -> Scenario:
    """Return the demonstration town with friction and hills drawn randomly by the seed, for
    evaluations.

    The friction of dry, wet, snowy and icy places lies anywhere in the usual range of its kind.
    Evaluations use towns with other seeds than tuning. Black ice appears at 30 s.
    """
    key = key_of(checked_seed(seed), DRAWN_STREAM)
    usual = demo()
    kinds = {DRY: (0.78, 1.05), WET: (0.50, 0.72), SNOW: (0.25, 0.42), ICE: (0.10, 0.195)}
    now = {
        kind: low + (high - low) * uniform(key, k)
        for k, (kind, (low, high)) in enumerate(kinds.items())
    }
    patches = tuple(
        replace(
            p,
            mu=now[p.mu],
            looks=now.get(p.looks, p.looks) if p.looks is not None else None,
            start=30.0 if math.isfinite(p.start) else p.start,
        )
        for p in usual.patches
    )
    waves = tuple(
        Wave(
            peak, length, 2.0 * math.pi * uniform(key, 10 + k), 2.0 * math.pi * uniform(key, 20 + k)
        )
        for k, (peak, length) in enumerate(((0.045, 620.0), (0.035, 290.0), (0.02, 150.0)))
    )
    relief = Relief(waves, crossfall=0.03 * uniform(key, 30), banking=0.5)
    return replace(
        usual,
        name=f"{DRAWN}{seed}",
        about="a town on randomly drawn hills",
        background=now[DRY],
        patches=patches,
        relief=relief,
    )


def with_cobbles(town: Scenario, seed: int) -> Scenario:
    """Return the scenario with cobbles on all roads, on which the wheel loads swing."""
    return replace(town, relief=replace(town.relief, surface=uneven_surface(COBBLES, seed)))


def winter(seed: int) -> Scenario:
    """Return the `drawn_town` with this seed, with winter conditions on its lanes.

    Each lane has one of these: black ice where drivers brake before a junction, or in a bend; ice
    only under the left or the right wheels; two ruts of slush; or nothing. Drivers do not see ice;
    slush looks wet.
    """
    town = drawn_town(seed)
    key = key_of(checked_seed(seed), WINTER_STREAM)
    network = town.network
    order = sorted(range(len(ON_LANES)), key=lambda k: uniform(key, k))
    patches = list(town.patches)
    for lane in range(network.roads):
        kind = ON_LANES[order[lane % len(ON_LANES)]]
        patches += _patches_on_lane(
            kind, network.lane(lane), lane, [uniform(key, 100 + 4 * lane + k) for k in range(3)]
        )
    temperature = -6.0 + 7.0 * uniform(key, 99)
    about = "a winter town on randomly drawn hills"
    return replace(
        town,
        name=f"{WINTER}{seed}",
        about=about,
        patches=tuple(patches),
        air_temperature=temperature,
    )


def _patches_on_lane(kind: str, points: FloatArray, lane: int, numbers: list[float]) -> list[Patch]:
    """Return the patches of ice or slush for one lane in winter. `kind` is the kind of patch (see
    `winter`), and `points` are the points of the lane. `numbers` are three random numbers in [0, 1)
    from which position, length and friction of the patches follow.
    """
    place, size, grip = numbers
    ice = 0.10 + 0.095 * grip
    slush = 0.28 + 0.12 * grip
    last = len(points) - 1
    if kind == "braking":
        length = 12.0 + 13.0 * size
        row = last - int(4.0 + 6.0 * place + 0.5 * length)
        return [_lay_patch(f"ice before junction {lane}", points, row, (length, 3.6), ice)]
    if kind == "bend":
        edge = len(points) // 5
        row = edge + int(np.argmax(np.abs(points[edge:-edge, LanePoint.CURVATURE])))
        return [_lay_patch(f"ice in bend {lane}", points, row, (9.0 + 5.0 * size, 4.5), ice)]
    if kind in ("left", "right"):
        length = 25.0 + 15.0 * size
        side = 1.5 if kind == "left" else -1.5
        row = last - int(8.0 + 15.0 * place + 0.5 * length)
        return [_lay_patch(f"ice {kind} of lane {lane}", points, row, (length, 3.0), ice, side)]
    if kind == "ruts":
        length = 25.0 + 20.0 * size
        row = last - int(5.0 + 20.0 * place + 0.5 * length)
        return [
            _lay_patch(
                f"rut {side:+.0f} of lane {lane}",
                points,
                row,
                (length, 0.7),
                slush,
                side * 0.5 * TRACK_M,
            )
            for side in (-1.0, 1.0)
        ]
    return []


def _lay_patch(
    name: str, points: FloatArray, row: int, size: tuple[float, float], mu: float, left: float = 0.0
) -> Patch:
    """Return a patch of road of `size` (length, width) [m] with friction `mu`. It lies at row `row`
    of the lane's `points`, along the lane and `left` [m] to the left of its centre line.
    """
    point = points[min(max(row, 0), len(points) - 1)]
    x = float(point[LanePoint.X] - left * point[LanePoint.SIN])
    y = float(point[LanePoint.Y] + left * point[LanePoint.COS])
    angle = math.atan2(point[LanePoint.SIN], point[LanePoint.COS])
    return Patch(
        name, x, y, size[0], size[1], mu, angle, looks=WET if name.startswith("rut") else None
    )


def tiny() -> Scenario:
    """Return a triangle of three streets for tests: half of its road is snow, and an ice patch
    appears after 5 s.
    """
    return Scenario(
        name="test",
        about="a triangle of 300 m, half of it snow; ice appears at 5 s",
        junctions={"a": (0.0, 0.0), "b": (110.0, 0.0), "c": (50.0, 90.0)},
        roads=(Road("a", "b"), Road("b", "c"), Road("c", "a")),
        background=DRY,
        patches=(
            Patch("snow in the west", -20.0, 50.0, 140.0, 160.0, SNOW, looks=SNOW),
            Patch("ice", 80.0, 0.0, 20.0, 10.0, ICE, start=5.0),
        ),
    )


SCENARIOS: Final = {scenario.name: scenario for scenario in (demo(), hills(), frost(), tiny())}


def scenario_named(name: str | Scenario) -> Scenario:
    """Return the scenario with that name. "hills-7" is the `drawn_town` with seed 7, and "winter-7"
    the same town in winter.

    Raises:
        InputError: there is no such scenario.
    """
    if isinstance(name, Scenario):
        return name
    if name.startswith(DRAWN) and name[len(DRAWN) :].isdecimal():
        return drawn_town(int(name[len(DRAWN) :]))
    if name.startswith(WINTER) and name[len(WINTER) :].isdecimal():
        return winter(int(name[len(WINTER) :]))
    if name not in SCENARIOS:
        choices = f"choose one of {', '.join(SCENARIOS)}, {DRAWN}SEED, {WINTER}SEED"
        raise InputError("scenario", f"there is no scenario {name!r}", choices)
    return SCENARIOS[name]
