"""Reasons why a live agent publishes nothing, as sentences for the user."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final, Protocol

import numpy as np

from edge_agent.inputs.block import Block
from edge_agent.publish.ack_settlement import Counts
from schemas.runtime.logs import json_values
from schemas.signals import S

# [s] time from the first block to the first check. Meanwhile a session opens and a receiver finds
# its position.
FIRST_S: Final = 3.0
EVERY_S: Final = 1.0
MISSING_S: Final = 2.5  # [s] a receiver of 1 Hz may miss one position without a message
UNANSWERED_S: Final = 4.0
STANDING: Final = 0.5  # [rad/s] a wheel speed below this is slower than walking pace
_NUMBER: Final = re.compile(r"\d+(\.\d+)?")


class PublisherState(Protocol):
    """Interface of a publisher: the values that show whether its records arrive at the service."""

    @property
    def links(self) -> int:
        """Return the number of open Zenoh sessions."""
        ...

    @property
    def cut_off(self) -> bool:
        """Return True if an open Zenoh session has lost its connection to a router."""
        ...

    @property
    def unanswered_s(self) -> float:
        """Return the time [s] for which the service has not acknowledged sent batches."""
        ...

    @property
    def counts(self) -> Counts:
        """Return the numbers of records by kind and by result (acknowledged, rejected, …)."""
        ...


class SignalWatch:
    """Observer of a source of signals: it records when the source last delivered a position, a
    wheel speed, and a wheel speed above standstill.

    Args:
        clock: returns the time of a monotonic clock [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.began = clock()
        self._seen: dict[str, float] = {}

    def watch_blocks(self, source: Iterator[Block]) -> Iterator[Block]:
        """Yield the blocks of samples of a source unchanged, and record which signals they
        contain.
        """
        for block in source:
            self.add(block)
            yield block

    def add(self, block: Block) -> None:
        """Record which signals a block of samples contains."""
        signals = block.signals
        now = self._clock()
        if not self._seen:
            self.began = now
            self._seen = dict.fromkeys(("position", "wheels", "turning"), now)
        wheels = signals[..., S.OMEGA : S.OMEGA + 4]
        present = {
            "position": np.isfinite(signals[..., [S.LATITUDE, S.LONGITUDE]]).all(axis=-1).any(),
            "wheels": np.isfinite(wheels).any(),
            "turning": (np.abs(np.nan_to_num(wheels)) > STANDING).any(),
        }
        self._seen.update({name: now for name, here in present.items() if here})

    def is_missing(self, name: str) -> bool:
        """Return True if the source has not delivered the signal `name` for longer than MISSING_S
        seconds. The name is "position", "wheels" (any wheel speed) or "turning" (a wheel speed
        above standstill).
        """
        return bool(self._seen) and self._clock() - self._seen[name] > MISSING_S


def reasons_not_publishing(
    watch: SignalWatch, publisher: PublisherState, endpoints: Sequence[str], problems: Sequence[str]
) -> list[str]:
    """Return the reasons why nothing is published, as sentences for the user. The list is empty if
    records can be published.

    Args:
        watch: observer of the blocks of samples that the source has delivered.
        publisher: status of the publisher.
        endpoints: routers that the publisher tries to reach.
        problems: problems reported by the signal sources and by the signal doctor (automatic
            check).
    """
    found = list(problems)
    if watch.is_missing("wheels"):
        found.append(
            "the signals contain no wheel speed: compare the profile with the car's signals"
        )
    elif watch.is_missing("turning"):
        found.append("the vehicle stands: only a moving vehicle visits cells")
    if watch.is_missing("position"):
        found.append(
            "no position: connect a receiver (gpsd:HOST:PORT) or a source with latitude and "
            "longitude"
        )
    where = ", ".join(endpoints)
    if not publisher.links:
        found.append(
            f"no router answers at {where}: start one with `gripmap router`, or correct "
            "zenoh.connect"
        )
    elif publisher.cut_off:
        found.append(
            f"the router at {where} does not answer: records wait on disk and are sent when it "
            f"returns"
        )
    elif publisher.unanswered_s > UNANSWERED_S:
        found.append(
            "no service acknowledges the records: start `fleet-service run` on the same router"
        )
    if any(publisher.counts.rejected.values()) and not any(publisher.counts.acknowledged.values()):
        found.append("a service refuses all records: its log and its metrics give the reason")
    return found


class ReasonReporter:
    """Printer of the reasons why an agent publishes nothing. It determines them first after FIRST_S
    seconds and then every EVERY_S seconds, and prints them only if they have changed.

    Args:
        find: returns the present reasons.
        events: logger of the agent's events.
        clock: returns the time of a monotonic clock [s].
    """

    def __init__(
        self,
        find: Callable[[], list[str]],
        events: logging.Logger,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._find = find
        self._events = events
        self._clock = clock
        self._due: float | None = None
        self._last_printed: list[str] = []

    def print_if_due(self) -> None:
        """Print the reasons why nothing is published, if it is time for a check and the reasons
        differ from those printed last.
        """
        now = self._clock()
        if self._due is None:
            self._due = now + FIRST_S
        if now < self._due:
            return
        self._due = now + EVERY_S
        found = self._find()
        without_numbers = [_NUMBER.sub("", reason) for reason in found]
        if without_numbers == self._last_printed:
            return
        self._last_printed = without_numbers
        text = f"not published: {'; '.join(found)}" if found else "publishing: records are sent"
        event = "unpublished" if found else "publishing"
        self._events.info(text, extra=json_values(event=event, reasons=found))
