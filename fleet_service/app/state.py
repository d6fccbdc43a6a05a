"""State of a service, loaded from the newest checkpoint (saved state) and the rows archived after
it, or from archived rows alone.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa

from fleet_service.archive.format.layout import DAY_NS, Cut
from fleet_service.archive.format.load import skip_damaged
from fleet_service.fusion import Fusion
from fleet_service.fusion.store.store import distinct_values
from fleet_service.ingest.dedup import ArchivedRows, SequenceTrackers
from fleet_service.ingest.weather import archived_reports
from fleet_service.replay.checkpoints import Taken
from fleet_service.replay.rebuild import (
    Since,
    first_day,
    ignore_observations,
    replay,
)
from fleet_service.replay.restart import image_of, load_restart
from fleet_service.replay.streams import Begin, read_streams, restore_streams
from fleet_service.serve.alerts import Alerts
from fleet_service.serve.idle_roads import IdleRoads
from fleet_service.serve.map_state import MapState, tile_of
from fleet_service.serve.public_cells import PRESENT, WAITING, PublicCells
from fleet_service.serve.tile_cache import TileCache
from fleet_service.serve.visitors import Visitors
from schemas.config import ServiceConfig
from schemas.numeric import IntArray
from schemas.wire import Kind

# [ns] Time after the last visit after which a cell may be dropped. It is 56 times the mean time
# between changes (fusion.constants.CHANGE_S), so that the belief has become the prior.
KEPT_NS: Final = 7 * DAY_NS
# Smallest share of the cells that is worth dropping, because all other cells must be copied.
LEAST_DROPPED: Final = 0.01
VISITORS: Final = "visitors"  # name of a table in checkpoints


class ServiceState(NamedTuple):
    """State of a service.

    Attributes:
        fusion, map, alerts: beliefs about the friction of all cells; the map and the active alerts
            made from them.
        streams: record of the batches (messages with records) that were admitted.
        refused: number of checkpoints that could not be loaded.
        public: cells that readers may see; None if they may see all cells.
    """

    fusion: Fusion
    map: MapState
    alerts: Alerts
    streams: SequenceTrackers
    refused: int
    public: PublicCells | None

    def drop_old(self) -> int:
        """Drop cells that were not visited for KEPT_NS, and weather that is as old. The belief of
        such cells has returned to the prior, the belief before any measurement. Return the number
        of dropped cells.
        """
        newest = self.fusion.checkpoint or 0
        self.fusion.drop_weather(newest - KEPT_NS)
        stale = self.fusion.untouched(newest - KEPT_NS)
        stale[sorted(self.alerts.slots)] = False
        dropped = int(stale.sum())
        if dropped > self.fusion.size * LEAST_DROPPED:
            place = self.fusion.drop(stale)
            self.map.rebuild()
            self.alerts.renumber(place)
            if self.public is not None:
                self.public.renumber(place)
            return dropped
        return 0

    def image(self, cut: Cut, weather: Iterable[Path]) -> Taken:
        """Return the content of a checkpoint that includes all rows up to the segment (file of new
        rows) `cut`, and the given weather files.
        """
        tables = image_of(self.fusion, self.alerts.standing_alerts, self.streams)
        if self.public is not None:
            tables |= public_tables(self.public)
        return Taken(tables, cut, tuple(path.name for path in weather))


class SharedState:
    """State of a running service that several threads use: the worker (the thread that processes
    messages) changes it, queries read it.

    Args:
        state: state loaded from the archive.
        public_vehicles: smallest number of vehicles that must have visited a cell, so that readers
            may see the cell.

    Attributes:
        guard: lock that is held while the map is changed or read.
        state: current state; replaced as a whole by `replace`.
        tiles: cached tiles of the current map.
    """

    def __init__(self, state: ServiceState, public_vehicles: int) -> None:
        self.guard = threading.Lock()
        self._public_vehicles = public_vehicles
        self._adopt(state)

    def _adopt(self, state: ServiceState) -> None:
        """Use `state` from now on, and start with an empty cache of map tiles."""
        self.state = state
        self.tiles = TileCache(state.map, self.guard, self._public_vehicles, state.public)

    def replace(self, state: ServiceState) -> None:
        """Replace the service's state by a newly loaded one. Tiles that have lost all their cells
        are published once more, because subscribers still have these cells.
        """
        before = self._readable_tiles() | self.state.map.emptied
        self._adopt(state)
        state.map.mark_emptied(before - self._readable_tiles())

    def _readable_tiles(self) -> set[int]:
        """Return the numbers of the tiles that have cells for readers."""
        fusion = self.state.fusion
        slots = self.tiles.public_slots(np.arange(fusion.size), self.state.streams.newest)
        return set(distinct_values(tile_of(fusion, slots)).tolist())


def public_tables(public: PublicCells) -> dict[str, pa.Table]:
    """Return the public copy of the map (cells that readers may see) as tables for a checkpoint.
    All columns of a table have the same length.
    """
    columns = public.visitors.columns()
    part = np.full(len(columns["bits"]), columns["part"][0])
    tables = {VISITORS: {"bits": columns["bits"], "part": part}} | public.columns()
    return {
        name: pa.table({column: pa.array(values) for column, values in table.items()})
        for name, table in tables.items()
    }


def _load_public(
    least: int, fusion: Fusion, kept: Mapping[str, dict[str, IntArray]]
) -> PublicCells | None:
    """Return the public copy of the map from the tables of a checkpoint; None if readers may see
    all cells. If the checkpoint does not contain it, a cell is shown only after new visits. `least`
    is the number of vehicles of a public cell.
    """
    if least <= 1:
        return None
    known = {VISITORS, WAITING, PRESENT} <= kept.keys() and len(kept[VISITORS]["bits"])
    visitors = Visitors.of(fusion, kept[VISITORS]) if known else Visitors(fusion)
    return PublicCells(fusion, visitors, least, kept if known else None)


def _load_streams(
    root: Path,
    streams: SequenceTrackers,
    begin: Begin,
    damaged: Callable[[Path, str], None],
    *,
    is_new: bool,
) -> list[tuple[Kind, ArchivedRows]]:
    """Read which batches were admitted. If `is_new` (no checkpoint), record them in `streams`.
    Otherwise return the rows after the checkpoint, which are few. The caller adds them when the
    replay is complete, because the replay needs `streams` as it was at the checkpoint.
    """
    if is_new:
        restore_streams(root, streams, begin, damaged)
        return []
    return list(read_streams(root, begin, damaged))


def load_state(
    root: Path,
    config: ServiceConfig,
    damaged: Callable[[Path, str], None] = skip_damaged,
    until: Cut | None = None,
) -> ServiceState:
    """Load the state from the archive. If `until` is given, use only segments up to this position
    in their sequence.

    Raises:
        OSError: the archive cannot be read.
    """
    enrolled = config.fleet is not None
    begin = load_restart(root, config.lateness_s, (VISITORS, WAITING, PRESENT), enrolled=enrolled)
    fusion = begin.fusion
    streams = begin.streams
    public = _load_public(config.public_vehicles, fusion, begin.extra_tables)
    shown = MapState(fusion)
    alerts = Alerts(fusion, IdleRoads(), is_private=config.public_vehicles > 1)
    alerts.resume(begin.standing)
    first = first_day(root)
    # Weather comes first, because it affects how observations are fused. A report affects the hours
    # after it, but no day after the next.
    acts_since = 0 if first is None else (first - 1) * DAY_NS
    fusion.update_weather(
        archived_reports(root, known=begin.weather, damaged=damaged, acts_since=acts_since)
    )
    shown.mark_all_changed()
    relevant = Begin(first, begin.cut, until)
    listener = ignore_observations if public is None else public.follow
    updates = replay(
        root, fusion, Since(relevant, streams if begin.cut else None), damaged, listener
    )
    with ThreadPoolExecutor(1, "streams") as thread:
        later = thread.submit(_load_streams, root, streams, relevant, damaged, is_new=not begin.cut)
        for updated in updates:
            alerts.update(updated.slots)
            shown.mark_changed(updated.slots)
        for kind, rows in later.result():
            streams.restore(kind, rows)
    pa.default_memory_pool().release_unused()  # memory from reading the archive
    state = ServiceState(fusion, shown, alerts, streams, begin.refused, public)
    state.drop_old()
    return state
