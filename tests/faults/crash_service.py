"""Histories of a whole service on a disk with power loss. They include keys, log, compaction
(sorting of rows), roll-ups (hourly statistics), checkpoints (saved states), map snapshots, weather,
retention and erasure.

A history is a few lives (runs of the service) of one archive, days apart. In each life the engine
receives batches and weather, and its maintenance jobs run in any order. Between two lives an
operator may erase one vehicle's month or the whole month. The power fails at a random operation.
The next life must find every acknowledged row exactly once, and all weather that was used. It must
recognise a repeated batch if and only if the archive contains it. The map restored from a
checkpoint and later rows must equal the map restored from all rows without a checkpoint. No
compacted file may be damaged, and erased rows must not come back.
"""

from __future__ import annotations

import shutil
import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from fleet_service.app.engine import Engine
from fleet_service.app.state import ServiceState, load_state
from fleet_service.archive.format import layout, reading, snapshots
from fleet_service.archive.format.load import load_rows
from fleet_service.archive.format.segments import to_nanoseconds
from fleet_service.archive.identity.pseudonyms import Pseudonyms, pseudonym_number
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.archive.maintenance.retention import (
    forget_period,
    forget_vehicle,
    retire_rows,
)
from fleet_service.ingest import weather
from fleet_service.ingest.inbox import Message
from fleet_service.replay import checkpoints
from schemas import grid, keys, tables, wire
from schemas.config import LEAST_RAW_DAYS, ServiceConfig
from schemas.errors import InputError
from schemas.weather import Report
from schemas.wire import Kind
from tests.faults.crash_lives import Lives
from tests.fleet_service.examples import LATITUDE, LONGITUDE, REGION, SECOND, batch, key
from tests.schemas.examples import encode_weather

STEPS: Final = 14
START: Final = 1_698_500_000 * SECOND  # 2023-10-28: months end within the histories
AWAY_DAYS: Final = 14  # longest time between two lives
VEHICLES: Final = ("car-a", "car-b", "car-c")
PLACES: Final = 4  # cells that the vehicles visit
NORTH: Final = 0.0003  # [deg] distance in latitude between two places
CONFIG: Final = ServiceConfig(name="shard")
SAME: Final = 1e-6  # largest accepted difference in the probability of a bin of the map's friction
# The same, for a cell that was dropped after an idle week and then visited again, and for all cells
# if the vehicles have other vote weights.
NEARLY: Final = 0.01


class Sent(NamedTuple):
    """Batch of observations as its vehicle stores it until it is acknowledged; `time` is the time
    of the batch's last row [ns].
    """

    vehicle: str
    seq: int
    time: int
    payload: bytes

    @property
    def rows(self) -> tuple[int, int]:
        """Return the times of the batch's rows [ns], which identify the rows in the archive."""
        return self.time - SECOND, self.time

    @property
    def month(self) -> str:
        """Return the month to which the batch belongs, as YYYY-MM."""
        return f"{datetime.fromtimestamp(self.rows[0] // SECOND, UTC):%Y-%m}"


