"""Explicit-state model of acknowledgement, lease (exclusive ownership of an archive), takeover,
hand-over and erasure; `explore_states` visits every reachable state.

Two services share a bucket (object store). The lease object in the bucket has two counters. The
*number* grows with each takeover, and the *turn* with each renewal. A vehicle sends the batches in
BATCHES, and a service uploads each one as an object with the service's lease number. The *fence*,
written at a takeover, decides which objects count (are valid for readers). These are the objects
that the fence lists, and all objects whose lease number is not lower than that of the fence.

Time passes in ticks. In each tick a service's clock advances by one, but the clock of a lease
holder may stand still in every second tick. No step is compulsory: a service that does nothing for
a while models a frozen or disconnected one. Uploads and renewals take effect in the bucket at any
time after they began.

    renew    The holder writes the next turn. The renewal is valid if the bucket then shows no
             higher number; its age is measured from its beginning. If the holder gives a renewal
             up, its turn may still be written later.
    ack      The holder acknowledges only uploaded batches, and only within half a lease time after
             the beginning of its last valid renewal.
    take     A standby that has seen the same turn for its lease time creates the next number. The
             holder may have renewed its lease since the standby last read the turn. In this case
             the standby waits for another lease time before `list`.
    list     The new holder writes all objects of the bucket into the fence. Objects with lower
             numbers that are uploaded later do not count.
    release  The holder gives up its lease at once. It acknowledges nothing afterwards.
    erase    The holder records that a batch is erased, and then deletes it from the bucket.

Invariants: every acknowledged batch that is not erased is known to each serving service; a batch
counts at most once; an erased batch counts nowhere and is not accepted again.

`Rules` can switch off single rules. Without any one of the rules an invariant must break, which
shows that the model can detect errors.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Final, NamedTuple

NAMES: Final = (0, 1)
BATCHES: Final = (0,)  # one batch is enough, because batches do not depend on each other
NOT_YET: Final = -1


class Rules(NamedTuple):
    """Rules of the modelled takeover protocol that are switched on, and the lease times [ticks] of
    both services.
    """

    lease: tuple[int, int] = (4, 4)
    compares_lease: bool = True
    acknowledges_within_half: bool = True
    lists_after_waiting: bool = True
    # In half lease times: wait before a new holder lists the objects in the bucket.
    wait_share: int = 2
    has_fence: bool = True
    remembers_erasure: bool = True
    writes_turn_once: bool = True


# Faulty protocols: each lacks one rule.
BROKEN: Final = {
    "unlike lease times": Rules(lease=(6, 2), compares_lease=False),
    "acknowledges for ever": Rules(acknowledges_within_half=False),
    "waits half a lease next to a slow clock": Rules(wait_share=1),
    "no fence": Rules(has_fence=False),
    "erasure forgotten": Rules(remembers_erasure=False),
    "turn written again after a failure": Rules(writes_turn_once=False),
}


class Service(NamedTuple):
    """State of a service. `age`, `begun` and `same` never exceed the lease time + 1, so that the
    number of states is finite.

    Attributes:
        role: "waiting", "taking" (has created its lease number, but has not yet read the objects of
            the bucket), "serving", or "gone".
        number: number of its lease (each takeover creates the next one); 0 without a lease.
        age: ticks since the beginning of its last valid renewal.
        begun: ticks since the beginning of a renewal in progress; NOT_YET without one.
        seen: (number, turn) in the lease object when the service last looked.
        same: ticks for which a waiting service has seen this (number, turn).
        wait: ticks to wait before it reads the objects of the bucket.
        known: batches that it has accepted or found in the bucket; it does not accept them again.
        sending: batches whose upload is in progress.
        uploaded: batches that it knows to be in the bucket; only these may be acknowledged.
        slow: True if its clock did not advance in the last tick.
        turn: last turn (counter of renewals) that it has used for its lease.
        late: turn of a renewal that was given up and may still be written; 0 without one.
    """

    role: str = "waiting"
    number: int = 0
    age: int = 0
    begun: int = NOT_YET
    seen: tuple[int, int] = (0, 0)
    same: int = 0
    wait: int = 0
    known: frozenset[int] = frozenset()
    sending: frozenset[int] = frozenset()
    uploaded: frozenset[int] = frozenset()
    slow: bool = False
    turn: int = 0
    late: int = 0


class World(NamedTuple):
    """State of the whole model.

    Attributes:
        services: states of both services.
        number, holder, turn, released: content of the newest lease object in the bucket; turn
            counts its renewals.
        objects: (batch, lease number of the uploader) of each object in the bucket.
        fence: lease number of the service that wrote the fence, and the objects that it lists.
            Objects with a lower lease number are valid only if they are in this list.
        acked: batches that were acknowledged to the vehicle as durable.
        erased: batches that were erased.
    """

    services: tuple[Service, Service]
    number: int = 0
    holder: int = NOT_YET
    turn: int = 0
    released: bool = False
    objects: frozenset[tuple[int, int]] = frozenset()
    fence: tuple[int, frozenset[tuple[int, int]]] = (0, frozenset())
    acked: frozenset[int] = frozenset()
    erased: frozenset[int] = frozenset()


class Violation(NamedTuple):
    """Broken invariant that the exploration of the model found, with the steps that lead to it."""

    problem: str
    steps: tuple[str, ...]


class Checked(NamedTuple):
    """Result of exploring all states of the protocol model: number of states, and the violation
    found, if any.
    """

    states: int
    violation: Violation | None


def explore_states(rules: Rules, most_number: int = 2, most_turn: int = 3) -> Checked:
    """Visit all reachable states of the model with at most `most_number` leases (ownerships of the
    archive) and `most_turn` renewals of each. Stop at the first violation.
    """
    start = World((Service(), Service()))
    reached_from: dict[World, tuple[World, str] | None] = {start: None}
    waiting = deque([start])
    while waiting:
        world = waiting.popleft()
        problem = find_problem(world)
        if problem:
            return Checked(len(reached_from), Violation(problem, _steps_to(world, reached_from)))
        for step, after in list_steps(world, rules, most_number, most_turn):
            if after not in reached_from:
                reached_from[after] = (world, step)
                waiting.append(after)
    return Checked(len(reached_from), None)


def _steps_to(world: World, reached_from: dict[World, tuple[World, str] | None]) -> tuple[str, ...]:
    out = []
    while (before := reached_from[world]) is not None:
        world, step = before
        out.append(step)
    return tuple(reversed(out))


def list_counted(world: World) -> list[int]:
    """Return the batches of all valid objects in the bucket, in the model's state `world`. An
    object is valid if the fence lists it, or if its lease number is not lower than that of the
    fence. If two valid objects contain the same batch, the batch occurs twice.
    """
    number, before = world.fence
    return [batch for batch, epoch in world.objects if epoch >= number or (batch, epoch) in before]


def find_problem(world: World) -> str:
    """Return a message for the invariant that the model's state `world` breaks, or "" if it breaks
    none. In the messages, a batch counts if a valid object contains it (see `list_counted`).
    """
    counted = list_counted(world)
    if len(counted) != len(set(counted)):
        return "a batch counts twice"
    if world.erased & set(counted):
        return "an erased batch counts"
    if (world.acked - world.erased) - set(counted):
        return "an acknowledged batch does not count"
    current = [s for s in world.services if s.role == "serving" and s.number == world.number]
    if any((world.acked - world.erased) - s.known for s in current):
        return "the serving service does not know an acknowledged batch"
    return ""


def list_steps(
    world: World, rules: Rules, most_number: int, most_turn: int
) -> Iterator[tuple[str, World]]:
    """Yield, for each step that the model can take from the state `world`, its name and the state
    after it.
    """
    for slow in (NOT_YET, *NAMES):
        if slow == NOT_YET or (
            not world.services[slow].slow and world.services[slow].role == "serving"
        ):
            yield f"tick, slow {slow}", _advance_clocks(world, slow, rules)
    for me in NAMES:
        one = world.services[me]
        # The network may deliver at any time, whatever state the service is in.
        for batch in one.sending:
            landed = world._replace(objects=world.objects | {(batch, one.number)})
            known = one._replace(sending=one.sending - {batch}, uploaded=one.uploaded | {batch})
            yield f"upload of {batch} by {me} lands", _replace_service(landed, me, known)
        if one.late and world.number == one.number:
            written = world._replace(turn=one.late, released=False)
            yield (
                f"late turn {one.late} of {me} lands",
                _replace_service(written, me, one._replace(late=0)),
            )
        yield from _list_serving_steps(world, me, rules, most_turn)
        yield from _stand_by(world, me, rules, most_number)


def _list_serving_steps(
    world: World, me: int, rules: Rules, most_turn: int
) -> Iterator[tuple[str, World]]:
    one = world.services[me]
    if one.role != "serving":
        return
    lease = rules.lease[me]
    # Turn of the renewal that is under way.
    turn = one.turn if rules.writes_turn_once else one.turn + 1
    if one.begun == NOT_YET:
        if one.turn < most_turn:
            begun = one._replace(begun=0, turn=one.turn + rules.writes_turn_once)
            yield f"{me} begins a renewal", _replace_service(world, me, begun)
    elif world.number != one.number:
        yield f"{me} sees that it lost the lease", _replace_service(world, me, _end_service(one))
    else:
        renewed = one._replace(age=one.begun, begun=NOT_YET, turn=turn)
        if not world.released:
            yield (
                f"{me} renews turn {turn}",
                _replace_service(world._replace(turn=turn), me, renewed),
            )
        if not one.late:
            given_up = one._replace(begun=NOT_YET, late=turn)
            yield f"{me} gives up the renewal {turn}", _replace_service(world, me, given_up)
    is_fresh = one.age < lease / 2 or not rules.acknowledges_within_half
    for batch in BATCHES:
        is_refused = batch in world.erased and rules.remembers_erasure
        if batch not in one.known and batch not in one.sending and not is_refused:
            yield (
                f"{me} takes {batch}",
                _replace_service(
                    world,
                    me,
                    one._replace(known=one.known | {batch}, sending=one.sending | {batch}),
                ),
            )
        if is_fresh and batch in one.uploaded and batch not in world.acked:
            yield f"{me} acknowledges {batch}", world._replace(acked=world.acked | {batch})
        if (
            is_fresh
            and world.number == one.number
            and batch in one.known
            and (batch, one.number) in world.objects
        ):
            kept = frozenset(o for o in world.objects if o[0] != batch)
            gone = one._replace(known=one.known - {batch}, uploaded=one.uploaded - {batch})
            yield (
                f"{me} erases {batch}",
                _replace_service(
                    world._replace(objects=kept, erased=world.erased | {batch}), me, gone
                ),
            )
    if world.number == one.number and not one.sending and not world.released:
        yield (
            f"{me} hands over",
            _replace_service(world._replace(released=True), me, _end_service(one)),
        )


def _stand_by(world: World, me: int, rules: Rules, most_number: int) -> Iterator[tuple[str, World]]:
    one = world.services[me]
    now = (world.number, world.turn)
    if one.role == "waiting":
        other = rules.lease[1 - me]
        is_refused = (
            rules.compares_lease
            and world.holder == 1 - me
            and not world.released
            and other != rules.lease[me]
        )
        if one.seen != now:
            yield f"{me} looks", _replace_service(world, me, one._replace(seen=now, same=0))
        is_free = world.number == 0 or world.released
        is_stale = one.seen[0] == world.number and one.same >= rules.lease[me]
        if not is_refused and world.number < most_number and (is_free or is_stale):
            is_changed = not is_free and one.seen != now and rules.lists_after_waiting
            wait = rules.wait_share * rules.lease[me] // 2 if is_changed else 0
            taken = Service("taking", world.number + 1, age=0, wait=wait)
            after = world._replace(number=world.number + 1, holder=me, turn=0, released=False)
            yield f"{me} takes number {world.number + 1}", _replace_service(after, me, taken)
    elif one.role == "taking" and one.wait <= 0:
        if world.number != one.number:
            yield f"{me} lost it before it served", _replace_service(world, me, _end_service(one))
            return
        counted = frozenset(list_counted(world))
        fence = (one.number, frozenset(world.objects)) if rules.has_fence else world.fence
        served = one._replace(role="serving", wait=0, known=counted, uploaded=counted)
        yield f"{me} lists", _replace_service(world._replace(fence=fence), me, served)


def _advance_clocks(world: World, slow: int, rules: Rules) -> World:
    """Return the state of the model after one tick. The clocks of all running services advance,
    except that of the service with the index `slow`. The clocks measure the age of a lease
    (ownership of the archive), the wait for a lease, and the wait before a service reads the
    bucket's objects.
    """
    out = []
    for me, one in enumerate(world.services):
        most = rules.lease[me] + 1
        if me == slow:
            one = one._replace(slow=True)
        elif one.role == "waiting":
            one = one._replace(same=min(one.same + 1, most), slow=False)
        elif one.role != "gone":
            begun = one.begun if one.begun == NOT_YET else min(one.begun + 1, most)
            one = one._replace(
                age=min(one.age + 1, most), begun=begun, wait=max(one.wait - 1, 0), slow=False
            )
        out.append(one)
    return world._replace(services=(out[0], out[1]))


def _end_service(one: Service) -> Service:
    """Return the state of a modelled service after its end; its messages in transit may still take
    effect.
    """
    return Service("gone", one.number, age=0, sending=one.sending, late=one.late)


def _replace_service(world: World, me: int, one: Service) -> World:
    services = (one, world.services[1]) if me == 0 else (world.services[0], one)
    return world._replace(services=services)
