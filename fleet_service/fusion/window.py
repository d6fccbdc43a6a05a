"""The observations of the lateness window: kept per cell in order of time, folded in it whatever order they come in.

A cell has two rows: `kept`, the belief after everything older than the checkpoint, and `live`, that after the window.
A newcomer at the end of the order is folded onto `live`; one in between refolds the window from `kept`. `settle` moves
the checkpoint. Both rows see the same operations in the same order, so that they agree bit for bit.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion import constants as c
from fleet_service.fusion.belief import BOUND, VALUE, describe, doubt, forget, kind_of, spread, vote
from fleet_service.fusion.cells import NOBODY, WITNESSES, Cells, copy_slot
from fleet_service.fusion.table import EMPTY, locate
from fleet_service.fusion.trust import Peers, Speakers, meet
from schemas import mugrid
from schemas.numeric import ByteArray, Float32Array, FloatArray, IntArray, compiled

NONE: Final = -1
_VEHICLE_BITS: Final = 32  # of a pair's key: slot in the upper half, vehicle in the lower


class Links(NamedTuple):
    """First and last entry of each slot's window, (slots,); NONE where it is empty."""

    head: IntArray
    tail: IntArray


class Entries(NamedTuple):
    """One observation in one cell, (m,); a pool with a stack of free places.

    `identity` (m, 4) is (vehicle, boot, region, place in the stream), the order of equal times. `mean`, `std`, `share`
    describe the vote; `power`, `last_mean`, `last_std`, `spent`, `fresh` say what the same vehicle had said before.
    """

    free: IntArray
    unused: IntArray
    previous: IntArray
    following: IntArray
    slot: IntArray
    time: IntArray
    identity: IntArray
    vehicle: IntArray
    evidence: ByteArray
    weight: Float32Array
    kind: NDArray[np.int8]
    fresh: NDArray[np.int8]
    mean: Float32Array
    std: Float32Array
    share: Float32Array
    power: Float32Array
    last_mean: Float32Array
    last_std: Float32Array
    spent: Float32Array


class Pairs(NamedTuple):
    """What a vehicle last said in a cell before the checkpoint: hash table; columns are the kinds BOUND and VALUE."""

    keys: IntArray
    time: IntArray
    mean: Float32Array
    std: Float32Array
    spent: Float32Array


def no_links(slots: int) -> Links:
    """Empty windows."""
    return Links(np.full(slots, NONE, np.int64), np.full(slots, NONE, np.int64))


def no_entries(places: int) -> Entries:
    """A pool of free places."""

    def whole() -> IntArray:
        return np.full(places, NONE, np.int64)

    def single() -> Float32Array:
        return np.zeros(places, np.float32)

    return Entries(
        free=np.arange(places - 1, -1, -1, dtype=np.int64), unused=np.array([places]),
        previous=whole(), following=whole(), slot=whole(), time=whole(), identity=np.zeros((places, 4), np.int64),
        vehicle=whole(), evidence=np.zeros((places, mugrid.BINS), np.uint8), weight=single(),
        kind=np.zeros(places, np.int8), fresh=np.zeros(places, np.int8), mean=single(), std=single(), share=single(),
        power=single(), last_mean=single(), last_std=single(), spent=single(),
    )  # fmt: skip


def no_pairs(places: int) -> Pairs:
    """An empty table."""
    return Pairs(
        np.full(places, EMPTY),
        np.zeros((places, 2), np.int64),
        np.zeros((places, 2), np.float32),
        np.zeros((places, 2), np.float32),
        np.zeros((places, 2), np.float32),
    )


@compiled
def absorb(
    live: Cells, kept: Cells, links: Links, entries: Entries, pairs: Pairs,
    slots: IntArray, time: IntArray, identity: IntArray, vehicle: IntArray, weight: Float32Array, evidence: ByteArray,
) -> None:  # fmt: skip
    """Take observations (n,) into their windows and fold them onto `live`. `entries` must have n free places."""
    p, likelihood = np.empty(mugrid.BINS), np.empty(mugrid.BINS)
    for i in range(len(slots)):
        entries.unused[0] -= 1
        entry = entries.free[entries.unused[0]]
        slot = slots[i]
        entries.slot[entry] = slot
        entries.time[entry] = time[i]
        entries.identity[entry] = identity[i]
        entries.vehicle[entry] = vehicle[i]
        entries.weight[entry] = weight[i]
        entries.evidence[entry] = evidence[i]
        kind = kind_of(evidence[i])
        spread(evidence[i], kind, likelihood)
        mean, std, share = describe(likelihood)
        entries.kind[entry] = kind
        entries.mean[entry] = mean
        entries.std[entry] = max(std, c.NOVELTY_STD)
        entries.share[entry] = share
        _link(links, entries, slot, entry)
        if entries.following[entry] != NONE:
            copy_slot(kept, live, slot)
            entry = links.head[slot]
        while entry != NONE:
            _recall(entries, pairs, entry)
            _fold(live, entries, entry, p, likelihood)
            entry = entries.following[entry]


