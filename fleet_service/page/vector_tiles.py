"""Vector tiles: an encoder of Mapbox Vector Tiles 2.1, and a reader of PMTiles 3 files. Pure except
for the reader's file.

The encoder is for small generated maps such as the demo's town; it writes the layers that the
page's base map draws. The reader serves tiles from an operator's own file, so that no tile server
is needed. References: github.com/mapbox/vector-tile-spec/tree/master/2.1,
github.com/protomaps/PMTiles/blob/main/spec/v3.
"""

from __future__ import annotations

import gzip
import io
import json
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from schemas.errors import InputError

EXTENT: Final = 4096
POINT = 1
LINE = 2
POLYGON = 3
_MOVE = 1
_DRAW = 2
_CLOSE = 7
_GZIP: Final = b"\x1f\x8b"
_MAGIC: Final = b"PMTiles\x03"
_HEAD: Final = struct.Struct("<7sB11Q6B")
_NO_COMPRESSION = 1
_GZIP_COMPRESSION = 2
_MVT = 1
_MOST_DIRECTORY: Final = 16 << 20
MOST_UNPACKED: Final = 16 << 20  # [bytes] largest unpacked tile or directory


class TileShape(NamedTuple):
    """Shape in a layer of a vector tile.

    Attributes:
        kind: points, lines or rings.
        parts: coordinates of each part, as integers from 0 to EXTENT across the tile, y downwards.
        tags: properties of the shape.
    """

    kind: int
    parts: Sequence[Sequence[tuple[int, int]]]
    tags: Mapping[str, str | int]


def encode_tile(layers: Mapping[str, Iterable[TileShape]]) -> bytes:
    """Return a vector tile with the given layers; layers without shapes are left out."""
    return b"".join(
        _bytes_field(3, _encode_layer(name, list(shapes)))
        for name, shapes in layers.items()
        if shapes
    )


def _encode_layer(name: str, shapes: list[TileShape]) -> bytes:
    keys: dict[str, int] = {}
    values: dict[str | int, int] = {}
    found = [_number_field(15, 2), _bytes_field(1, name.encode())]
    for shape in shapes:
        tags = b"".join(
            _encode_varint(keys.setdefault(key, len(keys)))
            + _encode_varint(values.setdefault(value, len(values)))
            for key, value in shape.tags.items()
        )
        body = (
            _bytes_field(2, tags)
            + _number_field(3, shape.kind)
            + _bytes_field(4, _encode_geometry(shape))
        )
        found.append(_bytes_field(2, body))
    found += [_bytes_field(3, key.encode()) for key in keys]
    found += [
        _bytes_field(4, _bytes_field(1, v.encode()) if isinstance(v, str) else _number_field(5, v))
        for v in values
    ]
    return b"".join([*found, _number_field(5, EXTENT)])


def _encode_geometry(shape: TileShape) -> bytes:
    out = []
    x = 0
    y = 0

    def move_to(points: Sequence[tuple[int, int]]) -> None:
        nonlocal x, y
        for px, py in points:
            out.append(_encode_varint(_zigzag(px - x)) + _encode_varint(_zigzag(py - y)))
            x = px
            y = py

    for part in shape.parts:
        if shape.kind == POINT:
            out.append(_encode_varint(_MOVE | len(part) << 3))
            move_to(part)
            continue
        out.append(_encode_varint(_MOVE | 1 << 3))
        move_to(part[:1])
        out.append(_encode_varint(_DRAW | (len(part) - 1) << 3))
        move_to(part[1:])
        if shape.kind == POLYGON:
            out.append(_encode_varint(_CLOSE | 1 << 3))
    return b"".join(out)


def _zigzag(value: int) -> int:
    return value << 1 if value >= 0 else (-value << 1) - 1


def _encode_varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    out.append(value)
    return bytes(out)


def _number_field(field: int, value: int) -> bytes:
    return _encode_varint(field << 3) + _encode_varint(value)


def _bytes_field(number: int, body: bytes) -> bytes:
    return _encode_varint(number << 3 | 2) + _encode_varint(len(body)) + body


def unpack_tile(tile: bytes) -> bytes | None:
    """Return a base map tile after decompression, if it is compressed; None if it is damaged or
    larger than MOST_UNPACKED.
    """
    if not tile.startswith(_GZIP):
        return tile if len(tile) <= MOST_UNPACKED else None
    try:
        with gzip.open(io.BytesIO(tile)) as file:
            found = file.read(MOST_UNPACKED + 1)
    except (OSError, EOFError, zlib.error):
        return None
    return found if len(found) <= MOST_UNPACKED else None


