"""Liveliness tokens (signs that a process is alive) of services. They show which service serves
which region, and are read once or tracked continuously.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Lock
from typing import Final

import zenoh

from schemas.errors import InputError
from schemas.keys import SERVES, ServiceToken, parse_served

ANSWER_S: Final = 2.0  # longest wait for a router's list of the active tokens
_ALL: Final = f"{SERVES}/**"


def active_tokens(session: zenoh.Session, root: str = SERVES) -> set[ServiceToken]:
    """Return the Zenoh liveliness tokens of services that are active now and visible to this
    session. `root` is the first part of the tokens' Zenoh keys. Another root selects another kind
    of tokens, such as those of standby services.
    """
    found = set[ServiceToken]()
    for reply in session.liveliness().get(f"{root}/**", timeout=ANSWER_S):
        if reply.ok is not None:
            with suppress(InputError):  # ignore tokens of other programs
                found.add(parse_served(str(reply.ok.key_expr), root))
    return found


class PresenceTracker:
    """Set of the Zenoh liveliness tokens of services that are active now, updated as tokens come
    and go.
    """

    def __init__(self) -> None:
        self._guard = Lock()
        self._active = set[ServiceToken]()
        self._lost = set[ServiceToken]()
        self._ever_lost = set[ServiceToken]()

    @property
    def active(self) -> set[ServiceToken]:
        """Return the liveliness tokens of services that are active now."""
        with self._guard:
            return set(self._active)

    @property
    def lost_tokens(self) -> set[ServiceToken]:
        """Return the services' liveliness tokens that were active earlier and are no
        longer active.
        """
        with self._guard:
            return set(self._lost)

    @property
    def ever_lost(self) -> set[ServiceToken]:
        """Return all services' liveliness tokens that were ever lost; some may be active again."""
        with self._guard:
            return set(self._ever_lost)

    def refresh(self, session: zenoh.Session) -> set[ServiceToken]:
        """Query the liveliness tokens that are active now. Return the union of the queried tokens
        and the tracked tokens.

        Both sources are needed. A router's answer may lack a token that the router is just sending
        to the subscription of the same session. The subscription then delivers that token before
        the answer ends.
        """
        return active_tokens(session) | self.active

    def record(self, token: ServiceToken, *, is_active: bool) -> None:
        """Record that a service's liveliness token has appeared (`is_active` is True) or has
        disappeared (False).
        """
        with self._guard:
            if is_active:
                self._active.add(token)
                self._lost.discard(token)
            else:
                self._active.discard(token)
                self._lost.add(token)
                self._ever_lost.add(token)


@contextmanager
def track_tokens(session: zenoh.Session) -> Iterator[PresenceTracker]:
    """Yield a tracker of the services' liveliness tokens. It contains the tokens that are active
    now, and follows changes until the `with` block ends.
    """
    tokens = PresenceTracker()

    def on_sample(sample: zenoh.Sample) -> None:
        with suppress(InputError):
            tokens.record(
                parse_served(str(sample.key_expr)), is_active=sample.kind == zenoh.SampleKind.PUT
            )

    # `indirect=False`: the callback runs on Zenoh's receiving thread. A lost token is thus recorded
    # before the answer of any later query arrives.
    subscriber = session.liveliness().declare_subscriber(
        _ALL, zenoh.handlers.Callback(on_sample, indirect=False)
    )
    # A query is used instead of the subscription's history, because a query reports when its list
    # is complete.
    for token in active_tokens(session):
        if token not in tokens.lost_tokens:
            tokens.record(token, is_active=True)
    try:
        yield tokens
    finally:
        subscriber.undeclare()
