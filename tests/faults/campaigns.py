"""List of the fault campaigns, in the order in which they run."""

from __future__ import annotations

from typing import Final

from tests.faults import (
    age,
    alerts,
    availability,
    away,
    bitrot,
    clocks,
    compaction,
    crash_model,
    disk,
    flood,
    fuzz,
    fuzz_parsers,
    fuzz_wire,
    handover,
    insider,
    kill,
    lease,
    link,
    model,
    outages,
    path,
    privacy,
    queries,
    security,
    soak,
    truncation,
    versions,
    webhook,
)
from tests.faults.frame import Campaign

CAMPAIGNS: Final = (
    Campaign(
        "crash-model",
        crash_model.run,
        (
            *("faults.crash_model.violations", "faults.crash_model.acknowledged"),
            "faults.crash_model.service_acknowledged",
        ),
    ),
    Campaign(
        "compaction",
        compaction.run,
        (
            "faults.compaction.incomplete_reads",
            "faults.compaction.kills",
            "faults.compaction.reads",
            "faults.compaction.batches",
        ),
    ),
    Campaign(
        "age",
        age.run,
        (
            *("faults.age.ready_s", "faults.age.ready_mb", "faults.age.at_mb"),
            *("faults.age.cold_s", "faults.age.cold_mb", "faults.age.cells", "faults.age.at_bytes"),
            *("faults.age.old_days", "faults.age.tenfold"),
        ),
    ),
    Campaign(
        "truncation", truncation.run, ("faults.truncation.lost_rows", "faults.truncation.damages")
    ),
    Campaign(
        "versions",
        versions.run,
        (
            *("faults.versions.set_aside", "faults.versions.lost_rows"),
            *("faults.versions.map_difference", "faults.versions.files"),
        ),
    ),
    Campaign(
        "bitrot",
        bitrot.run,
        ("faults.bitrot.unnoticed", "faults.bitrot.crash_loops", "faults.bitrot.tried"),
    ),
    Campaign(
        "clocks",
        clocks.run,
        (
            *("faults.clocks.rejected", "faults.clocks.doubled", "faults.clocks.retired"),
            *("faults.clocks.alerts_lost", "faults.clocks.sent", "faults.clocks.jumps"),
        ),
    ),
    Campaign(
        "kill",
        kill.run,
        (
            *(
                "faults.kill.acknowledged_lost",
                "faults.kill.doubled",
                "faults.kill.unacknowledged_lost_at_end",
            ),
            *(
                "faults.kill.map_difference",
                "faults.kill.upkeep",
                "faults.kill.kills",
                "faults.kill.offered_per_s",
            ),
        ),
    ),
    Campaign(
        "router-down",
        outages.router_down,
        ("faults.router_down.lost", "faults.router_down.recovery_s", "faults.router_down.batches"),
    ),
    Campaign(
        "frozen",
        outages.freeze_parts,
        ("faults.frozen.lost", "faults.frozen.agent_deadline_misses", "faults.frozen.batches"),
    ),
    Campaign(
        "away",
        away.run,
        (
            *(
                "faults.away.bytes_ratio",
                "faults.away.lost",
                "faults.away.drain_share",
                "faults.away.backlog",
            ),
            *("faults.away.map_missing", "faults.away.late"),
        ),
    ),
    Campaign(
        "alerts", alerts.run, ("faults.alerts.missing_after_reconnect", "faults.alerts.standing")
    ),
    Campaign(
        "leaving",
        outages.stop_parts,
        (
            "faults.leaving.longest_s",
            "faults.leaving.acknowledged_lost",
            "faults.leaving.acknowledged",
        ),
    ),
    Campaign(
        "disk-full",
        outages.disk_full,
        ("faults.disk_full.false_acks", "faults.disk_full.recovered", "faults.disk_full.waiting"),
    ),
    Campaign(
        "disk",
        disk.run,
        (
            *("faults.disk.false_acks", "faults.disk.stuck"),
            *("faults.disk.times_full", "faults.disk.jobs_run", "faults.disk.room_made"),
        ),
    ),
    Campaign("security", security.run, ("faults.security.breaches", "faults.security.attempts")),
    Campaign(
        "fuzz",
        fuzz.run,
        (
            *(
                "faults.fuzz.crashes",
                "faults.fuzz.admitted_out_of_range",
                "faults.fuzz.honest_lost",
            ),
            *("faults.fuzz.refused", "faults.fuzz.answered", "faults.fuzz.pasts"),
        ),
    ),
    Campaign(
        "fuzz-wire",
        fuzz_wire.run,
        (
            *(
                "faults.fuzz_wire.crashes",
                "faults.fuzz_wire.honest_lost",
                "faults.fuzz_wire.doubled",
            ),
            *("faults.fuzz_wire.honest", "faults.fuzz_wire.refused", "faults.fuzz_wire.answered"),
        ),
    ),
    Campaign(
        "insider",
        insider.run,
        (
            *(
                "faults.insider.alerts_alone",
                "faults.insider.mb_per_hour",
                "faults.insider.honest_delay_s",
            ),
            *("faults.insider.messages", "faults.insider.honest_lost", "faults.insider.replayed"),
        ),
    ),
    Campaign(
        "webhook",
        webhook.run,
        (
            *("faults.webhook.lost_silently", "faults.webhook.late"),
            *("faults.webhook.kinds", "faults.webhook.arrived"),
        ),
    ),
    Campaign(
        "path",
        path.run,
        (
            *(
                "faults.path.implausible_accepted",
                "faults.path.honest_excluded",
                "faults.path.teleports",
            ),
            *("faults.path.two_car_alerts", "faults.path.pair_alerts", "faults.path.honest_alerts"),
        ),
    ),
    Campaign(
        "privacy",
        privacy.run,
        (
            *("faults.privacy.position_over_chance", "faults.privacy.street_over_chance"),
            *("faults.privacy.slippery_delay_s", "faults.privacy.puts"),
            "faults.privacy.control_position",
        ),
    ),
    Campaign(
        "availability",
        availability.run,
        (
            *("faults.availability.other_reader_served", "faults.availability.attackers"),
            "faults.availability.log_bytes",
        ),
    ),
    Campaign(
        "model",
        model.run,
        ("faults.model.violations", "faults.model.unnoticed", "faults.model.states_checked"),
    ),
    Campaign(
        "lease",
        lease.run,
        (
            *("faults.lease.acknowledged_by_two", "faults.lease.refused"),
            *("faults.lease.control_unlike", "faults.lease.control_endless"),
            *("faults.history.violations", "faults.history.failovers"),
            "faults.history.acknowledged",
        ),
    ),
    Campaign(
        "fuzz-parsers",
        fuzz_parsers.run,
        (
            *("faults.fuzz_parsers.crashes", "faults.fuzz_parsers.hangs"),
            *("faults.fuzz_parsers.executions", "faults.fuzz_parsers.lines"),
        ),
    ),
    Campaign(
        "queries",
        queries.run,
        ("faults.query.light_p99_ms", "faults.query.heavy_answers", "faults.query.light_answers"),
    ),
    Campaign(
        "flood",
        flood.run,
        ("faults.flood.honest_delay_s", "faults.flood.map_difference", "faults.flood.rate"),
    ),
    Campaign(
        "hand-over",
        handover.run,
        (
            *("faults.handover.lost", "faults.handover.doubled", "faults.handover.pause_s"),
            *("faults.handover.handovers", "faults.handover.acknowledged"),
        ),
        in_quick=False,  # each hand-over takes several seconds
    ),
    # This campaign needs root, and a minute for each transport.
    Campaign("link", link.measure, link.OWES, in_quick=False),
    # Memory growth shows only after half an hour.
    Campaign("soak", soak.run, soak.OWES, in_quick=False),
)
