"""Tests of the tile cache. The service may send a cached tile for at most a second. It must never
send one that an acknowledged report or an alert has changed.
"""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest

from fleet_service.fusion import Fusion
from fleet_service.serve import tile_cache
from fleet_service.serve.map_state import MapState
from fleet_service.serve.query import answer_query
from fleet_service.serve.tile_cache import ShownTile, TileCache
from schemas import grid
from schemas.query import MapQuery
from schemas.wire.tile import decode_tile
from tests.fleet_service.examples import SECOND, START, TILE, observations, value

NOW = START + 60 * SECOND


def visit(state: MapState, vehicle: int, cell: int = TILE << 14) -> None:
    """Let a vehicle report one observation of a cell to the map, and mark the cell as changed, as
    the service does.
    """
    state.mark_changed(
        state.fusion.update(observations([1.0], [vehicle], value([0.5]), cell)).slots
    )


@pytest.fixture
def state() -> MapState:
    made = MapState(Fusion(120.0))
    visit(made, 1)
    return made


def vehicles(made: TileCache, now: int, tile: int = TILE) -> list[int]:
    return [int(n) for n in made.read_tiles([tile], now)[0].columns["vehicles"]]


def test_unchanged_tile_is_cached_for_a_second(state: MapState) -> None:
    made = TileCache(state, nullcontext(), 1)
    first = made.read_tiles([TILE], NOW)[0]
    assert made.read_tiles([TILE], NOW + tile_cache.SHOWN_NS)[0] is first
    later = made.read_tiles([TILE], NOW + tile_cache.SHOWN_NS + 1)[0]
    assert later.cells["age_s"][0].as_py() > first.cells["age_s"][0].as_py()
    assert made.read_tiles([TILE], NOW - 1)[0] is not later  # the clock was set back


def test_acknowledged_change_is_visible_at_once_others_within_a_second(state: MapState) -> None:
    made = TileCache(state, nullcontext(), 1)
    assert vehicles(made, NOW) == [1]
    visit(state, 2)
    # The second visit is not acknowledged yet, so the old tile may be shown.
    assert vehicles(made, NOW + 1) == [1]
    assert vehicles(made, NOW + tile_cache.SHOWN_NS + 1) == [2]
    visit(state, 3)
    made.acknowledge()
    assert vehicles(made, NOW + tile_cache.SHOWN_NS + 1) == [3]


def test_change_of_another_tile_keeps_the_cached_tile(state: MapState) -> None:
    made = TileCache(state, nullcontext(), 1)
    first = made.read_tiles([TILE], NOW)[0]
    visit(state, 2, (TILE + 1) << 14)
    made.acknowledge()
    assert made.read_tiles([TILE], NOW)[0] is first
    assert vehicles(made, NOW, TILE + 1) == [1]


def test_cells_of_too_few_vehicles_are_not_in_a_tile(state: MapState) -> None:
    made = TileCache(state, nullcontext(), 2)
    assert vehicles(made, NOW) == []
    visit(state, 2)
    made.acknowledge()
    assert vehicles(made, NOW) == [2]


