"""Benefit and risk of the map as a prior of the friction estimate: error when a vehicle enters a
cell, delay caused by a wrong map, and effect on published records.

The default estimator drives through random towns, and its beliefs and likelihoods are recorded ten
times a second. The maps are applied afterwards, because the filter itself never uses a map. The
maps come from `known_town`, with random errors of the stated standard deviation. Two wrong maps are
tested. The old map shows dry road where the scenario's black ice has appeared since. The fake map
shows ice on equally long stretches that are dry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from edge_agent.ahead.local_map import LocalMap
from edge_agent.ahead.prior import NOWHERE, MapPrior
from edge_agent.app.estimator_factory import bank_of
from edge_agent.inputs.block import Block, to_utc_ns
from edge_agent.lab.simulation import SimulatedFleet
from edge_agent.lab.simulation.roads import LanePoint
from edge_agent.lab.simulation.scenarios import Scenario
from edge_agent.observe.pipeline import Pipeline
from schemas import grid, mugrid
from schemas.config import AgentConfig
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.runtime.figures import Figure
from schemas.thresholds import NS
from tests.benchmarks.ahead.known_town import KnownPlaces, map_of_places, places_of

RATE_HZ: Final = 100.0
BLOCK: Final = 10
FIRST_S: Final = 1.0
# [mu] error at which an estimate has arrived, as in `edge_agent.lab.evaluation`.
ARRIVED: Final = 0.1
START_NS: Final = 1_800_000_000 * NS
BEFORE_S: Final = 0.0  # time of the scenario before any event
FAKE_ICE: Final = 0.15
FAKE_M: Final = 22.0  # half the length of a fake stretch


@dataclass
class FilterTrace:
    """Records of N filters at T instants.

    Attributes:
        place: (T, N) map cell with heading sector, where each vehicle is.
        own: (T, N, 32) logarithms of the probabilities that the filter gives to 32 values of
            friction.
        visit: (T, N, 32) log-likelihood of the same values from the measurements since the vehicle
            entered the place.
        truth: (T, N) true friction.
        published: encoded log-likelihoods in the reports of the vehicles.
    """

    place: IntArray
    own: FloatArray
    visit: FloatArray
    truth: FloatArray
    published: list[bytes]


def entry_figures(seeds: Sequence[int], seconds: float, vehicles: int = 24) -> list[Figure]:
    """Simulate a drive through one town per seed, and return figures over all towns.

    - Error of the friction estimate after a vehicle enters a cell: with the map as a prior, without
      a map, and the ratio of both.
    - Delay until the estimate is right where the map is wrong: the delay with the wrong map,
      divided by the delay without a map.
    - Largest change [nat] that a wrong map causes in the log-likelihoods of published reports. The
      expected value is 0.
    """
    errors: list[FloatArray] = []
    delays: dict[str, list[tuple[float, float]]] = {"dry": [], "ice": []}
    nats = 0.0
    for seed in seeds:
        fleet = SimulatedFleet(f"hills-{seed}", vehicles, seed, RATE_HZ, rough=0.5)
        trace = record_beliefs(fleet, seconds)
        scenario = fleet.scenario
        now = START_NS
        rng = np.random.default_rng(seed)
        true_map = map_of_places(places_of(scenario, seconds), now, rng)
        old_map = map_of_places(places_of(scenario, BEFORE_S), now, rng)
        fake_map = map_of_places(_with_fake_ice(scenario, seconds, rng), now, rng)
        errors.append(entry_errors(trace, true_map, now))
        # "ice": places that are icy although the old map says grip. "dry": places with grip
        # although the fake map says ice.
        for name, wrong in (("ice", old_map), ("dry", fake_map)):
            delays[name] += arrival_times(trace, wrong, true_map, now)
        nats = max(nats, published_change(fleet, trace, seconds))
    with_, without = np.concatenate(errors).T
    out = [
        Figure("prior.entry_error_ratio", float(with_.mean() / without.mean()), "", 0.5),
        Figure("prior.entry_error.with", float(with_.mean()), "mean |error|"),
        Figure("prior.entry_error.without", float(without.mean()), "mean |error|"),
    ]
    both = np.array([pair for pairs in delays.values() for pair in pairs]).reshape(-1, 2)
    out.append(Figure("prior.wrong_map_delay_ratio", _mean_ratio(both), "", 1.2))
    for name, pairs in delays.items():
        out.append(
            Figure(
                f"prior.wrong_map_delay_ratio.{name}_there",
                _mean_ratio(np.array(pairs).reshape(-1, 2)),
                "",
            )
        )
        out.append(Figure(f"prior.wrong_map.{name}_there", len(pairs), "stretches"))
    return [*out, Figure("prior.evidence_nats", nats, "nat", 0.5)]


def record_beliefs(
    fleet: SimulatedFleet, seconds: float, prior: LocalMap | None = None
) -> FilterTrace:
    """Drive a fleet and record the beliefs of its filters and the published reports. If a map
    `prior` is given, each car also combines its belief with that map. The combined belief is not
    recorded; it must not change the reports.
    """
    vehicles = len(fleet.vehicles)
    config = AgentConfig()
    pipeline = Pipeline(bank_of(config.estimator, fleet.vehicles), vehicles, config)
    columns: list[tuple[IntArray, FloatArray, FloatArray, FloatArray]] = []
    published: list[bytes] = []
    informed = MapPrior(vehicles)
    for _ in range(int(seconds * RATE_HZ / BLOCK)):
        t, signals = fleet.step(BLOCK)
        _, seen, _ = pipeline.step(Block(t, to_utc_ns(t, START_NS), signals))
        published += [row.tobytes() for row in seen.columns["log_likelihood"]]
        beliefs = pipeline.beliefs()
        if beliefs is None:
            raise RuntimeError("the default estimator reports no belief")
        if prior is not None:
            now = START_NS
            map_beliefs = {
                k: _belief_or_none(prior, int(pipeline.places[k]), now)
                for k in informed.entered_vehicles(pipeline.places)
            }
            informed.step(pipeline.places, *beliefs, map_beliefs)
        columns.append((pipeline.places, *beliefs, fleet.truth.mu_wheel[-1].mean(axis=1)))
    place, own, visit, truth = (np.stack(column) for column in zip(*columns, strict=True))
    return FilterTrace(place, own, visit, truth, published)


def entry_errors(trace: FilterTrace, known: LocalMap, now: int) -> FloatArray:
    """Return the absolute errors of the estimated median friction, (n, 2), first with and then
    without the map `known` as a prior. The n samples are those within FIRST_S seconds after a
    vehicle entered a cell of this map.
    """
    with_prior = with_map(trace, known, now)
    alone = _median_friction(np.exp(trace.own))
    since = _since_entry(trace.place)
    first = (since * BLOCK / RATE_HZ < FIRST_S) & np.isin(trace.place, known.keys())
    # Leave out the start of the drive, which is not an entry.
    first[: int(RATE_HZ / BLOCK * 5.0)] = False
    return np.column_stack([np.abs(one - trace.truth)[first] for one in (with_prior, alone)])


def arrival_times(
    trace: FilterTrace, wrong: LocalMap, right: LocalMap, now: int
) -> list[tuple[float, float]]:
    """Return, for each stretch of road where the map `wrong` differs from the map `right`, two
    times [s] until a filter's friction estimate is right: with the wrong map as a prior, and
    without a map.

    A time is counted from the entry of the stretch until the estimate differs by at most ARRIVED
    from the true friction. If it never does, the time spent on the stretch counts.
    """
    differ = _maps_differ(trace.place, wrong, right, now)
    with_prior = with_map(trace, wrong, now)
    alone = _median_friction(np.exp(trace.own))
    out = []
    for k in range(trace.place.shape[1]):
        edges = np.flatnonzero(
            np.diff(np.concatenate([[False], differ[:, k], [False]]).astype(np.int8))
        )
        for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            if last - first < RATE_HZ / BLOCK:  # the stretch lasts less than 1 s
                continue
            pair = []
            for one in (with_prior, alone):
                near = np.abs(one[first:last, k] - trace.truth[first:last, k]) <= ARRIVED
                pair.append((int(near.argmax()) if near.any() else last - first) * BLOCK / RATE_HZ)
            out.append((pair[0], pair[1]))
    return out


def published_change(fleet: SimulatedFleet, trace: FilterTrace, seconds: float) -> float:
    """Return the largest change [nat] of a published likelihood of friction that a completely wrong
    map causes. It must be 0, because the map never enters a published report.
    """
    seed = int(fleet.scenario.name.split("-")[1])
    again = SimulatedFleet(fleet.scenario, len(fleet.vehicles), seed, RATE_HZ, rough=0.5)
    short = min(seconds, 20.0)
    lie = places_of(fleet.scenario, 0.0)
    heard_lie = map_of_places(lie._replace(mu=np.where(lie.mu < 0.4, 0.9, 0.15)), START_NS)
    other = record_beliefs(again, short, heard_lie).published
    count = min(len(other), len(trace.published))
    if not count:
        return float("nan")
    pairs = (
        np.frombuffer(b"".join(rows[:count]), np.uint8).astype(np.float64)
        for rows in (other, trace.published)
    )
    a, b = pairs
    return float(np.abs(a - b).max()) / mugrid.STEPS_PER_NAT


def with_map(trace: FilterTrace, known: LocalMap, now: int) -> FloatArray:
    """Return the median friction (T, N) of the N filters at T instants, after their recorded
    beliefs were combined with the map `known` as a prior.
    """
    prior = MapPrior(trace.place.shape[1])
    out = np.empty(trace.place.shape)
    for t, place in enumerate(trace.place):
        map_beliefs = {
            k: _belief_or_none(known, int(place[k]), now) for k in prior.entered_vehicles(place)
        }
        out[t] = mugrid.quantiles(prior.step(place, trace.own[t], trace.visit[t], map_beliefs), 0.5)
    return out


def _belief_or_none(known: LocalMap, place: int, now: int) -> FloatArray | None:
    return known.belief_at(place, now) if place != NOWHERE else None


def _median_friction(weights: FloatArray) -> FloatArray:
    return mugrid.quantiles(weights, 0.5)


def _since_entry(place: IntArray) -> IntArray:
    out = np.zeros(place.shape, np.int64)
    for t in range(1, len(place)):
        out[t] = np.where(place[t] == place[t - 1], out[t - 1] + 1, 0)
    return out


def _maps_differ(place: IntArray, wrong: LocalMap, right: LocalMap, now: int) -> BoolArray:
    """Return an array (T, N) that compares two maps at each `place` (T, N): True if only one of
    them shows a slippery road and their median frictions differ by more than 0.3.
    """
    keys, inverse = np.unique(place, return_inverse=True)
    one, other = (known.look_up(keys, now).mu for known in (wrong, right))
    with np.errstate(invalid="ignore"):
        apart = (np.abs(one - other) > 0.3) & ((one < 0.4) != (other < 0.4))
    return np.asarray(apart[inverse.reshape(place.shape)])


def _with_fake_ice(scenario: Scenario, t: float, rng: np.random.Generator) -> KnownPlaces:
    places = places_of(scenario, t)
    points = scenario.network.points
    mu = places.mu.copy()
    latitude, longitude = grid.centre(places.key // grid.SECTORS)
    x, y = scenario.from_latlon(latitude, longitude)
    for row in points[rng.integers(0, len(points), 6)]:
        near = np.hypot(x - row[LanePoint.X], y - row[LanePoint.Y]) <= FAKE_M
        mu[near & (mu > 0.5)] = FAKE_ICE
    return places._replace(mu=mu)


def _mean_ratio(pairs: FloatArray) -> float:
    return (
        float(pairs[:, 0].sum() / pairs[:, 1].sum())
        if len(pairs) and pairs[:, 1].sum() > 0.0
        else float("nan")
    )
