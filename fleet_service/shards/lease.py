"""Who serves an archive's copy: a lease in its bucket, for which a bucket that makes an object only once is enough.

    lease/NUMBER.json       {"holder", "service", "epoch", "turn", "released", "before", "to"}: the highest number holds
    ARCHIVE/holder.json     who this folder is to the others, over restarts

Taking over is making the next number, which one alone can; renewing is putting one's own number again, with the next
turn, and then seeing that there is no next number. Clocks are not compared.

Why nothing acknowledged is lost. Let A hold, and B make the next number at T. A acknowledges only what is in the bucket
already, and only within `lease_s / 2` after it *began* a renewal that counts; one that counts saw no next number, so it
began before T. B takes over when it has seen the same turn for `lease_s` (or for HINT of it, when A's token fell): then
A's last renewal began before B saw it first, and A's time was over before T. If the turn is another one after T, a
renewal landed in between, and B waits for `lease_s / 2` more. Only then B lists the bucket: all that A acknowledged is
there. An acknowledgement that A's network delivers years later is still true. What A, frozen meanwhile, puts after the
list has an older epoch and is not in B's fence (`archive.terms`): it counts for nothing, and A acknowledged none of it.
Deletes: A deletes only after it put what stands for it and saw no next number since, so B finds what stands for it.

Why nothing is doubled. What counts is one set of files, which B read whole before it admits anything: a batch that A
archived and did not acknowledge is known to B, and acknowledged again. What of A's is not in the set its senders send
again, and it is admitted once. A's folder becomes what the bucket is before A serves again.

A machine that was suspended finds its lease old (`elapsed`).

Not covered: a machine whose clock of elapsed time runs at less than half the speed of another's, or stands still while
it is copied from host to host, and a bucket that does not show at once what it has taken.
"""

from __future__ import annotations

import json
import logging
import secrets
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from fleet_service.archive import terms
from fleet_service.archive.bucket import CopyError, ObjectBucket
from fleet_service.archive.terms import Term
from schemas.errors import InputError
from schemas.runtime.durable import written

log = logging.getLogger(__name__)
FOLDER: Final = "lease"
HOLDER: Final = "holder.json"  # of an archive: who it is, over restarts
TURNS: Final = 6  # in the time of a lease
HINT: Final = 0.6  # of it, after which one whose token fell is followed: more than the half in which it acknowledges
AHEAD_S: Final = 10.0  # between two times that a standby gets what is new, so that little is left when it must
_BOOTTIME: Final[int | None] = getattr(time, "CLOCK_BOOTTIME", None)
LOOK_S: Final = 0.25  # between two looks of who waits


class Held(NamedTuple):
    """A lease as the bucket has it.

    Attributes:
        number, epoch: of the term.
        holder, service: the folder, and the name of the service on it.
        turn: grows with each renewal.
        released: it was given free.
        before: names of the services that held it earlier.
        to: the service that it was given free for; for a lease's time others leave it alone.
    """

    number: int
    holder: str
    service: str
    epoch: int
    turn: int
    released: bool
    before: tuple[str, ...] = ()
    to: str = ""

    @property
    def name(self) -> str:
        """Of the object."""
        return f"{FOLDER}/{self.number:010d}.json"

    @property
    def content(self) -> bytes:
        """Of the object."""
        return json.dumps({name: value for name, value in self._asdict().items() if name != "number"}).encode()


class Standby(NamedTuple):
    """What a service that waits asks while it waits."""

    may: Callable[[], bool]  # whether it would be heard if it took over now
    stands: Callable[[str], bool]  # whether a service's token stands
    alive: Callable[[], None]  # is called at each look
    get_ahead: Callable[[], None]  # gets what is new in the bucket


