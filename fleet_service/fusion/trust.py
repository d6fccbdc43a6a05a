"""Reputation: how well a vehicle's values agree with those of others in the same cells. Pure, compiled where per row.

Each vehicle keeps a table of the others that it met: how often (`met`) and how well they agreed (`agreed`). Every other
one counts once, however often they met, and in the measure of its own trust. So a group that agrees only with itself is
as large as the number of its members and no larger, in however many cells it drives alone; and once the many distrust
it, its word about others is worth nothing.

Legend
    q    agreement of two values: 1 within PEERS_AGREE standard deviations, 0 from PEERS_DISAGREE on
    ā    mean q of a pair of vehicles over their last meetings
    m    how much the other counts: its trust, TRUST_HEARD_LEAST at least
    T    trust, clip(((a₀ + Σ m·ā) / (n₀ + Σ m) - TRUST_NONE) / (TRUST_FULL - TRUST_NONE), 0, 1)
"""

from __future__ import annotations

import math

import numpy as np

from fleet_service.fusion import constants as c
from fleet_service.fusion.store.records import NOBODY
from schemas.numeric import BoolArray, Float32Array, FloatArray
from schemas.runtime.jit import refcount_free
from schemas.runtime.records import RecordArray
from schemas.thresholds import NS


@refcount_free
def compare(
    reporters: RecordArray, row: int, peers: RecordArray, names: RecordArray, entries: RecordArray, entry: int
) -> None:  # fmt: skip
    """Compare a value with those that others gave here lately; it takes the place of its vehicle's own, or the oldest.

    `names` (V,) are the vehicles' numbers, by index. Who was more probably elsewhere is compared with nobody.
    """
    here = reporters[row]
    if entries[entry].share < c.HERE_SHARE:
        return
    vehicle, now = int(entries[entry].vehicle), entries[entry].time // NS
    mean, std = float(entries[entry].mean), float(entries[entry].std)
    reporter, reported = here.reporter, here.time
    place = 0
    for k in range(c.REPORTERS):
        if reporter[k] == vehicle:
            place = k
            break
        if reported[k] < reported[place]:
            place = k
    for k in range(c.REPORTERS):
        other = int(reporter[k])
        if other == NOBODY or other == vehicle or now - reported[k] > c.PEER_S:  # noqa: SIM109 not known to the compiler
            continue
        spread = math.hypot(std, float(here.std[k]))
        if spread > c.PEER_STD:
            continue
        deviations = abs(mean - here.mean[k]) / spread
        agreement = (c.PEERS_DISAGREE - deviations) / (c.PEERS_DISAGREE - c.PEERS_AGREE)
        agreement = min(max(agreement, 0.0), 1.0)
        _note(peers, vehicle, other, _rank(names[vehicle].key, names[other].key), agreement)
        _note(peers, other, vehicle, _rank(names[other].key, names[vehicle].key), agreement)
    reporter[place] = vehicle
    reported[place] = now
    here.mean[place] = mean
    here.std[place] = std


@refcount_free
def _rank(vehicle: int, other: int) -> int:
    """A fixed random number of a pair, by their own numbers and not by the order in which they came.

    Of all that share a place the lowest stays, so that a rare companion is as likely to be kept as a frequent one; or
    those that report most would displace the others.
    """
    mixed = np.uint64(vehicle) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(other) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0x94D049BB133111EB)
    return int(np.int64(mixed >> np.uint64(33)))


@refcount_free
def _note(peers: RecordArray, vehicle: int, other: int, rank: int, agreement: float) -> None:
    place = rank % c.PEERS
    known = peers[vehicle].other[place]
    if known != other:
        if known != NOBODY and peers[vehicle].rank[place] < rank:
            return
        peers[vehicle].rank[place] = rank
        peers[vehicle].other[place] = other
        peers[vehicle].agreed[place] = 0.0
        peers[vehicle].met[place] = 0.0
    peers[vehicle].agreed[place] += agreement
    peers[vehicle].met[place] += 1.0
    if peers[vehicle].met[place] > c.PEER_MEMORY:
        peers[vehicle].agreed[place] *= 0.5
        peers[vehicle].met[place] *= 0.5


def trusted(peers: RecordArray, before: Float32Array) -> tuple[Float32Array, bool]:
    """Trust of each vehicle, (V,), from whom it met and their trust `before`, (V,); whether the service is established.

    In an established one, who has met few that are trusted is a newcomer.
    """
    vehicles = len(before)
    other, met = peers["other"][:vehicles], peers["met"][:vehicles].astype(np.float64)
    theirs = np.maximum(before.astype(np.float64), c.TRUST_HEARD_LEAST)[np.maximum(other, 0)]
    weight = np.where(other != NOBODY, theirs, 0.0) * np.minimum(met, 1.0)
    agreement = peers["agreed"][:vehicles] / np.maximum(met, 1.0)
    heard = weight.sum(axis=1)
    mean = (c.TRUST_PRIOR * c.TRUST_PRIOR_PEERS + (weight * agreement).sum(axis=1)) / (c.TRUST_PRIOR_PEERS + heard)
    trust = _scaled(mean)
    known: BoolArray = heard >= c.ESTABLISHED_PEERS
    established = int((known & (trust >= c.SOURCE_TRUST)).sum()) >= c.ESTABLISHED_VEHICLES
    if established:
        trust = np.where(known, trust, np.minimum(trust, c.NEWCOMER))
    return trust.astype(np.float32), established


def newcomer(established: bool) -> float:
    """Weight of a vehicle that was compared with nobody yet."""
    weight = float(_scaled(np.array([c.TRUST_PRIOR]))[0])
    return min(weight, c.NEWCOMER) if established else weight


def _scaled(mean: FloatArray) -> FloatArray:
    return np.clip((mean - c.TRUST_NONE) / (c.TRUST_FULL - c.TRUST_NONE), 0.0, 1.0)
