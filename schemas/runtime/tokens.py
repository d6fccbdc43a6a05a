"""Who serves which region, as the services' liveliness tokens tell: now, or watched."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from threading import Lock
from typing import Final

import zenoh

from schemas.errors import InputError
from schemas.keys import SERVES, Served, parse_served

ANSWER_S: Final = 2.0  # for a router to tell which tokens there are
_ALL: Final = f"{SERVES}/**"


def standing(session: zenoh.Session) -> set[Served]:
    """The tokens that stand now, as far as this session may see them."""
    found = set[Served]()
    for reply in session.liveliness().get(_ALL, timeout=ANSWER_S):
        if reply.ok is not None:
            with suppress(InputError):  # a stranger's
                found.add(parse_served(str(reply.ok.key_expr)))
    return found


class Watched:
    """Tokens that stand, kept up; `gone` are those that fell since `begin`."""

    def __init__(self) -> None:
        self._guard, self._here, self._gone = Lock(), set[Served](), set[Served]()

    @property
    def here(self) -> set[Served]:
        """Those that stand."""
        with self._guard:
            return set(self._here)

    @property
    def gone(self) -> set[Served]:
        """Those that stood and fell."""
        with self._guard:
            return set(self._gone)

    def take(self, token: Served, *, stands: bool) -> None:
        """A token stands, or fell."""
        with self._guard:
            (self._here.add if stands else self._here.discard)(token)
            (self._gone.discard if stands else self._gone.add)(token)


@contextmanager
def watched(session: zenoh.Session, changed: Callable[[], None] = lambda: None) -> Iterator[Watched]:
    """The tokens, from those that stand at the beginning of the block on; `changed` is called after each change."""
    tokens = Watched()

    def hear(sample: zenoh.Sample) -> None:
        with suppress(InputError):
            tokens.take(parse_served(str(sample.key_expr)), stands=sample.kind == zenoh.SampleKind.PUT)
            changed()

    subscriber = session.liveliness().declare_subscriber(_ALL, hear)
    for token in standing(session):  # a get ends when all were told, which a subscription's history does not
        if token not in tokens.gone:
            tokens.take(token, stands=True)
    try:
        yield tokens
    finally:
        subscriber.undeclare()
