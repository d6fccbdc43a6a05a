"""Cell tracker: finds the map cell and the heading sector of each vehicle at each sample, from its
position fixes and yaw. It thereby finds the start and the end of each visit (passage of one cell).

A visit begins with a position fix in a new cell or heading sector. Fixes are noisy, and a road may
run along a border. Therefore a visit ends only when a fix lies clearly outside: CELL_MARGIN beyond
the cell, or SECTOR_KEEP beyond the sector. After FIX_HELD_S without a fix the vehicle is in no cell
(cell -1). If the yaw is unknown, the course over ground is used instead.

The module is pure (no I/O). The state between two blocks of samples is one `CellTrack` per vehicle.
Any division of the samples into blocks gives the same result.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from schemas import grid
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.runtime.jit import compiled
from schemas.runtime.records import RecordArray, Records, records
from schemas.signals import S
from schemas.thresholds import METRES_PER_DEGREE, UNKNOWN

# [s] time for which a fix is used. A 10 Hz receiver that has missed ten fixes has no reception, and
# at 15 m/s the vehicle has reached the next cell by then.
FIX_HELD_S: Final = 1.0
# [1] margin around a cell over its side, 1 to 2 m: three standard deviations of receiver noise
CELL_MARGIN: Final = 0.1
SECTOR_KEEP: Final = np.radians(5.0)  # [rad] margin beyond the edges of a heading sector
# [m] distance of the fixes from which a course is computed; the course noise is about 8 degrees
COURSE_BASE_M: Final = 3.0
NOWHERE: Final = UNKNOWN  # cell of a vehicle without position


class CellTrack:
    """State of the cell tracking of one vehicle (last fix, visited cell), as an array record that
    is kept between two blocks of samples. A value is NaN where nothing has been received yet.
    """

    fix_time: float  # [s] time of the last fix
    latitude: float  # [deg] last fix
    longitude: float
    yaw_time: float  # [s] time of the last yaw reading
    yaw: float  # [rad]
    course_latitude: float  # [deg] position from which the next course is computed
    course_longitude: float
    course: float  # [rad from east] course over ground
    west: float  # [deg] borders of the visited cell
    south: float
    east: float
    north: float
    cell: int  # visited cell, or NOWHERE
    sector: int  # heading sector of the visit, or NOWHERE


class ReceiverSample:
    """One sample of the position receiver, as an array record: position [deg], yaw [rad], the map
    cell that contains the position, and the borders of this cell [deg].
    """

    latitude: float
    longitude: float
    yaw: float
    cell: int  # NOWHERE without a position
    west: float
    south: float
    east: float
    north: float


class Located(NamedTuple):
    """Cells visited by N vehicles at T samples; each array has the shape (T, N).

    Attributes:
        closes: True at the first sample after the end of a visit. At this sample the vehicle is in
            a new cell or sector, or in no cell.
        inside, outside: True where a position fix of this sample lies inside or outside the visited
            cell.
        cell, sector: cell (quadint, zoom 21) and heading sector, -1 when in no cell.
        latitude, longitude, yaw: as last received [deg], [deg], [rad]; NaN when too old.
    """

    closes: BoolArray
    inside: BoolArray
    outside: BoolArray
    cell: IntArray
    sector: IntArray
    latitude: FloatArray
    longitude: FloatArray
    yaw: FloatArray


def new_tracks(vehicles: int) -> RecordArray:
    """Return the initial states of the cell tracking, (N,), for N vehicles that have not received a
    position.
    """
    tracks = records(CellTrack, vehicles)
    for name in tracks.dtype.names or ():
        tracks[name] = NOWHERE if name in ("cell", "sector") else np.nan
    return tracks


def locate_vehicles(
    tracks: RecordArray, t: FloatArray, signals: FloatArray, *, lost: bool = False
) -> tuple[RecordArray, Located]:
    """Compute the map cells in which N vehicles are, for a block of samples.

    Args:
        tracks: (N,) states of the cell tracking after the previous block.
        t: (T, N) times of the samples [s].
        signals: (T, N, channels) measurements.
        lost: True to forget the last position fixes, which ends every visit.

    Returns:
        the states for the next block, and the cells per sample.
    """
    after = tracks.copy()
    if lost:
        after["fix_time"] = np.nan
    shape = t.shape
    located = Located(
        closes=np.zeros(shape, np.bool_),
        inside=np.zeros(shape, np.bool_),
        outside=np.zeros(shape, np.bool_),
        cell=np.full(shape, NOWHERE),
        sector=np.full(shape, NOWHERE),
        latitude=np.full(shape, np.nan),
        longitude=np.full(shape, np.nan),
        yaw=np.full(shape, np.nan),
    )
    _advance_tracks(t, _receiver_samples(signals), after, located)
    return after, located


def _receiver_samples(signals: FloatArray) -> RecordArray:
    """Return position, yaw and cell of each sample as an array of records (T, N), taken from the
    signals (T, N, channels).
    """
    fixes = records(ReceiverSample, *signals.shape[:-1])
    latitude = signals[..., S.LATITUDE]
    longitude = signals[..., S.LONGITUDE]
    fixes["latitude"] = latitude
    fixes["longitude"] = longitude
    fixes["yaw"] = signals[..., S.YAW]
    is_located = (np.abs(latitude) <= grid.MAX_LATITUDE) & (np.abs(longitude) <= 180.0)
    fixes["cell"] = NOWHERE
    cell = grid.cell_of(latitude[is_located], longitude[is_located])
    fixes["cell"][is_located] = cell
    for name, border in zip(("west", "south", "east", "north"), grid.bounds(cell), strict=True):
        fixes[name][is_located] = border
    return fixes


@compiled
def _update_course(track: CellTrack, latitude: float, longitude: float) -> None:
    """Update the vehicle's course over ground [rad from east] in its tracking state `track`. The
    course changes only if the vehicle has moved far enough since the last update.
    """
    north = (latitude - track.course_latitude) * METRES_PER_DEGREE
    eastward = longitude - track.course_longitude
    eastward -= 360.0 * np.floor(eastward / 360.0 + 0.5)  # at the antimeridian
    east = eastward * METRES_PER_DEGREE * np.cos(np.radians(latitude))
    distance = np.hypot(north, east)
    if distance >= COURSE_BASE_M:
        track.course = np.arctan2(north, east)
    if not distance < COURSE_BASE_M:
        track.course_latitude = latitude
        track.course_longitude = longitude


@compiled
def _stays_in_cell(track: CellTrack, fix: ReceiverSample, yaw: float) -> bool:
    """Return True if a position fix still belongs to the visit. This includes fixes within a margin
    around the cell and the heading sector.
    """
    wide = CELL_MARGIN * (track.east - track.west)
    high = CELL_MARGIN * (track.north - track.south)
    off = np.mod(yaw - track.sector * (np.pi / 2) + np.pi, 2 * np.pi) - np.pi
    return bool(
        track.west - wide <= fix.longitude <= track.east + wide
        and track.south - high <= fix.latitude <= track.north + high
        and abs(off) <= np.pi / 4 + SECTOR_KEEP
    )


@compiled
def _store_readings(track: CellTrack, fix: ReceiverSample, now: float) -> None:
    """Store the position and the yaw of one sample, each only if it is valid, in the vehicle's
    tracking state `track`.
    """
    if np.isfinite(fix.yaw):
        track.yaw_time = now
        track.yaw = fix.yaw
    if fix.cell != NOWHERE:
        track.fix_time = now
        track.latitude = fix.latitude
        track.longitude = fix.longitude
        _update_course(track, fix.latitude, fix.longitude)


@compiled
def _begin_visit(track: CellTrack, fix: ReceiverSample, heading: float) -> None:
    """Begin a visit (passage) of the map cell that contains the position `fix`, in the heading
    sector that contains the direction `heading` [rad].
    """
    track.cell = fix.cell
    track.sector = int(np.floor((heading + np.pi / 4) / (np.pi / 2))) % grid.SECTORS
    track.west = fix.west
    track.south = fix.south
    track.east = fix.east
    track.north = fix.north


@compiled
def _advance_tracks(
    t: FloatArray, fixes: Records[ReceiverSample], tracks: Records[CellTrack], located: Located
) -> None:
    """Advance the tracking states of all vehicles sample by sample, and write the visited cells to
    `located`. This is the compiled part of `locate_vehicles`.
    """
    for k in range(t.shape[0]):
        for n in range(t.shape[1]):
            track = tracks[n]
            fix = fixes[k, n]
            now = t[k, n]
            _store_readings(track, fix, now)
            heading = track.yaw if now - track.yaw_time <= FIX_HELD_S else track.course
            is_held = now - track.fix_time <= FIX_HELD_S
            if is_held:
                located.latitude[k, n] = track.latitude
                located.longitude[k, n] = track.longitude
                located.yaw[k, n] = heading
            if not is_held and track.cell != NOWHERE:
                track.cell = NOWHERE
                track.sector = NOWHERE
                located.closes[k, n] = True
            elif (
                fix.cell != NOWHERE
                and np.isfinite(heading)
                and not (track.cell != NOWHERE and _stays_in_cell(track, fix, heading))
            ):
                _begin_visit(track, fix, heading)
                located.closes[k, n] = True
            located.inside[k, n] = fix.cell != NOWHERE and fix.cell == track.cell
            located.outside[k, n] = fix.cell != NOWHERE and fix.cell != track.cell
            located.cell[k, n] = track.cell
            located.sector[k, n] = track.sector
