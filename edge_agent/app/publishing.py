"""Functions with which commands open a publisher according to the configuration, and close it. The
closing function prints the final counts of records.
"""

from __future__ import annotations

import json
import logging
import sqlite3
import sys
import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from schemas.config import AgentConfig
from schemas.errors import InputError
from schemas.runtime.logs import json_values, print_line

if TYPE_CHECKING:
    import zenoh

    from edge_agent.app.live_loop import Progress
    from edge_agent.publish.ack_settlement import Counts
    from edge_agent.publish.batching import DriveBatches
    from edge_agent.publish.outbox import Outbox
    from edge_agent.publish.publisher import Publisher

FLEET = "fleet"  # value of {name} in the path of an outbox that serves many vehicles

# Event that is set if a session or a source hangs, for example because a router is frozen. Its
# library might then wait at the exit of the process. Therefore the command line ends the process
# itself, after the command has closed its files and returned its exit code.
hanging_thread = threading.Event()


def open_publisher(
    names: Sequence[str],
    config: AgentConfig,
    estimator: str,
    on_open: Callable[[str, zenoh.Session], None] = lambda *_: None,
    drive: DriveBatches | None = None,
) -> Publisher:
    """Return a started publisher with the configured outbox (file of unsent records). It sends the
    batches that the outbox contains, and those of a recorded `drive`. `on_open(name, session)` is
    called with each vehicle's name and its opened Zenoh session.

    Raises:
        InputError: Zenoh rejects its settings, or the outbox is in use by another process or
            unusable.
    """
    from edge_agent.app.output_path import prepare_path
    from edge_agent.publish.outbox import Outbox
    from edge_agent.publish.publisher import Publisher
    from schemas.runtime.zenoh_session import configuration

    # Check the settings here, so that a bad one or a missing certificate raises an error now and
    # not later in a thread.
    for name in names:
        configuration(config.zenoh, name)
    spool = prepare_path("spool", config.spool_of(names[0] if len(names) == 1 else FLEET))
    outbox = Outbox(
        spool, capacity_bytes=round(config.spool_mb * 1e6), first_resend_s=config.resend_s
    )
    publisher = Publisher(names, outbox, config, estimator, on_open=on_open)
    if drive is not None:
        _store_drive(drive, outbox, publisher.counts)
    publisher.start()
    return publisher


def _store_drive(drive: DriveBatches, outbox: Outbox, counts: Counts) -> None:
    """Store the batches of a recorded drive in the outbox, and count their records as published.

    Raises:
        InputError: the disk does not accept the write.
    """
    try:
        outbox.store_drive(drive)
    except sqlite3.Error as error:
        outbox.close()
        problem = f"{outbox.path} does not accept the records ({error})"
        raise InputError("spool", problem, "make room on its disk, then repeat") from error
    for draft in drive.drafts:
        counts.offered[draft.kind] += draft.records
        counts.published[draft.kind] += draft.records


def close_publisher(
    publisher: Publisher, progress: Progress, drain_s: float, **extra_values: float
) -> None:
    """Wait at most `drain_s` seconds until the service has acknowledged the sent records, and close
    the publisher. Print the counts of records and the values `extra_values` as one line of JSON
    on stdout.

    Records without an acknowledgement stay in the outbox (store on disk) and are sent after the
    next start under the same vehicle name. Their number, the number of lost records and the
    outbox's path are printed on stderr.
    """
    from edge_agent.app.live_loop import final_counts

    clean = publisher.close(drain_s)
    path = publisher.status.outbox_path
    dropped = publisher.status.dropped_records
    if dropped:
        print_line(
            f"{dropped} records are lost, because {path} was full or its disk refused them; see "
            "spool_mb",
            sys.stderr,
        )
    if lost := publisher.status.lost_records - dropped:
        print_line(
            f"{lost} records are lost, because {path} was damaged or the service answered only "
            "later ones",
            sys.stderr,
        )
    if waiting := publisher.count_unsettled():
        print_line(
            f"{waiting} records without acknowledgement stay in {path}; the next start with this "
            "outbox and vehicle name sends them",
            sys.stderr,
        )
    if stranded := publisher.status.stranded_records:
        print_line(
            f"{stranded} records of other vehicle names stay in {path}; the next start with this "
            "outbox and their name sends them",
            sys.stderr,
        )
    if not clean:
        print_line(
            "warning: a session did not close in time; exiting without closing it", sys.stderr
        )
        hanging_thread.set()
    print(json.dumps(final_counts(progress, publisher) | extra_values), flush=True)


def print_status(progress: Progress, publisher: Publisher, events: logging.Logger) -> None:
    """Print one line with the progress of the estimation loop and the publisher's counts of
    records.
    """
    from edge_agent.app.live_loop import final_counts

    counts = publisher.counts
    late = (
        f", at most {progress.longest_lag_s:.1f} s behind real time" if progress.late_blocks else ""
    )
    text = (
        f"{progress.signals_s:7.1f} s  {publisher.status.links} sessions, "
        f"{sum(counts.published.values())} records published, {sum(counts.acknowledged.values())} "
        f"acknowledged, {publisher.count_unsettled()} unsettled{late}"
    )
    events.info(text, extra=json_values(event="status", **final_counts(progress, publisher)))
