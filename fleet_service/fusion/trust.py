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
from typing import NamedTuple

import numpy as np

from fleet_service.fusion import constants as c
from schemas.numeric import BoolArray, Float32Array, FloatArray, IntArray, compiled

NOBODY = -1


class Speakers(NamedTuple):
    """The last SPEAKERS vehicles that gave a value in each slot, (slots, SPEAKERS): who (index and number), when [ns],
    and what."""

    vehicle: IntArray
    number: IntArray
    time: IntArray
    mean: Float32Array
    std: Float32Array


class Peers(NamedTuple):
    """Whom each vehicle met, (vehicles, PEERS), NOBODY where free; the pair's rank, agreement and meetings."""

    other: IntArray
    rank: IntArray
    agreed: Float32Array
    met: Float32Array


def no_speakers(slots: int) -> Speakers:
    """Nobody spoke."""
    shape = (slots, c.SPEAKERS)
    return Speakers(
        np.full(shape, NOBODY, np.int64), np.zeros(shape, np.int64), np.zeros(shape, np.int64),
        np.zeros(shape, np.float32), np.zeros(shape, np.float32),
    )  # fmt: skip


def no_peers(vehicles: int) -> Peers:
    """Nobody met."""
    shape = (vehicles, c.PEERS)
    return Peers(
        np.full(shape, NOBODY, np.int64), np.zeros(shape, np.int64), np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
    )  # fmt: skip


@compiled
def meet(
    speakers: Speakers, peers: Peers, slot: int, vehicle: int, number: int, time: int, mean: float, std: float
) -> None:  # fmt: skip
    """Let a value meet those that others gave here lately, and take the place of its vehicle's own, or the oldest."""
    place = 0
    for k in range(c.SPEAKERS):
        other = speakers.vehicle[slot, k]
        if other == vehicle:
            place = k
            break
        if speakers.time[slot, k] < speakers.time[slot, place]:
            place = k
    for k in range(c.SPEAKERS):
        other = speakers.vehicle[slot, k]
        if other in (NOBODY, vehicle) or time - speakers.time[slot, k] > c.PEER_NS:
            continue
        spread = math.hypot(std, float(speakers.std[slot, k]))
        if spread > c.PEER_STD:
            continue
        deviations = abs(mean - speakers.mean[slot, k]) / spread
        agreement = (c.PEERS_DISAGREE - deviations) / (c.PEERS_DISAGREE - c.PEERS_AGREE)
        agreement = min(max(agreement, 0.0), 1.0)
        others = speakers.number[slot, k]
        _note(peers, vehicle, other, _rank(number, others), agreement)
        _note(peers, other, vehicle, _rank(others, number), agreement)
    speakers.vehicle[slot, place] = vehicle
    speakers.number[slot, place] = number
    speakers.time[slot, place] = time
    speakers.mean[slot, place] = mean
    speakers.std[slot, place] = std


@compiled
def _rank(vehicle: int, other: int) -> int:
    """A fixed random number of a pair, by their own numbers and not by the order in which they came.

    Of all that share a place the lowest stays, so that a rare companion is as likely to be kept as a frequent one; or
    those that talk most would crowd out the others.
    """
    mixed = np.uint64(vehicle) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(other) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0x94D049BB133111EB)
    return int(np.int64(mixed >> np.uint64(33)))


@compiled
def _note(peers: Peers, vehicle: int, other: int, rank: int, agreement: float) -> None:
    place = rank % c.PEERS
    known = peers.other[vehicle, place]
    if known != other:
        if known != NOBODY and peers.rank[vehicle, place] < rank:
            return
        peers.rank[vehicle, place] = rank
        peers.other[vehicle, place] = other
        peers.agreed[vehicle, place] = 0.0
        peers.met[vehicle, place] = 0.0
    peers.agreed[vehicle, place] += agreement
    peers.met[vehicle, place] += 1.0
    if peers.met[vehicle, place] > c.PEER_MEMORY:
        peers.agreed[vehicle, place] *= 0.5
        peers.met[vehicle, place] *= 0.5


def trusted(peers: Peers, before: Float32Array) -> tuple[Float32Array, bool]:
    """Trust of each vehicle, (V,), from whom it met and their trust `before`, (V,); whether the service is established.

    In an established one, who has met few that are trusted is a newcomer.
    """
    vehicles = len(before)
    other, met = peers.other[:vehicles], peers.met[:vehicles]
    theirs = np.maximum(before, c.TRUST_HEARD_LEAST)[np.maximum(other, 0)]
    weight = np.where(other != NOBODY, theirs, 0.0) * np.minimum(met, 1.0)
    agreement = peers.agreed[:vehicles] / np.maximum(met, 1.0)
    heard = weight.sum(axis=1)
    mean = (c.TRUST_PRIOR * c.TRUST_PRIOR_PEERS + (weight * agreement).sum(axis=1)) / (c.TRUST_PRIOR_PEERS + heard)
    trust = _scaled(mean)
    known: BoolArray = heard >= c.ESTABLISHED_PEERS
    established = int((known & (trust >= c.WITNESS_TRUST)).sum()) >= c.ESTABLISHED_VEHICLES
    if established:
        trust = np.where(known, trust, np.minimum(trust, c.NEWCOMER))
    return trust.astype(np.float32), established


def newcomer(established: bool) -> float:
    """Weight of a vehicle that met nobody yet."""
    weight = float(_scaled(np.array([c.TRUST_PRIOR]))[0])
    return min(weight, c.NEWCOMER) if established else weight


def _scaled(mean: FloatArray) -> FloatArray:
    return np.clip((mean - c.TRUST_NONE) / (c.TRUST_FULL - c.TRUST_NONE), 0.0, 1.0)
