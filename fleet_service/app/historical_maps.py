"""Maps of past moments, rebuilt in a separate process. The memory of this process is limited in
advance and freed when the process ends.

This process (`past_process`) reads queries as lines of JSON. It writes the replies; each reply is
preceded by a head, which states the tile number and the length of the reply. Tile -1 marks an error
and -2 the end of an answer.
"""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import nullcontext, suppress
from pathlib import Path
from select import select
from typing import BinaryIO, Final, NamedTuple

import pyarrow as pa

from fleet_service.fusion import Fusion
from fleet_service.replay.rebuild import Box, EpochListener, past_fusion, rows_near, too_much
from fleet_service.serve.map_state import MapState
from fleet_service.serve.public_cells import PublicCells
from fleet_service.serve.query import answer_query
from fleet_service.serve.tile_cache import TileCache
from fleet_service.serve.visitors import Visitors
from schemas import grid
from schemas.errors import InputError
from schemas.query import MapQuery
from schemas.runtime.process import trim_memory

MOST_ROWS: Final = 500_000  # largest number of rows to fuse: some seconds of work and 100 MB
# Largest number of rows in files near the box, according to the files' footers. Reading them takes
# half a minute.
LOOKED_ROWS: Final = 20_000_000
# [s] Longest wait for the next part of an answer, four times the time for LOOKED_ROWS.
SILENT_S: Final = 120.0
IDLE_S: Final = 60.0  # [s] time for which an idle process waits for the next query
# Number of answers after which a process ends, so that the memory it has accumulated is released.
ANSWERS: Final = 100
_HEAD: Final = struct.Struct("<qQ")
_ERROR = -1
_END = -2


class PastQuery(NamedTuple):
    """Query about the map at a past moment.

    Attributes:
        query: parameters of the query.
        at: the moment [ns].
        lateness_s: allowed delay of observations [s]; observations with a longer delay count less.
        only: the only selected tile; None for any.
        public: smallest number of vehicles that must have visited a cell recently, so that readers
            may see the cell.
    """

    query: MapQuery
    at: int
    lateness_s: float
    only: int | None
    public: int = 1