def test_tiles_are_kept_up_to_a_bound_the_youngest_of_them(
    state: MapState, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = TileCache(state, nullcontext(), 1)
    one = len(made.read_tiles([TILE], NOW)[0].payload)
    monkeypatch.setattr(tile_cache, "KEPT_BYTES", 2 * one)
    for tile in (TILE + 1, TILE + 2):
        visit(state, 1, tile << 14)
        made.read_tiles([tile], NOW)
    young = made.read_tiles([TILE + 2], NOW)[0]
    assert made.read_tiles([TILE + 2], NOW)[0] is young
    assert made.read_tiles([TILE], NOW)[0] is not made.read_tiles([TILE + 1], NOW)[0]
    # Two newer tiles have displaced it from the cache.
    assert made.read_tiles([TILE + 2], NOW)[0] is not young


def test_tile_is_a_copy_that_later_visits_do_not_change(state: MapState) -> None:
    made = TileCache(state, nullcontext(), 1).read_tiles([TILE], NOW)[0]
    before = np.array(made.columns["vehicles"])
    visit(state, 2)
    assert (made.columns["vehicles"] == before).all()


def test_a_box_gets_exactly_the_cells_that_it_touches() -> None:
    state = MapState(Fusion(120.0))
    rng = np.random.default_rng(0)
    for vehicle in (1, 2):
        for cell in (TILE << 14) + rng.choice(1 << 14, 60, replace=False):
            visit(state, vehicle, int(cell))
    made = TileCache(state, nullcontext(), 1)
    cells = made.read_tiles([TILE], NOW)[0].cells.to_pylist()
    west, south, east, north = (float(border) for border in grid.bounds(TILE, grid.TILE_ZOOM))
    lengths = set()
    for _ in range(200):
        x = np.sort(rng.uniform(west - 0.02, east + 0.02, 2))
        y = np.sort(rng.uniform(south - 0.01, north + 0.01, 2))
        asked = MapQuery(bbox=(x[0], y[0], x[1], y[1]), min_vehicles=int(rng.integers(1, 3)))
        wanted = {
            cell["cell"]
            for cell in cells
            if cell["east"] > x[0]
            and cell["west"] < x[1]
            and cell["north"] > y[0]
            and cell["south"] < y[1]
            and cell["vehicles"] >= asked.min_vehicles
        }
        replies = dict(answer_query(made, asked, lambda tile: tile == TILE, NOW, TILE))
        shown = decode_tile(replies[TILE])["cell"].to_pylist() if replies else []
        assert set(shown) == wanted
        assert len(shown) == len(wanted)
        lengths.add(len(wanted))
    assert {0, len(cells)} < lengths


def three_tiles() -> MapState:
    """Return a map with cells in three tiles: two vehicles in one tile, one in the others."""
    state = MapState(Fusion(120.0))
    rng = np.random.default_rng(1)
    for tile, passing in ((TILE + 1, 2), (TILE, 1), (TILE + 2, 1)):
        for cell in (tile << 14) + rng.choice(1 << 14, 20, replace=False):
            for vehicle in range(passing):
                visit(state, vehicle, int(cell))
    return state


@pytest.mark.parametrize("least", [1, 2])
def test_tiles_that_are_made_together_equal_tiles_that_are_made_alone(least: int) -> None:
    state = three_tiles()
    tiles = [TILE + 2, TILE, TILE + 7, TILE + 1]  # one of them has no cells
    together = TileCache(state, nullcontext(), least).make_tiles(tiles, NOW)
    for tile, one in zip(tiles, together, strict=True):
        (alone,) = TileCache(state, nullcontext(), least).make_tiles([tile], NOW)
        assert decode_tile(one.payload).equals(decode_tile(alone.payload))
        assert one.least_vehicles == alone.least_vehicles
        assert one.common == alone.common
        assert one.cells.equals(alone.cells)


def test_a_recent_tile_is_not_made_again_with_others() -> None:
    made = TileCache(three_tiles(), nullcontext(), 1)
    (first,) = made.read_tiles([TILE], NOW)
    again, other = made.read_tiles([TILE, TILE + 1], NOW + 1)
    assert again is first
    assert other.made_at == NOW + 1


def test_a_query_for_the_whole_map_gets_every_tile_once(monkeypatch: pytest.MonkeyPatch) -> None:
    state = three_tiles()
    groups: list[list[int]] = []
    make = TileCache.make_tiles

    def noted(self: TileCache, tiles: list[int], now: int) -> list[ShownTile]:
        groups.append(list(tiles))
        return make(self, tiles, now)

    monkeypatch.setattr(TileCache, "make_tiles", noted)
    for tiles_together, cells_together, sizes in (
        (32, 2000, [3]),
        (2, 2000, [2, 1]),
        (32, 40, [2, 1]),
    ):
        monkeypatch.setattr(tile_cache, "TILES_TOGETHER", tiles_together)
        monkeypatch.setattr(tile_cache, "CELLS_TOGETHER", cells_together)
        groups.clear()
        cache = TileCache(state, nullcontext(), 1)
        replies = list(answer_query(cache, MapQuery(), lambda _: True, NOW))
        assert sorted(tile for tile, _ in replies) == [TILE, TILE + 1, TILE + 2]
        assert all(decode_tile(payload).num_rows == 20 for _, payload in replies)
        assert [len(group) for group in groups] == sizes
