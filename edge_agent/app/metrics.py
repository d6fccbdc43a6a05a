"""Metrics and health problems of an agent."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from edge_agent.app.live_loop import Progress
from edge_agent.publish.ack_settlement import CLOCK_OFF_S, describe_clock
from edge_agent.publish.publisher import Publisher
from schemas.runtime.link_watch import link_metrics
from schemas.runtime.metrics import Metric, counter, gauge
from schemas.wire import Kind

BEHIND_S: Final = 1.0  # [s] delay from which the agent is too slow for its vehicles
UNANSWERED_S: Final = 60.0  # [s] time without any answer; a service needs less to restart
FULL: Final = 0.9  # used share of the outbox from which the outbox counts as full
_NAMES: Final = {Kind.OBSERVATION: "observation", Kind.STATE: "state"}


def agent_metrics(publisher: Publisher, progress: Progress) -> list[Metric]:
    """Return all metrics of an agent with their current values. Metrics of records have one value
    per kind of record.
    """
    return [
        *_record_metrics(publisher),
        *_outbox_metrics(publisher),
        gauge("sessions", "open sessions", publisher.status.links),
        *link_metrics(publisher.status.link_watches),
        gauge("blocks_behind", "blocks that were processed too late", progress.late_blocks),
        gauge("lag_seconds", "lag behind real time at the last block", progress.lag_s),
        gauge("longest_lag_seconds", "largest lag behind real time", progress.longest_lag_s),
    ]


def _record_metrics(publisher: Publisher) -> list[Metric]:
    """Return the metrics of sent records and of the service's answers to them."""
    counts = publisher.counts
    status = publisher.status
    return [
        _kind_counter(
            "published_records", "records written to the outbox and sent", counts.published
        ),
        _kind_counter(
            "acknowledged_records", "records acknowledged by a service", counts.acknowledged
        ),
        _kind_counter("rejected_records", "records rejected by a service", counts.rejected),
        counter(
            "dropped_records",
            "records dropped because the outbox was full",
            status.dropped_records,
        ),
        _kind_counter(
            "late_batches", "batches that came later than the service's lateness", counts.late
        ),
        counter(
            "unanswered_records",
            "records given up because only later batches were acknowledged",
            status.unanswered_records,
        ),
        counter("resent_batches", "batches sent again", counts.resent_batches),
        counter("bad_acks", "acknowledgements that could not be read", counts.bad_acks),
        counter("sender_failures", "failed iterations of the sending thread", counts.failures),
        gauge(
            "unanswered_seconds",
            "time for which sent batches have not been answered",
            status.unanswered_s,
        ),
        gauge(
            "clock_behind_seconds",
            "lag of the vehicle's clock behind the service's",
            status.clock_behind_s,
        ),
    ]


def _outbox_metrics(publisher: Publisher) -> list[Metric]:
    """Return the metrics of the outbox, the file of records that are not acknowledged yet."""
    status = publisher.status
    return [
        counter(
            "damaged_spools", "times that the outbox was found damaged", status.damage_counts[0]
        ),
        counter(
            "damaged_records",
            "records lost because the outbox was damaged",
            status.damage_counts[1],
        ),
        gauge(
            "stranded_records",
            "records in the outbox under a previous vehicle name",
            status.stranded_records,
        ),
        gauge("outbox_fill", "share of the outbox that is full", status.fill_share),
        gauge(
            "unsettled_records",
            "records neither acknowledged nor rejected yet",
            publisher.count_unsettled(),
        ),
    ]


def health_problems(publisher: Publisher, progress: Progress) -> list[str]:
    """Return one message per problem of the publisher and of the estimation loop, for the health
    check.
    """
    status = publisher.status
    found = [] if status.links else ["no session is open"]
    if status.cut_off:
        found.append("a session has no router")
    if status.unanswered_s > UNANSWERED_S:
        found.append(f"nothing was acknowledged for {status.unanswered_s:.0f} s")
    if status.fill_share > FULL:
        found.append("the outbox is full: the oldest states are dropped first")
    if error := publisher.disk_error:
        found.append(
            f"the outbox {status.outbox_path} cannot be read or written ({error}); make room on "
            "its disk"
        )
    if abs(status.clock_behind_s) > CLOCK_OFF_S:
        found.append(describe_clock(status.clock_behind_s))
    if status.stranded_records:
        found.append(
            f"{status.stranded_records} records are stored under a previous vehicle name; "
            "run once with that --name"
        )
    if publisher.is_broken:
        found.append("the sending thread has died; restart the agent")
    if progress.lag_s > BEHIND_S:
        found.append(f"{progress.lag_s:.1f} s behind real time")
    return found


def _kind_counter(name: str, text: str, counts: Mapping[Kind, int]) -> Metric:
    by_kind = {_NAMES[kind]: number for kind, number in counts.items()}
    return Metric(name, "counter", text, by_kind, "kind")
