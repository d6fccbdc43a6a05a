"""Evaluation of the map in short simulated situations in which it could become wrong. The
situations are reports that are only lower bounds of friction, an outage of the network, careful
drivers on ice, and a wet curve.

The true friction is known, because it is simulated. The module does no I/O.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from google.protobuf import json_format
from numpy.random import Generator

from fleet_service.fusion import Fusion, Observations, observations_of
from fleet_service.fusion.weather import Reports
from fleet_service.lab import agent, town
from fleet_service.lab.agent import Errors, Passes
from fleet_service.lab.drive import CELL, LATENESS_S, rows_of
from fleet_service.lab.town import START, Visits
from fleet_service.serve.alerts import Alerts
from schemas import grid, mugrid, wire
from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import GRAVITY, NS
from schemas.wire import Batch, Kind

USED: Final = (0.05, 0.12, 0.24, 0.48, 0.7)
BOUNDED: Final = 100  # number of vehicles that report only a lower bound
BACKLOG: Final = 20  # number of vehicles with an outage
HOUR_S: Final = 3600.0
ICE = 0.18
DRY = 0.85
FREEZING_C: Final = -1.0
# number of vehicles in the wet curve, and of simulated curves
CARS = 60
CURVES = 20
WET = 0.60
WINTER: Final = agent.CLEAN._replace(share=(0.25, 0.35), low=0.65, tyres=-0.05, usual_share=1.0)
# Share of these passes that look like values; with common tyres it is a tenth to a third.
VALUED: Final = 0.3


def bound_excess(used: float, path: str) -> float:
    """Return by how much the map's lower limit of friction in a cell exceeds the reported lower
    bound, after BOUNDED vehicles drove through the cell.

    Each vehicle used the grip `used` and did not measure the friction. The result is the lower end
    of the map's interval of friction, minus the larger of `used` and the lower end of the prior's
    interval. A positive result means that the map claims too much grip.

    `path` consists of the encoding ("protobuf" or "json") and the content of the reports.
    "posterior" means a median with an interval; "likelihood" means log-likelihoods on the friction
    grid.
    """
    n = BOUNDED
    nan = float("nan")
    cell = np.full(n, CELL[0])
    latitude, longitude = grid.centre(cell)
    columns: dict[str, Any] = {
        "enter_time": START + np.arange(n) * 5 * NS,
        "latitude": latitude,
        "longitude": longitude,
        "yaw": np.zeros(n),
        "mu_utilised": np.full(n, used),
        "mu": np.full(n, nan),
        "mu_lower": np.full(n, nan),
        "mu_upper": np.full(n, nan),
    }
    if "likelihood" in path:
        above = np.where(used > mugrid.CENTRES, -6.0, 0.3 * mugrid.CENTRES)
        columns["log_likelihood"] = np.tile(mugrid.encode_log_likelihood(above), (n, 1))
    else:
        columns |= {
            "mu": np.full(n, 0.9),
            "mu_lower": np.full(n, 0.2),
            "mu_upper": np.full(n, 1.14),
        }
    fusion = Fusion(LATENESS_S)
    for k in range(n):
        one = {name: column[k : k + 1] for name, column in columns.items()}
        fusion.update(
            _decode_batch(
                Batch(Kind.OBSERVATION, "car-1", 1, 0, 1, 1, one), k, as_json="json" in path
            )
        )
    slot = fusion.slots_of(CELL[:1], np.zeros(1, np.int64))
    lower = float(mugrid.quantiles(fusion.beliefs(slot, int(fusion.live.time[slot[0]])), 0.05)[0])
    return lower - max(used, float(mugrid.quantiles(mugrid.PRIOR, 0.05)))


def _decode_batch(batch: Batch, vehicle: int, *, as_json: bool) -> Observations:
    """Encode a batch (message with records) as bytes, and return the observations that the service
    decodes from them.
    """
    payload = wire.encode(batch)
    encoding = wire.ENCODING[Kind.OBSERVATION]
    if as_json:
        message = wire.MESSAGES[Kind.OBSERVATION].FromString(payload)
        payload = json_format.MessageToJson(message).encode()
        encoding = wire.JSON
    found = wire.decode(payload, encoding, Kind.OBSERVATION)
    columns = dict(found.columns)
    given = columns["log_likelihood"].shape[1] > 0
    if not given:
        columns["log_likelihood"] = np.zeros((found.rows, mugrid.BINS), np.uint8)
    identity = {"boot": 1, "region": found.region, "seq": 1, "row": 0}
    columns |= {name: np.full(found.rows, value) for name, value in identity.items()}
    columns["with_likelihood"] = np.full(found.rows, given)
    return observations_of(columns, np.full(found.rows, vehicle))


def lower_excess() -> float:
    """Return the largest excess of the map's lower limit of friction, as computed by
    `bound_excess`. A positive result means that the map claims too much grip.

    The result is the maximum over all combinations of the used grip (USED), the encoding (protobuf,
    JSON), and the content of the reports (posterior, likelihood).
    """
    paths = ("protobuf posterior", "json posterior", "protobuf likelihood", "json likelihood")
    return max(bound_excess(used, path) for used in USED for path in paths)


def backlog_fused(rng: Generator) -> float:
    """Return the share of late observations that still affect the map after an outage of the
    network. An observation is late if the service already has an observation of any vehicle that
    was made more than LATENESS_S later.

    In this situation, vehicles drive for an hour. BACKLOG vehicles have no connection in this hour,
    and their observations arrive together at its end. One other vehicle is connected all the time.
    The service has already received its newest observation when the others arrive, so that most of
    them are late.
    """
    place = town.draw_town(rng, 60, 0.0)
    errors = Errors.draw(rng, BACKLOG + 1)
    visits = town.drive_fleet(rng, place, errors, 60)
    observations = observations_of(rows_of(visits), visits.vehicle)
    live = observations.vehicle == BACKLOG
    fusion = Fusion(LATENESS_S)
    fusion.update(observations.take(live))
    found = [
        fusion.update(observations.take(rows)) for rows in np.array_split(np.flatnonzero(~live), 50)
    ]
    late = np.concatenate([updated.late for updated in found])
    fused = np.concatenate([updated.late_by > 0 for updated in found])
    return float(fused[late].mean())


def safe_excess(rng: Generator) -> float:
    """Return the safe deceleration according to the map minus the truly safe deceleration [m/s²],
    30 minutes after black ice has formed.

    The road was dry for an hour before. On the ice the drivers use a fifth of the grip. The weather
    report states FREEZING_C and no precipitation.
    """
    seconds: FloatArray = np.concatenate(
        [np.sort(rng.random(60)) * HOUR_S, HOUR_S + np.sort(rng.random(60)) * 1800.0]
    )
    icy = seconds >= HOUR_S
    n = len(seconds)
    who = rng.integers(0, 40, len(seconds))
    share: FloatArray = np.where(icy, 0.2, rng.uniform(0.6, 1.0, n))
    mu: FloatArray = np.where(icy, ICE, DRY)
    nothing = np.zeros(n, np.int64)
    passes = Passes(who, mu, np.zeros(n), share, rng.normal(size=n), nothing, ~icy)
    reports = agent.draw_reports(rng, Errors.draw(rng, 40), passes)
    visits = Visits(seconds, who, nothing, mu, ~icy, reports)
    fusion = Fusion(LATENESS_S)
    fusion.update_weather(_make_weather(FREEZING_C))
    fusion.update(observations_of(rows_of(visits), who))
    slot = fusion.slots_of(CELL[:1], np.zeros(1, np.int64))
    lower = mugrid.quantiles(fusion.beliefs(slot, START + int((HOUR_S + 1800.0) * NS)), 0.05)
    return GRAVITY * (float(lower[0]) - ICE)


def _make_weather(temperature: float) -> Reports:
    nothing = np.full((1, mugrid.BINS), np.nan)
    region = grid.region_of(CELL[:1])
    value: FloatArray = np.array([temperature])
    reports = [
        Reports(region, np.array([START + h * 3600 * NS]), value, value, 0.0 * value, nothing)
        for h in (0, 1)
    ]
    return Reports(
        *(np.concatenate(of) for of in zip(*(vars(r).values() for r in reports), strict=True))
    )


def false_alert(rng: Generator) -> bool:
    """Return True if an alert is raised in a wet curve through which CARS vehicles on winter tyres
    drive carefully. The service does not know these vehicles from earlier reports.
    """
    n = CARS
    who = np.arange(CARS)
    share = rng.uniform(*WINTER.share, n)
    valued = rng.random(n) < VALUED
    mu: FloatArray = np.full(n, WET)
    common = np.full(n, WINTER.common * rng.normal())
    turning: IntArray = np.full(n, 2)
    passes = Passes(who, mu, common, share, rng.normal(size=n), turning, valued)
    seconds = np.asarray(20.0 * who, np.float64)
    visits = Visits(
        seconds,
        who,
        0 * who,
        mu,
        valued,
        agent.draw_reports(rng, Errors.draw(rng, n, WINTER), passes),
    )
    observations = observations_of(rows_of(visits), who)
    fusion = Fusion(LATENESS_S)
    alerts = Alerts(fusion)
    raised = False
    for k in range(n):
        raised |= any(
            alert.raised
            for alert in alerts.update(fusion.update(observations.take(np.array([k]))).slots)
        )
    return raised


def measure(seeds: range) -> dict[str, float]:
    """Run all situations of this module, and return their figures by name."""
    few = seeds[:4]
    return {
        "fusion.bounds.lower_excess": lower_excess(),
        "fusion.backlog.fused": min(
            backlog_fused(np.random.default_rng([seed, 13])) for seed in few
        ),
        "fusion.gentle_after_dry.safe_excess": max(
            safe_excess(np.random.default_rng([seed, 17])) for seed in few
        ),
        "fusion.same_manoeuvre.false_alerts": float(
            sum(false_alert(np.random.default_rng([seeds[0], 19, k])) for k in range(CURVES))
        ),
    }
