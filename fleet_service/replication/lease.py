"""Lease of an archive's bucket copy: at most one service owns the copy. The bucket needs only one
special operation, conditional create (an object is written only if its name is new).

    lease/NUMBER.json       lease object; the object with the highest number states the holder
    ARCHIVE/holder.json     identity of this folder, kept over restarts

Fields of a lease object:

    holder, service     identity of the holder's folder, and name of the service that runs on it
    epoch               number in the names of all files that the holder writes
    turn                count of renewals of this lease
    released, to        true after a release, and the service that may take over then ("" for any)
    before              names of the earlier holders
    lease_s             lease time [s]

A service takes over by creating the object with the next number; the bucket lets only one service
do so. The holder renews its lease in two steps. It writes its own object again with the next turn,
and then checks that no higher number exists. A token (Zenoh liveliness token) shows that a service
is alive. The clocks of different machines are never compared.

A service may take over at once if the lease was released, and otherwise when it has seen the same
turn for `lease_s`. If the holder had a token and the token has disappeared, HINT · `lease_s`
suffices. HINT is a constant between 0.5 and 1. A service may also take over at once from an earlier
start of its own folder. A take-over from another folder uses a new identity, which the folder
stores only when it has joined. So an interrupted take-over counts as one by another folder.

**No acknowledged data are lost.** Let A be the holder, and let B create the next number at time T.

- A acknowledges only data that are already in the bucket, and only within `lease_s / 2` after it
  *began* a valid renewal. A renewal is valid if A found no higher number at its end. Every valid
  renewal therefore began before T.
- Assume first that A did not renew after B saw A's turn for the first time. A's last renewal then
  began before that moment. B waited for more than `lease_s / 2` from that moment until T, so A's
  right to acknowledge ended before T.
- Assume now that A renewed after B's last look before T. B reads A's object again after T and
  finds that the turn has changed. B then waits for another `lease_s`, which is twice the time in
  which A may acknowledge. This suffices even if A's clock is slower than B's.
- A turn is written at most once, even if the write failed. A failed write may take effect late, and
  a later renewal with the same content could not be distinguished from it. Therefore the bucket
  client must not repeat requests (`retries=0`).
- Only after this does B list the bucket, so it finds everything that A has acknowledged. An
  acknowledgement that A's network delivers later is still correct.
- If A was frozen and uploads files after the listing, they have an older epoch and are not in B's
  fence (list of valid files, see `fence`). All readers ignore these files, and A has acknowledged
  none of them.
- A deletes a file only after it has uploaded the replacement and found no higher number, so B finds
  the replacement.

**No data count twice.** The valid files are one set, and B reads this set completely before it
accepts new data. If A archived a batch without acknowledging it, B therefore knows the batch when
the vehicle sends it again, and only acknowledges it. Files of A outside the set are ignored, so
their rows are sent again and accepted once. A's folder is synchronised with the bucket before A
serves again.

The proof requires the same `lease_s` on all machines, so the value is stored in the object. A
service with another value does not start while a holder is alive. Unknown fields are ignored; the
record of an older version has no `lease_s`. A damaged object means that the holder is unknown; a
live holder writes the object again with its next turn.

A machine that was suspended finds that its lease has expired (`elapsed_seconds`).

Not covered
    - a machine whose elapsed-time clock runs at less than 5/6 of another machine's speed (1/2 of
      it if the holder's token stays active, so that HINT does not apply)
    - a clock that stops while the machine is migrated between hosts
    - a bucket without read-after-write consistency

`tests/faults/protocol_model.py` checks all states of a model. `tests/faults/lease_histories.py`
checks histories of this module in virtual time.
"""

from __future__ import annotations

import json
import logging
import math
import secrets
import threading
import time
from collections.abc import Callable
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final, NamedTuple

from fleet_service.replication.bucket import CopyError, ObjectBucket
from fleet_service.replication.fence import Term
from schemas.errors import InputError
from schemas.runtime.steady_clock import elapsed_seconds

log = logging.getLogger(__name__)
FOLDER: Final = "lease"
TURNS: Final = 6  # number of renewals per lease time
# Share of `lease_s` after which a holder without a token may be replaced. It is more than one half,
# because a holder acknowledges for `lease_s / 2` after its last renewal.
HINT: Final = 0.6
# [s] Period in which a standby downloads new objects, so that little is left to download at a
# take-over.
PREFETCH_S: Final = 10.0
UNKNOWN: Final = "unknown"  # holder's name if the lease object is damaged
LOOK_S: Final = 0.25  # [s] period of the checks while waiting


