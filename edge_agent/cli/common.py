"""Shared parts of the commands: estimators by name, closing of a publisher, signals, vehicle
names.
"""

from __future__ import annotations

import json
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from schemas.config import NAME_PATTERN, AgentConfig
from schemas.errors import InputError
from schemas.runtime.process import LogLine, print_line

if TYPE_CHECKING:
    from types import FrameType

    import zenoh

    from edge_agent.app.live_loop import Progress
    from edge_agent.inputs.doctor.diagnosis import Diagnosis
    from edge_agent.publish.publisher import Publisher


FLEET = "fleet"  # what {name} in the path of an outbox is for many vehicles


def checked_name(name: str) -> str:
    """Return a name that may be part of a key.

    Raises:
        InputError: it may not.
    """
    if not re.fullmatch(NAME_PATTERN, name):
        raise InputError(
            "name",
            f"{name!r} is not a vehicle name",
            "give --name, 3 to 63 of a-z, 0-9 and -, a letter first",
        )
    return name


def publisher_of(
    names: Sequence[str],
    config: AgentConfig,
    estimator: str,
    on_open: Callable[[str, zenoh.Session], None] = lambda *_: None,
) -> Publisher:
    """Return a started publisher on the configured outbox; `on_open` is called with each vehicle's
    session.

    Raises:
        InputError: Zenoh refuses its settings, or the outbox is in use or unusable.
    """
    from edge_agent.app.estimates_file import prepare_path
    from edge_agent.publish.outbox import Outbox
    from edge_agent.publish.publisher import Publisher
    from schemas.runtime.zenoh_session import configuration

    for (
        name
    ) in names:  # a bad setting, or a missing certificate, is to be an error here, not in a thread
        configuration(config.zenoh, name)
    spool = prepare_path("spool", config.spool_of(names[0] if len(names) == 1 else FLEET))
    outbox = Outbox(
        spool, capacity_bytes=round(config.spool_mb * 1e6), first_resend_s=config.resend_s
    )
    publisher = Publisher(names, outbox, config, estimator, on_open=on_open)
    publisher.start()
    return publisher


def require_valid_signals(diagnosis: Diagnosis) -> None:
    """Raise unless the signals of a log agree with each other.

    Raises:
        InputError: the signal doctor finds a fault, or cannot decide.
    """
    from edge_agent.inputs.doctor.report import publishing_advice, report_lines

    if not diagnosis.is_passed:
        print(
            "\n".join(line for line in report_lines(diagnosis) if not line.startswith("sound")),
            file=sys.stderr,
        )
        raise InputError(
            "log",
            "did not pass the signal doctor",
            f"{publishing_advice(diagnosis)}; --trust publishes it unchanged",
        )


def warn_about_faults(diagnosis: Diagnosis) -> list[str]:
    """Print on stderr the faults that the signal doctor finds in a log; return notes to print
    after the estimates.
    """
    found = diagnosis.findings
    for fault in found:
        print(f"warning: {fault.channel} {fault.kind}: {fault.words}", file=sys.stderr)
    if found:
        print(
            "warning: the estimates below are invalid until this is corrected; run edge-agent "
            "check",
            file=sys.stderr,
        )
    notes = []
    if found:
        notes.append(
            "note: the signal doctor did not pass this log; replay --publish would refuse it"
        )
    elif not diagnosis.is_passed:
        channels = ", ".join(diagnosis.unknown)
        notes.append(f"note: the signal doctor did not pass this log: it cannot judge {channels}")
    return notes


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """Yield an event that SIGTERM and Ctrl-C set; a second signal ends the process at once."""
    stop = threading.Event()
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}

    def on_signal(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 the signal interface hands it over
        stop.set()
        signal.signal(number, signal.SIG_DFL)

    for number in before:
        signal.signal(number, on_signal)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# Set when a session or a source hangs, on a frozen router, say: what its library does at the exit
# may wait for it. So the command line ends the process itself, once the command has closed its
# files and its exit code is known.
left_behind = threading.Event()


def close_publisher(
    publisher: Publisher, progress: Progress, drain_s: float, **more: float
) -> None:
    """Wait for acknowledgements, close, and print counts and extra values as one line of JSON on
    stdout.

    Unsettled records stay in the outbox for the next start.
    """
    from edge_agent.app.live_loop import final_counts

    clean = publisher.close(drain_s)
    if not clean:
        print_line(
            "warning: a session did not close in time; exiting without closing it", sys.stderr
        )
        left_behind.set()
    print(json.dumps(final_counts(progress, publisher) | more), flush=True)


def print_status(progress: Progress, publisher: Publisher, log_line: Callable[[str], None]) -> None:
    """Print one line of progress."""
    from edge_agent.app.live_loop import final_counts

    counts = publisher.counts
    late = f", at most {progress.lag_s:.1f} s behind real time" if progress.behind else ""
    text = (
        f"{progress.signals_s:7.1f} s  {publisher.links} sessions, "
        f"{sum(counts.published.values())} records published, "
        f"{sum(counts.acknowledged.values())} acknowledged, {publisher.count_unsettled()} unsettled{late}"
    )
    log_line(LogLine(text, event="status", **final_counts(progress, publisher)))
