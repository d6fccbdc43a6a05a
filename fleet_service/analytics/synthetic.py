"""Synthetic archive for examples, tests and benchmarks: roads, trips, ice at night, biased
vehicles.

Its rows resemble those of the real estimator: two of three visits (passages of cells) give only a
lower bound of mu, the third gives a value of mu.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Final

import numpy as np

from fleet_service.archive.format.segments import Rows, Writer, round_to_steps
from schemas import grid, mugrid
from schemas.numeric import BoolArray, ByteArray, FloatArray, IntArray
from schemas.thresholds import NS, Z_95
from schemas.wire import Kind

START_NS: Final = 1_769_472_000 * NS  # 2026-01-27 00:00 UTC
DAY_S: Final = 86_400
LATITUDE = 57.70
LONGITUDE = 11.97
CELL_S: Final = 0.7  # [s] time in a cell at 15 m/s
ICE = 0.22
DRY = 0.85
_EXCITED: Final = 0.35  # share of visits that give a friction value
_STD: Final = 0.05


@dataclass(frozen=True)
class SyntheticFleet:
    """Size of the synthetic archive: number of rows, days, vehicles, roads, and cells per road
    (`length`). One road in every `icy` roads freezes at night.
    """

    rows: int
    days: int = 7
    vehicles: int = 2000
    roads: int = 400
    length: int = 250
    icy: int = 8
    seed: int = 0


def write_archive(root: Path, world: SyntheticFleet, segment_rows: int = 20_000) -> None:
    """Write observations to the inbox (folder of new rows) of an archive in order of time, one
    segment (file of new rows) after another.

    Raises:
        OSError: the disk is full.
    """
    writer = Writer(root, "shard-0")
    for rows in make_chunks(world):
        for start in range(0, len(rows["cell"]), segment_rows):
            part = slice(start, start + segment_rows)
            writer.write(Kind.OBSERVATION, {name: column[part] for name, column in rows.items()})


def make_chunks(world: SyntheticFleet, hours: int = 6) -> Iterator[Rows]:
    """Yield rows of observations in order of time, in chunks of `hours` hours each."""
    rng = np.random.default_rng(world.seed)
    bias = rng.normal(0.0, 0.04, world.vehicles)
    spans = world.days * 24 // hours
    for span in range(spans):
        rows = world.rows * (span + 1) // spans - world.rows * span // spans
        if rows:
            yield _make_chunk(world, rng, bias, span * hours * 3600, hours * 3600, rows)


def _make_chunk(
    world: SyntheticFleet,
    rng: np.random.Generator,
    bias: FloatArray,
    since_s: int,
    span_s: int,
    rows: int,
) -> Rows:
    trips = -(-rows // world.length)
    road = rng.integers(0, world.roads, trips)
    who = rng.integers(0, world.vehicles, trips)
    begin = since_s + rng.random(trips) * (span_s - world.length * CELL_S)
    along = np.tile(np.arange(world.length), trips)[:rows]
    trip = np.repeat(np.arange(trips), world.length)[:rows]
    seconds = begin[trip] + along * CELL_S + rng.normal(0.0, 0.05, rows)
    latitude, longitude, yaw = _draw_positions(road[trip], along, rng)
    truth = truth_of(world, road[trip], along, seconds)
    mu, used, excited = _draw_friction(rng, truth, bias[who[trip]])
    half = np.where(excited, Z_95 * _STD, 0.35)
    cell = grid.cell_of(latitude, longitude)
    names = np.array(
        [
            blake2b(f"{world.seed}/{v}".encode(), digest_size=8).hexdigest()
            for v in range(world.vehicles)
        ]
    )
    leave = START_NS + (seconds * NS).astype(np.int64)
    found = _equal_columns(rows) | {
        "enter_time": leave - int(CELL_S * NS) - rng.integers(0, 10**7, rows),
        "leave_time": leave,
        "cell": cell,
        "sector": grid.sector_of(yaw),
        "latitude": latitude,
        "longitude": longitude,
        "yaw": yaw.astype(np.float32),
        "speed": (15 + rng.normal(0, 2, rows)).astype(np.float32),
        "mu": mu.astype(np.float32),
        "mu_lower": np.maximum(mu - half, 0.05).astype(np.float32),
        "mu_upper": np.minimum(mu + half, 1.2).astype(np.float32),
        "mu_utilised": used.astype(np.float32),
        "log_likelihood": _make_likelihoods(rng, mu, used, excited),
        "health": np.where(rng.random(rows) < 0.01, 16, 0).astype(np.int32),
        "air_temperature": (5.0 - 8.0 * night_factor(seconds) + rng.normal(0, 1, rows)).astype(
            np.float32
        ),
        "vehicle": names[who[trip]],
        "boot": (who[trip] + 1) * 7919 + since_s,
        "region": grid.region_of(cell),
        "seq": trip * 64 + along // 10 + 1,
        "row": (along % 10).astype(np.int32),
        "first_held": trip * 64 + np.maximum(along // 10 - 1, 0) + 1,
        "received_at": (leave // 50_000_000 + 20) * 50_000_000 + leave // 50_000_000 % 997 * 1000,
    }
    order = np.argsort(leave, kind="stable")
    return {name: column[order] for name, column in round_to_steps(found).items()}


def _equal_columns(rows: int) -> Rows:
    """Return the columns that have the same value in all rows."""
    values = {
        "position_std": np.float32(1.5),
        "yaw_std": np.float32(0.02),
        "with_likelihood": np.True_,
        "tyre_season": np.int8(0),
        "abs_active": np.int8(-1),
        "used_longitudinal": np.float32(np.nan),
        "used_lateral": np.float32(np.nan),
        "esc_active": np.int8(-1),
        "tcs_active": np.int8(-1),
        "wiper": np.float32(np.nan),
        "estimator": np.str_("aco-fckf"),
        "late": np.False_,
        "weight": np.float32(0.75),
        "late_by": np.int64(0),
        "bias": np.float32(0.0),
        "bias_std": np.float32(0.05),
        "spread": np.float32(1.0),
        "slope": np.float32(0.4),
    }
    return {name: np.full(rows, value) for name, value in values.items()}


def _draw_friction(
    rng: np.random.Generator, truth: FloatArray, bias: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the reported friction and the used grip of n visits (n,), and a mask (n,): True for a
    visit that used enough grip to measure the friction. `truth` (n,) is the true friction, and
    `bias` (n,) the relative error of the vehicle.
    """
    rows = len(truth)
    excited = rng.random(rows) < _EXCITED
    share = np.where(excited, rng.uniform(0.62, 1.0, rows), rng.uniform(0.05, 0.5, rows))
    used = np.clip(truth * share, 0.02, 1.2)
    measured = truth * (1.0 + bias) + _STD * rng.normal(size=rows)
    guessed = np.maximum(0.62, used + 0.2) + 0.03 * rng.normal(size=rows)
    mu = np.clip(np.where(excited, measured, guessed), 0.06, 1.19)
    return mu, used, excited