class Lease:
    """The lease of one archive's copy; `wait` for it, `keep` it, `end` it.

    Args:
        holder: who this folder is, see `holder_of`; it is locked by this process: another start of it has ended.
        bucket: of the copy.
        service: its name.
        lease_s: after which a lease that is not renewed may be taken.

    Attributes:
        lost: another has it.
        service: its name.
        serves: whether the service does its work: one that reaches no router is to be followed.
        succeeds: whether somebody else had it before: the folder may hold what counts for nothing.
    """

    def __init__(self, holder: str, bucket: ObjectBucket, service: str, lease_s: float) -> None:
        self._holder, self._bucket, self.service, self._lease_s = holder, bucket, service, lease_s
        self._mine: Held | None = None
        self._renewed, self._stop = 0.0, threading.Event()
        self._thread: threading.Thread | None = None
        self.lost, self.succeeds = False, False
        self.serves: Callable[[], bool] = lambda: True

    @property
    def term(self) -> Term:
        """How many had it with this one, and the epoch of the names that it gives."""
        return Term(0, 0) if self._mine is None else Term(self._mine.number, self._mine.epoch)

    @property
    def former(self) -> tuple[str, ...]:
        """Names of the services that held it earlier."""
        return () if self._mine is None else self._mine.before

    @property
    def left_s(self) -> float:
        """For which what is in the bucket may be acknowledged, without a renewal [s]; 0 or less: not now."""
        return 0.0 if self.lost or self._mine is None else self._lease_s / 2 - (elapsed() - self._renewed)

    @property
    def fresh(self) -> bool:
        """Whether what is in the bucket now may be acknowledged."""
        return self.left_s > 0.0

    def alone(self) -> None:
        """See that nobody has taken over: then who does later finds all that was put until now.

        Raises:
            CopyError: somebody has, or the bucket does not say.
        """
        mine = self._mine
        if mine is None or self._bucket.get(mine._replace(number=mine.number + 1).name) is not None:
            self.lost = mine is not None
            raise CopyError("another service has the lease")

    def wait(
        self, stop: threading.Event, say: Callable[[str], None], epoch: Callable[[], int], standby: Standby | None
    ) -> bool:
        """Wait until the lease is this one's; False if stopped.

        Args:
            stop: ends the wait.
            say: takes a line when there is something new to say.
            epoch: the largest that is known.
            standby: None: it is none, and does not wait for a service that lives.

        Raises:
            InputError: a service that lives has it, and this one is no standby.
            CopyError: the bucket cannot be reached, and this one is no standby.
        """
        seen: Held | None = None
        since, ahead, logged, stood = time.monotonic(), 0.0, "", False
        while not stop.is_set():
            line = ""
            if standby is not None:
                standby.alive()
            try:
                found = self._newest()
                if found is not None and found != seen:
                    if standby is None and seen is not None and found.number == seen.number:
                        problem = f"is served by {found.service} on another machine or in another folder"
                        raise InputError("archive.copy", problem, "stop it, or start with --standby")
                    stood = stood and seen is not None and found.number == seen.number
                    seen, since = found, time.monotonic()
                stands = standby is not None and found is not None and standby.stands(found.service)
                stale_s = self._lease_s * (HINT if stood and not stands else 1.0)
                stood = stood or stands
                free = found is None or (found.to in ("", self.service) and (found.released or self._had(found)))
                if free or time.monotonic() - since >= stale_s:
                    if (standby is None or standby.may()) and self._take(found, epoch, stop):
                        return True
                elif standby is not None and found is not None:
                    line = f"standby: {found.service} is served under lease {found.number}"
                    if time.monotonic() - ahead > AHEAD_S:
                        ahead = time.monotonic()
                        standby.get_ahead()
            except CopyError as error:
                if standby is None:
                    raise
                line = f"standby: the copy cannot be reached ({error})"
            if line != logged and line:
                say(line)
                logged = line
            stop.wait(LOOK_S)
        return False

    def keep(self) -> None:
        """Renew it from now on, in a thread, while it `serves`: else it runs out, and another takes it."""
        self._thread = threading.Thread(target=self._keep, name="lease", daemon=True)
        self._thread.start()

    def end(self, to: str = "") -> None:
        """Give it free, if it is still held, for a service or for any: nothing is acknowledged after this."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(self._lease_s)
        mine, self._mine = self._mine, None
        if mine is not None and not self.lost:
            try:
                self._bucket.put(mine.name, mine._replace(released=True, turn=mine.turn + 1, to=to).content)
            except CopyError as error:
                log.warning("the lease runs out by itself: %s", error)

    def again(self) -> Lease:
        """One to wait for, after this one was lost."""
        return Lease(self._holder, self._bucket, self.service, self._lease_s)

    def renew(self) -> None:
        """Put the next turn; it counts if nobody has a higher number after it.

        Raises:
            CopyError: it is not known whether it counts.
        """
        if self._mine is None or self.lost:
            return
        began = elapsed()
        turn = self._mine._replace(turn=self._mine.turn + 1)
        self._bucket.put(turn.name, turn.content)
        self._mine = turn
        self.alone()
        self._renewed = began

    def _keep(self) -> None:
        while not self._stop.wait(self._lease_s / TURNS):
            try:
                if self.serves():
                    self.renew()
            except CopyError as error:
                log.warning("the lease is not renewed: %s", error)
            if self.lost:
                return

    def _had(self, found: Held) -> bool:
        """Whether it was this folder's in a former start."""
        return found.holder == self._holder

    def _newest(self) -> Held | None:
        names = [name for name in self._bucket.names(FOLDER) if name.endswith(".json")]
        content = self._bucket.get(max(names)) if names else None
        return None if content is None else _read(max(names), content)

    def _take(self, found: Held | None, known: Callable[[], int], stop: threading.Event) -> bool:
        """Make the next number; False if another was faster."""
        number = 1 if found is None else found.number + 1
        epoch = max(int(time.time()), known() + 1, 0 if found is None else found.epoch + 1)
        before = () if found is None else tuple(dict.fromkeys((*found.before, found.service)))
        mine = Held(number, self._holder, self.service, epoch, 0, released=False, before=before)
        began = elapsed()
        if not self._bucket.make(mine.name, mine.content):
            return False
        self._mine, self._renewed = mine, began
        self.succeeds = found is not None and found.holder != self._holder
        if found is not None and self._bucket.get(found.name) != found.content:
            stop.wait(self._lease_s / 2)  # it was renewed in between, and may acknowledge for so long
        return True


