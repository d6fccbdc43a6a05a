"""Campaign of hand-overs: a region is handed over to and fro between two services while vehicles
report.

At the end both machines, and one that starts with an empty disk, must have every acknowledged row
exactly once.
"""

from __future__ import annotations

import random
from contextlib import ExitStack
from typing import Final

from deploy.router import open_router
from schemas.config import ServiceConfig, ZenohSettings
from schemas.runtime.figures import Figure
from tests.buckets import bucket_server
from tests.faults.bars import make_figure
from tests.faults.census import compare_with_archive
from tests.faults.cluster_stage import (
    PATIENCE_S,
    Journals,
    Machines,
    drain_loads,
    start_loads,
)
from tests.faults.frame import Site
from tests.standbys import open_hosts, restore_archive
from tests.waiting import until

# Load: 1 000 observations/s in all.
PROCESSES: Final = 2
VEHICLES: Final = 10
RATE: Final = 50.0
PERIODS: Final[dict[str, object]] = {"compact_s": 5.0, "checkpoint_s": 4.0, "segment_s": 0.25}


def run(site: Site) -> list[Figure]:
    """Let a region be handed over between two services twenty times while vehicles report. Return
    the figures: the longest time without acknowledgements, and the numbers of lost and doubled
    rows.
    """
    pauses = []
    lease_s = ServiceConfig().lease_s
    with ExitStack() as stack:
        router, (endpoint, *_) = open_router(listen="tcp/127.0.0.1:0")
        stack.enter_context(router)
        bucket = stack.enter_context(bucket_server(site.folder / "objects"))
        hosts = stack.enter_context(
            open_hosts(site.folder, ["one", "two"], endpoint, bucket, named=True, **PERIODS)
        )
        hosts[0].part.start()
        until(lambda: hosts[0].has_said("ready: "), PATIENCE_S)
        parts = start_loads(site.folder, endpoint, PROCESSES, VEHICLES, RATE)
        for part in parts:
            stack.callback(part.kill)
        journals = Journals(part.log for part in parts)
        machines = Machines(
            hosts, bucket.path_of("lease"), lease_s, journals, random.Random(site.seed)
        )
        for _ in range(20):
            machines.start_standbys(1)
            pauses.append(machines.pause_s(ZenohSettings(connect=[endpoint])))
            site.say(f"{len(pauses)} handed over, a pause of {pauses[-1]:.1f} s")
        drain_loads(parts)
        roots = [host.root for host in machines.stop_all()]
        roots.append(restore_archive(site.folder / "empty", bucket))
        census = [compare_with_archive([part.log for part in parts], root) for root in roots]
    site.say(f"{census}")
    return [
        make_figure("faults.handover.lost", sum(c.acknowledged_lost + c.lost for c in census)),
        make_figure("faults.handover.doubled", sum(c.doubled for c in census)),
        make_figure("faults.handover.pause_s", max(pauses)),
        make_figure("faults.handover.handovers", len(pauses)),
        make_figure("faults.handover.acknowledged", census[0].settled),
    ]
