"""Read access to a running service's map: tiles, the whole map, and answers about the present or
the past.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from fleet_service.app.historical_maps import HistoricalMaps, PastQuery
from fleet_service.app.state import SharedState
from fleet_service.serve.encode import batch_of
from fleet_service.serve.query import AnswerSize, answer_query, bound_answer_size
from schemas.config import ServiceConfig, to_nanoseconds
from schemas.errors import InputError
from schemas.query import MapQuery
from schemas.tables import MAP_SCHEMA

# Number of slots that are read at once. The lock is then held for 40 ms, and memory stays small.
SLOTS: Final = 20_000


class Queries:
    """Read access to a running service's map; safe to call from several threads.

    Args:
        config: settings.
        root: folder of the archive, for maps of the past.
        shared: state of the service.
    """

    def __init__(self, config: ServiceConfig, root: Path, shared: SharedState) -> None:
        self._config = config
        self._shared = shared
        self._past = HistoricalMaps(root)

    def first_tiles(self, tiles: list[int], now: int) -> dict[int, bytes]:
        """Return the first of the given tiles that are made in one step, at least one. For each
        tile, those cells that readers may see are given as an Arrow stream (bytes). If there are
        none, it is a stream without rows if readers saw cells there before, else empty bytes.
        """
        group = self._shared.tiles.first_group(tiles)
        made = zip(group, self._shared.tiles.make_tiles(group, now), strict=True)
        emptied = self._shared.state.map.emptied
        return {
            tile: shown.payload if shown.cells.num_rows or tile in emptied else b""
            for tile, shown in made
        }

    def take_changed(self, now: int) -> list[int]:
        """Return the numbers of the tiles that changed since the last call. If cells are hidden for
        privacy, a change counts only when it becomes visible to readers.
        """
        state = self._shared.state
        if state.public is not None:
            with self._shared.guard:
                state.public.publish(now)
                state.map.mark_changed(state.public.take_published())
        return state.map.take_dirty()

    def whole_map(self, now: int) -> pa.Table:
        """Return all cells that readers may see, as a table. The lock of the map is held for a few
        cells at a time, so that ingest continues.
        """
        tables = []
        shared = self._shared
        for start in range(0, shared.state.fusion.size, SLOTS):
            with shared.guard:
                slots = np.arange(start, min(start + SLOTS, shared.state.fusion.size))
                seen = shared.tiles.read_cells(shared.tiles.public_slots(slots, now), now)
                tables.append(pa.Table.from_batches([batch_of(seen, now)]))
        return pa.concat_tables([*tables, MAP_SCHEMA.empty_table()])

    def answer(
        self,
        query: MapQuery,
        is_requested: Callable[[int], bool],
        now: int,
        only: int | None = None,
    ) -> Iterator[tuple[int, bytes]]:
        """Yield the tile number and the payload of every reply to a query, computed on demand.
        `is_requested` returns True for tiles that match the query's key, and `only` is the tile if
        the key names exactly one. `now` is the service's time [ns].

        Raises:
            InputError: the route is too long, the time is in the future, or the archive cannot be
                read.
        """
        least = max(query.min_vehicles, self._config.public_vehicles)
        query = query.model_copy(update={"min_vehicles": least})
        if query.at is None:
            return answer_query(self._shared.tiles, query, is_requested, now, only)
        at = to_nanoseconds(query.at)
        if at > now:
            raise InputError("at", "lies in the future", "give a time in the past")
        past = PastQuery(query, at, self._config.lateness_s, only, self._config.public_vehicles)
        return self._past.ask(past, is_requested)

    def measure_answer(
        self, query: MapQuery, is_requested: Callable[[int], bool], only: int | None = None
    ) -> AnswerSize:
        """Return an upper bound of the size of the answer to a query, as number of cells and number
        of tiles. `is_requested` returns True for tiles that match the query's key, and `only` is
        the tile if the key names exactly one.
        """
        return bound_answer_size(self._shared.tiles, query, is_requested, only)

    def close(self) -> None:
        """Stop the process that rebuilds maps of the past."""
        self._past.close()
