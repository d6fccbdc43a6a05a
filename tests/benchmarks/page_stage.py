"""Test set-up for the page: a router, a simulated service with a town of twenty thousand cells, and
the page.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import zenoh

from deploy.router import open_router
from fleet_service.serve.encode import arrow_stream
from schemas import grid, keys, tables
from schemas.config import ZenohSettings
from schemas.numeric import IntArray
from schemas.runtime.zenoh_session import open_session
from schemas.thresholds import GRAVITY
from tests.waiting import until

CELLS: Final = 20_000
SIDE: Final = 2  # tiles along a side; at the smallest zoom that shows cells they fill one screen
ZOOM: Final = 14.75
MIDDLE: Final = (57.7, 11.97)
BOUND_SHARE: Final = 0.3


class Town:
    """Simulated town whose map cells are stored by map tile. Its tiles can be changed and encoded
    for publication as a service does.
    """

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        x, y = (int(v) for v in grid.deinterleave(grid.tile_of(grid.cell_of(*MIDDLE))))
        self.corner = (x + SIDE / 2, y + SIDE / 2)
        self.tiles: dict[int, dict[str, Any]] = {}
        for k in range(SIDE * SIDE):
            tile = int(grid.interleave(np.array([x + k % SIDE]), np.array([y + k // SIDE]))[0])
            cells = np.sort(
                (tile << 14) + self.rng.choice(1 << 14, CELLS // SIDE**2, replace=False)
            )
            self.tiles[tile] = self._draw_columns(cells)
        self.marker = next(iter(self.tiles))

    def local_marker(self, tile: int) -> int:
        """Return the index of the marker cell within a map tile. The vehicle count of this cell is
        the number of the publication, so a test that reads the tile knows which publication it
        received.
        """
        return int(self.tiles[tile]["cell"][0]) & 0x3FFF

    def _draw_columns(self, cells: IntArray) -> dict[str, Any]:
        n = len(cells)
        latitude, longitude = grid.centre(cells)
        west, south, east, north = grid.bounds(cells)
        mu = self.rng.uniform(0.1, 0.9, n)
        half = self.rng.uniform(0.03, 0.3, n)
        lower = np.maximum(mu - half, 0.05)
        upper = np.minimum(mu + half, 1.2)
        bound = self.rng.random(n) < BOUND_SHARE
        bound[0] = False
        now = np.full(n, time.time_ns())
        return {
            "cell": cells,
            "sector": np.zeros(n, np.int8),
            "mu": pa.array(mu, mask=bound),
            "mu_lower": lower,
            "mu_upper": upper,
            "p_slippery": (mu < 0.4) * 0.9,
            "basis": np.where(bound, "bound", "measured"),
            "vehicles": np.full(n, 3),
            "observations": np.full(n, 5),
            "first_time": now,
            "last_time": now,
            "age_s": np.zeros(n),
            "latitude": latitude,
            "longitude": longitude,
            "west": west,
            "south": south,
            "east": east,
            "north": north,
            "safe_deceleration": GRAVITY * lower,
        }

    def make_batch(self, tile: int) -> pa.RecordBatch:
        """Return the map tile number `tile` of the simulated town as a record batch with the schema
        of the map.
        """
        columns = ((self.tiles[tile][f.name], f.type) for f in tables.MAP_SCHEMA)
        arrays = [
            (c if isinstance(c, pa.Array) else pa.array(c)).cast(kind, safe=False)
            for c, kind in columns
        ]
        return pa.RecordBatch.from_arrays(arrays, schema=tables.MAP_SCHEMA)

    def change_cells(self, tile: int, cells: int, number: int) -> bytes:
        """Change `cells` random cells of a map tile, and return the tile's bytes for publication.

        The vehicle count of the tile's marker cell is set to `number`, the number of the
        publication. A test that reads the tile thus knows which publication it received.
        """
        columns = self.tiles[tile]
        which = self.rng.choice(len(columns["cell"]) - 1, cells, replace=False) + 1
        columns["vehicles"][which] = self.rng.integers(1, 250, cells)
        columns["last_time"][which] = time.time_ns()
        columns["vehicles"][0] = number
        return arrow_stream(self.make_batch(tile))


class Stage(NamedTuple):
    """Test set-up of the page benchmark: address of the page, a Zenoh session, the simulated town,
    and the process of the page.
    """

    address: str
    session: zenoh.Session
    town: Town
    process: subprocess.Popen[str]
    router: ZenohSettings


@contextmanager
def open_stage(seed: int) -> Iterator[Stage]:
    """Yield the running test set-up: router, simulated service, and the page, which runs in a
    separate process.
    """
    router, endpoints = open_router(listen="tcp/127.0.0.1:0")
    settings = ZenohSettings(connect=endpoints)
    town = Town(seed)
    session = open_session(settings)
    assert session is not None
    with router, session:

        def answer_query(asked: zenoh.Query) -> None:
            with asked:
                for tile in town.tiles:
                    if asked.key_expr.intersects(zenoh.KeyExpr(keys.map_key(tile))):
                        asked.reply(keys.map_key(tile), arrow_stream(town.make_batch(tile)))

        session.declare_queryable(f"{keys.ROOT}/map/*/*/*/*", answer_query, complete=True)
        words = ["page", "--port", "0", "--connect", endpoints[0]]
        command = [sys.executable, "-m", "fleet_service.cli", *words]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as page:
            try:
                assert page.stdout is not None
                address = page.stdout.readline().strip().removeprefix("page: ")
                assert address, "the page did not start"
                until(lambda: tiles_of(address) == len(town.tiles))
                yield Stage(address, session, town, page, settings)
            finally:
                page.terminate()


def tiles_of(address: str) -> int:
    """Return the number of map tiles that the page has received from the simulated service."""
    import json
    import urllib.request

    with urllib.request.urlopen(f"{address}tiles", timeout=10) as answer:
        return len(json.loads(answer.read()))


def seen_town(address: str, town: Town) -> str:
    """Return the address that opens the page with the whole town in view, zoomed in enough to show
    cells.
    """
    x, y = town.corner
    return f"{address}#x={x / 2**14:.8f}&y={y / 2**14:.8f}&zoom={ZOOM}"


def pin_to_core(process: subprocess.Popen[str], core: int) -> None:
    """Restrict all threads of a process to one core."""
    for thread in Path(f"/proc/{process.pid}/task").iterdir():
        os.sched_setaffinity(int(thread.name), {core})
