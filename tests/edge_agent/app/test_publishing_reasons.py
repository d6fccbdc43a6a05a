"""Tests of the reasons why an agent publishes nothing: each cause is printed once, within five
seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from edge_agent.app.publishing_reasons import ReasonReporter, SignalWatch, reasons_not_publishing
from edge_agent.inputs.block import Block
from edge_agent.publish.ack_settlement import Counts
from schemas.signals import CHANNELS, S
from schemas.wire import Kind
from tests.event_lines import logger_into

ENDPOINTS = ("tcp/127.0.0.1:7447",)
NAMED_S = 5.0
REFUSED = Counts(rejected={Kind.OBSERVATION: 3})


@dataclass
class State:
    """Simulated publisher status; the test sets its fields."""

    links: int = 1
    cut_off: bool = False
    unanswered_s: float = 0.0
    counts: Counts = field(default_factory=Counts)


class Clock:
    """Simulated clock whose time the test sets."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def block(position: bool = True, wheels: float = 20.0) -> Block:
    signals = np.full((10, 1, len(CHANNELS)), np.nan)
    signals[..., S.OMEGA : S.OMEGA + 4] = wheels
    if position:
        signals[..., S.LATITUDE] = 57.7
        signals[..., S.LONGITUDE] = 11.97
    return Block(np.zeros((10, 1)), np.zeros((10, 1), np.int64), signals)


CAUSES: dict[str, tuple[Block, State, list[str], str]] = {
    "silent source": (block(), State(), ["can0 has sent nothing for 3 s"], "has sent nothing"),
    "doctor has not passed": (
        block(),
        State(),
        ["the signal doctor: has not passed the signals yet"],
        "doctor",
    ),
    "no position": (block(position=False), State(), [], "no position"),
    "no wheel speed": (block(wheels=float("nan")), State(), [], "no wheel speed"),
    "standing": (block(wheels=0.0), State(), [], "stands"),
    "no router": (block(), State(links=0), [], "no router answers at tcp/127.0.0.1:7447"),
    "router away": (block(), State(cut_off=True), [], "does not answer"),
    "no service": (block(), State(unanswered_s=4.5), [], "no service acknowledges"),
    "refused": (block(), State(counts=REFUSED), [], "refuses"),
}


def told_within(
    source: Block, find: Callable[[SignalWatch], list[str]], seconds: float
) -> list[str]:
    """Let the agent run for `seconds` of simulated time. Return the lines in which it prints why it
    publishes nothing.

    Args:
        source: block of signals that arrives every 0.1 s.
        find: function that returns the present reasons.
    """
    clock = Clock()
    lines = list[str]()
    watch = SignalWatch(clock)
    reporter = ReasonReporter(lambda: find(watch), logger_into(lines), clock)
    for _ in range(round(seconds / 0.1)):
        watch.add(source)
        reporter.print_if_due()
        clock.now += 0.1
    return lines


@pytest.mark.parametrize("cause", CAUSES)
def test_a_planted_cause_is_named_within_five_seconds(cause: str) -> None:
    source, state, troubles, words = CAUSES[cause]
    lines = told_within(
        source, lambda watch: reasons_not_publishing(watch, state, ENDPOINTS, troubles), NAMED_S
    )
    assert len(lines) == 1
    assert lines[0].startswith("not published: ")
    assert words in lines[0]


def test_nothing_is_printed_while_records_are_published() -> None:
    assert (
        told_within(
            block(), lambda watch: reasons_not_publishing(watch, State(), ENDPOINTS, []), 30.0
        )
        == []
    )


def test_a_reason_is_printed_again_only_when_it_changes() -> None:
    seconds = iter(range(10**6))
    lines = told_within(block(), lambda _: [f"can0 has sent nothing for {next(seconds)} s"], 60.0)
    assert len(lines) == 1
    changing = iter([["a"], ["a"], ["b"], []] + [[]] * 100)
    assert told_within(block(), lambda _: next(changing), 20.0) == [
        "not published: a",
        "not published: b",
        "publishing: records are sent",
    ]
