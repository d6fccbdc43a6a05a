"""Tests of a base map from a file of the operator. The page must show the file's tiles below the
map without using a network, and must refuse files of another form.
"""

from __future__ import annotations

import sqlite3
import struct
import zlib
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Final, cast

import pytest

from fleet_service.page.basemap import OWN, ZOOMS, BaseMap, TileFile, base_map
from schemas import grid
from schemas.config import ZenohSettings
from schemas.errors import InputError
from tests.browser import open_page
from tests.fleet_service.page.conftest import page_of
from tests.fleet_service.page.test_page import READY, waits
from tests.fleet_service.page.test_server import ask

BLUE: Final = (20, 60, 200)
ZOOM: Final = 12
AT: Final = (57.7, 11.97)


def png(colour: tuple[int, int, int], side: int = 256) -> bytes:
    """Return the bytes of a square PNG picture of one colour."""

    def part(name: bytes, body: bytes) -> bytes:
        return (
            struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        )

    rows = zlib.compress((b"\0" + bytes(colour) * side) * side)
    head = struct.pack(">2I5B", side, side, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", rows) + part(b"IEND", b"")


def tiles_in(path: Path, tiles: Mapping[tuple[int, int, int], bytes], form: str = "png") -> Path:
    """Write an MBTiles file (map tiles in one database) that contains the given tiles, by (zoom,
    column, row counted from the north). Return its path.
    """
    with closing(sqlite3.connect(path)) as table, table:
        table.execute("create table metadata (name text, value text)")
        table.execute(
            "create table tiles (zoom_level int, tile_column int, tile_row int, tile_data blob)"
        )
        table.execute("insert into metadata values ('format', ?)", (form,))
        rows = [(z, x, 2**z - 1 - y, data) for (z, x, y), data in tiles.items()]
        table.executemany("insert into tiles values (?, ?, ?, ?)", rows)
    return path


def town(path: Path) -> Path:
    """Write an MBTiles file (map tiles in one database) with one blue tile that contains the point
    AT. Return its path.
    """
    x, y = (int(v) for v in grid.deinterleave(grid.parent(int(grid.cell_of(*AT)), ZOOM)))
    return tiles_in(path, {(ZOOM, x, y): png(BLUE)})


def test_mbtiles_rows_count_from_the_south_and_requests_from_the_north(tmp_path: Path) -> None:
    of = base_map(str(tiles_in(tmp_path / "a.mbtiles", {(2, 1, 0): b"north", (2, 1, 3): b"south"})))
    assert of.file is not None
    assert (of.address, of.zooms, of.file.kind) == (OWN, (2, 2), "image/png")
    assert [of.file.picture(2, 1, y) for y in range(4)] == [b"north", None, None, b"south"]
    assert [
        of.file.picture(*place)
        for place in ((1, 1, 0), (2, 4, 0), (2, -1, 0), (-1, 0, 0), (99, 0, 0))
    ] == [None] * 5
    assert base_map("https://t.example/{z}/{x}/{y}.png") == BaseMap(
        "https://t.example/{z}/{x}/{y}.png", ZOOMS
    )


@pytest.mark.campaign
def test_attribution_of_a_base_map_is_on_the_page(router: ZenohSettings, tmp_path: Path) -> None:
    path = town(tmp_path / "town.mbtiles")
    with closing(sqlite3.connect(path)) as table, table:
        table.execute("insert into metadata values ('attribution', '© its makers')")
    with (
        page_of(router, base_map=base_map(str(path))) as address,
        open_page(address) as seen,
    ):
        waits(seen, "document.getElementById('attribution').textContent")
        assert seen.page.locator("#attribution").inner_text() == "© its makers"
        assert seen.page.locator("#attribution").is_visible()


def test_invalid_tile_file_is_refused_with_the_problem(tmp_path: Path) -> None:
    (tmp_path / "text.mbtiles").write_text("no table")
    names = {
        "missing.mbtiles": "does not exist",
        "text.mbtiles": "cannot be read",
        tiles_in(tmp_path / "other.mbtiles", {(0, 0, 0): b"x"}, "svg").name: "contains svg tiles",
        tiles_in(tmp_path / "empty.mbtiles", {}).name: "holds no tile",
    }
    for name, problem in names.items():
        with pytest.raises(InputError, match=problem):
            base_map(str(tmp_path / name))
    for text in (
        "https://t.example/{z}/{x}.png",
        "ftp://t.example/{z}/{x}/{y}",
        "https://t.example/{z}/{x}/{y};a",
    ):
        with pytest.raises(InputError, match="not a URL of tiles"):
            base_map(text)


def test_tiles_of_a_file_are_served_and_one_that_is_not_there_is_no_error(
    router: ZenohSettings, tmp_path: Path
) -> None:
    with page_of(router, base_map=base_map(str(town(tmp_path / "town.mbtiles")))) as address:
        x, y = (int(v) for v in grid.deinterleave(grid.parent(int(grid.cell_of(*AT)), ZOOM)))
        status, headers, body = ask(address, f"/base/{ZOOM}/{x}/{y}")
        assert (status, headers["content-type"], body) == (200, "image/png", png(BLUE))
        assert "img-src 'self' data:;" in headers["content-security-policy"]
        assert ask(address, f"/base/{ZOOM}/{x + 1}/{y}")[0] == 204
        assert ask(address, "/base/x/y/z")[0] == 404


@pytest.mark.campaign
def test_base_map_file_is_shown_without_network(router: ZenohSettings, tmp_path: Path) -> None:
    """The picture in the operator's map file must be visible below the map, enlarged beyond the
    file's deepest zoom level. At low zoom levels the page must request no tile of the file, and at
    no level anything from another host.
    """
    with (
        page_of(router, base_map=base_map(str(town(tmp_path / "town.mbtiles")))) as address,
        open_page(address) as seen,
    ):
        seen.page.wait_for_selector(READY, state="attached")
        go = "([x, y, zoom]) => gripmap.map.view.go(x, y, zoom)"
        x, y = seen.page.evaluate(
            "([la, lo]) => [(lo + 180) / 360, (1 - Math.asinh(Math.tan(la * Math.PI / 180)) / "
            "Math.PI) / 2]",
            AT,
        )
        for zoom in (12.0, 18.0):
            seen.page.evaluate(go, [x, y, zoom])
            waits(seen, _BLUE)
        seen.page.evaluate(go, [x, y, 5.0])
        waits(seen, f"!({_BLUE})")
        assert seen.errors == []
        assert all(url.startswith(address) for url in seen.requests)
        assert sum("/base/" in url for url in seen.requests) < 30


# True if at least a quarter of the map's middle is blue. The page draws hatching over the rest,
# because no service covers it.
_BLUE: Final = """(() => {
  const map = document.getElementById("map"), x = map.width >> 1, y = map.height >> 1;
  const points = map.getContext("2d").getImageData(x - 20, y - 20, 40, 40).data;
  let blue = 0;
  for (let k = 0; k < points.length; k += 4)
    blue += points[k + 2] - points[k] > 60 && points[k + 2] > points[k + 1];
  return blue > 400;
})()"""


@pytest.mark.parametrize("value", ["2000000000", "null", "'text'", "zeroblob(5000000)"])
def test_mbtiles_value_that_is_no_tile_is_none(tmp_path: Path, value: str) -> None:
    path = tiles_in(tmp_path / "a.mbtiles", {(0, 0, 0): b"x"})
    with closing(sqlite3.connect(path)) as table, table:
        table.execute(f"update tiles set tile_data = {value}")
    assert base_map(str(path)).file is not None
    assert cast(TileFile, base_map(str(path)).file).picture(0, 0, 0) is None


def test_mbtiles_view_with_an_endless_query_is_aborted(tmp_path: Path) -> None:
    path = tiles_in(tmp_path / "a.mbtiles", {(0, 0, 0): b"x"})
    endless = "with recursive n(i) as (select 1 union all select i + 1 from n) select max(i) from n"
    file = cast(TileFile, base_map(str(path)).file)
    with closing(sqlite3.connect(path)) as table, table:
        table.execute("alter table tiles rename to sound")
        table.execute(
            "create view tiles as select zoom_level, tile_column, tile_row,"
            f" ({endless}) as tile_data from sound"
        )
    assert file.picture(0, 0, 0) is None
    assert file.picture(1, 0, 0) is None