class LeaseRecord(NamedTuple):
    """Lease (ownership limited in time) as stored in the bucket.

    Attributes:
        number, epoch: number of the lease, and epoch (a number) in the names of the files that the
            holder writes.
        holder, service: identity of the holder's folder, and name of the service that runs on it.
        turn: count of renewals of this lease; the lease number stays the same.
        released: True if the holder released the lease.
        before: names of the services that held the lease earlier.
        to: service for which the lease was released; other services wait for one lease time.
        lease_s: lease time of the holder [s]; 0 in a record of an older version.
    """

    number: int
    holder: str
    service: str
    epoch: int
    turn: int
    released: bool
    before: tuple[str, ...] = ()
    to: str = ""
    lease_s: float = 0.0

    @property
    def name(self) -> str:
        """Return the name of the lease object (it states the owner of the archive) in the
        bucket.
        """
        return f"{FOLDER}/{self.number:010d}.json"

    @property
    def content(self) -> bytes:
        """Return the JSON content of the lease object in the bucket."""
        return json.dumps(
            {name: value for name, value in self._asdict().items() if name != "number"}
        ).encode()


class Standby(NamedTuple):
    """Functions that a standby (a service that waits for the lease, the ownership) gives to
    `Lease.wait`.

    Attributes:
        can_serve: returns True if the standby reaches a router and so could serve if it took over
            now.
        has_token: returns True if the service with the given name has a liveliness token.
        notify_alive: called at each check of the lease.
        prefetch: downloads new objects from the bucket in advance. It returns the problem if this
            disk does not accept them, else an empty text.
    """

    can_serve: Callable[[], bool]
    has_token: Callable[[str], bool]
    notify_alive: Callable[[], None]
    prefetch: Callable[[], str]


