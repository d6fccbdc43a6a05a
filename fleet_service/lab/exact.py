"""Evaluation of properties of the map that must hold except for rounding errors: it does not depend
on the order in which reports arrive, and a replay from the archive gives the same map. The module
also measures how far the upper end of an interval is lowered by visits (passages of cells) in which
a vehicle used too little grip to measure the friction.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Final

import numpy as np
from numpy.random import Generator

from fleet_service.app.engine import Engine
from fleet_service.fusion import Fusion, observations_of
from fleet_service.lab import agent, town
from fleet_service.lab.agent import Errors, Passes
from fleet_service.lab.drive import CELL, LATENESS_S, rows_of
from fleet_service.lab.messages import clock_of, make_messages
from fleet_service.lab.town import Visits
from schemas import mugrid
from schemas.config import ServiceConfig
from schemas.numeric import FloatArray

VEHICLES = 40
MINUTES = 20
UNEXCITED: Final = (1, 3, 10, 100, 1000)
PARTS: Final = 60  # number of portions in which the shuffled observations arrive


def largest_difference(a: Fusion, b: Fusion) -> float:
    """Return the largest difference between two `Fusion` objects in any of the 32 probabilities of
    any cell's belief; 1 if a cell exists in only one of them.
    """
    slots_in_b = b.slots_of(a.cell[: a.size], a.sector[: a.size])
    if a.size != b.size or (slots_in_b < 0).any():
        return 1.0
    now = int(max(a.live.time[: a.size].max(), b.live.time[: b.size].max()))
    return float(np.abs(a.beliefs(np.arange(a.size), now) - b.beliefs(slots_in_b, now)).max())


def drive_town(rng: Generator) -> Visits:
    """Simulate the reports of twenty minutes in a town in which some vehicles report false values,
    so that vehicles get different weights.
    """
    visits = town.drive_fleet(
        rng, town.draw_town(rng, MINUTES, 0.3), Errors.draw(rng, VEHICLES), MINUTES
    )
    return town.claim_falsely(visits, np.arange(VEHICLES) < VEHICLES // 8, 0.25)


def order_difference(rng: Generator) -> float:
    """Return the largest difference in any probability of any cell's belief between two maps: one
    from observations in order of time, the other from observations in random order within the
    allowed delay.
    """
    visits = drive_town(rng)
    observations = observations_of(rows_of(visits), visits.vehicle)
    straight = Fusion(LATENESS_S)
    mixed = Fusion(LATENESS_S)
    straight.update(observations)
    arrival = np.argsort(visits.seconds + rng.uniform(0.0, 0.5 * LATENESS_S, len(visits)))
    late = sum(
        int(mixed.update(observations.take(rows)).late.sum())
        for rows in np.array_split(arrival, PARTS)
    )
    return 1.0 if late else largest_difference(straight, mixed)


def replay_difference(rng: Generator) -> float:
    """Return the largest difference in any probability of any cell's belief between two services:
    one received messages, some late or twice, and the other was restarted from the archive of the
    first.
    """
    visits = drive_town(rng)
    sent = make_messages(visits)
    at = visits.seconds[[m.last_visit for m in sent]] + rng.uniform(
        0.0, 1.5 * LATENESS_S, len(sent)
    )
    with tempfile.TemporaryDirectory() as folder:
        engine = Engine(ServiceConfig(), Path(folder))
        for portion in np.array_split(np.argsort(at), PARTS):
            now = clock_of(float(at[portion].max()))
            engine.intake.ingest([sent[k].message for k in (*portion, *portion[::7])], now)
            engine.settlement.flush()
        engine.close()
        again = Engine(ServiceConfig(), Path(folder))
        again.close()
        return largest_difference(engine.state.fusion, again.state.fusion)


def upper_shift(rng: Generator) -> float:
    """Return how far unexcited visits, which use too little grip to measure the friction, lower the
    upper end of the interval below that of the prior. The result is the maximum over all surfaces
    and the numbers of vehicles in UNEXCITED.
    """
    prior = float(mugrid.quantiles(mugrid.PRIOR, 0.95))
    worst = -np.inf
    for vehicles in UNEXCITED:
        for mu, _, _ in town.SURFACES.values():
            n = max(vehicles, 200)
            seconds: FloatArray = np.sort(rng.random(n)) * 3600.0
            who = rng.integers(0, vehicles, n)
            along = np.zeros(n, np.int64)
            shares = agent.used_shares(rng, np.zeros(n, bool))
            road: FloatArray = np.full(n, mu)
            passes = Passes(
                who, road, 0.0 * road, shares, agent.reading_noise(rng, along), along, along > 0
            )
            reports = agent.draw_reports(rng, Errors.draw(rng, vehicles), passes)
            fusion = Fusion(LATENESS_S)
            fusion.update(
                observations_of(rows_of(Visits(seconds, who, along, road, along > 0, reports)), who)
            )
            slot = fusion.slots_of(CELL[:1], np.zeros(1, np.int64))
            belief = fusion.beliefs(slot, int(fusion.live.time[slot[0]]))
            worst = max(worst, prior - float(mugrid.quantiles(belief, 0.95)[0]))
    return worst
