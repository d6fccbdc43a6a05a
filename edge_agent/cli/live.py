"""Optional components of the agent for the commands `run` and `fleet`: warnings of slippery road
ahead, and friction as VSS signals (vehicle signal specification). The module also compiles the
functions of the simulation before a run.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import zenoh

from edge_agent.ahead.path import Pose
from edge_agent.observe.pipeline import Pipeline
from edge_agent.publish.vss import RoadFrictionOutput
from schemas.config import AgentConfig
from schemas.runtime import progress_messages
from schemas.runtime.logs import event_logger, json_values

if TYPE_CHECKING:
    from edge_agent.ahead.lookout import Lookout
    from schemas.wire.ahead import GripWarning


def warm_up_simulation(scenario: str, rate_hz: float, rough: float = 0.0) -> None:
    """Simulate one step of a scenario, so that the functions of the simulation are compiled or
    loaded before the run begins.
    """
    from edge_agent.lab.simulation import SimulatedFleet

    with progress_messages.show_status("starting the simulation"):
        SimulatedFleet(scenario, 1, 0, rate_hz, rough=rough).step(1)


class LookoutPart:
    """Component of the agent for the road ahead: it receives the map over the vehicles' sessions
    and gives warnings.
    """

    def __init__(self, lookout: Lookout) -> None:
        self._lookout = lookout

    def attach_session(self, name: str, session: zenoh.Session) -> None:
        """Subscribe to the map on a vehicle's session."""
        self._lookout.attach(name, session)

    def start_part(self) -> None:
        """Start the lookout, the thread that looks ahead in the map."""
        self._lookout.start()

    # The argument `admitted` is unused, because warnings are given even if nothing is published.
    def update_part(self, pipeline: Pipeline, *, admitted: bool) -> None:  # noqa: ARG002
        """Pass the vehicles' positions, and the beliefs of their filters (probabilities of
        friction), to the lookout (thread that looks ahead in the map).
        """
        if pipeline.seen is None:
            return
        columns = (column.tolist() for column in pipeline.seen)
        self._lookout.set_poses([Pose(*row) for row in zip(*columns, strict=True)])
        self._lookout.combine_beliefs(pipeline.places, pipeline.beliefs())

    def close_part(self) -> Mapping[str, float]:
        """Stop the lookout; return the counts of warnings and messages."""
        self._lookout.close()
        return self._lookout.counts.values()


class VssPart:
    """Component of the agent that publishes the friction at the vehicles as signals in the format
    of the Vehicle Signal Specification (VSS). It does so only while records of the vehicles may be
    published.
    """

    def __init__(self, output: RoadFrictionOutput) -> None:
        self._output = output

    def attach_session(self, name: str, session: zenoh.Session) -> None:
        """Publish the friction signals on a vehicle's session."""
        self._output.attach(name, session)

    def start_part(self) -> None:
        """Do nothing, because the output needs no start: the first VSS signals are published with
        the first report of friction.
        """

    def update_part(self, pipeline: Pipeline, *, admitted: bool) -> None:
        """Publish the friction at the vehicles after a block of samples, if `admitted` is True (the
        records of the block may be published).
        """
        if admitted:
            self._output.report_grip(pipeline.grip)

    def close_part(self) -> Mapping[str, float]:
        """Close the output of friction signals. Return an empty dictionary, because this component
        has no counters.
        """
        self._output.close()
        return {}


def make_warning_printer(config: AgentConfig) -> Callable[[str, GripWarning], None]:
    """Return a function that prints a warning of slippery road ahead as one line on stdout. Its
    arguments are the vehicle's name and the warning. The log format selects text or JSON.

    A warning contains the time [s] until the car reaches the slippery stretch of road. In JSON, an
    infinite time is written as null.
    """
    events = event_logger("ahead", config.log, sys.stdout)

    def print_warning(vehicle: str, warning: GripWarning) -> None:
        parts = {
            name: None if value == math.inf else value
            for name, value in vars(warning).items()
            if name != "time"
        }
        events.info(
            f"{vehicle}: {warning.line()}",
            extra=json_values(event="warning", vehicle=vehicle, at=warning.time, **parts),
        )

    return print_warning
