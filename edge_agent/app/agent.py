"""The agent: connects three components in the live loop. They are the estimator bank (estimators of
all vehicles, advanced together), the pipeline that makes records from estimates, and the publisher
that sends the records.

It is the counterpart of `fleet_service.app.service`. Signals come from an `AgentSource`. Additional
components that use the vehicles' Zenoh sessions, such as warnings of the road ahead, are
`AgentPart`s.
"""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
import zenoh

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app.estimator_factory import bank_of
from edge_agent.app.live_loop import (
    ENDED_DRAIN_S,
    STATUS_EVERY_S,
    STOPPED_DRAIN_S,
    LoopOptions,
    Progress,
    run_live_loop,
)
from edge_agent.app.metrics import agent_metrics, health_problems
from edge_agent.app.publishing import close_publisher, open_publisher, print_status
from edge_agent.app.publishing_reasons import ReasonReporter, SignalWatch, reasons_not_publishing
from edge_agent.inputs.block import Block
from edge_agent.observe.pipeline import Pipeline
from edge_agent.publish.publisher import Publisher
from schemas.config import AgentConfig
from schemas.runtime import progress_messages
from schemas.runtime.logs import event_logger, json_values, log_warnings, print_line
from schemas.runtime.metrics import Metric, serve_metrics
from schemas.signals import CHANNELS
from schemas.vehicle import Vehicle

if TYPE_CHECKING:
    from types import FrameType


@dataclass(frozen=True)
class AgentOptions:
    """Settings of an agent.

    Attributes:
        vehicles: parsed vehicle files (nominal parameters), one per vehicle.
        names: names under which the vehicles publish, in the same order.
        config: configuration of the agent.
        estimator: name of the estimator; None for the one named in the configuration.
        memberships: fuzzy sets that replace the estimator's own; None to keep those.
        duration_s: time after which the agent stops [s].
    """

    vehicles: Sequence[Vehicle]
    names: Sequence[str]
    config: AgentConfig
    estimator: str | None = None
    memberships: Memberships | None = None
    duration_s: float = float("inf")


class AgentSource(NamedTuple):
    """Source of the vehicles' signals.

    Attributes:
        blocks: blocks (consecutive samples of all vehicles), in real time or faster.
        is_admitted: function that returns True if the records of the current block may be
            published.
        health_problems: function that returns one message per problem of the source, for the health
            check.
        end: function that the agent calls when its loop over the blocks has ended.
        clock: returns the steady time [s] by which the blocks come in real time.
    """

    blocks: Iterator[Block]
    is_admitted: Callable[[], bool] = lambda: True
    health_problems: Callable[[], list[str]] = list
    end: Callable[[], None] = lambda: None
    clock: Callable[[], float] = time.monotonic


class AgentPart(Protocol):
    """Interface of an additional component of the agent that uses the vehicles' Zenoh sessions."""

    def attach_session(self, name: str, session: zenoh.Session) -> None:
        """Give this component of the agent the opened Zenoh session of the vehicle `name`."""

    def start_part(self) -> None:
        """Start this component (for example its thread). The agent calls this before it processes
        the first samples.
        """

    def update_part(self, pipeline: Pipeline, *, admitted: bool) -> None:
        """Update this component after the pipeline (estimation and making of records) has processed
        a block of samples. `admitted` is True if the records of the block are published.
        """

    def close_part(self) -> Mapping[str, float]:
        """Stop this component of the agent; return its counters by name, which the agent prints in
        its last line of output.
        """