class ServiceHistory(Lives[Sent]):
    """Simulated history of a service (operations and power losses) on one disk.

    Attributes:
        done: number of completed operations, by name.
    """

    lives = 4
    operations = 250
    full_after = 100

    def __init__(self, number_: int, folder: Path) -> None:
        super().__init__(number_, folder)
        self.sent: list[Sent] = []
        self.weather: set[int] = set()  # times of the weather reports that had an effect
        # (month, vehicle) of each erasure that has begun; vehicle is "" for a whole month.
        self.forgetting: set[tuple[str, str]] = set()
        self.gone: set[Sent] = set()  # batches whose rows were erased
        self.destroyed: set[bytes] = set()  # destroyed keys of months
        self._nobodys: set[Sent] = set()  # batches whose rows can no longer be identified
        self.retired = -1  # last day whose rows may have been removed
        self.done: Counter[str] = Counter()
        self._now = START

    def _run_life(self, root: Path, last: bool) -> None:
        if self.sent and self.random.random() < 0.4:
            self._forget_month(root)
        with (
            suppress(OSError),
            ExitStack() as held,
        ):  # a service that starts on a full disk reports this and ends
            engine = Engine(CONFIG, root)
            held.callback(engine.holding.close)
            for _ in range(STEPS):
                self._run_step(engine, root)
            if last:
                self._ingest_batches(engine, self.sent)
                self._flush_acks(engine)

    def _pass_time(self) -> None:
        self._now += self.random.randint(0, AWAY_DAYS * 86_400) * SECOND

    def _forget_month(self, root: Path) -> None:
        """Erase the archived rows of one vehicle in one month, or of all vehicles in it, while no
        service runs. Month and vehicle are drawn at random.
        """
        one = self.random.choice(self.sent)
        whole = self.random.random() < 0.3
        key = root / "keys" / f"{one.month}.key"
        if not key.exists():
            return
        secret = key.read_bytes()
        self.forgetting.add((one.month, "" if whole else one.vehicle))
        with suppress(OSError):
            if whole:
                forget_period(root, one.month)
                self.destroyed.add(secret)
                self._nobodys.update(sent for sent in self.sent if sent.month == one.month)
            else:
                forget_vehicle(root, one.vehicle, one.month)
                theirs = {
                    sent
                    for sent in self.acknowledged
                    if (sent.month, sent.vehicle) == (one.month, one.vehicle)
                }
                self.gone |= theirs - self._nobodys
            self.done["forgetting"] += 1

    def _run_step(self, engine: Engine, root: Path) -> None:
        self._now += self.random.randint(5, 3000) * SECOND
        jobs = {
            "batches": 8,
            "flush": 5,
            "compaction": 2,
            "checkpoint": 2,
            "weather": 1,
            "retention": 1,
        }
        job = self.random.choices([*jobs], [*jobs.values()])[0]
        with suppress(OSError):  # the background jobs count this error and continue
            if job == "batches":
                new = [self._make_batch() for _ in range(self.random.randint(1, 3))]
                self._ingest_batches(
                    engine, new + self.random.sample(self.sent, min(2, len(self.sent)))
                )
            elif job == "weather":
                self._report_weather(engine)
            elif job == "compaction":
                weather.join_daily_files(root)
                compact(root, round_rows=self.random.choice((1, 5, 1000)))
            elif job == "retention":
                self._apply_retention(root)
            else:
                # The background jobs run right after a segment was written.
                self._flush_acks(engine)
                if job == "checkpoint":
                    self._write_checkpoint(engine, root)
            self.done[job] += 1

    def _write_checkpoint(self, engine: Engine, root: Path) -> None:
        """Write a checkpoint (saved state of the service): a background job requests it, and the
        worker takes it when all accepted rows are on disk. The service writes it in a child
        process; here this process does, because it simulates the disk.
        """
        stop = threading.Event()

        def take_image() -> checkpoints.Taken:
            return engine.state.image(engine.settlement.newest_segment, weather.weather_files(root))

        with ThreadPoolExecutor(1) as executor:
            coming = executor.submit(engine.settlement.run_between_segments, take_image, stop)
            try:
                while not coming.done():
                    self._flush_acks(engine)
            finally:
                stop.set()
        taken = coming.result()
        if taken is not None:
            checkpoints.save_checkpoint(root, taken)
            snapshots.write_snapshot(root, engine.queries.whole_map(self._now), self._now)

    def _make_batch(self) -> Sent:
        vehicle = self.random.choice(VEHICLES)
        self._now = self._now + 5 * SECOND
        seq = 1 + sum(one.vehicle == vehicle for one in self.sent)
        latitude = np.full(2, LATITUDE + NORTH * self.random.randrange(PLACES))
        mu = self.random.choice((0.15, 0.5, 0.85))
        made = batch(
            vehicle,
            seq,
            self._now,
            [mu, mu],
            latitude=latitude,
            cell=grid.cell_of(latitude, LONGITUDE),
        )
        self.sent.append(Sent(vehicle, seq, self._now, wire.encode(made)))
        return self.sent[-1]

    def _ingest_batches(self, engine: Engine, batches: list[Sent]) -> None:
        wanted = [
            Message(
                Kind.OBSERVATION, key(one.vehicle), one.payload, wire.ENCODING[Kind.OBSERVATION]
            )
            for one in batches
        ]
        engine.intake.ingest(wanted, self._now)

    def _flush_acks(self, engine: Engine) -> None:
        durable = {
            (vehicle, seq)
            for vehicle, payload in engine.settlement.flush()
            for stream in wire.decode_ack(payload)[1]
            for first, end in stream.durable
            for seq in range(first, end + 1)
        }
        self.acknowledged.update(one for one in self.sent if (one.vehicle, one.seq) in durable)

    def _report_weather(self, engine: Engine) -> None:
        report = Report(self._now, 0.5, 0.5, 0.5)
        failures = engine.counts.failures["weather"]
        engine.intake.weather.enqueue(
            weather.WeatherMessage(
                keys.weather_key(REGION), encode_weather(report), wire.WEATHER_ENCODING
            )
        )
        engine.intake.update_weather(self._now)
        if engine.counts.failures["weather"] == failures:
            self.weather.add(report.time)

    def _apply_retention(self, root: Path) -> None:
        today = datetime.fromtimestamp(self._now // SECOND, UTC).date()
        self.retired = max(self.retired, (today - date(1970, 1, 1)).days - LEAST_RAW_DAYS - 1)
        with suppress(InputError):
            retire_rows(root, LEAST_RAW_DAYS, today)
            weather.retire_files(root, self._now // layout.DAY_NS - LEAST_RAW_DAYS - 1)

    def _find_problems(self, root: Path, last: bool) -> list[str]:
        rows: Counter[int] = Counter()
        with suppress(FileNotFoundError):
            for table in reading.read_tables(root, Kind.OBSERVATION, ["leave_time"]):
                rows.update(to_nanoseconds(table["leave_time"]).tolist())
        found = [f"{time} is there {count} times" for time, count in rows.items() if count > 1]
        found += self._find_lost(rows, last) + self._came_back(root, rows)
        reports = (
            load_rows(path, tables.WEATHER_ARCHIVE, ["time"])
            for path in weather.weather_files(root)
        )
        stored = {
            time
            for table in reports
            if table is not None
            for time in to_nanoseconds(table["time"]).tolist()
        }
        found += [
            f"the weather of {time} is lost"
            for time in sorted(self.weather - stored)
            if time // layout.DAY_NS > self.retired
        ]
        found += self._find_state_errors(root, rows)
        return found

    def _find_lost(self, rows: Counter[int], last: bool) -> list[str]:
        """Return one message for each batch that must be in the archive but lacks rows. All
        acknowledged batches must be there. After the `last` run of the service, the unacknowledged
        batches must be there as well, because by then every vehicle has sent its batches again.
        """
        owed = [
            one for one in self.sent if one in self.acknowledged or (last and self._may_come(one))
        ]
        return [
            f"{one.vehicle} {one.seq} is lost"
            for one in owed
            if not self._given_up(one) and not all(rows[time] for time in one.rows)
        ]

    def _may_come(self, one: Sent) -> bool:
        return self._now - one.time < CONFIG.oldest_s * SECOND - layout.DAY_NS

    def _given_up(self, one: Sent) -> bool:
        marks = {(one.month, ""), (one.month, one.vehicle)}
        return one.rows[0] // layout.DAY_NS <= self.retired or bool(marks & self.forgetting)

    def _came_back(self, root: Path, rows: Counter[int]) -> list[str]:
        """Return one message per batch or key that was erased and is nevertheless present."""
        found = [
            f"{one.vehicle} {one.seq} came back"
            for one in self.gone
            if any(rows[time] for time in one.rows)
        ]
        keys = (path.read_bytes() for path in (root / "keys").glob("*.key"))
        return found + ["the key of a month came back" for key in keys if key in self.destroyed]

    def _find_state_errors(self, root: Path, rows: Counter[int]) -> list[str]:
        """Restore the map and the known batches twice: from a checkpoint (saved state) and later
        rows, and from all archived rows without a checkpoint. Return a message for each difference.
        """
        if not (root / "inbox").is_dir():
            return []
        same, bare = (root.with_name(f"{root.name}-{name}") for name in ("same", "bare"))
        for copy in (same, bare):
            shutil.copytree(root, copy)
        shutil.rmtree(bare / layout.CHECKPOINTS, ignore_errors=True)
        damaged: list[Path] = []
        begun, whole = (
            load_state(copy, CONFIG, lambda path, _: damaged.append(path)) for copy in (same, bare)
        )
        # A map from rows alone has other vote weights of vehicles if rows are no longer linked to
        # their vehicles, because their month was erased, or are too old to be read.
        is_unlinked = any(not vehicle for _, vehicle in self.forgetting)
        is_partial = self._now - START > layout.MAP_DAYS * layout.DAY_NS
        accepted = NEARLY if is_unlinked or is_partial else SAME
        found = _find_differences(begun, whole, self._now, accepted)
        for copy in (same, bare):
            shutil.rmtree(copy)
        pseudonyms = Pseudonyms(root / "keys")
        for one in self.sent:
            if (one.month, "") in self.forgetting or not self._may_come(one):
                # Rows of an erased month cannot be identified; too old batches are refused.
                continue
            if not (root / "keys" / f"{one.month}.key").exists():
                if rows[one.time]:
                    found.append(f"{one.vehicle} {one.seq} is there, its key is lost")
                continue
            first = one.rows[0]
            name = (
                pseudonym_number(pseudonyms.of(one.vehicle, first)),
                pseudonyms.boot(one.vehicle, _compute_boot(one.vehicle), first),
            )
            names = np.array([[*name, REGION, one.seq]], np.int64)
            for memory, by in ((begun, "the checkpoint"), (whole, "the log")):
                held = bool(rows[one.time])
                if bool(memory.streams.find_accepted(Kind.OBSERVATION, names)[0]) != held:
                    found.append(f"{one.vehicle} {one.seq} is {'un' if held else ''}known by {by}")
        return found


def _compute_boot(vehicle: str) -> int:
    """Return the boot number (identifier of the start of a vehicle's agent) that the helper
    `examples.batch` uses in all batches of this vehicle.
    """
    return 1 + sum(vehicle.encode())


def _find_differences(
    begun: ServiceState, whole: ServiceState, now: int, accepted: float
) -> list[str]:
    """Return a description of the differences between the beliefs of two service states that were
    restored from one archive. `accepted` is the largest accepted difference in the probability of a
    bin.
    """
    if not whole.fusion.size:
        return []
    slots = np.arange(whole.fusion.size)
    begun_slots = begun.fusion.slots_of(
        whole.fusion.cell[slots], whole.fusion.sector[slots].astype(np.int64)
    )
    if (begun_slots < 0).any():
        return [f"{int((begun_slots < 0).sum())} cells are not in the checkpoint's map"]
    restored = begun.fusion.beliefs(begun_slots, now)
    difference = np.abs(restored - whole.fusion.beliefs(slots, now)).max(axis=1)
    # The cell was at rest and dropped, and has been visited again since.
    is_revisited = begun.fusion.live.visits[begun_slots] < whole.fusion.live.visits[slots]
    excessive = difference[difference > np.where(is_revisited, NEARLY, accepted)]
    return [f"the maps differ by {excessive.max():.2g}"] if len(excessive) else []
