"""Who serves which region, as the services' liveliness tokens tell: now, or watched."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Lock
from typing import Final

import zenoh

from schemas.errors import InputError
from schemas.keys import SERVES, Served, parse_served

ANSWER_S: Final = 2.0  # for a router to tell which tokens there are
_ALL: Final = f"{SERVES}/**"


def standing(session: zenoh.Session, root: str = SERVES) -> set[Served]:
    """The tokens that stand now, as far as this session may see them; or those below another root."""
    found = set[Served]()
    for reply in session.liveliness().get(f"{root}/**", timeout=ANSWER_S):
        if reply.ok is not None:
            with suppress(InputError):  # a stranger's
                found.add(parse_served(str(reply.ok.key_expr), root))
    return found


class Watched:
    """Tokens that stand, kept up."""

    def __init__(self) -> None:
        self._guard, self._here, self._withdrawn, self._fell = Lock(), set[Served](), set[Served](), set[Served]()

    @property
    def here(self) -> set[Served]:
        """Those that stand."""
        with self._guard:
            return set(self._here)

    @property
    def withdrawn(self) -> set[Served]:
        """Those that stood and fell."""
        with self._guard:
            return set(self._withdrawn)

    @property
    def fell(self) -> set[Served]:
        """Those that fell at any time; they may be back."""
        with self._guard:
            return set(self._fell)

    def asked(self, session: zenoh.Session) -> set[Served]:
        """Those that stand now. A router's answer may lack the token that it is just telling to the same session's
        subscription (1 of 60 answers), which is then heard before the answer ends."""
        return standing(session) | self.here

    def take(self, token: Served, *, stands: bool) -> None:
        """A token stands, or fell."""
        with self._guard:
            (self._here.add if stands else self._here.discard)(token)
            (self._withdrawn.discard if stands else self._withdrawn.add)(token)
            if not stands:
                self._fell.add(token)


@contextmanager
def watched(session: zenoh.Session) -> Iterator[Watched]:
    """The tokens, from those that stand at the beginning of the block on."""
    tokens = Watched()

    def hear(sample: zenoh.Sample) -> None:
        with suppress(InputError):
            tokens.take(parse_served(str(sample.key_expr)), stands=sample.kind == zenoh.SampleKind.PUT)

    # at once, on the thread that receives: what fell is known before the answer to any later question is
    subscriber = session.liveliness().declare_subscriber(_ALL, zenoh.handlers.Callback(hear, indirect=False))
    for token in standing(session):  # a get ends when all were told, which a subscription's history does not
        if token not in tokens.withdrawn:
            tokens.take(token, stands=True)
    try:
        yield tokens
    finally:
        subscriber.undeclare()