@compiled
def settle(
    kept: Cells, links: Links, entries: Entries, pairs: Pairs, speakers: Speakers, peers: Peers,
    slots: IntArray, before: int,
) -> int:  # fmt: skip
    """Fold the entries of `slots` older than `before` [ns] onto `kept`; returns how many new pairs there are.

    Values that pass meet those of others, which is what reputation is made of.
    """
    p, likelihood = np.empty(mugrid.BINS), np.empty(mugrid.BINS)
    added = 0
    for slot in slots:
        entry = links.head[slot]
        while entry != NONE and entries.time[entry] < before:
            _fold(kept, entries, entry, p, likelihood)
            if entries.kind[entry] == VALUE:
                vehicle, number = entries.vehicle[entry], entries.identity[entry, 0]
                mean, std = float(entries.mean[entry]), float(entries.std[entry])
                meet(speakers, peers, slot, vehicle, number, entries.time[entry], mean, std)
            added += _remember(pairs, entries, entry)
            entries.free[entries.unused[0]] = entry
            entries.unused[0] += 1
            entry = entries.following[entry]
        links.head[slot] = entry
        if entry == NONE:
            links.tail[slot] = NONE
        else:
            entries.previous[entry] = NONE
    return added


@compiled
def _earlier(entries: Entries, a: int, b: int) -> bool:
    if entries.time[a] != entries.time[b]:
        return bool(entries.time[a] < entries.time[b])
    for k in range(4):
        if entries.identity[a, k] != entries.identity[b, k]:
            return bool(entries.identity[a, k] < entries.identity[b, k])
    return False


@compiled
def _link(links: Links, entries: Entries, slot: int, entry: int) -> None:
    """Put an entry at its place in time; from the end, where nearly all belong."""
    after = links.tail[slot]
    while after != NONE and _earlier(entries, entry, after):
        after = entries.previous[after]
    following = links.head[slot] if after == NONE else entries.following[after]
    entries.previous[entry] = after
    entries.following[entry] = following
    if after == NONE:
        links.head[slot] = entry
    else:
        entries.following[after] = entry
    if following == NONE:
        links.tail[slot] = entry
    else:
        entries.previous[following] = entry


@compiled
def _recall(entries: Entries, pairs: Pairs, entry: int) -> None:
    """How much of a vote is new, from what its vehicle said here before: in the window, or before the checkpoint."""
    vehicle, kind = entries.vehicle[entry], int(entries.kind[entry])
    time, mean, std, spent = 0, np.float32(0.0), np.float32(0.0), np.float32(0.0)
    seen, found = False, False
    earlier = entries.previous[entry]
    while earlier != NONE and not found:
        if entries.vehicle[earlier] == vehicle:
            seen = True
            if entries.kind[earlier] == kind:
                found = True
                time, mean, std = entries.time[earlier], entries.last_mean[earlier], entries.last_std[earlier]
                spent = entries.spent[earlier]
        earlier = entries.previous[earlier]
    if not found:
        place = locate(pairs.keys, (entries.slot[entry] << _VEHICLE_BITS) | vehicle)
        if pairs.keys[place] != EMPTY:
            seen = True
            if pairs.time[place, kind] > 0:
                found = True
                time, mean, std = pairs.time[place, kind], pairs.mean[place, kind], pairs.std[place, kind]
                spent = pairs.spent[place, kind]
    new_mean, new_std = entries.mean[entry], entries.std[entry]
    power = np.float32(1.0)
    if found:
        renewed = -math.expm1(-(entries.time[entry] - time) * 1e-9 / c.VOTE_RENEWAL_S)
        spent *= np.float32(1.0 - renewed)
        novelty = 0.0
        if entries.time[entry] - time >= c.REVISIT_S * 1e9:
            novelty = _novelty(kind, float(mean), float(std), float(new_mean), float(new_std))
        power = np.float32(max(renewed, min(novelty, c.VOTES - float(spent))))
        new_mean = mean + power * (new_mean - mean)
        new_std = std + power * (new_std - std)
    entries.power[entry] = power
    entries.last_mean[entry] = new_mean
    entries.last_std[entry] = new_std
    entries.spent[entry] = spent + power
    entries.fresh[entry] = 0 if seen else 1


