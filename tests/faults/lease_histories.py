"""Simulated histories (sequences of events) of services that share an archive, in virtual time, and
a checker of these histories.

The product's `Lease` (exclusive ownership of the archive) runs unchanged on a bucket in memory.
Every process has its own clock rate, wall clock and lease time. Processes are killed, frozen, cut
off from the bucket, or lose the liveliness token by which other processes see that they run.
Requests to the bucket are slow, and some take effect after the process gave up. The seed of a
random generator determines all events.

A history records the life of every batch: uploaded by a service, acknowledged, known to each later
owner when it begins to serve, and counted by a reader at the end.
"""

from __future__ import annotations

import heapq
import logging
import random
import threading
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, Final, NamedTuple, cast
from unittest.mock import patch

from fleet_service.replication import lease as lease_module
from fleet_service.replication.bucket import CopyError, ObjectBucket
from fleet_service.replication.lease import Lease, Standby
from schemas.errors import InputError

NAMES: Final = ("one", "two", "three")
LENGTH_S: Final = 90.0  # simulated length of a history
LEASES: Final = (2.0, 3.0, 20.0)
# Speeds of the processes' clocks. A takeover after HINT = 0.6 of a lease allows a ratio of 5/6
# between two clocks.
RATES: Final = (0.93, 1.07)
REQUEST_S: Final = 0.6  # time after which a client gives up a request
BATCHES_PER_S = 4
WALL: Final = 1_700_000_000.0
DAY_S = 86_400.0
_SILENT: Final = logging.Logger("silent", logging.CRITICAL + 1)


class Event(NamedTuple):
    """Event of the simulated history of several services. There are three kinds. `serves`: a
    service that holds lease `number` (ownership of the archive) begins to serve; the event lists
    the batches that it knows. `acknowledges`: a service acknowledges batches. `reads`: at the end,
    a reader finds the batches in valid objects of the bucket.
    """

    kind: str
    number: int
    batches: tuple[int, ...]


class Verdict(NamedTuple):
    """Result of the check of a simulated history. It has the number of acknowledgements by an
    earlier holder of the lease (ownership of the archive) after its successor began to serve, and
    the violations of the promises to agents.
    """

    acknowledged_by_two: int
    violations: int


def judge_history(events: list[Event]) -> Verdict:
    """Check a simulated history of services that share an archive. Return the number of
    acknowledgements by a holder of the lease (ownership of the archive) after its successor began
    to serve. Also return the number of batches that were acknowledged but unknown to a later owner
    or to the reader, or that were counted twice.
    """
    served = 0
    by_two = 0
    acknowledged: set[int] = set()
    broken: set[int] = set()
    for event in events:
        if event.kind == "acknowledges":
            by_two = by_two + (event.number < served)
            acknowledged.update(event.batches)
            continue
        if event.kind == "serves":
            served = max(served, event.number)
        if event.number >= served:
            broken |= acknowledged - set(event.batches)
        broken |= {batch for batch, count in Counter(event.batches).items() if count > 1}
    return Verdict(by_two, len(broken))


class _EndError(BaseException):
    """Exception that ends a simulated thread when its process was killed or the simulation has
    ended.
    """


class _Process:
    """State of a simulated service process: its clocks, whether it is frozen, and whether it is cut
    off from the bucket.
    """

    def __init__(self, name: str, random_: random.Random, lease_s: float) -> None:
        self.name = name
        self.lease_s = lease_s
        self.rate = random_.uniform(*RATES)
        self.wall = WALL + random_.uniform(-DAY_S, DAY_S)
        self.is_dead = False
        self.frozen_until = 0.0
        self.cut_until = 0.0
        self.token_until = 0.0  # time at which its token is active again


class _Actor:
    def __init__(self, process: _Process, run: Callable[[], None]) -> None:
        self.process = process
        self.run = run
        self.turn = threading.Semaphore(0)
        self.is_done = False