class Lease:
    """Lease of one archive's copy: `wait` for it, then call `start_renewal`, and finally `release`.

    Args:
        holder: identity of this folder, see `folder_identity`. This process has locked the folder,
            so no other process uses this identity.
        bucket: bucket of the copy; it must not repeat requests.
        service: name of the service.
        lease_s: time [s] after which a lease that is not renewed may be taken over.

    Attributes:
        lost: True if another service has taken over.
        problem: reason why this standby must not take over, such as a full disk; "" if none. It is
            that of the last prefetch, which is repeated every PREFETCH_S.
        service: name of the service.
        serves: function that returns True if the service works; a service that reaches no router
            must be replaced.
        succeeds: True if another folder had the lease before; this folder may then contain files
            that are not valid.
    """

    def __init__(self, holder: str, bucket: ObjectBucket, service: str, lease_s: float) -> None:
        self._holder = holder
        self._bucket = bucket
        self.service = service
        self._lease_s = lease_s
        self._mine: LeaseRecord | None = None
        self._renewed = 0.0
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.lost = False
        self.problem = ""
        self.succeeds = False
        self.serves: Callable[[], bool] = lambda: True

    @property
    def term(self) -> Term:
        """Return the number of the lease (1 for the first owner of the archive), and the epoch,
        which is a number in the names of this owner's files.
        """
        return Term(0, 0) if self._mine is None else Term(self._mine.number, self._mine.epoch)

    @property
    def holder(self) -> str:
        """Return the identity in this service's lease object. After a take-over from another folder
        it is a new one, and this folder must store it with `save_holder` when it has joined.
        """
        return self._holder if self._mine is None else self._mine.holder

    @property
    def former_holders(self) -> tuple[str, ...]:
        """Return the names of the services that had the lease earlier."""
        return () if self._mine is None else self._mine.before

    @property
    def left_s(self) -> float:
        """Return the time [s] for which the service may still acknowledge data in the bucket
        without another renewal of its lease; 0 or less if it may not.
        """
        return (
            0.0
            if self.lost or self._mine is None
            else self._lease_s / 2 - (elapsed_seconds() - self._renewed)
        )

    @property
    def may_acknowledge(self) -> bool:
        """Return True if the service may now acknowledge data that are in the bucket (object
        store).
        """
        return self.left_s > 0.0

    def assert_not_superseded(self) -> None:
        """Check in the bucket that no other service has taken over. If the check passes, every
        later holder of the lease will find all data that this service uploaded before the check.

        Raises:
            CopyError: another service has taken over, or the bucket does not answer.
        """
        own = self._mine
        if own is None or self._bucket.get(own._replace(number=own.number + 1).name) is not None:
            self.lost = own is not None
            raise CopyError("another service has the lease")

    def wait(
        self,
        stop: threading.Event,
        log_line: Callable[[str], None],
        epoch: Callable[[], int],
        standby: Standby | None,
    ) -> bool:
        """Wait until this service has the lease; return False if `stop` is set first.

        Args:
            stop: event that ends the wait.
            log_line: called with a line of text when the reason for waiting changes.
            epoch: function that returns the largest known epoch (number in the names of an owner's
                files).
            standby: functions of a standby service. None for a service that is no standby and does
                not wait for a live holder.

        Raises:
            InputError: a live service has the lease, and this service is no standby or has another
                `lease_s`.
            CopyError: the bucket cannot be reached, and this service is no standby.
        """
        watch = _HolderWatch(self._lease_s)
        prefetched_at = time.monotonic() if self.problem else -math.inf
        logged = ""
        while not stop.is_set():
            line = ""
            if standby is not None:
                standby.notify_alive()
            try:
                found = _read_newest_record(self._bucket)
                can_take = self._can_take(found, watch, standby)
                if standby is not None and found is not None and (self.problem or not can_take):
                    if time.monotonic() - prefetched_at > PREFETCH_S:
                        prefetched_at = time.monotonic()
                        self.problem = standby.prefetch()
                    line = (
                        f"standby: {self.problem}; trying again"
                        if self.problem
                        else f"standby: {found.service} is served under lease {found.number}"
                    )
                if can_take and not self.problem:
                    can_serve = standby is None or standby.can_serve()
                    if can_serve and self._create_next(found, epoch, stop):
                        return True
            except CopyError as error:
                if standby is None:
                    raise
                line = f"standby: the copy cannot be reached ({error})"
            if line != logged and line:
                log_line(line)
                logged = line
            stop.wait(LOOK_S)
        return False

    def start_renewal(self) -> None:
        """Start a thread that renews the lease while `serves` returns True. Otherwise the lease
        expires, and another service takes over.
        """
        self._thread = threading.Thread(target=self._renew_until_stopped, name="lease", daemon=True)
        self._thread.start()

    def release(self, to: str = "") -> None:
        """Release the lease if this service still has it. Then the service named `to` may take over
        at once, or any service if `to` is empty. This service must not acknowledge anything
        afterwards.
        """
        self._stop.set()
        if self._thread is not None:
            self._thread.join(self._lease_s)
        own = self._mine
        self._mine = None
        if own is not None and not self.lost:
            try:
                self._bucket.put(
                    own.name, own._replace(released=True, turn=own.turn + 1, to=to).content
                )
            except CopyError as error:
                log.warning("the lease was not released and expires by itself: %s", error)

    def make_new_lease(self) -> Lease:
        """Return a new `Lease` object with which the service can wait for the ownership again after
        it has lost this lease.
        """
        return Lease(self._holder, self._bucket, self.service, self._lease_s)

    def renew(self) -> None:
        """Renew the lease: write its object in the bucket again, with the same lease number and a
        turn (count of renewals) that is one higher. The renewal is valid if no object with a higher
        lease number exists afterwards, because each service that takes over creates the next lease
        number.

        Raises:
            CopyError: it is unknown whether the renewal is valid.
        """
        if self._mine is None or self.lost:
            return
        began = elapsed_seconds()
        self._mine = self._mine._replace(turn=self._mine.turn + 1)
        self._bucket.put(self._mine.name, self._mine.content)
        self.assert_not_superseded()
        self._renewed = began

    def _renew_until_stopped(self) -> None:
        while not self._stop.wait(self._lease_s / TURNS):
            try:
                if self.serves():
                    self.renew()
            except CopyError as error:
                log.warning("the lease could not be renewed: %s", error)
            if self.lost:
                return

    def _can_take(
        self, found: LeaseRecord | None, watch: _HolderWatch, standby: Standby | None
    ) -> bool:
        """Return True if this service may take over the lease, whose newest record is `found`.

        Raises:
            InputError: a live service has the lease, and this service is no standby or has another
                `lease_s`.
        """
        if found is None:
            return True
        if standby is None and watch.has_renewed(found):
            problem = f"is served by {found.service} on another machine or in another folder"
            raise InputError("archive.copy", problem, "stop it, or start with --standby")
        watch.update(found, has_token=standby is not None and standby.has_token(found.service))
        was_held_here = found.holder == self._holder
        if found.to in ("", self.service) and (found.released or was_held_here):
            return True
        _check_settings(found, self._lease_s)
        return watch.is_stale

    def _create_next(
        self, found: LeaseRecord | None, known: Callable[[], int], stop: threading.Event
    ) -> bool:
        """Create the lease object with the next number in the bucket; in this way, this service
        takes over the archive. Return False if another service was faster, or if `stop` is set.
        """
        succeeds = found is not None and found.holder != self._holder
        own = LeaseRecord(
            number=1 if found is None else found.number + 1,
            holder=secrets.token_hex(8) if succeeds else self._holder,
            service=self.service,
            epoch=max(int(time.time()), known() + 1, 0 if found is None else found.epoch + 1),
            turn=0,
            released=False,
            before=() if found is None else tuple(dict.fromkeys((*found.before, found.service))),
            lease_s=self._lease_s,
        )
        began = elapsed_seconds()
        if not self._bucket.create(own.name, own.content):
            return False
        is_renewed = found is not None and self._bucket.get(found.name) != found.content
        # A holder that renewed its lease meanwhile may acknowledge for half of `lease_s`.
        if is_renewed and stop.wait(self._lease_s):
            return False
        # Only now may `release` let another service take over at once.
        self._mine = own
        self._renewed = began
        self.succeeds = succeeds
        return True


