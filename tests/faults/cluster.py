"""`python -m tests.faults.cluster [--failovers 100] [--out DIR] [--seed N]`: repeated failovers
between services under load.

The active service is killed, frozen or cut off, at random times, during a compaction (sorting of
new rows), or during an upload. Some failovers have two standbys (waiting services), and some
services resume after a freeze. At the end each machine, and one that starts with an empty disk,
must have all acknowledged rows exactly once.
"""

from __future__ import annotations

import argparse
import math
import random
import statistics
import time
from collections import defaultdict
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

from deploy.router import open_router
from fleet_service.archive.format import reading
from schemas.config import ServiceConfig, ZenohSettings
from schemas.runtime import figures
from schemas.runtime.figures import Figure
from schemas.wire import Kind
from tests.benchmarks.cluster import cluster as ack_p50_s
from tests.buckets import bucket_server
from tests.faults.bars import make_figure
from tests.faults.census import Census, compare_with_archive
from tests.faults.cluster_service import COMPACTING, COPYING
from tests.faults.cluster_stage import (
    PATIENCE_S,
    TWO,
    WAKES,
    WAYS,
    Asking,
    Failover,
    Journals,
    Machines,
    drain_loads,
    start_loads,
    write_town_archive,
)
from tests.faults.frame import Campaign, Site, run_and_exit, run_campaigns
from tests.faults.processes import Part
from tests.standbys import open_hosts, restore_archive
from tests.waiting import until

FULL: Final = 100  # failovers in a full run
LEASE_S: Final = ServiceConfig().lease_s
# Load: 300 observations/s in all.
PROCESSES = 2
VEHICLES = 6
RATE = 25.0
EVERY: Final = 8  # failovers per group, with a hand-over in its middle and at its end
HOLD_S: Final = (1.0, 5.0)  # undisturbed time between two failovers
# These jobs run often, so that each happens in the few seconds for which a service lives. A
# snapshot costs a second.
PERIODS: Final[dict[str, object]] = {
    "compact_s": 5.0,
    "checkpoint_s": 4.0,
    "snapshot_s": 20.0,
    "segment_s": 0.25,
}
KILLED: Final = ("kill", TWO, COMPACTING, COPYING)
FROZEN: Final = ("freeze", WAKES)
NAMED: Final = {way: way.replace(" ", "_") for way in WAYS}
OWES: Final = (
    "cluster.lost",
    "cluster.doubled",
    "cluster.unacknowledged_lost",
    "cluster.takeover_s.kill",
    "cluster.takeover_s.freeze",
    "cluster.failovers",
    "cluster.cells",
    "cluster.acknowledged",
    "cluster.ack_p50_s",
    "cluster.handover.pause_s",
    "cluster.handover.map_difference",
    "cluster.handovers",
    "cluster.empty_disk.rows_missing",
    "cluster.empty_disk.rows",
    "cluster.silent_regions",
    "cluster.unserved_answers",
    *(f"cluster.failovers.{name}" for name in NAMED.values()),
)


class Course(NamedTuple):
    """Course of a campaign.

    Attributes:
        happened: failovers in which a standby took over.
        pauses: pauses of service [s] during planned hand-overs.
        differences: differences of the map before and after planned hand-overs.
    """

    happened: list[Failover]
    pauses: list[float]
    differences: list[float]


def run(site: Site, failovers: int, lease_s: float) -> list[Figure]:
    """Run `failovers` failovers of all kinds in turn, and return the figures about losses, takeover
    times and pauses.
    """
    with ExitStack() as stack:
        router, (endpoint, *_) = open_router(listen="tcp/127.0.0.1:0")
        stack.enter_context(router)
        bucket = stack.enter_context(bucket_server(site.folder / "objects"))
        hosts = stack.enter_context(
            open_hosts(
                site.folder,
                ["one", "two", "three"],
                endpoint,
                bucket,
                module="tests.faults.cluster_service",
                named=True,
                lease_s=lease_s,
                **PERIODS,
            )
        )
        box = write_town_archive(hosts[0].root)
        hosts[0].part.start()
        until(lambda: hosts[0].has_said("ready: "), PATIENCE_S)
        cells = int(hosts[0].part.line_with("ready: ").split(", ")[1].split()[0])
        site.say(f"{cells} cells")
        loads = start_loads(site.folder, endpoint, PROCESSES, VEHICLES, RATE)
        for load in loads:
            stack.callback(load.kill)
        random_ = random.Random(site.seed)
        journals = Journals(load.log for load in loads)
        machines = Machines(hosts, bucket.path_of("lease"), lease_s, journals, random_)
        asking = Asking(endpoint, box, site.say)
        course = Course([], [], [])
        settings = ZenohSettings(connect=[endpoint])
        for number in range(failovers):
            machines.start_standbys(2 if _way_of(number) == TWO else 1)
            time.sleep(random_.uniform(*HOLD_S))
            _fail_over(number, course, machines, asking, site)
            _hand_over(number, course, machines, loads, settings, site)
        asking.end()
        drain_loads(loads)
        roots = [host.root for host in machines.stop_all()]
        roots.append(restore_archive(site.folder / "empty", bucket))
        rows = [rows_of(root) for root in roots]
        census = [compare_with_archive([load.log for load in loads], root) for root in roots]
    site.say(f"rows {rows}; {census}")
    handovers = len(course.pauses) + len(course.differences)
    return [
        *_make_figures(failovers, course.happened, census),
        *_make_median_figures(course.happened),
        *ack_p50_s(),
        make_figure("cluster.handover.pause_s", max(course.pauses, default=math.nan)),
        make_figure("cluster.handover.map_difference", max(course.differences, default=math.nan)),
        _make_figure(failovers, "cluster.handovers", handovers, "hand-overs"),
        make_figure("cluster.cells", cells),
        make_figure("cluster.silent_regions", asking.silent),
        make_figure("cluster.unserved_answers", asking.unserved),
        make_figure("cluster.empty_disk.rows_missing", max(rows) - rows[-1]),
        make_figure("cluster.empty_disk.rows", rows[-1]),
    ]