class VirtualTime:
    """Scheduler of threads in virtual time. Only one thread runs at a time, the one with the
    earliest wake-up time.
    """

    def __init__(self) -> None:
        self.now = 0.0
        self._queue: list[tuple[float, int, _Actor]] = []
        self._count = 0
        self._main = threading.Semaphore(0)
        self._actor: _Actor | None = None
        self._is_over = False

    @property
    def process(self) -> _Process:
        """Return the simulated process whose thread is running."""
        assert self._actor is not None
        return self._actor.process

    def spawn(self, process: _Process, run: Callable[[], None]) -> _Actor:
        """Start a thread of a simulated process, and return it."""
        actor = _Actor(process, run)
        self._push_event(self.now, actor)
        threading.Thread(target=self._run_actor, args=(actor,), daemon=True).start()
        return actor

    def sleep(self, seconds: float) -> None:
        """Let the running thread sleep for `seconds` of simulated true time; it sleeps longer if
        its process is frozen meanwhile.
        """
        actor = self._actor
        assert actor is not None
        end = self.now + seconds
        while True:
            self._push_event(end, actor)
            self._main.release()
            actor.turn.acquire()
            if self._is_over or actor.process.is_dead:
                raise _EndError
            if actor.process.frozen_until <= self.now:
                return
            end = actor.process.frozen_until

    def run(self, until: float) -> None:
        """Run all threads until the true time `until`, and then end them."""
        while self._queue:
            at, _, actor = heapq.heappop(self._queue)
            self._is_over = self._is_over or at > until
            self.now = min(at, until)
            self._actor = actor
            actor.turn.release()
            self._main.acquire()

    def _push_event(self, at: float, actor: _Actor) -> None:
        self._count += 1
        heapq.heappush(self._queue, (at, self._count, actor))

    def _run_actor(self, actor: _Actor) -> None:
        actor.turn.acquire()
        try:
            if not self._is_over and not actor.process.is_dead:
                actor.run()
        except _EndError:
            pass
        finally:
            actor.is_done = True
            self._main.release()

    # The methods below replace those functions of `time` that the lease module uses.

    def monotonic(self) -> float:
        """Return the reading [s] of the elapsed-time clock of the running simulated process."""
        return self.now * self.process.rate

    def time(self) -> float:
        """Return the time [s] that the wall clock of the currently running simulated process
        shows.
        """
        return self.process.wall + self.now


class VirtualStop:
    """Event like `threading.Event` for threads in virtual time. A wait always takes its full time,
    measured by the clock of the waiting process.
    """

    def __init__(self, world: VirtualTime) -> None:
        self._world = world
        self._is_set = False

    def is_set(self) -> bool:
        """Return True if this event has been set."""
        return self._is_set

    def set(self) -> None:
        """Set the event. Threads that wait for it continue when their waiting time is over."""
        self._is_set = True

    def wait(self, seconds: float) -> bool:
        """Wait for `seconds` by the clock of the simulated process. Return True if the event is set
        after this time.
        """
        self._world.sleep(seconds / self._world.process.rate)
        return self._is_set


class VirtualBucket:
    """Simulated bucket (object store) in memory. Requests are slow or lost, and some lost requests
    take effect later.
    """

    def __init__(self, world: VirtualTime, random_: random.Random) -> None:
        self.objects: dict[str, bytes] = {}
        self._world = world
        self._random = random_
        self._network = _Process("network", random_, 1.0)

    def list_names(self, folder: str) -> list[str]:
        """Return the names of the objects in a folder of the simulated bucket."""
        return list(self._request(lambda: [n for n in self.objects if n.startswith(f"{folder}/")]))

    def get(self, name: str) -> bytes | None:
        """Return the content of an object in the simulated bucket, or None if it does not exist."""
        return cast("bytes | None", self._request(lambda: self.objects.get(name)))

    def put(self, name: str, content: bytes) -> None:
        """Write an object into the simulated bucket; the request may be slow or lost."""
        self._request(lambda: self.objects.__setitem__(name, content))

    def create(self, name: str, content: bytes) -> bool:
        """Create an object in the simulated bucket. Return False if an object of this name with
        other content exists. A repeated request with the same content succeeds.
        """
        return bool(self._request(lambda: self.objects.setdefault(name, content) == content))

    def _request(self, effect: Callable[[], Any]) -> Any:  # noqa: ANN401 any operation's result
        world = self._world
        if world.now < world.process.cut_until or self._random.random() < 0.01:
            if self._random.random() < 0.5:
                late = self._random.uniform(0.0, 5.0)

                def arrive() -> None:
                    world.sleep(late)
                    effect()

                world.spawn(self._network, arrive)
            world.sleep(REQUEST_S)
            raise CopyError("no answer")
        world.sleep(self._random.uniform(0.0, 0.05))
        found = effect()
        world.sleep(self._random.uniform(0.0, 0.05))
        return found


