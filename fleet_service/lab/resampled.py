"""Errors of the real estimator: its reports on whole ways, resampled for the visits of a town.
Pure.

The synthetic vehicle of `agent` errs as the fusion assumes, which flatters the fusion. Here each
vehicle of a town is one of those of the ways, with all that persists in it (offsets, a tilted
sensor, tyres). Each of its visits is one that this vehicle made on a road nearly as slippery,
excited or not as the town's visit is:

    μ, μ_w   friction of the town's road, and of the road in the visit that is drawn     (n,)
    c        μ/μ_w: forces scale with the grip, so value, interval and grip used do, and ℓ(x)
             becomes ℓ(x/c)

A pass over the border of a surface is drawn as any other. The error that all vehicles of one place
share is not kept, because each visit is drawn by itself; the whole ways cover it.
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

NEAREST: Final = 8  # visits, by friction, of which one is drawn
# |ln c|; beyond it another vehicle's visit is drawn: surfaces of one kind lie closer
FARTHEST: Final = 0.35


class TrueVisits(NamedTuple):
    """True visits of vehicles, (m,): vehicle, first moment [ns], mean friction, largest share of it
    used.
    """

    vehicle: IntArray
    enter: IntArray
    mu: FloatArray
    share: FloatArray


class DrivenVisits(NamedTuple):
    """Visits of whole ways, (k,): vehicle, true friction, whether they were excited, and what
    was reported of them.
    """

    vehicle: IntArray
    mu: FloatArray
    excited: BoolArray
    reports: SimulatedReports


def attach_truth(observations: dict[str, Any], truth: TrueVisits) -> DrivenVisits:
    """Return observations of a way, columns as `end_to_end.read_observations` gives them, with the truth at the
    middle of each.
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
    """Return the visits of several ways as one; vehicles of different ways are different
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
    """Return the town's visits with reports drawn from `ways`. Each of the `vehicles` uses the
    reports of one vehicle there, a different one if there are enough.
    """
    there = np.unique(ways.vehicle)
    who = rng.choice(there, vehicles, replace=vehicles > len(there))
    row = np.empty(len(visits), np.int64)
    for excited in (False, True):
        alike = np.flatnonzero(ways.excited == excited)
        alike = alike[np.argsort(ways.mu[alike], kind="stable")]
        for vehicle in range(vehicles):
            wanted = np.flatnonzero((visits.vehicle == vehicle) & (visits.excited == excited))
            own = _nearest_friction(
                rng, visits.mu[wanted], ways.mu, alike[ways.vehicle[alike] == who[vehicle]]
            )
            others = _nearest_friction(rng, visits.mu[wanted], ways.mu, alike)
            far = (own < 0) | (np.abs(np.log(visits.mu[wanted] / ways.mu[own])) > FARTHEST)
            row[wanted] = np.where(far, others, own)
    return replace(visits, reports=_scale_reports(ways.reports, row, visits.mu / ways.mu[row]))


def _nearest_friction(rng: Generator, mu: FloatArray, of: FloatArray, rows: IntArray) -> IntArray:
    """Return, for each friction, a random one of the NEAREST of `rows`, which are sorted by
    friction; -1 without rows.
    """
    if not len(rows):
        return np.full(len(mu), -1)
    first = np.clip(np.searchsorted(of[rows], mu) - NEAREST // 2, 0, max(len(rows) - NEAREST, 0))
    return np.asarray(rows[first + rng.integers(0, min(NEAREST, len(rows)), len(mu))])


def _scale_reports(reports: SimulatedReports, row: IntArray, by: FloatArray) -> SimulatedReports:
    """Return rows of reports, scaled to roads with `by` times the grip."""
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
