"""Evaluation of a changing road: ice forms or melts on one road of a simulated town. The module
counts the vehicles' passes until the map shows the change. Only passes count in which the vehicle
used enough grip to measure the friction. Pure (no I/O).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.random import Generator

from fleet_service.fusion import Fusion, observations_of
from fleet_service.lab import town
from fleet_service.lab.agent import Errors
from fleet_service.lab.drive import CELL, LATENESS_S, rows_of
from fleet_service.lab.town import LENGTH, Town
from fleet_service.serve.alerts import CLEAR_BELOW, RAISE_ABOVE
from schemas import mugrid
from schemas.numeric import FloatArray, IntArray

DRY = 0.85
ICE = 0.20
# number of vehicles, length of the drive [min], and minute in which the road changes
VEHICLES = 60
MINUTES = 40
CHANGE = 22
EXCITEMENT: Final = 0.3  # probability that a pass over the road is excited
UNREACHED: Final = 99  # number of passes if the map did not show the change until the end


def changing_town(rng: Generator, before: float, after: float) -> Town:
    """Return a random town in which the friction of the first road changes from `before` to
    `after`.
    """
    drawn = town.draw_town(rng, MINUTES, 0.0)
    mu = drawn.mu.copy()
    excitement = drawn.excitement.copy()
    mu[:CHANGE, :LENGTH] = before
    mu[CHANGE:, :LENGTH] = after
    excitement[:LENGTH] = EXCITEMENT
    return Town(mu, excitement, drawn.changed, drawn.common, drawn.usual)


def detection_delays(rng: Generator, before: float, after: float) -> IntArray:
    """Return the number of excited passes over each cell of the road until the map shows the
    change, (LENGTH,). An excited pass uses enough grip to measure the friction.

    The map shows ice when P(μ < .4) > .9, and the end of ice when P(μ < .4) < .1, which ends an
    alert. A pass is counted in the cell for which it was reported, even if the position was wrong.
    """
    place = changing_town(rng, before, after)
    visits = town.drive_fleet(rng, place, Errors.draw(rng, VEHICLES), MINUTES)
    observations = observations_of(rows_of(visits), visits.vehicle)
    here = (visits.place < LENGTH) & visits.excited & (visits.seconds >= 60.0 * CHANGE)
    passes = np.zeros(LENGTH, np.int64)
    seen = np.full(LENGTH, UNREACHED)
    fusion = Fusion(LATENESS_S)
    for part in np.split(np.arange(len(visits)), np.flatnonzero(here) + 1):
        if not len(part) or (seen < UNREACHED).all():
            continue
        fusion.update(observations.take(part))
        if here[part[-1]]:
            cell = visits.place[part[-1]]
            passes[cell] += 1
            if seen[cell] == UNREACHED and _has_seen(fusion, int(cell), after < before):
                seen[cell] = passes[cell]
    return seen


def _has_seen(fusion: Fusion, cell: int, ice: bool) -> bool:
    slot = fusion.slots_of(CELL[cell : cell + 1], np.zeros(1, np.int64))[0]
    slippery = float(fusion.beliefs_at_last_report(np.array([slot]))[0] @ mugrid.SLIPPERY_SHARE)
    return slippery > RAISE_ABOVE if ice else slippery < CLEAR_BELOW


def measure(seeds: range) -> dict[str, float]:
    """Return medians and 95 % quantiles of the detection delays over the cells of all seeds. A
    delay is counted in excited passes (with enough grip used to measure the friction). Also return
    the share of cells in which the change was detected after each number of passes.
    """
    out: dict[str, float] = {}
    for name, before, after in (("ice_onset", DRY, ICE), ("ice_end", ICE, DRY)):
        found: FloatArray = np.concatenate(
            [
                detection_delays(np.random.default_rng([seed, 5]), before, after).astype(float)
                for seed in seeds
            ]
        )
        out[f"fusion.{name}.passes.median"] = float(np.median(found))
        out[f"fusion.{name}.passes.p95"] = float(np.quantile(found, 0.95, method="higher"))
        for passes in range(1, 16):
            out[f"fusion.{name}.share_after.{passes}"] = float(np.mean(found <= passes))
    return out