class HistoricalMaps:
    """Answers to queries about past maps. They are computed in a separate process. Starting a
    process takes a second, so an idle one is kept for IDLE_S [s].

    Args:
        root: folder of the archive.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._idle: _Process | None = None

    def ask(
        self, question: PastQuery, is_requested: Callable[[int], bool]
    ) -> Iterator[tuple[int, bytes]]:
        """Yield the tile number and the payload of every reply to a query. `is_requested` returns
        True for the numbers of the tiles that are part of the answer.

        Raises:
            InputError: too many rows would have to be read, the archive cannot be read, or the
                process writes nothing for SILENT_S.
            ChildProcessError: the process died.
        """
        box = box_of(question)
        most = MOST_ROWS if box is None else LOOKED_ROWS
        if rows_near(self._root, question.at, box, most) > most:
            raise too_much()
        process = self._ask_process(question)
        try:
            for tile, payload in process.replies():
                if is_requested(tile):
                    yield tile, payload
        finally:
            self._release_process(process)

    def close(self) -> None:
        """End the process that rebuilds past maps, if it is idle."""
        if process := self._exchange_idle(None):
            process.end()

    def _ask_process(self, question: PastQuery) -> _Process:
        """Send a query about a past map to an idle or new process. Return this process, which has
        begun to reply.
        """
        if process := self._exchange_idle(None):
            with suppress(BrokenPipeError, ChildProcessError):  # if the process has just ended
                process.ask(question)
                return process
        process = _Process(self._root)
        process.ask(question)
        return process

    def _release_process(self, process: _Process) -> None:
        """Keep a process that has written its whole answer for the next query; end one that has
        not.
        """
        surplus = self._exchange_idle(process) if process.is_idle else process
        if surplus:
            surplus.end()

    def _exchange_idle(self, process: _Process | None) -> _Process | None:
        """Store an idle process (or None) for the next query; return the process that was stored
        before.
        """
        self._idle, before = process, self._idle
        return before


class _Process:
    """Process that answers queries about past maps one after the other, and exits when no query
    arrives for a while.
    """

    def __init__(self, root: Path) -> None:
        command = [sys.executable, "-m", "fleet_service.app.past_process", str(root)]
        self._child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert self._child.stdin
        assert self._child.stdout
        self._in = self._child.stdin
        self.out = self._child.stdout
        self.is_idle = True
        self._head = b""  # head of the next reply
        self._is_silent = False

    def ask(self, question: PastQuery) -> None:
        """Send a query about a past map to the process, and wait for the head (tile number and
        length) of the first reply. If this fails, the process is ended.
        """
        self.is_idle = False
        try:
            self._in.write(encode_question(question))
            self._in.flush()
            self._head = self._read_head()
        except BaseException:
            self.end()
            raise

    def replies(self) -> Iterator[tuple[int, bytes]]:
        """Yield the tile number and the payload of every reply to the query. The process is idle
        after the last one.

        Raises:
            InputError: the process cannot answer, or writes nothing for SILENT_S.
            ChildProcessError: the process died.
        """
        while True:
            tile, size = _HEAD.unpack(self._head)
            payload = self._read_payload(size)
            self.is_idle = tile in (_ERROR, _END)
            if tile == _ERROR:
                raise InputError(*json.loads(payload))
            if tile == _END:
                return
            yield tile, payload
            self._head = self._read_head()

    def _read_head(self) -> bytes:
        """Return the head of the next reply. Raise ChildProcessError if the process has ended."""
        head = self._read_bytes(_HEAD.size)
        if len(head) < _HEAD.size:
            raise ChildProcessError(f"the past map could not be rebuilt ({self._child.wait()})")
        return head

    def _read_payload(self, size: int) -> bytes:
        """Return a reply's payload of `size` bytes. Raise ChildProcessError if the process has
        ended before it was complete.
        """
        payload = self._read_bytes(size)
        if len(payload) < size:
            raise ChildProcessError(f"the past map is incomplete ({self._child.wait()})")
        return payload

    def _read_bytes(self, size: int) -> bytes:
        """Return the next `size` bytes from the process, fewer if it has ended. Kill it if they do
        not arrive within SILENT_S, because it holds up all later queries.
        """
        limit = threading.Timer(SILENT_S, self._kill_silent)
        limit.start()
        try:
            found = self.out.read(size)
        finally:
            limit.cancel()
        if self._is_silent and len(found) < size:
            raise InputError(
                "at", f"the past map made no progress for {SILENT_S:.0f} s", "use a smaller bbox"
            )
        return found

    def _kill_silent(self) -> None:
        self._is_silent = True
        self._child.kill()

    def end(self) -> None:
        """Kill the process that rebuilds past maps, and close its pipes."""
        self._child.kill()
        with suppress(BrokenPipeError):
            self._in.close()
        self.out.close()
        self._child.wait()


def box_of(question: PastQuery) -> Box | None:
    """Return the box (west, south, east, north [deg]) that a query about a past map reads; None for
    the whole map.
    """
    query = question.query
    if query.route is not None:
        longitudes, latitudes = zip(*query.route, strict=True)
        return min(longitudes), min(latitudes), max(longitudes), max(latitudes)
    if question.only is not None and query.bbox is None:
        west, south, east, north = (
            float(edge) for edge in grid.bounds(question.only, grid.TILE_ZOOM)
        )
        return west, south, east, north
    return query.bbox


def replies_to(root: Path, question: PastQuery) -> Iterator[tuple[int, bytes]]:
    """Answer a query about a past map: yield the tile number and the payload of every reply. This
    runs in a process of its own.

    Raises:
        InputError: too many rows are in the box, or the archive cannot be read.
    """
    public_cells: list[PublicCells] = []

    def make_listener(fusion: Fusion) -> EpochListener:
        public_cells.append(PublicCells(fusion, Visitors(fusion), question.public))
        return public_cells[0].follow

    listening = make_listener if question.public > 1 else None
    try:
        past = past_fusion(
            root, question.lateness_s, question.at, box_of(question), MOST_ROWS, listening
        )
    except OSError as error:
        raise InputError(
            "at", f"the archive cannot be read ({error.strerror or error})", "ask again later"
        ) from error
    cache = TileCache(
        MapState(past), nullcontext(), question.public, public_cells[0] if public_cells else None
    )
    yield from answer_query(cache, question.query, lambda _: True, question.at, question.only)


def encode_question(question: PastQuery) -> bytes:
    """Return a query about a past map as a line of JSON, which `answer_line` reads."""
    return (
        json.dumps({**question._asdict(), "query": question.query.model_dump_json()}).encode()
        + b"\n"
    )


def answer_line(root: Path, line: bytes, out: BinaryIO) -> None:
    """Answer one query about a past map, given as a line of JSON; write the replies to `out`."""
    fields = json.loads(line)
    question = PastQuery(**{**fields, "query": MapQuery.model_validate_json(fields["query"])})
    try:
        for tile, payload in replies_to(root, question):
            out.write(_HEAD.pack(tile, len(payload)) + payload)
        out.write(_HEAD.pack(_END, 0))
    except InputError as error:
        payload = json.dumps([error.field, error.problem, error.fix]).encode()
        out.write(_HEAD.pack(_ERROR, len(payload)) + payload)
    out.flush()


def answer_all(root: Path, query_stream: BinaryIO, out: BinaryIO) -> None:
    """Answer queries about past maps until none arrives for IDLE_S [s], or until ANSWERS queries
    have been answered.
    """
    pa.set_cpu_count(1)
    pa.set_io_thread_count(1)  # each reading thread needs 20 MB of memory
    for _ in range(ANSWERS):
        if not select([query_stream], [], [], IDLE_S)[0] or not (line := query_stream.readline()):
            return
        answer_line(root, line, out)
        trim_memory()
