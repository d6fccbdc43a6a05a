"""Base map below the roads: vector or raster tiles from a file that this server reads, or raster
tiles from a web address.

Supported files are MBTiles 1.3 (github.com/mapbox/mbtiles-spec: an SQLite table, rows counted from
the south) with images or vector tiles, and PMTiles 3 with vector tiles. The layers of vector tiles
must be those of OpenMapTiles or Protomaps.
"""

from __future__ import annotations

import re
import sqlite3
import threading
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

from fleet_service.page.vector_tiles import PmtilesFile, unpack_tile
from schemas.errors import InputError

MBTILES = ".mbtiles"
PMTILES = ".pmtiles"
OWN: Final = "/base/{z}/{x}/{y}"  # URL path of tiles that this server reads from a file
VECTOR: Final = "pbf"
KINDS: Final = {
    "png": "image/png",
    "jpg": "image/jpeg",
    "jpeg": "image/jpeg",
    "webp": "image/webp",
    VECTOR: "application/vnd.mapbox-vector-tile",
}
ZOOMS: Final = (0, 19)  # zoom levels of tiles at a URL, as at public servers
DEEPEST: Final = 30
MOST_BYTES: Final = 4 << 20  # [bytes] largest tile
# A query for a tile is stopped after MOST_STEPS times STEP instructions of SQLite. With an index it
# needs fewer than STEP.
STEP: Final = 10_000
MOST_STEPS: Final = 100
_TAG: Final = re.compile(r"<[^>]*>")


class TileSource(Protocol):
    """Interface of a file that contains the tiles of a base map, whatever its format."""

    kind: str
    zooms: tuple[int, int]

    def picture(self, zoom: int, x: int, y: int) -> bytes | None:
        """Return the bytes of a base map tile, with rows counted from the north; None if there is
        no such tile.
        """
        ...


class TileFile:
    """Base map tiles of an MBTiles file; thread-safe.

    Args:
        path: path that ends in .mbtiles.

    Raises:
        InputError: the file does not exist, or has no tiles.
    """

    def __init__(self, path: Path) -> None:
        self._lock = threading.Lock()
        if not path.is_file():
            raise _base_map_error(f"{path} does not exist")
        try:
            self._table = sqlite3.connect(
                f"{path.resolve().as_uri()}?mode=ro", uri=True, check_same_thread=False
            )
            self.metadata: dict[str, Any] = dict(
                self._table.execute("select name, value from metadata")
            )
            least, most = self._table.execute(
                "select min(zoom_level), max(zoom_level) from tiles"
            ).fetchone()
        except sqlite3.Error as error:
            raise _base_map_error(f"{path} cannot be read ({error})") from error
        form = str(self.metadata.get("format"))
        if form not in KINDS or least is None:
            raise _base_map_error(
                f"{path} contains {form} tiles" if least is not None else f"{path} holds no tile"
            )
        self.kind = KINDS[form]
        self.zooms = (int(least), int(most))

    def picture(self, zoom: int, x: int, y: int) -> bytes | None:
        """Return the bytes of a base map tile after decompression, with rows counted from the
        north; None if there is no such tile.
        """
        if not 0 <= zoom <= DEEPEST or not 0 <= max(x, y) < 1 << zoom:
            return None
        statement = (
            "select tile_data from tiles where zoom_level = ? and tile_column = ? and tile_row = ?"
        )
        with self._lock:
            steps = iter(range(MOST_STEPS))
            self._table.set_progress_handler(lambda: next(steps, None) is None, STEP)
            try:
                found = self._table.execute(statement, (zoom, x, (1 << zoom) - 1 - y)).fetchone()
            except sqlite3.Error:  # the file is damaged, or its view needs too many instructions
                return None
        if found is None or not isinstance(found[0], bytes) or len(found[0]) > MOST_BYTES:
            return None
        return unpack_tile(found[0])


class _Pmtiles:
    """Base map tiles of a PMTiles file."""

    def __init__(self, path: Path) -> None:
        self._file = PmtilesFile(path)
        self.kind = KINDS[VECTOR]
        self.zooms = self._file.zooms
        self.metadata = self._file.metadata

    def picture(self, zoom: int, x: int, y: int) -> bytes | None:
        """Return the bytes of a base map tile, with rows counted from the north; None if there is
        no such tile.
        """
        if not 0 <= zoom <= DEEPEST or not 0 <= max(x, y) < 1 << zoom:
            return None
        return self._file.tile(zoom, x, y)


class BaseMap(NamedTuple):
    """Base map: address or file of its tiles, and their authors.

    Attributes:
        address: address of the tiles with {z}, {x} and {y}.
        zooms: smallest and largest zoom level that has tiles.
        file: file of the tiles; None for tiles from elsewhere.
        attribution: text that names the authors of the base map; the page shows it.
    """

    address: str
    zooms: tuple[int, int] = ZOOMS
    file: TileSource | None = None
    attribution: str = ""

    @property
    def is_vector(self) -> bool:
        """Return True if the base map's tiles are vector tiles, False if they are images."""
        return self.file is not None and self.file.kind == KINDS[VECTOR]


def base_map(text: str, attribution: str | None = None) -> BaseMap:
    """Return a base map from the text of the command-line option. `attribution` replaces the
    attribution in the file.

    Raises:
        InputError: the text is neither an address of tiles nor a file with tiles.
    """
    if text.endswith((MBTILES, PMTILES)):
        file = TileFile(Path(text)) if text.endswith(MBTILES) else _Pmtiles(Path(text))
        named = (
            attribution if attribution is not None else str(file.metadata.get("attribution") or "")
        )
        return BaseMap(OWN, file.zooms, file, _TAG.sub("", named).strip())
    whole = all(f"{{{name}}}" in text for name in "zxy") and not any(
        mark in text for mark in " ;,'\""
    )
    if not whole or not text.startswith(("http://", "https://", "/")):
        raise _base_map_error(f"{text[:60]!r} is not a URL of tiles")
    return BaseMap(text, attribution=attribution or "")


def _base_map_error(problem: str) -> InputError:
    return InputError(
        "base_map",
        problem,
        "write https://HOST/{z}/{x}/{y}.png, or name an .mbtiles or .pmtiles file",
    )