def elapsed() -> float:
    """Seconds that have passed; those in which the machine was suspended too, where the system counts them (Linux)."""
    return time.monotonic() if _BOOTTIME is None else time.clock_gettime(_BOOTTIME)


def holder_of(root: Path, url: str) -> tuple[str, bool]:
    """Who a folder is to others, and whether it was somebody before; a copy of it, or one moved, is another.

    Raises:
        OSError: the folder cannot be read or written.
    """
    path, place = root / HOLDER, {"copy": url, "host": socket.gethostname(), "folder": root.stat().st_ino}
    identity: dict[str, Any] = {}
    if path.exists():
        with suppress(ValueError):
            identity = json.loads(path.read_bytes())
    if not place.items() <= identity.items() or "holder" not in identity:
        known, identity = identity.get("copy") == url, {**place, "holder": secrets.token_hex(8)}
        with written(path) as file:
            file.write(json.dumps(identity).encode())
        return str(identity["holder"]), known
    return str(identity["holder"]), True


def forget_holder(root: Path) -> None:
    """A folder that is written without a lease holds what no bucket has: it may not become what a bucket is.

    Raises:
        OSError: it cannot be written.
    """
    (root / HOLDER).unlink(missing_ok=True)
    (root / terms.NAME).unlink(missing_ok=True)


def _read(name: str, content: bytes) -> Held:
    record: dict[str, Any] = json.loads(content)
    return Held(int(Path(name).stem), **{**record, "before": tuple(record.get("before", ()))})
