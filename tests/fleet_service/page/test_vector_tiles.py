"""Tests of vector tiles. Tiles must have the ids that the PMTiles library gives them. A written
file must be read back unchanged, and the page must draw the tiles.
"""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from fleet_service.page.basemap import base_map
from fleet_service.page.vector_tiles import (
    LINE,
    MOST_UNPACKED,
    POINT,
    POLYGON,
    PmtilesFile,
    TileShape,
    encode_tile,
    unpack_tile,
)
from schemas.errors import InputError

pmtiles_tile = pytest.importorskip("pmtiles.tile")
pmtiles_writer = pytest.importorskip("pmtiles.writer")
TILES = {
    (z, x, y): f"{z}/{x}/{y}".encode()
    for z in range(7)
    for x in range(2**z)
    for y in range(0, 2**z, 2)
}


def write(path: Path, kind: int = 1) -> Path:
    """Write a PMTiles file (map tiles in one file) with leaf directories, by the PMTiles library.
    Return the file's path.
    """
    with path.open("wb") as file:
        writer = pmtiles_writer.Writer(file)
        for (z, x, y), data in sorted(
            TILES.items(), key=lambda one: pmtiles_tile.zxy_to_tileid(*one[0])
        ):
            writer.write_tile(pmtiles_tile.zxy_to_tileid(z, x, y), gzip.compress(data, mtime=0))
        head = {
            "tile_type": pmtiles_tile.TileType(kind),
            "tile_compression": pmtiles_tile.Compression.GZIP,
            "min_lon_e7": 0,
            "min_lat_e7": 0,
            "max_lon_e7": 0,
            "max_lat_e7": 0,
            "center_zoom": 0,
            "center_lon_e7": 0,
            "center_lat_e7": 0,
        }
        writer.finalize(head, {"attribution": "<a href='x'>© somebody</a>"})
    return path


@pytest.mark.campaign
def test_every_tile_of_a_pmtiles_file_is_found_and_no_other(tmp_path: Path) -> None:
    file = PmtilesFile(write(tmp_path / "map.pmtiles"))
    assert file.zooms == (0, 6)
    assert {place: file.tile(*place) for place in TILES} == TILES
    assert file.tile(3, 1, 1) is None
    assert file.tile(9, 1, 1) is None


def test_the_base_map_names_its_makers_without_markup(tmp_path: Path) -> None:
    found = base_map(str(write(tmp_path / "map.pmtiles")))
    assert found.is_vector
    assert found.attribution == "© somebody"
    assert base_map(str(tmp_path / "map.pmtiles"), "me").attribution == "me"


def test_file_that_is_no_vector_pmtiles_is_refused(tmp_path: Path) -> None:
    (tmp_path / "no.pmtiles").write_bytes(b"no" * 100)
    for path in (
        tmp_path / "no.pmtiles",
        tmp_path / "none.pmtiles",
        write(tmp_path / "images.pmtiles", kind=2),
    ):
        with pytest.raises(InputError, match="base_map"):
            base_map(str(path))


def test_a_tile_is_the_bytes_of_the_specification() -> None:
    """A point, a line and a polygon must be encoded to the bytes of the examples in section 4.3.5
    of the vector tile specification.
    """
    point = encode_tile({"p": [TileShape(POINT, [[(25, 17)]], {})]})
    assert bytes([9, 50, 34]) in point
    line = encode_tile({"l": [TileShape(LINE, [[(2, 2), (2, 10), (10, 10)]], {})]})
    assert bytes([9, 4, 4, 18, 0, 16, 16, 0]) in line
    ring = encode_tile({"r": [TileShape(POLYGON, [[(3, 6), (8, 12), (20, 34)]], {})]})
    assert bytes([9, 6, 12, 18, 10, 12, 24, 44, 15]) in ring
    assert encode_tile({"empty": []}) == b""


def test_damaged_pmtiles_file_has_no_tiles_and_raises_nothing(tmp_path: Path) -> None:
    path = write(tmp_path / "map.pmtiles")
    sound = path.read_bytes()
    rng = np.random.default_rng(5)
    for _ in range(60):
        content = np.frombuffer(sound, np.uint8).copy()
        at = rng.integers(100, len(content), 200)
        content[at] = rng.integers(0, 256, len(at))
        path.write_bytes(content.tobytes())
        try:
            file = PmtilesFile(path)
        except InputError:
            continue
        for place in list(TILES)[::400]:
            assert isinstance(file.tile(*place), bytes | None)


def test_compressed_bomb_is_no_tile() -> None:
    bomb = gzip.compress(bytes(MOST_UNPACKED + 1))
    assert len(bomb) < 100_000
    assert unpack_tile(bomb) is None
    assert unpack_tile(bomb[:1000]) is None
    assert unpack_tile(gzip.compress(b"tile")) == b"tile"
