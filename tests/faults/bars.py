"""Names, units and bars (targets) of the figures of the fault campaigns."""

from __future__ import annotations

from typing import Final, Literal, NamedTuple

from schemas.runtime.figures import Figure


class Bar(NamedTuple):
    """Bar (target) of a figure, with the figure's unit. The bar is either an upper or a lower
    limit.
    """

    unit: str
    bar: float
    better: Literal["less", "more"] = "less"


BARS: Final = {
    "faults.kill.acknowledged_lost": Bar("batches", 0),
    "faults.kill.doubled": Bar("rows", 0),
    "faults.kill.unacknowledged_lost_at_end": Bar("batches", 0),
    "faults.kill.map_difference": Bar("of mu, its bounds, P(slippery)", 1e-6),
    "faults.kill.upkeep": Bar(
        "kinds of background jobs that were interrupted by a kill", 3, "more"
    ),
    "faults.kill.kills": Bar("processes killed", 200, "more"),
    "faults.kill.offered_per_s": Bar("observations/s during the kills", 5000, "more"),
    "faults.compaction.incomplete_reads": Bar("reads", 0),
    "faults.compaction.kills": Bar("kills", 5, "more"),
    "faults.compaction.reads": Bar("reads", 10, "more"),
    "faults.compaction.batches": Bar("batches", 500, "more"),
    "faults.crash_model.violations": Bar("histories", 0),
    "faults.crash_model.acknowledged": Bar("batches before a power loss", 100, "more"),
    "faults.crash_model.service_acknowledged": Bar("of these by a whole service", 20, "more"),
    "faults.truncation.lost_rows": Bar("rows", 0),
    "faults.truncation.damages": Bar("segments cut or changed", 100, "more"),
    "faults.router_down.lost": Bar("batches", 0),
    "faults.router_down.recovery_s": Bar("s", 10),
    "faults.router_down.batches": Bar("batches stored without a router", 10, "more"),
    "faults.frozen.lost": Bar("batches", 0),
    "faults.frozen.agent_deadline_misses": Bar("blocks", 0),
    "faults.frozen.batches": Bar("batches stored while one was frozen", 10, "more"),
    "faults.leaving.longest_s": Bar("s", 3),
    "faults.leaving.acknowledged_lost": Bar("batches", 0),
    "faults.leaving.acknowledged": Bar("batches", 5, "more"),
    "faults.disk_full.false_acks": Bar("batches", 0),
    "faults.disk_full.recovered": Bar("times", 1, "more"),
    "faults.disk_full.waiting": Bar("batches that a full service did not acknowledge", 5, "more"),
    "faults.fuzz.crashes": Bar("crashes", 0),
    "faults.fuzz.admitted_out_of_range": Bar("rows", 0),
    "faults.fuzz.honest_lost": Bar("batches", 0),
    "faults.fuzz.refused": Bar("messages", 1000, "more"),
    "faults.fuzz.answered": Bar("queries", 5, "more"),
    "faults.fuzz.pasts": Bar("pasts rebuilt", 1, "more"),
    "faults.fuzz_wire.crashes": Bar(
        "ends, tracebacks and failed answers of a real service and vehicles", 0
    ),
    "faults.fuzz_wire.honest_lost": Bar("batches", 0),
    "faults.fuzz_wire.doubled": Bar("rows", 0),
    "faults.fuzz_wire.honest": Bar("batches acknowledged amid it", 10, "more"),
    "faults.fuzz_wire.refused": Bar("messages", 500, "more"),
    "faults.fuzz_wire.answered": Bar("answers", 5, "more"),
    "faults.security.breaches": Bar("breaches", 0),
    "faults.security.attempts": Bar("attacks", 25, "more"),
    "faults.flood.honest_delay_s": Bar("s", 2),
    "faults.flood.map_difference": Bar("-", 0.01),
    "faults.flood.rate": Bar("messages/s", 1000, "more"),
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
    "faults.clocks.jumps": Bar("jumps that a service had", 12, "more"),
    "faults.insider.alerts_alone": Bar("alerts", 0),
    "faults.insider.mb_per_hour": Bar("MB an hour", 20),
    "faults.insider.honest_delay_s": Bar("s", 2),
    "faults.insider.messages": Bar("messages/s of the insider", 5, "more"),
    "faults.insider.replayed": Bar("batches that it had sent before", 50, "more"),
    "faults.insider.honest_lost": Bar("-", 0),
    "faults.webhook.lost_silently": Bar("alerts that neither arrived nor wait nor are reported", 0),
    "faults.webhook.late": Bar("kinds of receivers that recovered and did not get all", 0),
    "faults.webhook.kinds": Bar("kinds of broken receivers", 12, "more"),
    "faults.webhook.arrived": Bar("alerts", 60, "more"),
    "faults.model.violations": Bar("protocols that break an invariant", 0),
    "faults.model.unnoticed": Bar("protocols without a rule that break none", 0),
    "faults.model.states_checked": Bar("states", 1000, "more"),
    "faults.lease.acknowledged_by_two": Bar("batches, after a successor began to serve", 0),
    "faults.lease.refused": Bar("starts with another lease time", 20, "more"),
    "faults.lease.control_unlike": Bar(
        "batches acknowledged after a successor began to serve, if lease times are not compared",
        1,
        "more",
    ),
    "faults.lease.control_endless": Bar(
        "batches acknowledged after a successor began to serve, if no lease expires", 1, "more"
    ),
    "faults.history.violations": Bar("batches lost or doubled on their way to a reader", 0),
    "faults.history.failovers": Bar("takeovers", 50, "more"),
    "faults.history.acknowledged": Bar("batches", 2000, "more"),
    "faults.fuzz_parsers.crashes": Bar("inputs that raise what is not documented", 0),
    "faults.fuzz_parsers.hangs": Bar("inputs that take more than five seconds", 0),
    "faults.fuzz_parsers.executions": Bar("executions", 5000, "more"),  # ten million in a full run
    "faults.fuzz_parsers.lines": Bar("pairs of lines that ran one after the other", 200, "more"),
    "faults.path.implausible_accepted": Bar(
        "reports of places that their car cannot have reached", 0
    ),
    "faults.path.honest_excluded": Bar("rows of the same cars' own way", 0),
    "faults.path.teleports": Bar("cars that report a far place", 100, "more"),
    "faults.path.two_car_alerts": Bar("of 210 places on idle roads, the worst of three ways", 2),
    "faults.path.pair_alerts": Bar("of 20 icy places, by two honest cars alone", 2, "more"),
    "faults.path.honest_alerts": Bar("of 20 icy places, by three honest cars", 20, "more"),
    "faults.availability.other_reader_served": Bar(
        "of another reader's requests, next to the worst attacker", 0.95, "more"
    ),
    "faults.availability.attackers": Bar("kinds of attackers", 9, "more"),
    "faults.availability.log_bytes": Bar("bytes that the page logged meanwhile", 100_000),
    "faults.privacy.position_over_chance": Bar(
        "share of updates by which a reader finds a lone car within 25 m, minus that of chance",
        0.05,
    ),
    "faults.privacy.street_over_chance": Bar(
        "as position_over_chance, for the car's street among five", 0
    ),
    "faults.privacy.slippery_delay_s": Bar("s later than on a map that shows every visit", 1),
    "faults.privacy.puts": Bar("map updates while a lone car drove", 200, "more"),
    "faults.privacy.control_position": Bar(
        "as position_over_chance, if every visit is shown at once", 0.5, "more"
    ),
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
    "faults.age.tenfold": Bar(
        "of memory, a start's and a question's, over those of a tenth of the archive", 1.5
    ),
    "faults.age.old_days": Bar(
        "of the time or memory of a start without days that no longer matter", 1.2
    ),
    "faults.disk.false_acks": Bar("batches", 0),
    "faults.disk.stuck": Bar("times", 0),
    "faults.disk.times_full": Bar("times", 3, "more"),
    "faults.disk.jobs_run": Bar("rounds of each job", 1, "more"),
    "faults.disk.room_made": Bar("days that retention removed from a full disk", 1, "more"),
    "faults.versions.set_aside": Bar("files", 0),
    "faults.versions.lost_rows": Bar("rows", 0),
    "faults.versions.map_difference": Bar("of a belief", 1e-6),
    "faults.versions.files": Bar("files of a newer version", 3, "more"),
    "cluster.lost": Bar("acknowledged batches, over all machines and an empty disk", 0),
    "cluster.doubled": Bar("rows, over all machines and an empty disk", 0),
    "cluster.unacknowledged_lost": Bar("batches, over all machines and an empty disk", 0),
    "cluster.takeover_s.kill": Bar("s to the next acknowledgement, the longest", 8),
    "cluster.takeover_s.freeze": Bar("s to the next acknowledgement, the longest", 12),
    "cluster.failovers": Bar(
        "failovers", 95, "more"
    ),  # of a hundred attempts; a frozen service may resume in time
    "cluster.failovers.kill": Bar("killed", 5, "more"),
    "cluster.failovers.freeze": Bar("frozen for good", 5, "more"),
    "cluster.failovers.bucket": Bar("cut from the bucket", 5, "more"),
    "cluster.failovers.routers": Bar("cut from the routers", 5, "more"),
    "cluster.failovers.two_standbys": Bar("killed while two waited", 5, "more"),
    "cluster.failovers.wakes": Bar("frozen, that woke", 5, "more"),
    "cluster.failovers.compacting": Bar("killed amid a compaction", 5, "more"),
    "cluster.failovers.copying": Bar("killed amid of copying", 5, "more"),
    "cluster.handover.pause_s": Bar("s without an acknowledgement, the longest", 5),
    "cluster.handover.map_difference": Bar("of anything that a checkpoint knows", 1e-6),
    "cluster.handovers": Bar("hand-overs", 20, "more"),
    "cluster.cells": Bar("cells of the map", 1e5, "more"),
    "cluster.acknowledged": Bar("batches", 10_000, "more"),
    "cluster.ack_p50_s": Bar("over that without a copy", 2),
    "cluster.empty_disk.rows_missing": Bar("rows", 0),
    "cluster.empty_disk.rows": Bar("rows that it has", 100_000, "more"),
    "cluster.silent_regions": Bar("answers that lacked something and said nothing", 0),
    "cluster.unserved_answers": Bar("answers that said so", 10, "more"),
    "link.address_change.lost": Bar("samples", 0),
    "link.address_change.gap_s": Bar("s", 0.5),
    "link.address_change.samples": Bar("samples", 200, "more"),
    "link.lossy.alert_p99_ms": Bar(
        "ms at 2 % loss and 80 ms round trip, with tiles sent at the same time", 200
    ),
    "link.lossy.alert_p99_ratio": Bar("over that with TLS", 0.6),
    "link.lossy.alerts_lost": Bar("alerts", 0),
    "link.udp_blocked.ready_s": Bar("s", 3),
    "link.router_back_tls_only_s": Bar("s", 5),
    "link.flood.honest_p99_ratio": Bar("with a flooding car over without", 1.2),
    "link.flood.sent_per_s": Bar("messages/s of the flooding car", 500, "more"),
    "faults.handover.lost": Bar("batches, over both machines and an empty disk", 0),
    "faults.handover.doubled": Bar("rows, over both machines and an empty disk", 0),
    "faults.handover.pause_s": Bar("s without an acknowledgement, the longest", 5),
    "faults.handover.handovers": Bar("hand-overs under load", 20, "more"),
    "faults.handover.acknowledged": Bar("batches", 2000, "more"),
    "faults.soak.growth_mb": Bar("MB per 10 min", 1),
    "faults.soak.handles": Bar("handles", 0),
    "faults.soak.lost": Bar("batches or rows", 0),
    "faults.soak.observations_per_s": Bar("observations/s", 1000, "more"),
}


def make_figure(name: str, value: float) -> Figure:
    """Return the figure called `name` with its value, and with unit and target from the table BARS.
    Raise KeyError for an unknown name.
    """
    unit, bar, better = BARS[name]
    return Figure(name, value, unit, bar, better)
