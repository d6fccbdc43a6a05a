"""Telling which regions a service serves, and that nobody else does: of two for one region only one would be asked."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final

import zenoh

from schemas.config import ServiceConfig
from schemas.errors import InputError
from schemas.keys import Served
from schemas.regions import overlap
from schemas.runtime import tokens, zenoh_session

GONE_S: Final = 5.0  # in which the token of a service that froze or lost its host falls: its lease is 3 s
LOOK_S: Final = 0.1
_TRIES: Final = 5  # of services that start at the same moment


@contextmanager
def serving(
    session: zenoh.Session, name: str, regions: Sequence[str], stop: threading.Event, *, owns: bool = False
) -> Iterator[frozenset[Served]]:
    """Say that a service serves these regions, until the block ends.

    Args:
        session: of the service.
        name: of the service.
        regions: key expressions.
        stop: ends the wait for another's token to fall.
        owns: whether a lease says that it is the one of this name: then another that says so too is to leave.

    Raises:
        InputError: another service serves one of them.
    """
    mine = frozenset(Served(region, name, secrets.token_hex(4)) for region in regions)
    held = _claimed(session, mine, stop, name if owns else None)
    try:
        yield mine
    finally:
        for token in held:
            token.undeclare()


def rivals(mine: frozenset[Served], there: set[Served], former: str | None = None) -> list[Served]:
    """Tokens of others for the same regions, but for those of a `former` service."""
    others = (one for one in there - mine if one.service != former)
    return sorted(one for one in others if any(overlap(one.region, own.region) for own in mine))


def _claimed(
    session: zenoh.Session, mine: frozenset[Served], stop: threading.Event, former: str | None
) -> list[zenoh.LivelinessToken]:  # fmt: skip
    for _ in range(_TRIES):
        waited = 0.0
        while others := rivals(mine, tokens.standing(session), former):
            if waited > GONE_S or stop.wait(LOOK_S):
                break
            waited += LOOK_S
        if others:
            problem = f"{others[0].region} is served by {others[0].service} already"
            raise InputError("regions", problem, "stop that service, or give each its own regions")
        held = _declared(session, mine)
        if not rivals(mine, tokens.standing(session), former):
            return held
        for token in held:  # both began at once: the one that comes back first has it
            token.undeclare()
        stop.wait(secrets.randbelow(1000) * 1e-3)
    raise InputError("regions", "others start for them at the same time", "start one service for each region")


def _declared(session: zenoh.Session, mine: frozenset[Served]) -> list[zenoh.LivelinessToken]:
    return [session.liveliness().declare_token(token.key) for token in sorted(mine)]


@contextmanager
def standing_by(
    config: ServiceConfig, stop: threading.Event
) -> Iterator[tuple[Callable[[], bool], Callable[[str], bool]] | None]:
    """Of a standby: whether it would be heard if it took over now, as it reaches a router, and whether the token of a
    service stands. None: it is none, or was stopped before it reached a router."""
    session = zenoh_session.open_session(config.zenoh, stop, config.name) if config.standby else None
    if session is None:
        yield None
        return
    with session, tokens.watched(session) as there:
        yield (
            lambda: bool(list(session.info.routers_zid())),
            lambda name: any(one.service == name for one in there.here),
        )