@compiled
def _novelty(kind: int, mean: float, std: float, new_mean: float, new_std: float) -> float:
    if kind == BOUND:  # the mean of "at least u" against the uniform prior moves by half of u
        share = 2.0 * (new_mean - mean) / c.NOVELTY_UTILISED
    else:
        deviations = abs(new_mean - mean) / math.hypot(std, new_std)
        share = (deviations - c.NOVELTY_FROM) / (c.NOVELTY_FULL - c.NOVELTY_FROM)
    return min(max(share, 0.0), 1.0)


@compiled
def _fold(cells: Cells, entries: Entries, entry: int, p: FloatArray, likelihood: FloatArray) -> None:
    """Fold one entry onto its slot."""
    slot, time, power = entries.slot[entry], entries.time[entry], entries.power[entry]
    kind, weight = int(entries.kind[entry]), entries.weight[entry]
    p[:] = cells.belief[slot]
    seconds = 0.0
    if cells.visits[slot] == 0:
        cells.first[slot] = time
    else:
        seconds = (time - cells.time[slot]) * 1e-9
        if cells.crowd[slot, 0] > 0.0 or cells.crowd[slot, 1] > 0.0:
            cells.crowd[slot] *= np.float32(math.exp(-max(seconds, 0.0) / c.VOTE_RENEWAL_S))
        forget(p, seconds)
    if 0.0 < weight < c.WITNESS_TRUST:
        weight = _crowded(cells, slot, kind, power, weight)
    if kind == VALUE and cells.visits[slot] > 0:
        doubt(p, seconds, power * weight)
    spread(entries.evidence[entry], kind, likelihood)
    vote(p, likelihood, 1.0 - (1.0 - c.CONTAMINATION) * weight, power)
    cells.belief[slot] = p.astype(np.float32)
    cells.time[slot] = time
    cells.visits[slot] += 1
    cells.vehicles[slot] += entries.fresh[entry]
    if kind == VALUE:
        cells.values[slot] += power * weight
        if weight >= c.WITNESS_TRUST and entries.share[entry] >= c.WITNESS_SHARE:
            _witness(cells, slot, entries.vehicle[entry], time)


@compiled
def _crowded(cells: Cells, slot: int, kind: int, power: float, weight: float) -> np.float32:
    """Weight of a vote among others that are not trusted either: the k-th new one counts 1/k², all together 1.6 votes.

    So names cost nothing and bring nothing. A vehicle's repeated vote is discounted by its `power` already.
    """
    crowd = cells.crowd[slot, kind]
    cells.crowd[slot, kind] = crowd + np.float32(power)
    return np.float32(weight / (1.0 + crowd) ** 2)


@compiled
def _witness(cells: Cells, slot: int, vehicle: int, time: int) -> None:
    """Note a witness: at its own place if it has one, else at that of the oldest."""
    place = 0
    for k in range(WITNESSES):
        if cells.witness[slot, k] == vehicle:
            place = k
            break
        if cells.witnessed[slot, k] < cells.witnessed[slot, place]:
            place = k
    cells.witness[slot, place] = vehicle
    cells.witnessed[slot, place] = time


@compiled
def _remember(pairs: Pairs, entries: Entries, entry: int) -> int:
    place = locate(pairs.keys, (entries.slot[entry] << _VEHICLE_BITS) | entries.vehicle[entry])
    added = 1 if pairs.keys[place] == EMPTY else 0
    kind = int(entries.kind[entry])
    pairs.keys[place] = (entries.slot[entry] << _VEHICLE_BITS) | entries.vehicle[entry]
    pairs.time[place, kind] = entries.time[entry]
    pairs.mean[place, kind] = entries.last_mean[entry]
    pairs.std[place, kind] = entries.last_std[entry]
    pairs.spent[place, kind] = entries.spent[entry]
    return added


def witnesses(cells: Cells, slots: IntArray, since: int) -> IntArray:
    """Distinct vehicles, at most WITNESSES, that called each slot slippery after `since` [ns]; (k,)."""
    spoken = (cells.witness[slots] != NOBODY) & (cells.witnessed[slots] > since)
    return np.asarray(spoken.sum(axis=1))
