"""Shared part of `run` and `fleet`: bank, pipeline and publisher around the live loop."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
import zenoh

from edge_agent.adaptation.memberships import Memberships
from edge_agent.ahead.lookout import Lookout
from edge_agent.ahead.path import Pose
from edge_agent.app.estimator_factory import bank_of
from edge_agent.app.live_loop import (
    ENDED_DRAIN_S,
    STATUS_EVERY_S,
    STOPPED_DRAIN_S,
    Progress,
    run_live_loop,
)
from edge_agent.app.metrics import agent_metrics, health_problems
from edge_agent.app.publishing_reasons import ReasonReporter, SignalWatch, reasons_not_publishing
from edge_agent.cli.common import close_publisher, print_status, publisher_of, stop_on_signal
from edge_agent.inputs.block import Block
from edge_agent.observe.pipeline import Pipeline
from edge_agent.publish.publisher import Publisher
from edge_agent.publish.vss import RoadFrictionOutput
from schemas.config import AgentConfig
from schemas.runtime import progress_messages
from schemas.runtime.metrics import serve_metrics
from schemas.runtime.process import LogLine, line_logger, log_as, print_line
from schemas.signals import CHANNELS
from schemas.vehicle import Vehicle
from schemas.wire.ahead import GripWarning


def _warm_up(
    estimator: str, vehicle: Vehicle, config: AgentConfig, memberships: Memberships | None
) -> None:
    """Load or compile the kernels before the clock runs, on a temporary vehicle."""
    t = np.zeros((1, 1))
    time = np.zeros((1, 1), dtype=np.int64)
    signals = np.full((1, 1, len(CHANNELS)), np.nan)
    with progress_messages.show_status("starting the estimator"):
        Pipeline(bank_of(estimator, [vehicle], memberships), 1, config).step(
            Block(t, time, signals)
        )


def warm_up_simulation(scenario: str, rate_hz: float, rough: float = 0.0) -> None:
    """Load or compile the kernels of the simulation before its first step."""
    from edge_agent.lab.simulation import SimulatedFleet

    with progress_messages.show_status("starting the simulation"):
        SimulatedFleet(scenario, 1, 0, rate_hz, rough=rough).step(1)


def drive_live(
    vehicles: Sequence[Vehicle],
    names: Sequence[str],
    blocks: Iterator[Block],
    config: AgentConfig,
    estimator: str | None,
    duration_s: float,
    at_end: Callable[[], None] = lambda: None,
    *,
    admitted: Callable[[], bool] = lambda: True,
    troubled: Callable[[], list[str]] = list,
    lookout: Lookout | None = None,
    vss: RoadFrictionOutput | None = None,
    memberships: Memberships | None = None,
) -> int:
    """Drive in real time, call `at_end`, and shut down; print a line of counts and return 0.

    Records made while not `admitted` are not published; `troubled` returns the problems of the
    sources. A `lookout` receives the map over the vehicles' sessions. `vss` reports the friction at
    the vehicles if their signals are admitted. `memberships` replace the estimator's own.
    """
    chosen = estimator or config.estimator
    log_as(config.log, sys.stderr)
    _warm_up(chosen, vehicles[0], config, memberships)
    progress = Progress()
    running = list[Publisher]()
    with (
        stop_on_signal() as stop,
        serve_metrics(
            config.metrics_host,
            config.metrics_port,
            lambda: [
                metric for publisher in running for metric in agent_metrics(publisher, progress)
            ],
            lambda: (
                [*health_problems(running[0], progress), *troubled()]
                if running
                else ["the agent is starting"]
            ),
        ) as address,
    ):
        if address:
            print_line(f"metrics: {address}/metrics", sys.stderr)

        def attach_session(name: str, session: zenoh.Session) -> None:
            for one in (lookout, vss):
                if one is not None:
                    one.attach(name, session)

        def after_block() -> None:
            reporter.print_if_due()
            if lookout is not None:
                _update_lookout(lookout, pipeline)
            if vss is not None and admitted():
                vss.report_grip(pipeline.grip)

        pipeline = Pipeline(bank_of(chosen, vehicles, memberships), len(vehicles), config)
        publisher = publisher_of(names, config, chosen, attach_session)
        running.append(publisher)
        log_line = line_logger(config.log, sys.stderr)
        who = names[0] if len(names) == 1 else f"{len(names)} vehicles"
        log_line(
            LogLine(
                f"{who}: driving; a line of counts every {STATUS_EVERY_S:.0f} s",
                event="ready",
                vehicles=len(names),
            )
        )
        watch = SignalWatch()
        reporter = ReasonReporter(
            lambda: reasons_not_publishing(watch, publisher, config.zenoh.connect, troubled()),
            log_line,
        )
        report = partial(print_status, publisher=publisher, log_line=log_line)
        if lookout is not None:
            lookout.start()
        run_live_loop(
            watch.watch_blocks(blocks),
            pipeline,
            publisher,
            stop,
            report,
            duration_s=duration_s,
            progress=progress,
            admitted=admitted,
            after=after_block,
        )
        heard: dict[str, float] = {}
        if lookout is not None:
            lookout.close()
            heard = lookout.counts.values()
        if vss is not None:
            vss.close()
        at_end()
        close_publisher(
            publisher, progress, STOPPED_DRAIN_S if stop.is_set() else ENDED_DRAIN_S, **heard
        )
    return 0


def _update_lookout(lookout: Lookout, pipeline: Pipeline) -> None:
    """Pass the vehicles' positions and their filters' beliefs to a lookout."""
    if pipeline.seen is not None:
        lookout.see(
            [Pose(*row) for row in zip(*(column.tolist() for column in pipeline.seen), strict=True)]
        )
        lookout.believe(pipeline.places, pipeline.beliefs())


def warning_lines(config: AgentConfig) -> Callable[[str, GripWarning], None]:
    """Return a function that prints warnings on stdout: text, or JSON if the log is JSON; an
    infinite time is null there."""
    say = line_logger(config.log, sys.stdout)

    def print_warning(vehicle: str, warning: GripWarning) -> None:
        values = {
            name: None if value == math.inf else value
            for name, value in vars(warning).items()
            if name != "time"
        }
        say(
            LogLine(
                f"{vehicle}: {warning.line()}",
                event="warning",
                vehicle=vehicle,
                at=warning.time,
                **values,
            )
        )

    return print_warning
