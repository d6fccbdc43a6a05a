"""Campaign of kill -9: agents, router and service are killed again and again, one or several at
once, under load.

The kills run in rounds, each with its own archive, so that a restarted service has to read back
minutes and not hours. The archive also has old rows, which a retention process removes meanwhile;
this process is killed too. At the end of a round everything runs until all batches are settled
(acknowledged or refused by the service). Then the archive is compared with the agents' journals
(lists of stored and acknowledged batches).
"""

from __future__ import annotations

import random
import sys
import time
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from fleet_service.analytics import synthetic
from fleet_service.app.engine import Engine
from fleet_service.archive.format import layout
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.archive.maintenance.retention import drop_checkpoints, due_folders
from fleet_service.serve.encode import cell_table
from schemas.config import LEAST_RAW_DAYS, ServiceConfig
from schemas.runtime.figures import Figure
from schemas.wire import Kind
from tests.faults.bars import make_figure
from tests.faults.census import Census, compare_with_archive, read_journals
from tests.faults.frame import Site
from tests.faults.processes import Part, Stage, open_stage

AGENTS: Final = 12
# [observations/s] offered by each agent, so that 5 000/s remain although restarting agents offer
# none.
# Few agents with a high rate are used, because starts are expensive for two cores. A start takes
# 0.6 s of a core. A thousand observations take 0.054 s at 300/s and 0.025 s at 700/s.
RATE: Final = 700.0
KILLS_PER_ROUND: Final = 20
# Time between two kills. It ends before, during or after the restart of the processes that were
# killed last.
PAUSE_S: Final = (
    0.5,
    3.0,
)
DOWN_S: Final = (0.0, 1.0)  # range of the time for which killed processes stay away
DRAIN_S: Final = 90.0
# Short periods, so that compaction, checkpoints and snapshots happen often in the seconds for which
# a service lives.
PERIODS: Final[dict[str, object]] = {
    "compact_s": 2.0,
    "checkpoint_s": 1.5,
    "snapshot_s": 3.0,
    "vehicle_kb_s": 250.0,
}
# Rows of January 2026, which are older than the retention time.
OLD: Final = synthetic.SyntheticFleet(4000, 4, vehicles=50)
RETIRED_EVERY: Final = 4  # kills between two retention runs
RETIRING_KILLED: Final = 0.5


class Load(NamedTuple):
    """Load of the system in the time in which processes were killed.

    Attributes:
        observations: number of observations sent.
        seconds: length of this time [s].
        retired: True if a retention process (deletion of old rows) removed a day in this time.
    """

    observations: int
    seconds: float
    retired: bool


def run(site: Site) -> list[Figure]:
    """Kill processes 200 times in ten rounds, and return the figures. A quick run kills five times
    in one round, with six agents and weaker targets.
    """
    random_ = random.Random(site.seed)
    kills = 0
    offered = 0
    seconds = 0.0
    whole_s = 0.0
    difference = 0.0
    found = []
    upkeep: frozenset[str] = frozenset()
    for number in range(site.choose_amount(10, 1)):
        began = time.monotonic()
        begin_with_old_rows(site.folder / f"round-{number}" / "archive")
        with open_stage(site.folder / f"round-{number}", segment_s=0.5, **PERIODS) as stage:
            census, load = _run_round(
                stage,
                site.choose_amount(AGENTS, 6),
                site.choose_amount(KILLS_PER_ROUND, 5),
                random_,
            )
        upkeep = upkeep.union(
            _find_finished_jobs(stage.archive), {"retention"} if load.retired else ()
        )
        difference = max(difference, map_difference(stage.archive))
        kills += sum(part.starts - 1 for part in stage.parts)
        offered = offered + load.observations
        seconds = seconds + load.seconds
        whole_s += time.monotonic() - began
        found.append(census)
        site.say(f"round {number}: {kills} killed so far, {census}")
    total = {name: sum(getattr(census, name) for census in found) for name in vars(found[0])}
    return [
        make_figure("faults.kill.acknowledged_lost", total["acknowledged_lost"]),
        make_figure("faults.kill.doubled", total["doubled"]),
        make_figure("faults.kill.unacknowledged_lost_at_end", total["lost"]),
        make_figure("faults.kill.map_difference", difference),
        _make_figure(site, "faults.kill.upkeep", len(upkeep), 2),
        _make_figure(site, "faults.kill.kills", kills, 5),
        _make_figure(site, "faults.kill.offered_per_s", offered / seconds, 100),
        Figure(
            "faults.kill.whole_per_s",
            total["observations"] / whole_s,
            "observations/s, with starts and drains",
        ),
        Figure("faults.kill.observations", total["observations"], "observations"),
    ]


