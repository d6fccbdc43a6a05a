"""Simulated country that consists of copies of one recorded town: the positions of its vehicles,
and the reports of each vehicle over time.

    regions    50, in three adjacent zones (map squares of zoom 7) with 17, 17 and 16 regions; one
               service per zone; the r-th region of a zone has a number of vehicles proportional to
               1/sqrt(r)
    towns      four copies of the recorded town in each region
    vehicles   each repeats a part of the drive of one recorded vehicle, shifted by whole tiles; if
               several vehicles in a town repeat the same drive, their starting points are spread
               evenly over the drive
    reports    each vehicle sends ROWS visits (passes through map cells) every PERIOD_S, and these
               visits last PERIOD_S, as in slow traffic

The sender and the observer compute the same country independently, from the seed and the recorded
town's observations.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from fleet_service.lab.end_to_end import OBSERVATIONS, read_observations
from schemas import grid, keys, wire
from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import NS
from schemas.wire import Kind

VEHICLES: Final = 100_000
RATE: Final = 20_000.0  # observations/s
ROWS: Final = 10  # observations in a batch
PERIOD_S: Final = VEHICLES * ROWS / RATE
ZONES: Final = (17, 17, 16)  # regions in each zone
# Position of the towns in a region, in tiles from its corner.
TOWNS: Final = ((2, 2), (9, 2), (2, 9), (9, 9))
ALIKE: Final = 8  # vehicles of a town that share one recorded drive
# Batches that a vehicle sends before it repeats them. After the first round, growth of memory is
# not due to new places.
LOOP: Final = 3
_TILES: Final = 1 << (grid.TILE_ZOOM - grid.REGION_ZOOM)  # tiles along a region's side
_REGIONS: Final = 1 << (grid.REGION_ZOOM - grid.ZONE_ZOOM)  # regions along a zone's side
_CELLS: Final = 1 << (grid.CELL_ZOOM - grid.TILE_ZOOM)  # cells along a tile's side


class Chunk(NamedTuple):
    """ROWS successive visits (passes through map cells) of one vehicle, which it sends as one
    batch.

    Attributes:
        message: the batch; vehicle, place and time are filled in when it is sent.
        x, y: column and row of each position, counted in cells from the north-western tile of the
            town, with fractions.
        cell_x, cell_y: column and row of the reported cells, counted from the same tile.
        enter, leave: begin and end of each visit, as the share of the batch's duration that remains
            until the last visit ends: 1 at the begin of the first visit, 0 at the end of the last.
    """

    message: Any
    x: FloatArray
    y: FloatArray
    cell_x: IntArray
    cell_y: IntArray
    enter: FloatArray
    leave: FloatArray


class Country:
    """Simulated country: home region and repeated drive of each vehicle.

    Args:
        folder: folder of the recorded town's observations.
        seed: seed of the distribution of vehicles over towns.
        vehicles: number of vehicles.
    """

    def __init__(self, folder: Path, seed: int, vehicles: int = VEHICLES) -> None:
        columns = read_observations(folder / OBSERVATIONS)
        x, y = grid.deinterleave(columns["cell"])
        corner = np.array([x.min(), y.min()]) // _CELLS * _CELLS
        assert max(np.ptp(x), np.ptp(y)) < 6 * _CELLS, (
            "the town does not fit between its neighbours"
        )
        self._home = grid.deinterleave(grid.zone_of(columns["cell"][:1]))
        self.drives = [_cut_chunks(columns, who, corner) for who in np.unique(columns["vehicle"])]
        self.drives = [drive for drive in self.drives if drive]
        self.regions = [
            self._locate_region(zone, k) for zone, count in enumerate(ZONES) for k in range(count)
        ]
        weight = np.concatenate([_compute_shares(count) for count in ZONES])
        rng = np.random.default_rng(seed)
        self.region = rng.choice(len(weight), vehicles, p=weight / weight.sum())
        self.town = rng.integers(0, len(TOWNS), vehicles)
        self.drive, self.begin = np.zeros((2, vehicles), np.int64)
        for place in np.unique(self.region * len(TOWNS) + self.town):
            who = np.flatnonzero(self.region * len(TOWNS) + self.town == place)
            many = max(1, min(len(who) // ALIKE, len(self.drives)))
            chosen = rng.permutation(len(self.drives))[:many]
            self.drive[who] = chosen[np.arange(len(who)) % many]
            for one in chosen:
                same = who[self.drive[who] == one]
                self.begin[same] = np.arange(len(same)) * len(self.drives[one]) // len(same)

    def _locate_region(self, zone: int, k: int) -> tuple[int, int]:
        """Return column and row of a region in the world's grid of regions. The region is number
        `k` of the zone (map square that one service serves) number `zone`.
        """
        zone_x, zone_y = (int(side[0]) for side in self._home)
        return (zone_x + zone - 1) * _REGIONS + k % _REGIONS, zone_y * _REGIONS + 2 + k // _REGIONS

    def list_expressions(self) -> list[str]:
        """Return, for each service, the Zenoh key expression of the regions that it serves: those
        of one zone (map square of zoom 7).
        """
        first = [sum(ZONES[:zone]) for zone in range(len(ZONES))]
        parts = [keys.chunks(int(self.region_id(k)), grid.REGION_ZOOM).split("/") for k in first]
        return ["/".join((*part[:2], "*")) for part in parts]

    def region_id(self, k: int) -> int:
        """Return the quadint (number of a grid square) of region number `k` of the country."""
        x, y = self.regions[k]
        return int(grid.interleave(np.array([x]), np.array([y]))[0])

    def encode_report(self, vehicle: int, turn: int, boot: int) -> tuple[str, bytes]:
        """Return the Zenoh key and the bytes of the report that the vehicle number `vehicle` sends
        in turn (period of PERIOD_S) number `turn`. The report's last visit ends now.
        """
        drive = self.drives[self.drive[vehicle]]
        chunk = drive[(self.begin[vehicle] + turn % LOOP) % len(drive)]
        k = int(self.region[vehicle])
        (region_x, region_y) = self.regions[k]
        (east, south) = TOWNS[self.town[vehicle]]
        x0 = (region_x * _TILES + east) * _CELLS
        y0 = (region_y * _TILES + south) * _CELLS
        side = 1 << grid.CELL_ZOOM
        now = time.time_ns()
        message = chunk.message
        message.vehicle = f"car-{vehicle:06}"
        message.boot = boot
        message.region = self.region_id(k)
        message.seq = turn + 1
        message.first_held = turn + 1
        message.cell[:] = grid.interleave(chunk.cell_x + x0, chunk.cell_y + y0).tolist()
        message.longitude[:] = ((chunk.x + x0) / side * 360.0 - 180.0).tolist()
        message.latitude[:] = np.degrees(
            np.arctan(np.sinh(np.pi * (1.0 - 2.0 * (chunk.y + y0) / side)))
        ).tolist()
        message.enter_time[:] = (now - (chunk.enter * PERIOD_S * NS).astype(np.int64)).tolist()
        message.leave_time[:] = (now - (chunk.leave * PERIOD_S * NS).astype(np.int64)).tolist()
        return keys.observation_key(message.region, message.vehicle), message.SerializeToString()


def _compute_shares(count: int) -> FloatArray:
    share = 1.0 / np.sqrt(np.arange(1, count + 1))
    return np.asarray(share / share.sum())


def _cut_chunks(columns: dict[str, Any], who: int, corner: IntArray) -> list[Chunk]:
    """Divide the visits (passages of cells) of one vehicle, in order of time, into chunks of ROWS
    visits; return the chunks. If fewer than ROWS visits remain at the end, they are left out.
    """
    mine = np.flatnonzero(columns["vehicle"] == who)
    mine = mine[np.argsort(columns["leave_time"][mine], kind="stable")]
    return [
        _make_chunk(columns, mine[at : at + ROWS], corner)
        for at in range(0, len(mine) - ROWS + 1, ROWS)
    ]


def _make_chunk(columns: dict[str, Any], rows: IntArray, corner: IntArray) -> Chunk:
    side = 1 << grid.CELL_ZOOM
    phi = np.radians(columns["latitude"][rows])
    x = (columns["longitude"][rows] + 180.0) / 360.0 * side - corner[0]
    y = (1.0 - np.arcsinh(np.tan(phi)) / np.pi) / 2.0 * side - corner[1]
    cell_x, cell_y = grid.deinterleave(columns["cell"][rows])
    last = columns["leave_time"][rows[-1]]
    spent = max(int(last - columns["enter_time"][rows[0]]), 1)
    taken = {name: columns[name][rows] for name in wire.column_types(Kind.OBSERVATION)}
    batch = wire.Batch(Kind.OBSERVATION, "car-000000", 1, 0, 1, 1, taken, "aco-fckf")
    message = wire.MESSAGES[Kind.OBSERVATION].FromString(wire.encode(batch))
    enter, leave = ((last - columns[name][rows]) / spent for name in ("enter_time", "leave_time"))
    return Chunk(message, x, y, cell_x - corner[0], cell_y - corner[1], enter, leave)
