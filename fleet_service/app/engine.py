"""Core of the service without its network: messages in; alerts, tiles, acknowledgements and answers out.

One worker calls `ingest`, `begin_flush`, `end_flush`, `flush`, `tile` and `fade_alerts`. Queries come from other
threads, so a lock guards the map.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import compress
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyarrow as pa

from fleet_service.app.clock import TimeNow
from fleet_service.app.memory import SLOTS, ServiceState, load_state, visitor_tables
from fleet_service.app.past import HistoricalMaps, PastQuery
from fleet_service.app.precompile import warm_up
from fleet_service.app.tasks import Tasks
from fleet_service.archive.format.layout import Cut
from fleet_service.archive.format.load import count_set_aside, set_aside
from fleet_service.archive.format.segments import Rows
from fleet_service.archive.identity.pseudonyms import Pseudonyms
from fleet_service.archive.identity.vehicle_ids import remove_damaged_lines
from fleet_service.archive.segment_log import SegmentLog
from fleet_service.fusion import observations_of
from fleet_service.fusion.standing import UNCORRECTED
from fleet_service.fusion.weather import Reports
from fleet_service.ingest.acks import Acks
from fleet_service.ingest.budgets import NewCells
from fleet_service.ingest.dedup import BatchId
from fleet_service.ingest.inbox import AcceptedBatches, BatchIntake, Message
from fleet_service.ingest.paths import VehiclePaths
from fleet_service.ingest.validation import Clock
from fleet_service.ingest.weather import WeatherInbox
from fleet_service.ingest.weather import files as weather_files
from fleet_service.replay import checkpoints
from fleet_service.replay.checkpoints import Taken
from fleet_service.replay.restart import image_of
from fleet_service.replication.bucket import CopyError
from fleet_service.replication.ownership import Ownership, open_exclusive
from fleet_service.serve.encode import batch_of
from fleet_service.serve.query import AnswerSize, answer, size_asked
from fleet_service.serve.tile_cache import TileCache
from schemas import grid, wire
from schemas.config import ServiceConfig, nanoseconds
from schemas.errors import InputError
from schemas.numeric import BoolArray, IntArray
from schemas.query import MapQuery
from schemas.tables import MAP_SCHEMA
from schemas.thresholds import NS
from schemas.wire import Alert, Kind

# Rows that wait for the disk at the most; beyond, nothing is taken from the queue until a segment is written.
WAITING_ROWS = 1_000_000
WAITING_BATCHES = 1_000_000  # likewise, of rows that are on disk and not yet in the copy: 100 MB
T = TypeVar("T")
ERASED = "what it was raised on was erased"


class Engine:
    """State of one service, rebuilt from its archive; `seen` is the latest time in a report [ns].

    Args:
        config: settings.
        root: of the archive; it is locked while the engine is open.
        holding: ownership of the archive, closed with the engine; None to open the archive now, without a lease.

    Raises:
        InputError: another service holds the archive.
        OSError: the archive cannot be read or written.
    """

    def __init__(self, config: ServiceConfig, root: Path, holding: Ownership | None = None) -> None:
        self._config, self._root, self._past = config, root, HistoricalMaps(root)
        self.holding = holding or open_exclusive(
            config, root
        )  # before anything is read: an empty disk is filled from the copy
        self.copy = self.holding.copy
        try:
            self._open(config, root)
        except BaseException:
            self.holding.close()
            raise

    def _open(self, config: ServiceConfig, root: Path) -> None:
        """Load the state from the archive."""
        self.counts: Counter[str] = Counter()
        self.report_lag_s = 0.0  # between the end of the newest visit and its arrival
        self._paths, self._places = VehiclePaths(), NewCells()
        self._turn = 0  # of the alerts that are told again
        self.failing = False  # the last segment could not be written
        self.counts["witnesses_damaged"] += remove_damaged_lines(root / "keys")
        self._guard = threading.Lock()
        self._acks, self._now = Acks(), 0
        upload = None if self.copy is None else self.copy.upload_segments
        self._log: SegmentLog[BatchId] = SegmentLog(root, config.name, upload, self.holding.epoch)
        self._wanted = Tasks()
        self._ended: list[Alert] = []  # alerts that nobody was told the end of yet
        memory = load_state(root, config, set_aside)
        self.counts["checkpoints_refused"] += memory.refused
        self.weather = WeatherInbox(root, config.name, memory.fusion, self.counts)
        self._adopt(memory)
        self.seen = self._streams.newest
        self.counts["files_set_aside"] = count_set_aside(root)
        if config.weather is not None:
            self._use(self.weather.begin(config.weather, memory.weather, time.time_ns()))
        warm_up()

    def _adopt(self, memory: ServiceState) -> None:
        """Adopt a state loaded from the archive."""
        self._memory = memory
        self.fusion, self.map, self._alerts, self._streams = memory.fusion, memory.map, memory.alerts, memory.streams
        self._visitors = memory.visitors
        self._tiles = TileCache(self.map, self._guard, self._config.public_vehicles, self._visitors)
        self._intake = BatchIntake(self._streams, Pseudonyms(self._root / "keys"), self.counts, self._acks)
        self.weather.fusion = self.fusion

    def reload_state(self, before: Callable[[], None]) -> None:
        """Call `before`, then replace the state by what the archive holds; call it in `run_between_segments`.

        Raises:
            OSError: the archive cannot be read; the state stays.
        """
        stood = self._alerts.standing_alerts
        before()
        memory = load_state(self._root, self._config, set_aside)
        with self._guard:
            self._paths, self._places = VehiclePaths(), NewCells()
            self._adopt(memory)
            still = {(alert.cell, alert.sector) for alert in self._alerts.standing_alerts}
            ended = [alert for alert in stood if (alert.cell, alert.sector) not in still]
            self._ended += [replace(alert, raised=False, reason=ERASED) for alert in ended]

    def drop_old(self) -> int:
        """Drop old cells that are back at the prior; return their number. Call it in `run_between_segments`."""
        with self._guard:
            return self._memory.drop_old()

    def checkpoint(self, stop: threading.Event) -> Taken | None:
        """Return the state and the last segment it includes; None if stopped meanwhile.

        The worker copies the state right after a segment, when every row in it is on disk. Another thread calls this.
        """
        return self.run_between_segments(self._image, stop)

    def run_between_segments(self, work: Callable[[], T], stop: threading.Event) -> T | None:
        """Let the worker run `work` right after a segment, when every row it took is on disk; return the result.

        None if stopped meanwhile. Another thread calls this.

        Raises:
            OSError: no segment could be written for too long.
        """
        return self._wanted.ask(work, stop)

    def _image(self) -> Taken:
        with self._guard:
            tables = image_of(self.fusion, self._alerts.standing_alerts, self._streams) | visitor_tables(self._visitors)
        return Taken(tables, self.newest_segment, tuple(path.name for path in weather_files(self._root)))

    @property
    def newest_segment(self) -> Cut:
        """Return the last written segment."""
        return self._log.newest

    def mark_survived(self) -> None:
        """Record that the service has run for a while with the checkpoint it began from."""
        checkpoints.mark_survived(self._root)

    def close(self) -> None:
        """Release the archive."""
        self._past.close()
        self.mark_survived()
        self._log.close()
        self.holding.close()

    @property
    def is_full(self) -> bool:
        """True if too many rows wait for the disk, or batches for the copy."""
        return self._log.rows >= WAITING_ROWS or self._log.unsettled >= WAITING_BATCHES

    @property
    def unsettled(self) -> int:
        """Number of admitted batches that are not on disk yet."""
        return self._log.unsettled

    @property
    def newest(self) -> int:
        """Latest time of an admitted record [ns]; a restart finds the same as `seen`."""
        return self._streams.newest

    @property
    def hangs_s(self) -> float:
        """How long the current segment has been written [s]."""
        return self._log.hangs_s

    @property
    def alerts(self) -> int:
        """Number of cells under alert."""
        return len(self._alerts.slots)

    @property
    def alert_slots(self) -> IntArray:
        """Return the slots under alert, (k,)."""
        return np.array(sorted(self._alerts.slots), np.int64)

    def standing_alerts(self, wanted: Callable[[int], bool]) -> list[tuple[int, bytes]]:
        """Return tile and payload of the standing alerts of selected tiles."""
        tiles: dict[int, list[Alert]] = {}
        with self._guard:
            for alert in self._alerts.standing_alerts:
                tiles.setdefault(int(grid.tile_of(alert.cell)), []).append(alert)
        return [(tile, wire.encode_standing(alerts)) for tile, alerts in tiles.items() if wanted(tile)]

    def alerts_to_repeat(self, most: int) -> list[Alert]:
        """Return at most `most` standing alerts, in turn, so that clients that were away receive them too."""
        with self._guard:
            standing = self._alerts.standing_alerts
        self._turn = self._turn % max(len(standing), 1)
        out = standing[self._turn : self._turn + most]
        self._turn += len(out)
        return out

    def ingest(self, messages: Sequence[Message], at: int | TimeNow) -> list[Alert]:
        """Admit and fuse messages; return the alerts that they raise or clear. `at` is the time; a number is
        certain."""
        at = at if isinstance(at, TimeNow) else TimeNow(at)
        now, ahead = at.now, int(self._config.clock_ahead_s * NS) + at.slack
        clock = Clock(now, ahead, int(self._config.oldest_s * NS), at.doubt, at.least)
        self._now = clock.now
        out: list[Alert] = []
        for kind, accepted in self._intake.accept(messages, clock).items():
            if kind is Kind.OBSERVATION:
                out += self._fuse(accepted)
            self.counts[kind] += len(accepted.rows["row"])
            self._log.add(kind, accepted.rows, accepted.batches)
        return out

    @property
    def times(self) -> dict[str, int]:
        """Return the newest time that each vehicle reported in the last `ingest` [ns]."""
        return self._intake.times

    def _fuse(self, accepted: AcceptedBatches) -> list[Alert]:
        rows = accepted.rows
        self.report_lag_s = float((rows["received_at"] - rows["leave_time"]).min()) * 1e-9
        with self._guard:
            heard = np.flatnonzero(~self._excluded_from_fusion(rows))
            taken = observations_of(rows, rows["witness"]).take(heard)
            updated = self.fusion.update(taken)
            if self._visitors is not None:
                self._visitors.add(taken)
            self.map.mark_changed(updated.slots)
            raised = self._alerts.update(updated.slots)
            if raised:
                self._tiles.acknowledge()
        n = len(rows["row"])
        rows["late"], rows["late_by"] = np.ones(n, bool), np.zeros(n, np.int64)
        rows["weight"] = np.zeros(n, np.float32)
        rows["late"][heard], rows["late_by"][heard] = updated.late, updated.late_by
        rows["weight"][heard] = updated.weight
        rows |= {name: np.full(n, value, np.float32) for name, value in UNCORRECTED.items()}
        self.counts["late"] += int(updated.late.sum())
        if updated.late.any():
            missed = np.zeros(n, bool)
            missed[heard] = updated.late
            of_batch = np.logical_or.reduceat(missed, np.flatnonzero(rows["row"] == 0))
            self._acks.record_late(compress(accepted.batches, of_batch.tolist()))
        return raised

    def _excluded_from_fusion(self, rows: Rows) -> BoolArray:
        """Return which rows are archived and not fused: their vehicle cannot be there, or reports too many new
        places."""
        witness = rows["witness"]
        beyond = self._paths.find_implausible(witness, rows["leave_time"], rows["latitude"], rows["longitude"])
        self.counts["implausible_moves"] += int(beyond.sum())
        new = np.flatnonzero((self.fusion.slots_of(rows["cell"], rows["sector"].astype(np.int64)) < 0) & ~beyond)
        over = self._places.beyond(witness[new], rows["cell"][new], float(rows["received_at"][0]) / NS)
        beyond[new[over]] = True
        self.counts["too_many_places"] += int(over.sum())
        return beyond

    def update_weather(self, now: int) -> None:
        """Apply the weather that arrived since the last call."""
        self._use(self.weather.take(now))

    def _use(self, reports: Reports | None) -> None:
        if reports is not None:
            with self._guard:
                self.fusion.update_weather(reports)
            self.counts["weather"] += len(reports.time)

    def flush(self) -> list[tuple[str, bytes]]:
        """Write waiting rows as durable segments; return vehicle and bytes of the acknowledgements to send.

        A full disk is counted, and the next call tries again; nothing of it is acknowledged.
        """
        acks = self._acknowledged(self._log.flush)
        if not self.failing:
            self._wanted.do()
        return acks

    def begin_flush(self) -> list[tuple[str, bytes]]:
        """Begin a flush; messages may be processed while segments are written. `end_flush` returns the acks.

        If work waits for `run_between_segments`, this is `flush`.
        """
        if self._wanted:
            return self.flush()
        self._log.begin()
        return []

    def end_flush(self) -> list[tuple[str, bytes]]:
        """Return the acknowledgements of a flush that was begun and has ended."""
        return self._acknowledged(self._log.end) if self._log.ended else []

    def _acknowledged(self, durable: Callable[[], list[BatchId]]) -> list[tuple[str, bytes]]:
        try:
            self._intake.sync()
            self._intake.acknowledge(durable())
        except OSError as error:
            if isinstance(error, CopyError) and self.copy is not None:
                self.counts["copy_failures"] = self.copy.failures
            else:
                self.counts["segment_failures"] += 1
            self.failing = True
        else:
            self.failing = False
            self._tiles.acknowledge()
        return self._acks.messages(self._now) if self.holding.may_acknowledge else []

    def tile(self, tile: int, now: int) -> bytes:
        """Return the Arrow stream of the public cells of a tile; empty if there are none."""
        shown = self._tiles.make(tile, now)
        return shown.payload if shown.cells.num_rows else b""

    def tiles(self, now: int) -> list[tuple[int, bytes]]:
        """Return tile and payload of every tile that changed since the last call and is not empty."""
        return [(tile, stream) for tile in self.map.take_dirty() if (stream := self.tile(tile, now))]

    def whole_map(self, now: int) -> pa.Table:
        """Return all public cells; the lock is held for a few at a time, so that ingest continues."""
        tables = []
        for start in range(0, self.fusion.size, SLOTS):
            with self._guard:
                slots = np.arange(start, min(start + SLOTS, self.fusion.size))
                seen = self._tiles.seen(self._tiles.public(slots, now), now)
                tables.append(pa.Table.from_batches([batch_of(seen, now)]))
        return pa.concat_tables([*tables, MAP_SCHEMA.empty_table()])

    def fade_alerts(self, now: int) -> list[Alert]:
        """Return the alerts that expired or were erased."""
        with self._guard:
            ended, self._ended = [replace(alert, time=now) for alert in self._ended], []
            return ended + self._alerts.expire(now)

    def answer(
        self, query: MapQuery, wanted: Callable[[int], bool], now: int, only: int | None = None
    ) -> Iterator[tuple[int, bytes]]:
        """Yield tile and payload of every reply to a query, computed on demand; see `serve.query.answer`.

        Raises:
            InputError: the route is too long, the time is in the future, or the archive cannot be read.
        """
        least = max(query.min_vehicles, self._config.public_vehicles)
        query = query.model_copy(update={"min_vehicles": least})
        if query.at is None:
            return answer(self._tiles, query, wanted, now, only)
        at = nanoseconds(query.at)
        if at > now:
            raise InputError("at", "lies in the future", "give a time that has been")
        past = PastQuery(query, at, self._config.lateness_s, only, self._config.public_vehicles)
        return self._past.ask(past, wanted)

    def size(self, query: MapQuery, wanted: Callable[[int], bool], only: int | None = None) -> AnswerSize:
        """Return the upper bound of an answer's size; errors as for `answer`."""
        return size_asked(self._tiles, query, wanted, only)