def _draw_positions(
    road: IntArray, along: IntArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return positions of n vehicles on their roads, arrays (n,): latitude and longitude [deg] with
    the noise of a satellite receiver, and yaw [rad]. Roads are straight, and every second one runs
    north.
    """
    step = 360.0 / (1 << grid.CELL_ZOOM)
    north = road % 2 == 1
    row = road // 2 % 20
    column = road // 40
    x = np.where(north, row * 260 + 130, along + column * 260) * step
    y = np.where(north, along + column * 260, row * 260 + 130) * step * np.cos(np.radians(LATITUDE))
    noise = 0.3 * step * rng.normal(size=(2, len(road)))
    return (
        LATITUDE + y + noise[0] * 0.5,
        LONGITUDE + x + noise[1],
        np.where(north, np.pi / 2, 0.0) + 0.02 * noise[0],
    )


def night_factor(seconds: FloatArray) -> FloatArray:
    """Return the degree of night cold at each time `seconds` (n,), from 0 to 1. It rises from 0 at
    ten in the evening to 1 at four in the morning, falls to 0 at ten in the morning, and is 0 by
    day.
    """
    return np.clip(np.cos(2 * np.pi * (seconds / DAY_S - 4 / 24)), 0.0, 1.0)


def truth_of(
    world: SyntheticFleet, road: IntArray, along: IntArray, seconds: FloatArray
) -> FloatArray:
    """Return the true friction (n,) at n places and times: dry, except ice on the middle fifth of
    icy roads during the night.
    """
    middle = np.abs(along - world.length // 2) < world.length // 10
    return np.where((road % world.icy == 0) & middle & (night_factor(seconds) > 0.5), ICE, DRY)


def _make_likelihoods(
    rng: np.random.Generator, mu: FloatArray, used: FloatArray, excited: BoolArray
) -> ByteArray:
    """Return the log-likelihoods of the reports, (n, 32), in steps of 1/16 nat. The likelihood of a
    reported value of mu decreases on both sides of this value. The likelihood of a lower bound
    decreases only below the grip that was used.
    """
    distance = (mugrid.CENTRES - np.where(excited, mu, used)[:, None]).astype(np.float32)
    flank = rng.uniform(0.02, 0.08, (2, len(mu), 1)).astype(np.float32)
    below = 0.5 * np.square(distance / flank[0]) * (distance < 0)
    above = 0.5 * np.square(distance / flank[1]) * (distance > 0) * excited[:, None]
    # Because of contamination, no likelihood is lower than this.
    floor = rng.uniform(5.0, 12.0, (len(mu), 1)).astype(np.float32)
    slope = rng.uniform(0.0, 1.5, (len(mu), 1)).astype(np.float32) * np.abs(distance)
    nats = np.minimum(below + above, floor) + slope * excited[:, None]
    return np.asarray(
        np.clip(np.rint((nats - nats.min(axis=1, keepdims=True)) * 16), 0, 255).astype(np.uint8)
    )
