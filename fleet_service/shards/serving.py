"""Announcement of the regions that a service serves. A second service for the same region is
excluded, because each query would reach only one of them.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from typing import Final

import zenoh

from schemas.config import ServiceConfig
from schemas.errors import InputError
from schemas.keys import CLAIMS, SERVES, WAITS, ServiceToken
from schemas.regions import overlap
from schemas.runtime import presence, zenoh_session

# [s] Time after which the token of a frozen or lost service has disappeared. Its Zenoh lease is
# 3 s.
GONE_S: Final = 5.0
LOOK_S: Final = 0.1
_TRIES: Final = 5  # number of attempts if several services start at the same moment


@contextmanager
def claim_regions(
    session: zenoh.Session,
    name: str,
    regions: Sequence[str],
    stop: threading.Event,
    former: Collection[str] = (),
) -> Iterator[frozenset[ServiceToken]]:
    """Claim regions exclusively until the `with` block ends; yield the liveliness tokens by which
    this service announces them.

    Args:
        session: Zenoh session of the service.
        name: name of the service.
        regions: key expressions of the regions.
        stop: event that ends the wait for another service's token to disappear.
        former: names of earlier holders of this service's lease (ownership of the archive); their
            remaining tokens are ignored, because they will disappear soon.

    Raises:
        InputError: another service has one of the regions.
    """
    own = frozenset(ServiceToken(region, name, secrets.token_hex(4)) for region in regions)
    with _hold_tokens(_claim_regions(session, own, stop, former)):
        yield own


@contextmanager
def announce_regions(session: zenoh.Session, own: frozenset[ServiceToken]) -> Iterator[None]:
    """Announce to all clients that regions are served while the `with` block runs. The service must
    be able to answer queries before the block begins and until after it ends: an empty answer from
    an announced region means that no data exist there.
    """
    with _hold_tokens(_declare_tokens(session, own, SERVES)):
        yield


@contextmanager
def _hold_tokens(held: list[zenoh.LivelinessToken]) -> Iterator[None]:
    try:
        yield
    finally:
        for token in held:
            token.undeclare()


@contextmanager
def watch_successors(
    session: zenoh.Session, own: frozenset[ServiceToken]
) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns True if another service has taken over the regions of the
    tokens `own` since the `with` block began. In this way a service that cannot reach its bucket
    learns that it was replaced, and stops serving outdated data.
    """
    with presence.track_tokens(session) as services:
        before = services.active
        yield lambda: bool(rival_tokens(own, services.active - before))


def rival_tokens(
    own: frozenset[ServiceToken], present: set[ServiceToken], former: Collection[str] = ()
) -> list[ServiceToken]:
    """Return, sorted, the liveliness tokens by which other services announce regions that overlap
    the regions of `own`. Tokens of the `former` services are excluded.
    """
    regions = {token.region for token in own}
    candidates = (token for token in present - own if token.service not in former)
    return sorted(
        token for token in candidates if any(overlap(token.region, region) for region in regions)
    )


def _claim_regions(
    session: zenoh.Session,
    own: frozenset[ServiceToken],
    stop: threading.Event,
    former: Collection[str],
) -> list[zenoh.LivelinessToken]:
    def find_rivals() -> list[ServiceToken]:
        return rival_tokens(
            own, presence.active_tokens(session) | presence.active_tokens(session, CLAIMS), former
        )

    for _ in range(_TRIES):
        waited = 0.0
        while rivals := find_rivals():
            if waited > GONE_S or stop.wait(LOOK_S):
                break
            waited += LOOK_S
        if rivals:
            problem = f"{rivals[0].region} is already served by {rivals[0].service}"
            raise InputError("regions", problem, "stop that service, or give each its own regions")
        claims = _declare_tokens(session, own, CLAIMS)
        if not find_rivals():
            return claims
        for token in claims:  # another service began at the same time; the first to retry succeeds
            token.undeclare()
        stop.wait(secrets.randbelow(1000) * 1e-3)
    raise InputError(
        "regions",
        "other services start for the same regions at the same time",
        "start one service for each region",
    )


def _declare_tokens(
    session: zenoh.Session, own: frozenset[ServiceToken], root: str
) -> list[zenoh.LivelinessToken]:
    return [session.liveliness().declare_token(token.key_under(root)) for token in sorted(own)]


@contextmanager
def standby_signs(
    config: ServiceConfig, stop: threading.Event, alive: Callable[[], None] = lambda: None
) -> Iterator[tuple[Callable[[], bool], Callable[[str], bool], Callable[[], None]] | None]:
    """Yield three functions that a standby (waiting service) calls while it waits for the lease.
    The first returns True if a router is reachable, the second if the service of a given name is
    present. The third is the argument `alive`. The standby calls it at each check of the lease, so
    that a watchdog can detect a standby that hangs. Yield None if the service is no standby, or was
    stopped before it reached a router.
    """
    session = (
        zenoh_session.open_session(config.zenoh, stop, config.name) if config.standby else None
    )
    if session is None:
        yield None
        return
    waits = frozenset(
        ServiceToken(region, config.name, secrets.token_hex(4)) for region in config.regions
    )
    with (
        session,
        presence.track_tokens(session) as services,
        _hold_tokens(_declare_tokens(session, waits, WAITS)),
    ):
        yield (
            lambda: bool(zenoh_session.connected_routers(session)),
            lambda name: any(one.service == name for one in services.active),
            alive,
        )
