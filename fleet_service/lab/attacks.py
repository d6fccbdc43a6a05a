"""Attacks on the map: how many alerts a few attackers change, compared with the honest vehicles
alone.

The attackers of `claim_random`, `shifted_pose` and `flood_one_cell` are enrolled vehicles that were
honest, and are therefore trusted, until the attack begins. `add_newcomers` uses new names.
`replay_messages` sends messages through the service's admission: old messages again, other
vehicles' messages under the attacker's key, and old visits (passages of cells) under the attacker's
name. A cell is counted if, at any minute, it has an alert with the attack but none without it, or
the reverse. Raised alerts are counted in dry or wet cells (μ > CLEARLY_DRY), suppressed alerts in
icy cells (μ < CLEARLY_ICY). Only cells are considered in which at least ENOUGH honest vehicles used
enough grip to measure the friction.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.random import Generator

from fleet_service.app.engine import Engine
from fleet_service.ingest.inbox import Message
from fleet_service.lab import agent, town
from fleet_service.lab.agent import Errors, SimulatedReports
from fleet_service.lab.bars import ATTACKS
from fleet_service.lab.drive import CELL, watch_drive
from fleet_service.lab.messages import SentMessage, clock_of, forge_messages, make_messages
from fleet_service.lab.score import excited_vehicles
from fleet_service.lab.town import CELLS, LENGTH, Town, Visits, with_claims
from schemas.config import ServiceConfig
from schemas.numeric import BoolArray, FloatArray, IntArray

VEHICLES = 60
ATTACKERS = 6
FLOODERS = 3
NAMES = 40
# [min] when the attack begins, and length of the drive
BEGIN = 18
MINUTES = 26
FLOOD: Final = 400  # visits of each flooding vehicle to its cell
CLEARLY_DRY = 0.5
CLEARLY_ICY = 0.25
ENOUGH = 5


@dataclass(frozen=True)
class AttackedDrive:
    """Simulated drive of the honest fleet through a town, to which the attacks of this module are
    added. `counted` (cells,) is True for cells in which at least ENOUGH vehicles have measured the
    friction before the attack begins.
    """

    town: Town
    visits: Visits
    counted: BoolArray


def drive_of(rng: Generator) -> AttackedDrive:
    """Return a simulated drive of the honest fleet through a random town."""
    place = town.draw_town(rng, MINUTES, 0.0)
    visits = town.drive_fleet(rng, place, Errors.draw(rng, VEHICLES), MINUTES)
    return AttackedDrive(place, visits, excited_vehicles(visits, place, BEGIN, VEHICLES) >= ENOUGH)


def measure(seeds: range) -> dict[str, float]:
    """Simulate each attack with each of the `seeds`; return, by name of the attack, in how many
    cells it raised or suppressed an alert, summed over the seeds.
    """
    out = dict.fromkeys((f"fusion.attack.{name}" for name in ATTACKS), 0.0)
    for seed in seeds:
        rng = np.random.default_rng([seed, 7])
        drive = drive_of(rng)
        alone = watch_drive(np.random.default_rng([seed, 8]), drive.visits, MINUTES).alerted
        for name, attack in VISITS.items():
            visits = attack(rng, drive)
            attacked = watch_drive(np.random.default_rng([seed, 8]), visits, MINUTES).alerted
            out[f"fusion.attack.{name}"] += count_differing(drive, alone, attacked)
        out["fusion.attack.replayed"] += replay_messages(rng, drive)
    return out


def count_differing(drive: AttackedDrive, alone: list[BoolArray], attacked: list[BoolArray]) -> int:
    """Return the number of cells in which the attack raised or suppressed an alert, compared with
    the alerts `alone` of the same drive without the attack.
    """
    raised = np.zeros(CELLS, bool)
    suppressed = np.zeros(CELLS, bool)
    for minute in range(BEGIN, MINUTES):
        raised |= attacked[minute] & ~alone[minute]
        suppressed |= alone[minute] & ~attacked[minute]
    mu = drive.town.mu[BEGIN]
    return int(
        np.sum(drive.counted & ((raised & (mu > CLEARLY_DRY)) | (suppressed & (mu < CLEARLY_ICY))))
    )


def _attacking_rows(visits: Visits, count: int) -> BoolArray:
    return (visits.vehicle < count) & (visits.seconds >= 60.0 * BEGIN)


def claim_random(rng: Generator, drive: AttackedDrive) -> Visits:
    """Return the visits of a drive with the attackers' reports replaced: at every visit they claim
    a random friction, with high confidence.
    """
    visits = drive.visits
    claim = rng.uniform(0.05, 1.2, len(visits))
    return with_claims(visits, _attacking_rows(visits, ATTACKERS), claim)


def shifted_pose(rng: Generator, drive: AttackedDrive) -> Visits:
    """Return the visits of a drive in which the attackers report wrong cells: their measurements
    are correct, but all their positions are shifted along the town.
    """
    visits = drive.visits
    moved = (visits.place + int(rng.integers(CELLS // 4, 3 * CELLS // 4))) % CELLS
    return Visits(
        visits.seconds,
        visits.vehicle,
        np.where(_attacking_rows(visits, ATTACKERS), moved, visits.place),
        visits.mu,
        visits.excited,
        visits.reports,
    )


def victim_cells(drive: AttackedDrive) -> IntArray:
    """Return the numbers of the two cells that are attacked: the cell with the most friction and
    the cell with the least. Only cells are candidates in which enough honest vehicles measured the
    friction.
    """
    mu = np.where(drive.counted, drive.town.mu[BEGIN], np.nan)
    return np.array([np.nanargmax(mu), np.nanargmin(mu)])


def flood_one_cell(rng: Generator, drive: AttackedDrive) -> Visits:
    """Return the visits of a drive and of the attackers. The attackers send hundreds of false
    reports per minute, of ice in the driest cell and of a dry road in the iciest. The values vary,
    because equal values would count as repetitions.
    """
    count = FLOODERS * FLOOD
    seconds = rng.uniform(60.0 * BEGIN, 60.0 * MINUTES, count)
    which = rng.integers(0, 2, count)
    claim = np.where(which == 0, rng.choice([0.1, 0.3], count), rng.choice([0.7, 1.1], count))
    return _add_visits(
        drive.visits, seconds, rng.integers(0, FLOODERS, count), victim_cells(drive)[which], claim
    )


def add_newcomers(rng: Generator, drive: AttackedDrive) -> Visits:
    """Return the visits of a drive and of the attackers: forty additional vehicle names that each
    pass once and agree with each other. They report ice on the road that contains the driest cell,
    and a dry road on the road that contains the iciest cell.
    """
    roads = victim_cells(drive) // LENGTH * LENGTH
    who, which, along = (
        a.ravel() for a in np.meshgrid(np.arange(NAMES), np.arange(2), np.arange(LENGTH))
    )
    seconds: FloatArray = 60.0 * BEGIN + rng.uniform(0.0, 300.0, NAMES)[who] + 20.0 * which + along
    claim: FloatArray = np.where(which == 0, 0.2, 0.85)
    return _add_visits(drive.visits, seconds, VEHICLES + who, roads[which] + along, claim)


def _add_visits(
    visits: Visits, seconds: FloatArray, vehicle: IntArray, place: IntArray, claim: FloatArray
) -> Visits:
    std = np.full(len(claim), agent.OVERCONFIDENT_STD)
    reports = (
        claim,
        std,
        claim,
        np.zeros(len(claim), np.int64),
        agent.overconfident_likelihood(claim),
    )
    joined = (
        np.concatenate([a, b]) for a, b in zip(vars(visits.reports).values(), reports, strict=True)
    )
    both = Visits(
        np.append(visits.seconds, seconds),
        np.append(visits.vehicle, vehicle),
        np.append(visits.place, place),
        np.append(visits.mu, np.full(len(claim), np.nan)),
        np.append(visits.excited, np.zeros(len(claim), bool)),
        SimulatedReports(*joined),
    )
    return both.take(np.argsort(both.seconds, kind="stable"))


VISITS: Final[dict[str, Callable[[Generator, AttackedDrive], Visits]]] = {
    "random": claim_random,
    "shifted_pose": shifted_pose,
    "flood_one_cell": flood_one_cell,
    "newcomers": add_newcomers,
}


def replay_messages(rng: Generator, drive: AttackedDrive) -> int:
    """Return the number of cells whose alert changes if the attackers send recorded messages of the
    first minutes again. They send each message in three forms: unchanged, under an attacker's Zenoh
    key, and with an attacker's name.
    """
    sent = make_messages(drive.visits)
    at = drive.visits.seconds[[m.last_visit for m in sent]]
    old = np.flatnonzero(at < 60.0 * BEGIN)
    again = rng.choice(old, min(len(old), 600), replace=False)
    forged = [
        m
        for k in again.tolist()
        for m in (sent[k].message, *forge_messages(sent[k].message, VEHICLES + k % NAMES))
    ]
    key = rng.bytes(32)
    alone = _alerts_by_minute(sent, at, [], key)
    attacked = _alerts_by_minute(sent, at, forged, key)
    return count_differing(drive, alone, attacked)


def _alerts_by_minute(
    sent: list[SentMessage], at: FloatArray, forged: list[Message], key: bytes
) -> list[BoolArray]:
    """Send messages through the service's admission, and return the alerts of each minute, as masks
    of cells. `key` determines the permanent numbers of the vehicles, and these numbers determine
    which vehicles the service compares. With the same `key`, two runs therefore differ only by the
    attack.
    """
    out = []
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "keys").mkdir()
        Path(folder, "keys", "witness.key").write_bytes(key)
        engine = Engine(ServiceConfig(), Path(folder))
        for minute in range(MINUTES):
            part = [
                sent[k].message
                for k in np.flatnonzero((at >= 60.0 * minute) & (at < 60.0 * (minute + 1)))
            ]
            extra = forged[minute - BEGIN :: MINUTES - BEGIN] if minute >= BEGIN else []
            engine.intake.ingest([*part, *extra], clock_of(60.0 * (minute + 1)))
            out.append(
                np.isin(
                    engine.state.fusion.slots_of(CELL, np.zeros(CELLS, np.int64)),
                    engine.alerts.slots,
                )
            )
        engine.close()
    return out
