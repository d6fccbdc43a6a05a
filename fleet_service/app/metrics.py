"""Metrics and health problems of a service."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

from fleet_service.app.engine import Engine
from fleet_service.archive.format import segments
from fleet_service.counts import ServiceCounts
from schemas.config import ServiceConfig
from schemas.runtime.metrics import Metric, counter, gauge
from schemas.wire import Kind

# [s] A worker whose loop has not passed for this time counts as stalled. A pass takes milliseconds.
STALLED_S: Final = 5.0
# [s] Difference between service time and system clock from which a time server seems to be missing.
CLOCK_S: Final = 60.0
FULL: Final = 0.9  # share of the queue's capacity from which it counts as full


class Pulse(NamedTuple):
    """Values for metrics and health checks that only the running service knows.

    Attributes:
        turn_age_s: time since the worker (the thread that processes messages) last began a pass of
            its loop [s].
        queued: number of messages that wait.
        routers: number of connected routers.
        clock_lag_s: how far the wall clock is behind the service's time [s].
        answer_s: time since the service began to compute the current tile of an expensive answer
            [s].
    """

    turn_age_s: float
    queued: int
    routers: int
    clock_lag_s: float
    answer_s: float = 0.0


def collect_metrics(
    engine: Engine, pulse: Pulse, config: ServiceConfig, root: Path
) -> list[Metric]:
    """Return all metrics of a service with their current values."""
    return [
        *_counter_metrics(engine.counts),
        Metric(
            "segments",
            "gauge",
            "segments waiting for compaction",
            _per_kind(root, segments.list_segments),
            "kind",
        ),
        *_load_metrics(engine, pulse, config),
        *_storage_metrics(engine),
        _serves_metric(config, 1.0),
        *_map_metrics(engine),
    ]


def _counter_metrics(counts: ServiceCounts) -> list[Metric]:
    """Return the counts since the start of the service as metrics."""
    single = [counter(name, text, getattr(counts, name)) for name, text in counts.texts().items()]
    failures = {**counts.failures, **({"key": counts.key_failures} if counts.key_failures else {})}
    kinds = {"observation": counts.observations, "state": counts.states}
    return [
        *single,
        Metric(
            "refused_messages",
            "counter",
            "batches that were refused, by reason",
            dict(counts.refused),
            "reason",
        ),
        Metric(
            "bad_queries",
            "counter",
            "queries that were refused, by parameter",
            dict(counts.bad_queries),
            "field",
        ),
        Metric("rows", "counter", "rows admitted", kinds, "kind"),
        Metric(
            "failures",
            "counter",
            "failed operations, which the service tries again",
            failures,
            "work",
        ),
        Metric("runs", "counter", "runs of background jobs", dict(counts.runs), "work"),
    ]


def _load_metrics(engine: Engine, pulse: Pulse, config: ServiceConfig) -> list[Metric]:
    """Return metrics of the received messages and of the worker (the thread that processes
    them).
    """
    return [
        gauge("queue_messages", "waiting messages", pulse.queued),
        gauge("queue_capacity", "capacity of the queue", config.queue_batches),
        gauge("routers", "routers to which the session is connected", pulse.routers),
        gauge("worker_turn_age_seconds", "time since the worker's last turn", pulse.turn_age_s),
        gauge("clock_lag_seconds", "lag of the system clock", pulse.clock_lag_s),
        gauge(
            "report_lag_seconds",
            "time between the end of the newest visit and its arrival",
            engine.intake.report_lag_s,
        ),
    ]


def _storage_metrics(engine: Engine) -> list[Metric]:
    """Return metrics of the disk, the archive's copy and the lease (ownership of the archive)."""
    away_s = 0.0 if engine.copy is None else engine.copy.backoff.away_s
    return [
        gauge(
            "unsettled_batches",
            "admitted batches that are not on disk yet",
            engine.settlement.unsettled,
        ),
        gauge(
            "copy_away_seconds",
            "time for which the archive's copy has not accepted segments",
            away_s,
        ),
        gauge(
            "lease_left_seconds",
            "time for which the service may acknowledge without renewing its lease",
            engine.holding.left_s,
        ),
    ]


def _map_metrics(engine: Engine) -> list[Metric]:
    """Return metrics of the map, the alerts and the archive's damaged files."""
    return [
        gauge("cells", "cells and sectors with a belief", engine.state.fusion.size),
        gauge(
            "window_observations",
            "observations younger than the checkpoint",
            engine.state.fusion.waiting,
        ),
        gauge("alerts", "cells under an alert", engine.alerts.count),
        gauge(
            "damaged_files",
            "damaged files set aside, at the last count",
            engine.counts.files_set_aside,
        ),
    ]


def standby_metrics(config: ServiceConfig) -> list[Metric]:
    """Return all metrics of a standby (a service that waits for the ownership of the archive)."""
    return [_serves_metric(config, 0.0)]


def _serves_metric(config: ServiceConfig, value: float) -> Metric:
    text = "1 if this service serves its regions, 0 if it is their standby"
    return Metric("serves", "gauge", text, {" ".join(sorted(config.regions)): value}, "regions")


def health_problems(engine: Engine, pulse: Pulse, config: ServiceConfig) -> list[str]:
    """Return one message per health problem; empty if the service is healthy."""
    found = [] if pulse.routers else ["no router is connected"]
    if pulse.turn_age_s > STALLED_S:
        found.append(f"the worker has been idle for {pulse.turn_age_s:.0f} s")
    if pulse.answer_s > STALLED_S:
        found.append(f"a tile of an answer has been in progress for {pulse.answer_s:.0f} s")
    if engine.settlement.hangs_s > STALLED_S:
        found.append(f"a segment write has been in progress for {engine.settlement.hangs_s:.0f} s")
    if abs(pulse.clock_lag_s) > CLOCK_S:
        found.append(
            f"the system clock differs by {abs(pulse.clock_lag_s):.0f} s from the service's time"
        )
    if engine.copy is not None and engine.copy.backoff.trouble is not None:
        found.append(engine.copy.backoff.trouble)
    elif engine.settlement.failing:
        found.append(f"segments cannot be written ({engine.settlement.failing})")
    if not engine.holding.may_acknowledge:
        found.append("the lease is not renewed, so nothing is acknowledged")
    if pulse.queued > FULL * config.queue_batches:
        found.append("the queue is full")
    return found


def _per_kind(root: Path, listing: Callable[[Path, Kind], list[Path]]) -> dict[str, float]:
    names = {Kind.OBSERVATION: "observation", Kind.STATE: "state"}
    return {name: float(len(listing(root, kind))) for kind, name in names.items()}
