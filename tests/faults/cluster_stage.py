"""Machines of the cluster campaign: services of one region that take over from each other, and the
ways in which each service fails.

There are three machines, a router, a bucket on a real S3 server, load generators that receive
acknowledgements, and a client that queries the map continuously.
"""

from __future__ import annotations

import json
import random
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa

from fleet_service.analytics import synthetic
from fleet_service.analytics.synthetic import DAY_S, START_NS, SyntheticFleet
from fleet_service.archive.format.layout import CHECKPOINTS
from fleet_service.archive.format.segments import Writer
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.client import map_client
from fleet_service.replay import checkpoints
from fleet_service.shards import handover
from schemas.config import ZenohSettings
from schemas.errors import InputError
from schemas.thresholds import NS
from schemas.wire import Kind
from tests.faults.cluster_service import BEGINS, COMPACTING, COPYING, ENDS
from tests.faults.processes import Part
from tests.standbys import Host
from tests.waiting import until

# 107 000 cells that were visited in the last day.
WORLD: Final = SyntheticFleet(300_000, days=1, roads=300)
SIDE: Final = 0.01  # [deg] side of the queried box
# Length of a freeze in lease times; another service takes over after 0.6 to 1.
FROZEN: Final = (0.5, 1.3)
AMID_S: Final = 0.3  # latest time of a kill after a compaction or an upload has begun
# In lease times: if no takeover happened by then, the frozen service resumed in time.
WOKE: Final = 3.0
SETTLED_S: Final = 2.0  # after this time all sent rows are in a segment
PATIENCE_S: Final = 600.0  # long, so that a slow takeover is measured instead of failing the run


def write_town_archive(root: Path) -> str:
    """Create an archive with a town's map of today, and return the bounding box of the town as
    text.
    """
    writer = Writer(root, "shard-0")
    since = time.time_ns() - START_NS - DAY_S * NS - 60 * NS
    for rows in synthetic.make_chunks(WORLD):
        place = [float(rows[name][0]) for name in ("longitude", "latitude")]
        moved = {name: rows[name] + since for name in ("enter_time", "leave_time", "received_at")}
        writer.write(Kind.OBSERVATION, rows | moved)
    writer.sync()
    compact(root)
    return ",".join(
        f"{side:.6f}" for side in (*(at - SIDE for at in place), *(at + SIDE for at in place))
    )


class Journals:
    """Reader of the load generators' journals (lists of stored and acknowledged batches). The
    object has the times of all acknowledgements. Each call of `read_new_times` adds those that are
    new.
    """

    def __init__(self, paths: Iterable[Path]) -> None:
        self._paths = list(paths)
        self._read = Counter[Path]()
        self._times: list[float] = []

    def read_new_times(self) -> list[float]:
        """Return the times [s] of those acknowledgements to the load generators that are new since
        the last call.
        """
        found: list[float] = []
        for path in self._paths:
            with path.open("rb") as file:
                file.seek(self._read[path])
                lines = file.read().rpartition(b"\n")[0].splitlines(keepends=True)
            self._read[path] += sum(map(len, lines))
            found += [float(line.split()[-1]) for line in lines if line.startswith(b"- ")]
        self._times += found
        return found

    def longest_pause(self, since: float) -> float:
        """Return the longest time [s] between successive acknowledgements to the load generators
        after the time `since` [s].
        """
        return float(np.diff(sorted(at for at in self._times if at >= since)).max())

    def first_after(self, moment: float) -> float:
        """Wait for the first acknowledgement to a load generator after the time `moment` [s], and
        return its time [s].
        """
        later: list[float] = []

        def has_arrived() -> bool:
            later.extend(at for at in self.read_new_times() if at > moment)
            return bool(later)

        until(has_arrived, PATIENCE_S)
        return min(later)


def start_loads(
    folder: Path, endpoint: str, processes: int, vehicles: int, rate: float
) -> list[Part]:
    """Start load generators in `processes` processes, each with `vehicles` vehicles and `rate`
    observations per second and vehicle.
    """
    made = []
    for number in range(processes):
        config = folder / f"load-{number}.json"
        names = [f"sim-{number}{vehicle:02}" for vehicle in range(vehicles)]
        plan = {
            "endpoint": endpoint,
            "names": names,
            "rate": rate,
            "outbox": str(folder / f"load-{number}.sqlite"),
        }
        config.write_text(json.dumps(plan | {"seed": number}))
        made.append(
            Part(f"load-{number}", [sys.executable, "-m", "tests.faults.load", str(config)], folder)
        )
        made[-1].start()
    for part in made:
        part.line_with("ready: ")
    return made


