"""Names, units and bars of the figures that the fault campaigns owe."""

from __future__ import annotations

from typing import Final, Literal, NamedTuple

from schemas.runtime.figures import Figure


class Bar(NamedTuple):
    """What a figure is held against."""

    unit: str
    bar: float
    better: Literal["less", "more"] = "less"


BARS: Final = {
    "faults.kill.acknowledged_lost": Bar("batches", 0),
    "faults.kill.doubled": Bar("rows", 0),
    "faults.kill.unacknowledged_lost_at_end": Bar("batches", 0),
    "faults.kill.map_difference": Bar("of mu, its bounds, P(slippery)", 1e-6),
    "faults.kill.upkeep": Bar("jobs that the kills met", 2, "more"),
    "faults.kill.kills": Bar("processes killed", 200, "more"),
    "faults.kill.offered_per_s": Bar("observations/s amid the kills", 5000, "more"),
    "faults.compaction.incomplete_reads": Bar("reads", 0),
    "faults.compaction.kills": Bar("kills", 5, "more"),
    "faults.compaction.reads": Bar("reads", 10, "more"),
    "faults.compaction.batches": Bar("batches", 500, "more"),
    "faults.crash_model.violations": Bar("histories", 0),
    "faults.truncation.lost_rows": Bar("rows", 0),
    "faults.router_down.lost": Bar("batches", 0),
    "faults.router_down.recovery_s": Bar("s", 10),
    "faults.frozen.lost": Bar("batches", 0),
    "faults.frozen.agent_deadline_misses": Bar("blocks", 0),
    "faults.leaving.longest_s": Bar("s", 3),
    "faults.leaving.acknowledged_lost": Bar("batches", 0),
    "faults.disk_full.false_acks": Bar("batches", 0),
    "faults.disk_full.recovered": Bar("times", 1, "more"),
    "faults.fuzz.crashes": Bar("crashes", 0),
    "faults.fuzz.admitted_out_of_range": Bar("rows", 0),
    "faults.fuzz.honest_lost": Bar("batches", 0),
    "faults.security.breaches": Bar("breaches", 0),
    "faults.flood.honest_delay_s": Bar("s", 2),
    "faults.flood.map_difference": Bar("-", 0.01),
    "faults.alerts.missing_after_reconnect": Bar("alerts", 0),
    "faults.alerts.standing": Bar("alerts", 10, "more"),
    "faults.away.map_missing": Bar("cells", 0),
    "faults.away.late": Bar("observations that came late", 100, "more"),
    "faults.away.bytes_ratio": Bar("bytes put by bytes of data", 1.5),
    "faults.away.lost": Bar("batches", 0),
    "faults.away.drain_share": Bar("of what the service takes", 0.8, "more"),
    "faults.away.backlog": Bar("batches a car", 1000, "more"),
    "faults.bitrot.unnoticed": Bar("damages", 0),
    "faults.bitrot.crash_loops": Bar("damages", 0),
    "faults.bitrot.tried": Bar("damages", 20, "more"),
    "faults.clocks.rejected": Bar("batches", 0),
    "faults.clocks.doubled": Bar("rows", 0),
    "faults.clocks.retired": Bar("rows", 0),
    "faults.clocks.alerts_lost": Bar("times", 0),
    "faults.clocks.sent": Bar("batches", 2000, "more"),
    "faults.insider.alerts_alone": Bar("alerts", 0),
    "faults.insider.mb_per_hour": Bar("MB an hour", 20),
    "faults.insider.honest_delay_s": Bar("s", 2),
    "faults.insider.messages": Bar("messages/s of the insider", 5, "more"),
    "faults.insider.honest_lost": Bar("-", 0),
    "faults.query.light_p99_ms": Bar("ms", 100),
    "faults.query.heavy_answers": Bar("whole maps of the slower of two", 2, "more"),
    "faults.query.light_answers": Bar("answers", 20, "more"),
    "faults.age.ready_s": Bar("s", 10),
    "faults.age.ready_mb": Bar("MB", 600),
    "faults.age.at_mb": Bar("MB", 300),
    "faults.age.cold_s": Bar("s", 180),
    "faults.age.cold_mb": Bar("MB", 1500),
    "faults.age.cells": Bar("cells", 50_000, "more"),
    "faults.age.at_bytes": Bar("bytes of the answer", 10_000, "more"),
    "faults.disk.false_acks": Bar("batches", 0),
    "faults.disk.stuck": Bar("times", 0),
    "faults.disk.times_full": Bar("times", 3, "more"),
    "faults.disk.jobs_run": Bar("rounds of each job", 1, "more"),
    "faults.versions.set_aside": Bar("files", 0),
    "faults.versions.lost_rows": Bar("rows", 0),
    "faults.versions.map_difference": Bar("of a belief", 1e-6),
    "faults.versions.files": Bar("files of a newer version", 3, "more"),
    "soak.memory_slope_mb_per_10min": Bar("MB per 10 min", 1),
    "soak.handles_growth": Bar("handles", 0),
}


def figure(name: str, value: float) -> Figure:
    """A figure of the table above; KeyError if it is not in it."""
    unit, bar, better = BARS[name]
    return Figure(name, value, unit, bar, better)
