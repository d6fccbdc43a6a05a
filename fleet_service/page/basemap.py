"""Base map below the cells: raster tiles from an address, or from a file of the operator, served here.

The file is MBTiles 1.3 (github.com/mapbox/mbtiles-spec): images in a table of SQLite, rows counted from the south.
"""

from __future__ import annotations

import sqlite3
import threading
from pathlib import Path
from typing import Final, NamedTuple

from schemas.errors import InputError

ENDING: Final = ".mbtiles"
OWN: Final = "/base/{z}/{x}/{y}"  # address of the tiles of a file
KINDS: Final = {"png": "image/png", "jpg": "image/jpeg", "jpeg": "image/jpeg", "webp": "image/webp"}
ZOOMS: Final = (0, 19)  # that an address answers: as far as the public ones go
DEEPEST: Final = 30


class TileFile:
    """Raster tiles of a file; thread-safe.

    Args:
        path: ends in .mbtiles.

    Raises:
        InputError: it does not exist, or has no images.
    """

    def __init__(self, path: Path) -> None:
        self._lock = threading.Lock()
        if not path.is_file():
            raise _refused(f"{path} is not there")
        try:
            self._table = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True, check_same_thread=False)
            metadata = dict(self._table.execute("select name, value from metadata where name = 'format'"))
            least, most = self._table.execute("select min(zoom_level), max(zoom_level) from tiles").fetchone()
        except sqlite3.Error as error:
            raise _refused(f"{path} cannot be read ({error})") from error
        form = str(metadata.get("format"))
        if form not in KINDS or least is None:
            raise _refused(f"{path} holds {form} tiles" if least is not None else f"{path} holds no tile")
        self.kind, self.zooms = KINDS[form], (int(least), int(most))

    def picture(self, zoom: int, x: int, y: int) -> bytes | None:
        """Return a tile, counted from the north-west; None if there is none."""
        if not 0 <= zoom <= DEEPEST or not 0 <= max(x, y) < 1 << zoom:
            return None
        asked = "select tile_data from tiles where zoom_level = ? and tile_column = ? and tile_row = ?"
        with self._lock:
            found = self._table.execute(asked, (zoom, x, (1 << zoom) - 1 - y)).fetchone()
        return None if found is None else bytes(found[0])


class BaseMap(NamedTuple):
    """Address of the tiles with {z}, {x} and {y}, its zoom levels, and the file, if there is one."""

    address: str
    zooms: tuple[int, int] = ZOOMS
    file: TileFile | None = None


def base_map(text: str) -> BaseMap:
    """Return a base map from the text of the option.

    Raises:
        InputError: the text is neither an address of tiles nor a file of them.
    """
    if text.endswith(ENDING):
        file = TileFile(Path(text))
        return BaseMap(OWN, file.zooms, file)
    whole = all(f"{{{name}}}" in text for name in "zxy") and not any(mark in text for mark in " ;,'\"")
    if not whole or not text.startswith(("http://", "https://", "/")):
        raise _refused(f"{text[:60]!r} is no address of tiles")
    return BaseMap(text)


def _refused(problem: str) -> InputError:
    return InputError("base_map", problem, "write https://HOST/{z}/{x}/{y}.png, or name a .mbtiles of png, jpg or webp")