class ServiceHistory:
    """Simulation of three services that compete for the lease (exclusive ownership) of one archive;
    call `run` once.

    Attributes:
        events: events in the order of true time.
        refused: number of starts that were refused because of a different lease time.
    """

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._world = VirtualTime()
        self._bucket = VirtualBucket(self._world, self._random)
        self._processes: dict[str, _Process] = {}
        self._acknowledged: set[int] = set()
        self._holders = {name: name for name in NAMES}
        self._fences: dict[int, frozenset[str]] = {}
        self.events: list[Event] = []
        self.refused = 0

    def run(self) -> None:
        """Run the simulation: let the three services compete for the lease until the simulated time
        is over.
        """
        for name in NAMES:
            self._start_process(name, 0.0)
        chaos = _Process("chaos", self._random, 1.0)
        self._world.spawn(chaos, self._disturb_processes)
        with (
            patch.object(lease_module, "time", self._world),
            patch.object(lease_module, "elapsed_seconds", self._world.monotonic),
            patch.object(lease_module, "log", _SILENT),
        ):
            self._world.run(LENGTH_S)
        names = [name for name in self._bucket.objects if name.startswith("batches/")]
        read = _batches_of(self._find_counted(names))
        self.events.append(Event("reads", max(self._fences, default=0), read))

    def _start_process(self, name: str, after: float) -> None:
        """Start a simulated service process. Half of the processes have a lease time (validity of
        the ownership of the archive) that may differ from the common one.
        """
        common = LEASES[0]
        own = self._random.choice(LEASES) if self._random.random() < 0.5 else common
        process = _Process(name, self._random, own)
        self._processes[name] = process

        def serve_repeatedly() -> None:
            self._world.sleep(after)
            while True:
                self._serve_once(process)
                self._world.sleep(self._random.uniform(0.5, 3.0))

        self._world.spawn(process, serve_repeatedly)

    def _disturb_processes(self) -> None:
        r = self._random
        while True:
            self._world.sleep(r.uniform(1.0, 6.0))
            process = self._processes[r.choice(NAMES)]
            until = self._world.now + r.uniform(0.2, 2.0) * process.lease_s
            kind = r.choice(("kill", "freeze", "cut", "token"))
            if kind == "kill":
                process.is_dead = True
                self._start_process(process.name, r.uniform(0.0, 8.0))
            elif kind == "freeze":
                process.frozen_until = until
            elif kind == "cut":
                process.cut_until = until
            else:
                process.token_until = until

    def _has_token(self, name: str) -> bool:
        process = self._processes.get(name)
        return process is not None and self._world.now >= process.token_until

    def _serve_once(self, process: _Process) -> None:
        """Wait for the lease (ownership of the archive), and serve until it is lost or released."""
        name = process.name
        holder = self._holders[name]
        lease = Lease(holder, cast(ObjectBucket, self._bucket), name, process.lease_s)
        stop = VirtualStop(self._world)
        standby = Standby(lambda: True, self._has_token, lambda: None, lambda: "")
        try:
            lease.wait(cast(threading.Event, stop), lambda _: None, lambda: 0, standby)
            lease._stop = cast(threading.Event, stop)
            keeper = self._world.spawn(process, lease._renew_until_stopped)
            known = self._begin_serving(lease)
        except InputError:
            self.refused += 1
            process.lease_s = LEASES[0] if self._random.random() < 0.5 else process.lease_s
            return
        except CopyError:
            stop.set()
            return
        end = self._world.now + self._random.uniform(5.0, 30.0)
        while not lease.lost and self._world.now < end:
            self._accept_batch(lease, known)
        stop.set()
        while not keeper.is_done:
            self._world.sleep(0.1)
        if self._random.random() < 0.7:
            lease.release()

    def _begin_serving(self, lease: Lease) -> set[int]:
        """Let a service begin to serve under its new lease (ownership of the archive). It lists the
        objects in the bucket, and writes those that are valid into its fence (list of the valid
        objects of earlier owners). Return the batches of observations in these objects.
        """
        self._world.sleep(self._random.uniform(0.0, 0.3))
        number = lease.term.number
        names = self._find_counted(self._bucket.list_names("batches"))
        lease.assert_not_superseded()
        self._fences[number] = frozenset(names)
        self._holders[lease.service] = lease.holder
        batches = _batches_of(names)
        self.events.append(Event("serves", number, batches))
        return set(batches)

    def _accept_batch(self, lease: Lease, known: set[int]) -> None:
        """Upload to the bucket a batch that a simulated vehicle offers, and acknowledge it if the
        service's lease (ownership of the archive) allows this.
        """
        self._world.sleep(self._random.uniform(0.0, 0.3))
        offered = range(int(self._world.now * BATCHES_PER_S) + 1)
        waiting = [batch for batch in offered if batch not in self._acknowledged]
        if not waiting:
            return
        batch = self._random.choice(waiting)
        number = lease.term.number
        if batch not in known:
            known.add(batch)
            while True:
                try:
                    self._bucket.put(f"batches/{batch}-{number}", b"")
                    break
                except CopyError:
                    if lease.lost:
                        return
        if lease.may_acknowledge:
            self._acknowledged.add(batch)
            self.events.append(Event("acknowledges", number, (batch,)))

    def _find_counted(self, names: Iterable[str]) -> list[str]:
        """Return those of the object `names` in the bucket that are valid, so that readers use
        them. An object is valid if its lease number is at least that of the newest owner, or if
        that owner's fence (list of the valid objects of earlier owners) contains it.
        """
        newest = max(self._fences, default=0)
        before = self._fences.get(newest, frozenset())
        return [name for name in names if int(name.split("-")[1]) >= newest or name in before]


def _batches_of(names: Iterable[str]) -> tuple[int, ...]:
    return tuple(int(name.split("/")[1].split("-")[0]) for name in names)
