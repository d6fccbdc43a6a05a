"""Processing of simulated visits (passages of cells) by the service's own code: archive rows →
`observations_of` → `Fusion.update` → alerts.

Deliveries are realistic: a few rows come late (some too late), and some twice; `SequenceTrackers`
drops the duplicates, as in the service.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.random import Generator

from fleet_service.fusion import Fusion, Observations, observations_of
from fleet_service.ingest.dedup import SequenceTrackers
from fleet_service.lab.town import CELLS, START, Visits, cell_numbers
from fleet_service.serve.alerts import Alerts
from schemas import grid, mugrid
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.thresholds import NS
from schemas.wire import Kind

LATENESS_S: Final = 120.0
DELAY_S: Final = 4.0  # [s] mean delay: a batch waits a second, and sometimes for the network
# share of rows that wait in a vehicle's outbox, and their longest delay [s]
LATE_SHARE = 0.02
LATE_S = 300.0
TWICE_SHARE: Final = 0.03
CELL: Final = cell_numbers()


def rows_of(visits: Visits, cells: IntArray = CELL) -> dict[str, Any]:
    """Return simulated visits as the archive columns from which a map is computed; every row is a
    separate batch (message with records).

    `cells` contains the grid number of each place of the town.
    """
    n = len(visits)
    nan = np.full(len(visits), np.nan, np.float32)
    cell = cells[visits.place]
    used = visits.reports.used.astype(np.float32)
    along, across = (
        used * np.array(part, np.float32)[visits.reports.manoeuvre]
        for part in ((1, -1, 0, 0), (0, 0, 1, -1))
    )
    order = np.lexsort((visits.seconds, visits.vehicle))
    seq = np.empty(n, np.int64)
    first = np.searchsorted(visits.vehicle[order], visits.vehicle[order])
    seq[order] = np.arange(n) - first + 1
    return {
        "leave_time": START + (visits.seconds * NS).astype(np.int64),
        "cell": cell,
        "latitude": grid.centre(cell)[0],
        "sector": np.zeros(n, np.int8),
        "yaw": np.zeros(n, np.float32),
        "position_std": np.full(n, 1.5, np.float32),
        "boot": visits.vehicle + 1,
        "region": grid.region_of(cell),
        "seq": seq,
        "row": np.zeros(n, np.int32),
        "with_likelihood": np.ones(n, bool),
        "log_likelihood": mugrid.encode_log_likelihood(visits.reports.log_likelihood),
        "used_longitudinal": along,
        "used_lateral": across,
        "mu": nan,
        "mu_lower": nan,
        "mu_upper": nan,
        "mu_utilised": used,
    }


def draw_arrivals(rng: Generator, visits: Visits) -> tuple[FloatArray, IntArray]:
    """Draw at random how the reports of the visits are delivered: some come late, some twice.
    Return two arrays with one item per delivery: the arrival time [s], in ascending order, and the
    index of the visit.
    """
    n = len(visits)
    delay = rng.exponential(DELAY_S, n) + np.where(
        rng.random(n) < LATE_SHARE, rng.uniform(0.0, LATE_S, n), 0.0
    )
    twice = np.flatnonzero(rng.random(n) < TWICE_SHARE)
    which = np.concatenate([np.arange(n), twice])
    at = visits.seconds[which] + np.concatenate(
        [delay, delay[twice] + rng.exponential(5.0, len(twice))]
    )
    order = np.argsort(at, kind="stable")
    return at[order], which[order]


def novel_deliveries(rows: dict[str, Any], vehicle: IntArray, which: IntArray) -> IntArray:
    """Return the indices of the deliveries that the service accepts: the first delivery of each
    visit. It drops later deliveries of the same visit as duplicates.
    """
    streams = SequenceTrackers()
    kept = []
    region = rows["region"].tolist()
    boot = rows["boot"].tolist()
    seq = rows["seq"].tolist()
    for k, row in enumerate(which.tolist()):
        stream = streams[int(vehicle[row]), boot[row], Kind.OBSERVATION, region[row]]
        if not stream.has_accepted(seq[row]):
            stream.accept(seq[row])
            kept.append(k)
    return np.array(kept, np.int64)


@dataclass
class AlertWatch:
    """Map made from a simulated drive, and its alerts; both are read and stored at some minutes of
    the drive.

    Attributes:
        beliefs: beliefs about the cells by minute, (cells, 32).
        alerted: for each minute read, a mask of cells with an alert.
    """

    fusion: Fusion
    alerts: Alerts
    beliefs: dict[int, FloatArray] = field(default_factory=dict)
    alerted: list[BoolArray] = field(default_factory=list)

    def snapshot(self, minute: int) -> None:
        """Read the map's beliefs (probabilities of each friction) and alerts at a minute of the
        drive, and store them.
        """
        now = START + minute * 60 * NS
        slots = self.fusion.slots_of(CELL, np.zeros(CELLS, np.int64))
        known = slots >= 0
        belief = np.tile(mugrid.PRIOR, (CELLS, 1))
        belief[known] = self.fusion.beliefs(slots[known], now)
        self.alerts.expire(now)
        self.beliefs[minute] = belief
        self.alerted.append(np.isin(slots, list(self.alerts.slots)) & known)


def split_minutes(observations: Observations, at: FloatArray, count: int) -> Iterator[Observations]:
    """Yield, for each of `count` minutes, the observations that arrive in it; `at` (n,) contains
    the arrival times [s], ascending.
    """
    for rows in np.split(np.arange(len(at)), np.searchsorted(at, 60.0 * np.arange(1, count + 1)))[
        :count
    ]:
        yield observations.take(rows)


def watch_drive(
    rng: Generator, visits: Visits, count: int, snapshot_minutes: tuple[int, ...] | None = None
) -> AlertWatch:
    """Deliver simulated visits to a new `Fusion` (a map's beliefs) for `count` minutes. Return the
    map with the beliefs and alerts that were read after each minute, or only at the minutes in
    `snapshot_minutes`.
    """
    rows = rows_of(visits)
    at, which = draw_arrivals(rng, visits)
    kept = novel_deliveries(rows, visits.vehicle, which)
    at = at[kept]
    which = which[kept]
    fusion = Fusion(LATENESS_S)
    watched = AlertWatch(fusion, Alerts(fusion))
    observations = observations_of(rows, visits.vehicle).take(which)
    for minute, part in enumerate(split_minutes(observations, at, count), 1):
        if len(part.time):
            updated = fusion.update(part)
            watched.alerts.update(updated.slots)
        if snapshot_minutes is None or minute in snapshot_minutes:
            watched.snapshot(minute)
    return watched
