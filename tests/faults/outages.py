"""Campaigns on outages: a router that is down for a minute, a frozen router and service, full
disks, and shutdown. No acknowledged report may be lost.
"""

from __future__ import annotations

import json
import signal
import time
from typing import Final

from schemas.runtime.figures import Figure
from tests.faults.bars import make_figure
from tests.faults.census import Census, compare_with_archive, read_journals
from tests.faults.frame import Site
from tests.faults.processes import Part, Stage, open_stage

AGENTS_PER_PROCESS: Final = 10
RATE: Final = 10.0  # observations/s of each agent
DRAIN_S: Final = 60.0


def router_down(site: Site) -> list[Figure]:
    """Kill the router for a minute. Every report of that minute must be settled (acknowledged or
    refused by the service) soon after the router's return.
    """
    down_s = site.choose_amount(60, 4)
    with open_stage(site.folder) as stage:
        _load_agents(stage, site.choose_amount(5, 2))
        time.sleep(site.choose_amount(3, 1))
        stage.router.kill()
        down = time.time()
        time.sleep(down_s)
        stage.router.start()
        stage.router.line_with("router: ")
        back = time.time()
        census = _at_rest(stage)
        known = read_journals(stage.journals)
        recovery = known.longest_wait(back)
        amid = known.stored_between(down, back)
    site.say(f"{census}")
    return [
        make_figure("faults.router_down.lost", census.lost),
        make_figure("faults.router_down.recovery_s", recovery),
        make_figure("faults.router_down.batches", amid),
        Figure("faults.router_down.seconds", down_s, "s without a router"),
    ]


def freeze_parts(site: Site) -> list[Figure]:
    """Freeze the router for a while, then the service. Meanwhile the simulated agents must accept
    every block of observations on time, and no observation may be lost.
    """
    frozen_s = site.choose_amount(20, 3)
    spans = []
    with open_stage(site.folder) as stage:
        _load_agents(stage, site.choose_amount(3, 1))
        for part in (stage.router, stage.service):
            time.sleep(site.choose_amount(3, 1))
            part.freeze()
            began = time.time()
            time.sleep(frozen_s)
            spans.append((began, time.time()))
            part.send_signal(signal.SIGCONT)
        census = _at_rest(stage)
        known = read_journals(stage.journals)
        ends = [
            json.loads(next(line for line in part.read_lines() if line.startswith("{")))
            for part in stage.loads
        ]
    site.say(f"{census}; {ends}")
    return [
        make_figure("faults.frozen.lost", census.lost),
        make_figure("faults.frozen.batches", min(known.stored_between(*span) for span in spans)),
        make_figure("faults.frozen.agent_deadline_misses", sum(end["late_blocks"] for end in ends)),
        Figure("faults.frozen.longest_lag_s", max(end["longest_lag_s"] for end in ends), "s"),
        Figure("faults.frozen.seconds", frozen_s, "s frozen, each"),
    ]


def stop_parts(site: Site) -> list[Figure]:
    """Send SIGTERM with a running router and with a frozen one. Agent and service must end soon and
    lose nothing.
    """
    longest = 0.0
    lost = 0
    acknowledged = 0
    for freeze in (False, True):
        with open_stage(site.folder / str(freeze)) as stage:
            _load_agents(stage, 1)
            time.sleep(site.choose_amount(3, 1))
            if freeze:
                stage.router.freeze()
                time.sleep(site.choose_amount(3, 1))
            for part in (*stage.loads, stage.service):
                began = time.monotonic()
                _check_clean_stop(part)
                longest = max(longest, time.monotonic() - began)
            stage.router.send_signal(signal.SIGCONT)
            census = compare_with_archive(stage.journals, stage.archive)
            lost = lost + census.acknowledged_lost
            acknowledged = acknowledged + census.settled
    site.say(f"gone after {longest:.1f} s at the most")
    return [
        make_figure("faults.leaving.longest_s", longest),
        make_figure("faults.leaving.acknowledged_lost", lost),
        make_figure("faults.leaving.acknowledged", acknowledged),
    ]


def disk_full(site: Site) -> list[Figure]:
    """Prevent the files of the service, then those of the agents, from growing. Nothing may be
    acknowledged without being stored, and everything must be acknowledged later.
    """
    full_s = site.choose_amount(10, 2)
    false_acks = 0
    recovered = 0
    waiting = 0
    with open_stage(site.folder) as stage:
        _load_agents(stage, 2)
        for parts in ([stage.service], stage.loads, stage.parts[1:]):
            time.sleep(site.choose_amount(3, 1))
            for part in parts:
                part.limit_files(0)
            time.sleep(full_s)
            census = compare_with_archive(stage.journals, stage.archive)
            false_acks += census.acknowledged_lost
            waiting = max(waiting, census.stored - census.settled)
            for part in parts:
                part.limit_files(-1)
            recovered += _is_settled(stage)
        census = _at_rest(stage)
    site.say(f"{census}")
    return [
        make_figure("faults.disk_full.false_acks", false_acks + census.acknowledged_lost),
        make_figure("faults.disk_full.recovered", recovered if not census.lost else 0),
        make_figure("faults.disk_full.waiting", waiting),
        Figure("faults.disk_full.seconds", full_s, "s full, each"),
    ]


def _load_agents(stage: Stage, processes: int) -> None:
    for number in range(processes):
        names = [f"sim-{number}{place:02}" for place in range(AGENTS_PER_PROCESS)]
        stage.make_load(names, RATE, seed=number, flush_s=1.0).start()
    for part in stage.loads:
        part.line_with("ready: ")


def _is_settled(stage: Stage) -> bool:
    """Return True if every batch that the agents have stored by now is settled (acknowledged or
    refused by the service) within DRAIN_S seconds.
    """
    since = time.time()
    deadline = time.monotonic() + DRAIN_S
    while time.monotonic() < deadline:
        if read_journals(stage.journals).longest_wait(since) < float("inf"):
            return True
        time.sleep(0.2)
    return False


def _at_rest(stage: Stage) -> Census:
    stage.drain(DRAIN_S)
    _check_clean_stop(stage.service)
    return compare_with_archive(stage.journals, stage.archive)


def _check_clean_stop(part: Part) -> None:
    code = part.stop()
    assert code == 0, f"{part.name} ended with {code}; see {part.log}"