class Asking:
    """Client that continuously queries the map in a box (rectangle of latitude and longitude). A
    correct answer is complete, or reports that no service serves the box.

    Attributes:
        whole: number of answers that contain every map cell of the first answer.
        unserved: number of answers, or errors, that report that something is missing.
        silent: number of incomplete answers that do not report that something is missing.
    """

    PAUSE_S: Final = 0.2

    def __init__(self, endpoint: str, box: str, say: Callable[[str], None]) -> None:
        self._say = say
        self._router = ZenohSettings(connect=[endpoint])
        self._box = box
        self.whole = 0
        self.unserved = 0
        self.silent = 0
        self._stop = threading.Event()
        self._known = self._read_cells()[0]
        assert len(self._known) > 100, "the box is empty"
        self._thread = threading.Thread(target=self._ask_repeatedly, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Stop the queries of this client."""
        self._stop.set()
        self._thread.join(PATIENCE_S)

    def _read_cells(self) -> tuple[frozenset[tuple[int, int]], bool]:
        """Query the map in the box. Return (cell, heading sector) of each row of the answer, and
        True if the answer reports a missing region or the query was refused.
        """
        try:
            answer = map_client.query_map(self._router, {"bbox": self._box})
        except InputError:
            return frozenset(), True
        table = answer.table
        assert table is not None
        both = [
            np.asarray(table[name].to_numpy(), np.int64).tolist() for name in ("cell", "sector")
        ]
        found = frozenset((cell, sector) for cell, sector in zip(*both, strict=True))
        return found, answer.gap_description is not None or not answer.served

    def _ask_repeatedly(self) -> None:
        while not self._stop.wait(self.PAUSE_S):
            found, missing = self._read_cells()
            whole = self._known <= found
            self.whole += whole
            self.unserved += missing
            if not whole and not missing:
                self.silent += 1
                self._say(
                    f"{len(self._known - found)} of {len(self._known)} cells are missing, and "
                    "nothing is said"
                )


Go = Callable[[Host, random.Random, float], None]


class Way(NamedTuple):
    """One way in which a campaign lets a service fail.

    Attributes:
        go: function that causes the failure; its last argument is the lease time [s].
        end: function that ends the failure.
    """

    go: Go
    end: Callable[[Host, random.Random], None] = lambda host, _: host.part.kill()


def _kill_host(host: Host, *_: object) -> None:
    host.part.kill()


def _freeze_host(host: Host, *_: object) -> None:
    host.part.freeze()


def _pause_host(host: Host, random_: random.Random, lease_s: float) -> None:
    host.part.freeze()
    timer = threading.Timer(
        lease_s * random_.uniform(*FROZEN), lambda: host.part.send_signal(signal.SIGCONT)
    )
    timer.daemon = True
    timer.start()


def _kill_during(what: str) -> Go:
    def go(host: Host, random_: random.Random, _: float) -> None:
        line = f"{what} {BEGINS}"
        before = host.part.read_lines().count(line)
        until(lambda: host.part.read_lines().count(line) > before, PATIENCE_S)
        time.sleep(random_.uniform(0.0, AMID_S))
        host.part.kill()

    return go


def _restore_link(host: Host, random_: random.Random) -> None:
    """Restore the network links of `host` after an interruption. Wait before that, either for a
    random time or until the service on this host has noticed that another one took over.
    """
    if random_.random() < 0.5 or host.to_router.is_cut:
        time.sleep(random_.uniform(0.0, 3.0))
        host.to_bucket.restore()
        host.to_router.restore()
    _check_superseded(host, random_)
    host.to_bucket.restore()


def _check_superseded(host: Host, _: random.Random) -> None:
    assert host.part.wait(PATIENCE_S) == 1
    assert host.has_said("lease lost to another service")


TWO: Final = "two standbys"
WAKES: Final = "wakes"
WAYS: Final = {
    "kill": Way(_kill_host),
    "freeze": Way(_freeze_host),
    "bucket": Way(lambda host, *_: host.to_bucket.cut(), _restore_link),
    "routers": Way(lambda host, *_: host.to_router.cut(), _restore_link),
    TWO: Way(_kill_host),
    WAKES: Way(_pause_host, _check_superseded),
    COMPACTING: Way(_kill_during(COMPACTING)),
    COPYING: Way(_kill_during(COPYING)),
}


class Failover(NamedTuple):
    """Result of one failover: the actual kind of failure, and the time [s] until a vehicle received
    the next acknowledgement.
    """

    way: str
    seconds: float


class Machines:
    """Machines of one region. One of them serves the region, some are standbys (they wait to take
    over), and the others are not started.
    """

    def __init__(
        self,
        hosts: list[Host],
        leases: Path,
        lease_s: float,
        journals: Journals,
        random_: random.Random,
    ) -> None:
        self.serving = hosts[0]
        self._idle = hosts[1:]
        self._leases = leases
        self._lease_s = lease_s
        self.waiting: list[Host] = []
        self._journals = journals
        self._random = random_

    def start_standbys(self, standbys: int) -> None:
        """Start services until `standbys` of them wait to take over (as standbys)."""
        while len(self.waiting) < standbys:
            host = self._idle.pop(0)
            host.part.start()
            self.waiting.append(host)
        until(
            lambda: all(_require_alive(host).has_said("standby: ") for host in self.waiting),
            PATIENCE_S,
        )

    def fail_over(self, name: str) -> Failover | None:
        """Let the active service fail in the way `name`, and return the result. Return None if no
        standby (waiting service) had to take over.
        """
        gone = self.serving
        way = WAYS[name]
        terms = self._count_leases()
        way.go(gone, self._random, self._lease_s)
        began = time.time()
        if name == WAKES:
            end = time.monotonic() + WOKE * self._lease_s
            until(lambda: self._count_leases() > terms or time.monotonic() > end, PATIENCE_S)
            if self._count_leases() == terms:
                return None
        self._await_takeover()
        seconds = self._journals.first_after(time.time()) - began
        way.end(gone, self._random)
        self._idle.append(gone)
        hit = name not in (COMPACTING, COPYING) or _was_amid(gone, name)
        return Failover(name if hit else "kill", seconds)

    def _count_leases(self) -> int:
        """Return how many times a service has so far taken the lease (exclusive ownership) of the
        region.
        """
        return sum(1 for _ in self._leases.glob("*.json"))

    def _await_takeover(self) -> None:
        """Wait until one of the standbys (waiting services) is active, and record it as the active
        machine.
        """
        until(self._find_ready, PATIENCE_S)
        taker = self._find_ready()
        assert taker is not None
        self.waiting.remove(taker)
        self.serving = taker

    def _find_ready(self) -> Host | None:
        return next(
            (host for host in self.waiting if _require_alive(host).has_said("ready: ")), None
        )

    def hand_over(self, router: ZenohSettings) -> Host:
        """Hand the region over to the standby (a waiting service), wait until the old service has
        ended, and return the standby.
        """
        former = self.serving
        to = self.waiting[0].root.parent.name
        with map_client.open_connected(router) as session:
            assert handover.hand_over(session, "*/*/*", to, lambda _: None) is not None
        self._await_takeover()
        assert former.part.wait(PATIENCE_S) == 0
        self._idle.append(former)
        return former

    def pause_s(self, router: ZenohSettings) -> float:
        """Hand the region over to the standby (a waiting service) under load, and return the
        longest time [s] without any acknowledgement.
        """
        began = self._journals.first_after(time.time())
        self.hand_over(router)
        self._journals.first_after(time.time())
        return self._journals.longest_pause(began)

    def map_difference(self, router: ZenohSettings, parts: list[Part]) -> float:
        """Pause the load generators and hand the region over to the standby. Return the largest
        difference between the states of the old and the new service, which are read from their
        checkpoints (saved states).
        """
        for part in parts:
            part.freeze()
        time.sleep(SETTLED_S)
        former = self.hand_over(router)
        mine = self.serving.root / CHECKPOINTS
        last = max(path.name for path in (former.root / CHECKPOINTS).glob("*-*"))
        until(lambda: any(path.name > last for path in mine.glob("*-*")), PATIENCE_S)
        both = [
            checkpoints.load_checkpoint(checkpoints.list_checkpoints(host.root)[0])
            for host in (former, self.serving)
        ]
        for part in parts:
            part.send_signal(signal.SIGCONT)
        return find_difference(both[0].tables, both[1].tables)

    def stop_all(self) -> list[Host]:
        """Let each machine take over and then stop, one after the other, so that each machine has
        received all data. Return all machines.
        """
        seen = []
        everybody = len(self.waiting) + len(self._idle)
        for left in range(everybody, -1, -1):
            self.start_standbys(1 if left else 0)
            assert self.serving.part.stop() == 0
            seen.append(self.serving)
            if left:
                self._await_takeover()
        return seen


def _require_alive(host: Host) -> Host:
    assert host.part.is_alive, f"it ended; see {host.part.log}"
    return host


def _was_amid(host: Host, what: str) -> bool:
    marks = [
        line for line in host.part.read_lines() if line in (f"{what} {BEGINS}", f"{what} {ENDS}")
    ]
    return bool(marks) and marks[-1].endswith(BEGINS)


def find_difference(one: dict[str, pa.Table], other: dict[str, pa.Table]) -> float:
    """Return the largest difference between the floating-point numbers in two sets of tables, which
    are given by name. The result is infinite if anything else differs.
    """
    worst = 0.0
    if one.keys() != other.keys():
        return float("inf")
    for name, table in one.items():
        for column in table.column_names:
            ours = table[column]
            theirs = other[name][column]
            if pa.types.is_floating(ours.type) and len(ours) == len(theirs):
                apart = np.abs(np.asarray(ours.to_numpy()) - np.asarray(theirs.to_numpy()))
                worst = max(worst, float(np.nanmax(apart, initial=0.0)))
            elif not ours.equals(theirs):
                return float("inf")
    return worst


def drain_loads(parts: list[Part]) -> None:
    """Signal the load generators to make no new observations. Wait until the service has
    acknowledged or refused all existing observations, but at most PATIENCE_S.
    """
    for part in parts:
        part.send_signal(signal.SIGUSR1)
    with suppress(TimeoutError):
        until(lambda: not any(part.is_alive for part in parts), PATIENCE_S)
