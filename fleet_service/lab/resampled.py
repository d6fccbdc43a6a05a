"""Simulated visits (passages of cells) in a town, with reports that have the errors of the real
estimator: each report is drawn from the estimator's own reports on simulated drives. Pure (no I/O).

The errors that `agent` draws follow the assumptions of the service, so a map of its reports looks
too good. This module therefore uses errors that the real estimator made.

A town vehicle drives in the town; a source vehicle comes from the simulated drives. Each town
vehicle is assigned one source vehicle, so that all its reports have the same persistent errors
(offsets, a tilted sensor, tyres). The report for a town visit is drawn from all visits of the
source vehicle to roads of similar friction. If the source vehicle has no such visit, a visit of any
source vehicle is drawn. Both visits are "excited" (enough grip was used to measure the friction),
or neither is. The report is then scaled to the town's friction:

    μ, μ_w   friction of the road in the town visit, and in the source visit             (n,)
    c        μ/μ_w, scale factor: value, interval and grip used are multiplied by c, because
             forces scale with the grip; the log-likelihood ℓ(x) becomes ℓ(x/c)

Visits at the border of two surfaces are drawn too, see SIMILAR. Each visit is drawn separately, so
an error that all vehicles share in one place does not occur here. The evaluation of complete drives
(`end_to_end`) includes such errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.random import Generator

from fleet_service.fusion.shared import manoeuvre_of
from fleet_service.lab.agent import SimulatedReports
from fleet_service.lab.town import Visits
from schemas import mugrid
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.thresholds import EXCITED_SHARE, Z_95

# Largest ratio between the frictions of a town visit and of the source visit drawn for it, in
# either direction. Most visits of a source vehicle have one of a few frictions. Visits at the
# border of two surfaces have frictions between these, so a small ratio draws them too often: 11 %
# of the excited visits of ten drives are at a border, but 61, 50, 27 and 19 % of those drawn in
# three towns with the ratios 1.05, 1.1, 1.22 and 1.35 (71 % if one of the eight most similar visits
# is drawn). In six towns, these four ratios gave coverages of .918, .938, .955 and .983.
SIMILAR: Final = 1.22


class TrueVisits(NamedTuple):
    """True values of visits, each (m,): number of the vehicle, start [ns], mean friction, and
    largest share of the friction that was used.
    """

    vehicle: IntArray
    enter: IntArray
    mu: FloatArray
    share: FloatArray


class DrivenVisits(NamedTuple):
    """Visits of simulated drives with the real estimator, each attribute (k,).

    Attributes:
        vehicle: number of the vehicle.
        mu: true friction.
        excited: True if enough grip was used to measure the friction.
        reports: reports of the real estimator.
    """

    vehicle: IntArray
    mu: FloatArray
    excited: BoolArray
    reports: SimulatedReports


def attach_truth(observations: dict[str, Any], truth: TrueVisits) -> DrivenVisits:
    """Return the observations of a drive (columns of `end_to_end.read_observations`) with the true
    values at the middle of each visit.
    """
    vehicle = observations["vehicle"].astype(np.int64)
    middle = (observations["enter_time"] + observations["leave_time"]) // 2
    order = np.lexsort((truth.enter, truth.vehicle))
    row = np.empty(len(middle), np.int64)
    for who in np.unique(vehicle).tolist():
        own = order[truth.vehicle[order] == who]
        here = vehicle == who
        row[here] = own[np.maximum(np.searchsorted(truth.enter[own], middle[here], "right") - 1, 0)]
    along = observations["used_longitudinal"]
    across = observations["used_lateral"]
    reading = observations["mu"].astype(float)
    std = (observations["mu_upper"] - observations["mu_lower"]).astype(float) / (2.0 * Z_95)
    reports = SimulatedReports(
        reading,
        np.where(np.isnan(reading), np.nan, std),
        np.nan_to_num(observations["mu_utilised"].astype(float)),
        np.maximum(manoeuvre_of(along, across), 0).astype(np.int64),
        mugrid.decode_log_likelihood(observations["log_likelihood"]),
    )
    return DrivenVisits(vehicle, truth.mu[row], truth.share[row] >= EXCITED_SHARE, reports)


def join_ways(ways: Sequence[DrivenVisits]) -> DrivenVisits:
    """Return the visits of several drives as one. Vehicles of different drives remain different
    vehicles.
    """
    begins = np.cumsum([0, *(int(way.vehicle.max()) + 1 for way in ways)])
    columns = zip(*(vars(way.reports).values() for way in ways), strict=True)
    return DrivenVisits(
        np.concatenate([way.vehicle + begin for way, begin in zip(ways, begins[:-1], strict=True)]),
        np.concatenate([way.mu for way in ways]),
        np.concatenate([way.excited for way in ways]),
        SimulatedReports(*(np.concatenate(column) for column in columns)),
    )


def resample_visits(rng: Generator, visits: Visits, ways: DrivenVisits, vehicles: int) -> Visits:
    """Return the visits in a town with reports drawn from the simulated drives `ways`. Each of the
    `vehicles` vehicles of the town is assigned one vehicle of the drives and gets reports of this
    vehicle. Where that vehicle visited no road of similar friction, a report of any vehicle of the
    drives is used. If the drives have enough vehicles, each is assigned at most once.
    """
    driven_vehicles = np.unique(ways.vehicle)
    who = rng.choice(driven_vehicles, vehicles, replace=vehicles > len(driven_vehicles))
    row = np.empty(len(visits), np.int64)
    for excited in (False, True):
        by_friction = np.flatnonzero(ways.excited == excited)
        by_friction = by_friction[np.argsort(ways.mu[by_friction], kind="stable")]
        for vehicle in range(vehicles):
            visit_rows = np.flatnonzero((visits.vehicle == vehicle) & (visits.excited == excited))
            mu = visits.mu[visit_rows]
            drawn, _ = _draw_similar(rng, mu, ways.mu, by_friction)
            own_rows = by_friction[ways.vehicle[by_friction] == who[vehicle]]
            if len(own_rows):
                own, is_similar = _draw_similar(rng, mu, ways.mu, own_rows)
                drawn = np.where(is_similar, own, drawn)
            row[visit_rows] = drawn
    return replace(visits, reports=_scale_reports(ways.reports, row, visits.mu / ways.mu[row]))


def _draw_similar(
    rng: Generator, mu: FloatArray, of: FloatArray, rows: IntArray
) -> tuple[IntArray, BoolArray]:
    """Draw a visit of similar friction (SIMILAR) for each friction in `mu` (n,). All such visits
    are equally probable. Visits near the border of two surfaces are still more frequent than in the
    drives, because their frictions lie between those of the surfaces.

    Return indices into `of` (n,), and a mask (n,): False where no visit has a similar friction. The
    visit is then the one with the next higher friction, or else the one with the highest.

    Args:
        rng: random generator.
        mu: wanted frictions (n,).
        of: friction of every visit (k,).
        rows: indices into `of` of the visits that may be drawn (m,), at least one, in increasing
            order of their friction.
    """
    first = np.searchsorted(of[rows], mu / SIMILAR)
    last = np.searchsorted(of[rows], mu * SIMILAR, side="right")
    drawn = first + rng.integers(0, np.maximum(last - first, 1))
    return rows[np.minimum(drawn, len(rows) - 1)], last > first


def _scale_reports(reports: SimulatedReports, row: IntArray, by: FloatArray) -> SimulatedReports:
    """Return n reports of the estimator on other roads: the reports in the rows `row` (n,),
    converted to a road whose friction is `by` (n,) times as large.
    """
    width = (mugrid.UPPER - mugrid.LOWER) / mugrid.BINS
    place = np.clip(
        (mugrid.CENTRES / by[:, None] - mugrid.CENTRES[0]) / width, 0.0, mugrid.BINS - 1.0
    )
    left = np.minimum(place.astype(np.int64), mugrid.BINS - 2)
    reported = reports.log_likelihood[row]
    part = place - left
    below, above = (np.take_along_axis(reported, at, axis=1) for at in (left, left + 1))
    return SimulatedReports(
        reports.reading[row] * by,
        reports.std[row] * by,
        reports.used[row] * by,
        reports.manoeuvre[row],
        below + part * (above - below),
    )