def _make_figure(site: Site, name: str, value: float, quick: float) -> Figure:
    """Return the figure called `name` of this campaign with its target; a quick run uses the weaker
    target `quick`.
    """
    found = make_figure(name, value)
    return replace(found, bar=quick) if site.quick else found


def begin_with_old_rows(archive: Path) -> None:
    """Create an archive with a day of recent rows, and with old rows that a service does not read
    at its start.
    """
    synthetic.write_archive(archive, OLD, OLD.rows // 4)
    compact(archive)
    (archive / layout.TABLES[Kind.OBSERVATION] / f"date={datetime.now(UTC).date()}").mkdir(
        exist_ok=True
    )


def old_days(archive: Path) -> list[Path]:
    """Return the folders of the days that retention (deletion of old rows) removes."""
    return due_folders(archive, LEAST_RAW_DAYS, datetime.now(UTC).date())


def _find_finished_jobs(archive: Path) -> frozenset[str]:
    """Return the names of the background jobs (checkpoints, compaction) that have completed during
    the kills. A job counts as completed if its results are in the archive. Compacted (sorted) files
    of the old days, which retention deletes, are ignored, because they existed before the kills.
    """
    old = old_days(archive)
    compacted = (file.parents[1] not in old for file in archive.glob("observations/*/*/*.parquet"))
    found = {"checkpoints": any(archive.glob("checkpoints/*-*")), "compaction": any(compacted)}
    return frozenset(name for name, done in found.items() if done)


def map_difference(archive: Path) -> float:
    """Restore the map of a service twice: from its checkpoint (saved state) and later rows, and
    from all archived rows without a checkpoint. Return the largest difference of mu, its bounds and
    P(slippery) between both maps, or infinity if a cell or a visit is missing.
    """
    maps = []
    for _ in range(2):
        with closing(Engine(ServiceConfig(), archive)) as engine:
            fusion = engine.state.fusion
            slots = np.lexsort((fusion.sector[: fusion.size], fusion.cell[: fusion.size]))
            maps.append(cell_table(fusion, slots, engine.seen))
        drop_checkpoints(archive)
    ours, theirs = maps
    if not all(
        ours[name].equals(theirs[name]) for name in ("cell", "sector", "observations", "vehicles")
    ):
        return float("inf")
    quantities = ("mu", "mu_lower", "mu_upper", "p_slippery")
    return max(
        float(np.nanmax(np.abs(ours[name].to_numpy() - theirs[name].to_numpy())))
        for name in quantities
    )


def _run_round(
    stage: Stage, agents: int, kills: int, random_: random.Random
) -> tuple[Census, Load]:
    """Run one round of kills. Return the counts of batches and rows (census), and the load from the
    start of all processes until the end.

    There are `kills` kills, or up to three times as many if the service has not yet compacted
    (sorted) rows and written a checkpoint (saved state).
    """
    for number in range(agents):
        stage.make_load([f"sim-{number:03}"], RATE, seed=number).start()
    for part in stage.loads:
        part.line_with("ready: ")
    words = [
        "retention",
        "--archive",
        str(stage.archive),
        "--raw-days",
        str(LEAST_RAW_DAYS),
        "--yes",
    ]
    retention = Part("retention", [sys.executable, "-m", "fleet_service.cli", *words], stage.folder)
    killed = 0
    began = time.time()
    old = len(old_days(stage.archive))
    assert old
    while killed < kills or (killed < 3 * kills and len(_find_finished_jobs(stage.archive)) < 2):
        if killed % RETIRED_EVERY == 1 and not retention.is_alive:
            retention.start()
        time.sleep(random_.uniform(*PAUSE_S))
        if random_.random() < RETIRING_KILLED:
            retention.kill()
        victims = _choose_victims(stage, random_)
        for part in victims:
            part.kill()
        killed += 1
        time.sleep(random_.uniform(*DOWN_S))
        for part in victims:
            part.start()
    stage.service.line_with("ready: ")
    end = time.time()
    retired = len(old_days(stage.archive)) < old
    stage.drain(DRAIN_S)
    stage.service.stop()
    retention.kill()
    retention.start()  # delete what the killed retention runs have left
    retention.wait(DRAIN_S)
    assert not old_days(stage.archive), f"retention did not go on after a kill; see {retention.log}"
    amid = sum(
        records
        for records, at in read_journals(stage.journals).stored.values()
        if began <= at <= end
    )
    return compare_with_archive(stage.journals, stage.archive), Load(amid, end - began, retired)


def _choose_victims(stage: Stage, random_: random.Random) -> list[Part]:
    """Return one or several random processes to kill. Router and service are each among them in 45
    % of the cases; the others are agents.
    """
    chosen = [part for part in (stage.router, stage.service) if random_.random() < 0.45]
    return chosen + random_.sample(
        stage.loads, random_.choice((0, 1, 3)) if chosen else random_.choice((1, 2, 5))
    )