class _HolderWatch:
    """Observation of the holder of a lease by a waiting service."""

    def __init__(self, lease_s: float) -> None:
        self._lease_s = lease_s
        self._seen: LeaseRecord | None = None
        self._since = time.monotonic()
        self._had_token = False
        self._has_token = False

    def has_renewed(self, found: LeaseRecord) -> bool:
        """Return True if the lease record has changed since the last `update`, and the lease number
        has not.
        """
        seen = self._seen
        return seen is not None and found != seen and found.number == seen.number

    def update(self, found: LeaseRecord, *, has_token: bool) -> None:
        """Record the newest lease record, and whether its holder has a liveliness token."""
        if found != self._seen:
            self._had_token = self._had_token and self.has_renewed(found)
            self._seen = found
            self._since = time.monotonic()
        self._has_token = has_token
        self._had_token = self._had_token or has_token

    @property
    def is_stale(self) -> bool:
        """Return True if the holder has not renewed its lease for so long that another service may
        take over.
        """
        has_lost_token = self._had_token and not self._has_token
        stale_s = self._lease_s * (HINT if has_lost_token else 1.0)
        return time.monotonic() - self._since >= stale_s


def _check_settings(found: LeaseRecord, lease_s: float) -> None:
    """Raise InputError if `found`, the record of a live holder's lease, states another lease time
    than `lease_s` [s]: such a holder could still acknowledge data after a take-over.
    """
    if found.lease_s not in (0.0, lease_s):
        problem = (
            f"is {lease_s:g}, and {found.service}, which has the lease, uses {found.lease_s:g}"
        )
        raise InputError(
            "archive.lease_s", problem, "give all services of an archive the same value"
        )


def _read_newest_record(bucket: ObjectBucket) -> LeaseRecord | None:
    """Return the record of the newest lease in the bucket; None if there is none.

    Raises:
        CopyError: the bucket does not answer.
    """
    names = sorted(name for name in bucket.list_names(FOLDER) if name.endswith(".json"))
    content = bucket.get(names[-1]) if names else None
    if content is None:
        return None
    found = _parse_record(names[-1], content)
    if found is not None:
        return found
    previous = bucket.get(names[-2]) if len(names) > 1 else None
    last = None if previous is None else _parse_record(names[-2], previous)
    return _unknown_holder(names[-1], content, last)


def _parse_record(name: str, content: bytes) -> LeaseRecord | None:
    """Return the lease record (who owns the archive) from the content of its object in the bucket;
    None if it is damaged. Unknown fields are ignored.
    """
    try:
        record: dict[str, Any] = json.loads(content)
        found = LeaseRecord(
            number=int(Path(name).stem),
            holder=record["holder"],
            service=record["service"],
            epoch=record["epoch"],
            turn=record["turn"],
            released=record["released"],
            before=tuple(record.get("before", ())),
            to=record.get("to", ""),
            lease_s=float(record.get("lease_s", 0.0)),
        )
    except (ValueError, KeyError, TypeError, AttributeError):
        return None
    texts = (found.holder, found.service, found.to, *found.before)
    is_valid = all(isinstance(text, str) for text in texts) and isinstance(found.released, bool)
    is_valid = is_valid and all(
        type(number) is int and number >= 0 for number in (found.epoch, found.turn)
    )
    return found if is_valid and found.lease_s >= 0.0 else None


def _unknown_holder(name: str, content: bytes, previous: LeaseRecord | None) -> LeaseRecord:
    """Return a lease record that stands for a damaged lease object: its holder is unknown, and its
    turn changes whenever the content of the object changes.
    """
    log.warning("the lease object %s is damaged", name)
    turn = int.from_bytes(blake2b(content, digest_size=6).digest(), "big")
    before = () if previous is None else (*previous.before, previous.service)
    epoch = 0 if previous is None else previous.epoch + 1
    return LeaseRecord(
        int(Path(name).stem), "", UNKNOWN, epoch, turn, released=False, before=before
    )