def _fail_over(number: int, course: Course, machines: Machines, asking: Asking, site: Site) -> None:
    """Let the active service fail in the way of failover `number`, and add the result to the
    course.
    """
    found = machines.fail_over(_way_of(number))
    course.happened.extend([found] if found else [])
    result = f"{found.way}, {found.seconds:.1f} s" if found else "woke in time"
    site.say(
        f"{len(course.happened)} of {number + 1}: {result}; {asking.unserved} answers name no "
        "active service"
    )


def _hand_over(
    number: int,
    course: Course,
    machines: Machines,
    loads: list[Part],
    settings: ZenohSettings,
    site: Site,
) -> None:
    """Hand the region over to a standby in the middle and at the end of each group of EVERY
    failovers, and add the measured pause or difference of the map to the course.
    """
    if number % EVERY == EVERY // 2 - 1:
        machines.start_standbys(1)
        course.pauses.append(machines.pause_s(settings))
        site.say(f"handed over, a pause of {course.pauses[-1]:.1f} s")
    if number % EVERY == EVERY - 1:
        machines.start_standbys(1)
        course.differences.append(machines.map_difference(settings, loads))
        site.say(f"handed over, the map differs by {course.differences[-1]:g}")


def _way_of(number: int) -> str:
    """Return the kind of failure of failover `number`; all kinds follow each other in turn."""
    return list(WAYS)[number % len(WAYS)]


def rows_of(root: Path) -> int:
    """Return the number of observation rows in an archive, from its new rows (inbox) and its
    compacted (sorted) files.
    """
    return sum(table.num_rows for table in reading.read_tables(root, Kind.OBSERVATION, ["row"]))


def _make_figures(failovers: int, happened: list[Failover], census: list[Census]) -> list[Figure]:
    ways = defaultdict(list)
    for one in happened:
        ways[one.way].append(one.seconds)

    def find_longest(kinds: tuple[str, ...]) -> float:
        return max((seconds for kind in kinds for seconds in ways[kind]), default=float("nan"))

    return [
        make_figure("cluster.lost", sum(one.acknowledged_lost for one in census)),
        make_figure("cluster.doubled", sum(one.doubled for one in census)),
        make_figure("cluster.unacknowledged_lost", sum(one.lost for one in census)),
        make_figure("cluster.takeover_s.kill", find_longest(KILLED)),
        make_figure("cluster.takeover_s.freeze", find_longest(FROZEN)),
        _make_figure(failovers, "cluster.failovers", len(happened), "failovers"),
        _make_figure(failovers, "cluster.acknowledged", census[0].settled, "batches"),
        *(
            _make_figure(failovers, f"cluster.failovers.{name}", len(ways[way]), "failovers")
            for way, name in NAMED.items()
        ),
    ]


def _make_figure(failovers: int, name: str, value: float, unit: str) -> Figure:
    """Return a figure (named number) about the failovers. The figure gets its target from
    `tests.faults.bars` only if at least FULL failovers were run, because a count in a shorter
    campaign is smaller and cannot be compared with the target.
    """
    return make_figure(name, value) if failovers >= FULL else Figure(name, value, unit)


def _make_median_figures(happened: list[Failover]) -> list[Figure]:
    """Return the median takeover time [s] per kind of failure, as figures (named numbers) without
    targets.
    """
    found = []
    for name, kinds in {"kill": KILLED, "freeze": FROZEN, "cut": ("bucket", "routers")}.items():
        seconds = [one.seconds for one in happened if one.way in kinds]
        if seconds:
            found.append(
                Figure(
                    f"cluster.takeover_p50_s.{name}",
                    statistics.median(seconds),
                    f"s, of {len(seconds)}",
                )
            )
    return found


def main() -> int:
    """Run the campaign of failovers. Return 0 if every figure meets its target, otherwise 1."""
    parser = argparse.ArgumentParser(
        prog="tests.faults.cluster", description="Services that follow each other."
    )
    parser.add_argument(
        "--failovers", type=int, default=FULL, help=f"how many (default {FULL}, half an hour)"
    )
    parser.add_argument(
        "--lease-s", type=float, default=LEASE_S, help="on a machine that has no time for 5 s"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(".faults/cluster"),
        help="folder for figures and remaining files",
    )
    parser.add_argument("--seed", type=int, default=0, help="of everything random (default 0)")
    args = parser.parse_args()
    campaign = Campaign(
        "cluster", partial(run, failovers=args.failovers, lease_s=args.lease_s), OWES
    )
    found = run_campaigns(
        [campaign], args.out, "cluster", quick=args.failovers < FULL, seed=args.seed
    )
    print(figures.format_table(found))
    return 0 if all(one.holds for one in found) else 1


if __name__ == "__main__":
    run_and_exit(main)