class Agent:
    """Agent for several vehicles: estimates friction from their signals, and publishes records. It
    can run only once.
    """

    def __init__(
        self, options: AgentOptions, source: AgentSource, parts: Sequence[AgentPart] = ()
    ) -> None:
        self.options = options
        self.source = source
        self.parts = parts
        self.estimator = options.estimator or options.config.estimator
        self._progress = Progress()
        self._publisher: Publisher | None = None

    def drive(self) -> int:
        """Process blocks of samples in real time until the source ends, the duration has passed or
        a signal (SIGTERM, Ctrl-C) arrives; then shut down.

        Print one line with the counts of blocks and records.

        Returns:
            0, or 1 if the source or the duration has ended and records were lost or are left in
            the outbox without acknowledgement. After a signal such records are no failure.
        """
        config = self.options.config
        log_warnings(config.log, sys.stderr)
        self._warm_up()
        with (
            stop_on_signal() as stop,
            serve_metrics(
                config.metrics_host, config.metrics_port, self._list_metrics, self._list_problems
            ) as address,
        ):
            if address:
                print_line(f"metrics: {address}/metrics", sys.stderr)
            options = self.options
            publisher = open_publisher(options.names, config, self.estimator, self._attach_session)
            self._publisher = publisher
            counts: dict[str, float] = {}
            try:
                self._drive_until(stop, publisher)
                for part in self.parts:
                    counts |= part.close_part()
                self.source.end()
            finally:  # an error must not lose the records that are not in the outbox yet
                drain_s = STOPPED_DRAIN_S if stop.is_set() else ENDED_DRAIN_S
                close_publisher(publisher, self._progress, drain_s, **counts)
        left = publisher.count_unsettled() or publisher.status.lost_records
        return 1 if left and not stop.is_set() else 0

    def _drive_until(self, stop: threading.Event, publisher: Publisher) -> None:
        options = self.options
        source = self.source
        pipeline = Pipeline(
            bank_of(self.estimator, options.vehicles, options.memberships),
            len(options.vehicles),
            options.config,
        )
        events = event_logger("agent", options.config.log, sys.stderr)
        label = options.names[0] if len(options.names) == 1 else f"{len(options.names)} vehicles"
        events.info(
            f"{label}: driving; a line of counts every {STATUS_EVERY_S:.0f} s; records wait in "
            f"{publisher.status.outbox_path} until they are acknowledged",
            extra=json_values(
                event="ready", vehicles=len(options.names), outbox=str(publisher.status.outbox_path)
            ),
        )
        watch = SignalWatch()
        connect = options.config.zenoh.connect
        reporter = ReasonReporter(
            lambda: reasons_not_publishing(
                watch, publisher.status, connect, source.health_problems()
            ),
            events,
        )
        for part in self.parts:
            part.start_part()

        def after_block() -> None:
            reporter.print_if_due()
            for part in self.parts:
                part.update_part(pipeline, admitted=source.is_admitted())

        run_live_loop(
            watch.watch_blocks(source.blocks),
            pipeline,
            publisher,
            stop,
            LoopOptions(
                on_status=partial(print_status, publisher=publisher, events=events),
                duration_s=options.duration_s,
                clock=source.clock,
                is_admitted=source.is_admitted,
                after_block=after_block,
            ),
            self._progress,
        )

    def _attach_session(self, name: str, session: zenoh.Session) -> None:
        for part in self.parts:
            part.attach_session(name, session)

    def _list_metrics(self) -> list[Metric]:
        return [] if self._publisher is None else agent_metrics(self._publisher, self._progress)

    def _list_problems(self) -> list[str]:
        if self._publisher is None:
            return ["the agent is starting"]
        return [
            *health_problems(self._publisher, self._progress),
            *self.source.health_problems(),
        ]

    def _warm_up(self) -> None:
        """Run one step with a temporary vehicle, so that the compiled functions are loaded or
        compiled before the loop starts.
        """
        t = np.zeros((1, 1))
        dates = np.zeros((1, 1), dtype=np.int64)
        signals = np.full((1, 1, len(CHANNELS)), np.nan)
        options = self.options
        with progress_messages.show_status("starting the estimator"):
            bank = bank_of(self.estimator, options.vehicles[:1], options.memberships)
            Pipeline(bank, 1, options.config).step(Block(t, dates, signals))


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """Provide a context in which SIGTERM or Ctrl-C sets the yielded event; a second signal ends the
    process at once.
    """
    stop = threading.Event()
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}

    # `signal.signal` requires a function with these two arguments.
    def on_signal(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        stop.set()
        signal.signal(number, signal.SIG_DFL)

    for number in before:
        signal.signal(number, on_signal)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
