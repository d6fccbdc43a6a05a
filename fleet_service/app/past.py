"""The map of a past moment, rebuilt in a process of its own: its memory is bounded before it reads, and goes with it.

That process (`past_process`) reads the question as JSON and writes the replies, each after its tile and length; an
error is a tile of -1.
"""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import pyarrow as pa

from fleet_service.fusion import Fusion, Observations
from fleet_service.replay.rebuild import Box, past, rows_near, too_much
from fleet_service.serve.map_state import MapState
from fleet_service.serve.query import answer
from fleet_service.serve.tile_cache import TileCache
from fleet_service.serve.visitors import Visitors
from schemas import grid
from schemas.errors import InputError
from schemas.query import MapQuery

MOST_ROWS: Final = 500_000  # that are fused: some seconds, and 100 MB
LOOKED_ROWS: Final = 20_000_000  # of row groups near the box, by the files' footers, read one at a time: half a minute
_HEAD: Final = struct.Struct("<qQ")
_ERROR: Final = -1


class PastQuery(NamedTuple):
    """A query about a moment [ns], with the lateness that the service had [s]; `only`: the one tile that is wanted;
    `public`: vehicles that a cell must have had lately to be shown."""

    query: MapQuery
    at: int
    lateness_s: float
    only: int | None
    public: int = 1


def ask(root: Path, question: PastQuery, wanted: Callable[[int], bool]) -> Iterator[tuple[int, bytes]]:
    """Tile and payload of every reply, from a process of its own.

    Raises:
        InputError: it would have to read too much, or the archive cannot be read.
        ChildProcessError: the process died.
    """
    box = box_of(question)
    most = MOST_ROWS if box is None else LOOKED_ROWS
    if rows_near(root, question.at, box, most) > most:
        raise too_much()
    command = [sys.executable, "-m", "fleet_service.app.past_process", str(root)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdin
        assert child.stdout
        with child.stdin as pipe:
            pipe.write(encoded(question))
        try:
            while head := child.stdout.read(_HEAD.size):
                tile, size = _HEAD.unpack(head)
                payload = child.stdout.read(size)
                if tile == _ERROR:
                    raise InputError(*json.loads(payload))
                if wanted(tile):
                    yield tile, payload
        finally:
            child.kill()
    if child.returncode not in (0, -9):
        raise ChildProcessError(f"the past could not be rebuilt ({child.returncode})")


def box_of(question: PastQuery) -> Box | None:
    """What a query looks at, if that is less than everything."""
    query = question.query
    if query.route is not None:
        longitudes, latitudes = zip(*query.route, strict=True)
        return min(longitudes), min(latitudes), max(longitudes), max(latitudes)
    if question.only is not None and query.bbox is None:
        west, south, east, north = (float(edge) for edge in grid.bounds(question.only, grid.TILE_ZOOM))
        return west, south, east, north
    return query.bbox


def replies(root: Path, question: PastQuery) -> Iterator[tuple[int, bytes]]:
    """Tile and payload of every reply.

    Raises:
        InputError: too many rows are in the box, or the archive cannot be read.
    """
    heard: list[Visitors] = []

    def listener(fusion: Fusion) -> Callable[[Observations], None]:
        heard.append(Visitors(fusion))
        return heard[0].heard

    listening = listener if question.public > 1 else None
    try:
        then = past(root, question.lateness_s, question.at, box_of(question), MOST_ROWS, listening)
    except OSError as error:
        raise InputError("at", f"the archive cannot be read ({error.strerror})", "ask again later") from error
    cache = TileCache(MapState(then), nullcontext(), question.public, heard[0] if heard else None)
    yield from answer(cache, question.query, lambda _: True, question.at, question.only)


def encoded(question: PastQuery) -> bytes:
    """A question for `answer_one`."""
    return json.dumps({**question._asdict(), "query": question.query.model_dump_json()}).encode()


def answer_one(root: Path, asked: BinaryIO, out: BinaryIO) -> None:
    """Answer the one question of a process that was begun for it."""
    pa.set_cpu_count(1)
    pa.set_io_thread_count(1)  # each thread that reads keeps memory of its own: 20 MB
    heard = json.loads(asked.read())
    question = PastQuery(**{**heard, "query": MapQuery.model_validate_json(heard["query"])})
    try:
        for tile, payload in replies(root, question):
            out.write(_HEAD.pack(tile, len(payload)) + payload)
    except InputError as error:
        payload = json.dumps([error.field, error.problem, error.fix]).encode()
        out.write(_HEAD.pack(_ERROR, len(payload)) + payload)
    out.flush()