class PmtilesFile:
    """Vector tiles of a PMTiles file; thread-safe.

    Args:
        path: path that ends in .pmtiles.

    Raises:
        InputError: the file does not exist, is not PMTiles 3, or contains no vector tiles.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            head = self._read(0, 127)
        except OSError as error:
            raise _refusal_of(f"{path} cannot be read ({error.strerror})") from error
        if len(head) < 127 or not head.startswith(_MAGIC):
            raise _refusal_of(f"{path} is not a PMTiles file of version 3")
        fields = _HEAD.unpack(head[: _HEAD.size])
        (self._root, self._root_size, about, about_size, self._leaves, _, self._data, *_) = fields[
            2:
        ]
        _, self._packing, tile_packing, kind, least, most = fields[-6:]
        if kind != _MVT:
            raise _refusal_of(f"{path} contains images; give them as .mbtiles")
        packings = (_NO_COMPRESSION, _GZIP_COMPRESSION)
        if self._packing not in packings or tile_packing not in packings:
            raise _refusal_of(f"{path} uses an unsupported compression (gzip is supported)")
        self.zooms = (int(least), int(most))
        try:
            about_map = json.loads(self._part(about, about_size) or b"{}")
        except (ValueError, OSError, OverflowError, RecursionError) as error:
            raise _refusal_of(f"{path} is damaged: its metadata cannot be read") from error
        self.metadata: dict[str, Any] = about_map if isinstance(about_map, dict) else {}

    def tile(self, zoom: int, x: int, y: int) -> bytes | None:
        """Return a base map tile after decompression, with rows counted from the north; None if
        there is no such tile, or if its part of the file is damaged.
        """
        try:
            return self._find_tile(zoom, x, y)
        except (StopIteration, OSError, OverflowError, ValueError):
            return None

    def _find_tile(self, zoom: int, x: int, y: int) -> bytes | None:
        tile_number = _hilbert_number(zoom, x, y)
        offset = self._root
        size = self._root_size
        for _ in range(4):
            entry = _find_entry(self._part(offset, size), tile_number)
            if entry is None:
                return None
            start, size, run = entry
            if run:
                return unpack_tile(self._read(self._data + start, min(size, MOST_UNPACKED + 1)))
            offset = self._leaves + start
        return None

    def _part(self, offset: int, size: int) -> bytes:
        raw = self._read(offset, min(size, _MOST_DIRECTORY))
        part = unpack_tile(raw)
        if part is None:
            raise ValueError("a damaged directory")
        return part

    def _read(self, offset: int, size: int) -> bytes:
        # Open the file for each call, so that threads do not share a file position.
        with self._path.open("rb") as file:
            file.seek(offset)
            return file.read(size)


def _find_entry(directory: bytes, tile_number: int) -> tuple[int, int, int] | None:
    """Return offset, size and run length of the last entry of a PMTiles directory whose tile number
    is at most `tile_number`. A run length of 0 means that the entry refers to a further directory.
    """
    numbers = _decode_varints(directory)
    count = next(numbers)
    ids = []
    at = 0
    for _ in range(count):
        at += next(numbers)
        ids.append(at)
    runs = [next(numbers) for _ in range(count)]
    sizes = [next(numbers) for _ in range(count)]
    offsets: list[int] = []
    for k in range(count):
        encoded_offset = next(numbers)
        offsets.append(
            offsets[-1] + sizes[k - 1] if encoded_offset == 0 and k else encoded_offset - 1
        )
    place = max((k for k in range(count) if ids[k] <= tile_number), default=-1)
    if place < 0 or (runs[place] and tile_number >= ids[place] + runs[place]):
        return None
    return offsets[place], sizes[place], runs[place]


def _decode_varints(data: bytes) -> Iterator[int]:
    value = 0
    shift = 0
    for byte in data:
        value |= (byte & 127) << shift
        if byte & 128:
            shift += 7
        else:
            yield value
            value = 0
            shift = 0


def _hilbert_number(zoom: int, x: int, y: int) -> int:
    """Return the number of a tile in PMTiles: the number of tiles of all smaller zooms, plus the
    position on the Hilbert curve.
    """
    found: int = (4**zoom - 1) // 3
    side = 1 << zoom >> 1
    while side:
        right = int(bool(x & side))
        below = int(bool(y & side))
        found += side * side * ((3 * right) ^ below)
        if not below:
            if right:
                x = side - 1 - x
                y = side - 1 - y
            x, y = y, x
        x = x & (side - 1)
        y = y & (side - 1)
        side = side >> 1
    return found


def _refusal_of(problem: str) -> InputError:
    return InputError(
        "base_map",
        problem,
        "create one with `pmtiles extract`, see the how-to guide of the live page",
    )
