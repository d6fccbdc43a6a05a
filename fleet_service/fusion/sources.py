"""Sources of a cell: the vehicles that recently reported ice or grip in it. Alerts need them, and
they show where a slippery stretch of road ends. Compiled.
"""

from __future__ import annotations

from fleet_service.fusion import constants
from fleet_service.fusion.store.records import NONE, SOURCES, Rows, Side
from schemas.runtime.jit import refcount_free, refcount_free_inlined
from schemas.runtime.records import RecordArray
from schemas.thresholds import NS


@refcount_free
def note_source(reporters: RecordArray, row: int, side: Side, vehicle: int, time: int) -> None:
    """Record that a vehicle reported ice or grip (`side`) in a cell at the time `time` [ns]. The
    record replaces the vehicle's earlier one, or else the oldest one in the cell's list. A record
    never replaces a newer one.
    """
    source = reporters[row].source
    source_time = reporters[row].source_time
    place = 0
    for k in range(SOURCES):
        if source[side, k] == vehicle:
            place = k
            break
        if source_time[side, k] < source_time[side, place]:
            place = k
    if time // NS < source_time[side, place]:
        return
    source[side, place] = vehicle
    source_time[side, place] = time // NS


@refcount_free_inlined
def is_border(rows: Rows, row: int, other: int, now: int) -> bool:
    """Return True if a slippery stretch of road is known to end between the cells in rows `row` and
    `other`: if two vehicles reported grip in one of them after two vehicles had reported ice in the
    other, all within the time SOURCE_NS before `now` [ns].
    """
    return _grip_beside_ice(rows, row, other, now) or _grip_beside_ice(rows, other, row, now)


@refcount_free_inlined
def _grip_beside_ice(rows: Rows, grip: int, ice: int, now: int) -> bool:
    grip_row = rows.cells[grip].reporters
    ice_row = rows.cells[ice].reporters
    if grip_row == NONE or ice_row == NONE:
        return False
    since = (now - constants.SOURCE_NS) // NS
    first = now // NS
    second = first
    for k in range(SOURCES):
        time = int(rows.reporters[ice_row].source_time[Side.ICE, k])
        if rows.reporters[ice_row].source[Side.ICE, k] != NONE and time >= since:
            second = min(second, max(first, time))
            first = min(first, time)
    vehicles = 0
    for k in range(SOURCES):
        time = int(rows.reporters[grip_row].source_time[Side.GRIP, k])
        if rows.reporters[grip_row].source[Side.GRIP, k] != NONE and time > second:
            vehicles += 1
    return vehicles >= 2
