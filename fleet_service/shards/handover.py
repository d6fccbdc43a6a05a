"""Live hand-over of a region: the active service shuts down in an orderly way, and a named standby
(a waiting service) gets its lease (ownership of the archive). A token is the Zenoh liveliness token
by which a service announces itself.

    client                                   active service
    get gripmap/v1/shard/SERVICE?to=NAME ──► checks that NAME stands by for its regions, replies
    watches the tokens                       writes and uploads a checkpoint (saved state)
                                             stops: flush, acknowledge, undeclare its token
                                             releases the lease for NAME
                                             NAME acquires it, restores the map, declares its token
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import zenoh

from schemas import keys, regions
from schemas.config import NAME_PATTERN
from schemas.errors import InputError
from schemas.runtime import presence

ANSWER_S: Final = 10.0
MOVED_S: Final = 300.0  # [s] long enough for a running compaction to end
LOOK_S: Final = 0.05
FIX: Final = "start it with --standby, the same settings and a name of its own"


class HandoverResult(NamedTuple):
    """Result of a hand-over between services: the name of the service that stopped, and the time
    [s] for which no service served the region.
    """

    service: str
    pause_s: float


def answer_request(query: zenoh.Query, session: zenoh.Session, served: Sequence[str]) -> str | None:
    """Answer a hand-over request; return the name of the standby (the waiting service that will
    take over), or None if the hand-over is impossible.

    Args:
        query: request as sent by `hand_over`.
        session: Zenoh session of the service.
        served: region expressions of the service.
    """
    with query:
        to = str(query.parameters).removeprefix("to=")
        waiting = {
            token.region
            for token in presence.active_tokens(session, keys.WAITS)
            if token.service == to
        }
        if re.fullmatch(NAME_PATTERN, to) is None or waiting != set(served):
            other = (
                f"stands by for {', '.join(sorted(waiting))}"
                if waiting
                else f"no {to[:63]!r} stands by"
            )
            query.reply_err(f"to: {other}, not for {', '.join(served)}; {FIX}".encode())
            return None
        query.reply(query.key_expr, ",".join(served).encode())
        return to


def hand_over(
    session: zenoh.Session, region: str, to: str, log_line: Callable[[str], None]
) -> HandoverResult | None:
    """Ask the service of a region to hand over to a standby, and wait until the standby serves the
    region. Return the name of the former service and the duration of the interruption, or None if
    the standby already serves the region.

    Args:
        session: Zenoh session of a client with a service certificate.
        region: key expression of the region.
        to: name of the standby.
        log_line: called with lines about the progress.

    Raises:
        InputError: the region has no service, the standby is not waiting, or it did not take over.
    """
    with presence.track_tokens(session) as services:
        service = _find_server(services, region)
        if service is None:
            raise InputError("region", f"no service serves {region}", "see `fleet-service watch`")
        if service == to:
            return None
        log_line(f"{service} hands over: {_request_handover(session, service, to)}")
        end = time.monotonic() + MOVED_S
        absent_since = 0.0
        while (now := _find_server(services, region)) != to:
            absent_since = absent_since or (time.monotonic() if now is None else 0.0)
            if time.monotonic() > end or now not in (None, service):
                raise InputError(
                    "to",
                    f"{to} does not serve {region}, but {now or 'no service'} does",
                    "see their logs",
                )
            time.sleep(LOOK_S)
        return HandoverResult(service, time.monotonic() - (absent_since or time.monotonic()))


def _find_server(services: presence.PresenceTracker, region: str) -> str | None:
    return next(
        (token.service for token in services.active if regions.covers(token.region, region)), None
    )


def _request_handover(session: zenoh.Session, service: str, to: str) -> str:
    """Send a request to a service to hand over its regions to the standby named `to`; return the
    regions that the service hands over, as text.
    """
    for reply in session.get(f"{keys.shard_key(service)}?to={to}", timeout=ANSWER_S):
        if reply.ok is not None:
            return reply.ok.payload.to_string().replace(",", ", ")
        problem = reply.err.payload.to_string() if reply.err else ""
        field, _, rest = problem.partition(": ")
        problem, _, fix = rest.partition("; ")
        if fix:
            raise InputError(field, problem, fix)
    raise InputError("region", f"{service} does not answer", "ask with a certificate of a service")
