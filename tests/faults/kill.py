"""kill -9 of agents, router and service, one or several at once, again and again, under load.

In rounds, each with an archive of its own, so that a restarted service has minutes to read back and not hours. At the
end of a round everything is left running until all is settled; then the archive is compared with the journals.
"""

from __future__ import annotations

import random
import time
from typing import Final

from schemas.runtime.figures import Figure
from tests.faults.bars import figure
from tests.faults.census import Census, take
from tests.faults.frame import Site
from tests.faults.processes import Part, Stage, stage

AGENTS: Final = 20
RATE: Final = 300.0  # observations/s of each: an agent that is restarting offers none, and 5 000/s are to remain
KILLS_PER_ROUND: Final = 20
PAUSE_S: Final = (0.5, 3.0)  # between kills: before, during and after the restart of the ones killed before
DOWN_S: Final = (0.0, 1.0)  # how long the killed ones stay away
DRAIN_S: Final = 90.0


def run(site: Site) -> list[Figure]:
    """200 kills in ten rounds; in a quick run, five in one with six agents."""
    random_ = random.Random(site.seed)
    kills, seconds, found = 0, 0.0, []
    for number in range(site.of(10, 1)):
        began = time.monotonic()
        with stage(site.folder / f"round-{number}", segment_s=0.5) as there:
            census = _round(there, site.of(AGENTS, 6), site.of(KILLS_PER_ROUND, 5), random_)
        kills += sum(part.starts - 1 for part in there.parts)
        seconds += time.monotonic() - began
        found.append(census)
        site.say(f"round {number}: {kills} killed so far, {census}")
    total = {name: sum(getattr(census, name) for census in found) for name in vars(found[0])}
    return [
        figure("faults.kill.acknowledged_lost", total["acknowledged_lost"]),
        figure("faults.kill.doubled", total["doubled"]),
        figure("faults.kill.unacknowledged_lost_at_end", total["lost"]),
        Figure("faults.kill.kills", kills, "processes killed"),
        Figure("faults.kill.offered_per_s", total["observations"] / seconds, "observations/s, drains included"),
        Figure("faults.kill.observations", total["observations"], "observations"),
    ]


def _round(there: Stage, agents: int, kills: int, random_: random.Random) -> Census:
    for number in range(agents):
        there.load([f"sim-{number:03}"], RATE, seed=number).start()
    for part in there.loads:
        part.line_with("ready: ")
    killed = 0
    while killed < kills:
        time.sleep(random_.uniform(*PAUSE_S))
        victims = _victims(there, random_)
        for part in victims:
            part.kill()
        killed += 1
        time.sleep(random_.uniform(*DOWN_S))
        for part in victims:
            part.start()
    there.service.line_with("ready: ")
    there.drain(DRAIN_S)
    there.service.stop()
    return take(there.journals, there.archive)


def _victims(there: Stage, random_: random.Random) -> list[Part]:
    """One or several at once; router and service as often as all the agents together."""
    chosen = [part for part in (there.router, there.service) if random_.random() < 0.45]
    return chosen + random_.sample(there.loads, random_.choice((0, 1, 3)) if chosen else random_.choice((1, 2, 5)))
