"""Trust in vehicles, computed by comparison with other vehicles in the same cells. Pure; loops over
rows are compiled.

Two vehicles meet when both report a friction value in the same cell within PEER_S. For each vehicle
the service stores the other vehicles that it met: how often (`met`) and how well they agreed
(`agreed`). Every other vehicle counts once, weighted by the trust in it, however often the two met.
So colluding vehicles cannot gain trust by many meetings with each other. Once they are distrusted,
their agreement has only the weight TRUST_HEARD_LEAST.

The module does not estimate a vehicle's constant error: differences between vehicles show only
which of two reads higher. It estimates one number for the whole fleet: by how much a friction value
is too low if the vehicle used little of the grip (`shape_of`). The estimate uses two visits of one
vehicle to one cell, because a constant error of the vehicle cancels in the difference of their
values.

Legend
    q    agreement of two values: 1 within PEERS_AGREE standard deviations, 0 from PEERS_DISAGREE on
    ā    mean q of a pair of vehicles over their last meetings
    m    weight of the other vehicle: its trust, at least TRUST_HEARD_LEAST and at most 1
    n₀   TRUST_PRIOR_PEERS, number of imagined other vehicles with which every vehicle starts
    a₀   share of the imagined vehicles with which it agreed: 1 - CONTAMINATION, or 1 -
         CONTAMINATION_LEAST if the service accepts only enrolled vehicles
    g    share of agreement of a vehicle; the sums run over the other vehicles
    T    trust, from 0 at g = TRUST_NONE to 1 at g = TRUST_FULL, linear between them
    ε    assumed share of wrong values of a vehicle
    r    weight of the vehicle's votes

    g = (n₀·a₀ + Σ m·ā) / (n₀ + Σ m)
    ε = 1 - g, limited to the range from CONTAMINATION_LEAST to CONTAMINATION, for a known or
        enrolled vehicle
    ε = CONTAMINATION, for other vehicles
    r = T·(1 - ε) / (1 - CONTAMINATION)

A vehicle is known if it has been compared with at least ESTABLISHED_PEERS other vehicles.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from fleet_service.fusion import constants
from fleet_service.fusion.shared import Shape
from fleet_service.fusion.store.records import NONE, USED
from fleet_service.fusion.vote_weights import VoteWeights
from schemas import mugrid
from schemas.numeric import BoolArray, Float32Array
from schemas.runtime.jit import refcount_free, refcount_free_locked
from schemas.runtime.records import RecordArray
from schemas.thresholds import NS, SLIPPERY_MU

# Assumed share of agreement of an enrolled vehicle that has not been compared with others: the
# operator vouches for it, so it starts like a vehicle that agreed with all others.
_ENROLLED_AGREEMENT: Final = 1.0 - constants.CONTAMINATION_LEAST
_AGREEMENT: Final = 1.0 - constants.CONTAMINATION
# Relative; no vehicle measures μ more exactly than the rounding to bins allows, 1 % on dry road.
_LEAST_VARIANCE: Final = constants.BIAS_ABSOLUTE**2
# Places of a vehicle's record among which another vehicle may have its place. Twice the number that
# makes a vehicle known, so the first meetings of a vehicle displace each other only if more than
# this many fall into one group.
_GROUP: Final = 2 * int(constants.ESTABLISHED_PEERS)


@refcount_free
def compare_reports(
    reporters: RecordArray,
    row: int,
    peers: RecordArray,
    names: RecordArray,
    entries: RecordArray,
    entry: int,
) -> None:
    """Compare a vehicle's friction value with the recent values of other vehicles in the cell, and
    record how well each pair of vehicles agrees. Then store the value in the place of the vehicle's
    earlier value, or else of the oldest value. Do nothing if the value is late.

    Args:
        reporters: recent values of each cell (`ReportersRecord`).
        row: row of this cell in `reporters`.
        peers: agreement of each vehicle with others (`PeersRecord`), one row per vehicle.
        names: records with the vehicles' permanent numbers (`VehicleRecord`), in the rows of
            `peers`.
        entries: observations (`EntryRecord`).
        entry: row of the new value in `entries`.
    """
    if entries[entry].late:
        return
    here = reporters[row]
    vehicle = int(entries[entry].vehicle)
    now = entries[entry].time // NS
    mean = float(entries[entry].mean)
    std = float(entries[entry].std)
    place = _find_place(reporters, row, vehicle)
    if here.reporter[place] == vehicle:
        _compare_visits(reporters, row, place, peers, entries, entry)
    for k in range(constants.REPORTERS):
        other = int(here.reporter[k])
        if other == NONE or other == vehicle:  # noqa: SIM109 Numba does not compile `in (...)`
            continue
        if now - here.time[k] > constants.PEER_S:
            continue
        spread = math.hypot(
            max(std, constants.NOVELTY_STD), max(float(here.std[k]), constants.NOVELTY_STD)
        )
        if spread > constants.PEER_STD:
            continue
        agreement = _rate_agreement(abs(mean - here.mean[k]) / spread)
        _record_meeting(
            peers, vehicle, other, _pair_rank(names[vehicle].key, names[other].key), agreement
        )
        _record_meeting(
            peers, other, vehicle, _pair_rank(names[other].key, names[vehicle].key), agreement
        )
    here.reporter[place] = vehicle
    here.time[place] = now
    here.mean[place] = mean
    here.std[place] = std
    here.used[place] = entries[entry].used / USED


@refcount_free
def _find_place(reporters: RecordArray, row: int, vehicle: int) -> int:
    """Return the place of a vehicle's friction value among the recent values of the cell in row
    `row`, or else the place of the oldest value.
    """
    here = reporters[row]
    place = 0
    for k in range(constants.REPORTERS):
        if here.reporter[k] == vehicle:
            return k
        if here.time[k] < here.time[place]:
            place = k
    return place


@refcount_free
def _compare_visits(
    reporters: RecordArray,
    row: int,
    place: int,
    peers: RecordArray,
    entries: RecordArray,
    entry: int,
) -> None:
    """Compare a vehicle's new friction value (row `entry`) with its earlier value in the same cell
    (place `place`), and add the result to the sums of `shape_of`. Do nothing if the visits are too
    near or too far apart in time, or if the road has probably changed in between.
    """
    here = reporters[row]
    age = entries[entry].time // NS - here.time[place]
    if age < constants.REVISIT_S or age > constants.PEER_S:
        return
    mean = float(entries[entry].mean)
    before = float(here.mean[place])
    both = 0.5 * (mean + before)
    difference = (mean - before) / both
    variance = _own_variance(mean, float(entries[entry].std)) + _own_variance(
        before, float(here.std[place])
    )
    # only if both values belong to the same road
    if difference * difference < constants.PEERS_DISAGREE**2 * variance:
        used = (entries[entry].used / USED - here.used[place]) / both
        _note_shape(peers, int(entries[entry].vehicle), used, difference, variance)


@refcount_free
def _rate_agreement(deviations: float) -> float:
    """Return the agreement q in [0, 1] of two friction values that differ by `deviations` standard
    deviations of their difference.
    """
    agreement = (constants.PEERS_DISAGREE - deviations) / (
        constants.PEERS_DISAGREE - constants.PEERS_AGREE
    )
    return min(max(agreement, 0.0), 1.0)


@refcount_free
def judge_flag(
    reporters: RecordArray, row: int, peers: RecordArray, entries: RecordArray, entry: int
) -> None:
    """Compare an intervention of a vehicle's slip controller (a flag) with the newest value that
    another vehicle recently gave in this cell; count a confirmation or a contradiction of the flag.

    A value supports a side (slippery or not) only if it is at least its standard deviation away
    from SLIPPERY. The vehicle's own value of the same visit is not a confirmation, because the flag
    and the value come from the same slip.
    """
    if entries[entry].late:
        return
    here = reporters[row]
    vehicle = int(entries[entry].vehicle)
    now = entries[entry].time // NS
    newest = 0
    deviation = 0.0
    for k in range(constants.REPORTERS):
        other = int(here.reporter[k])
        time = int(here.time[k])
        if other == NONE or other == vehicle:  # noqa: SIM109 Numba does not compile `in (...)`
            continue
        if now - time > constants.PEER_S or time <= newest:
            continue
        newest = time
        deviation = (SLIPPERY_MU - here.mean[k]) / max(float(here.std[k]), constants.NOVELTY_STD)
    this = peers[vehicle]
    if deviation >= 1.0:
        this.flags_confirmed += np.float32(1.0)
    elif deviation <= -1.0:
        this.flags_contradicted += np.float32(1.0)
    if this.flags_confirmed + this.flags_contradicted > constants.PEERS:
        this.flags_confirmed *= np.float32(0.5)
        this.flags_contradicted *= np.float32(0.5)


@refcount_free
def _note_shape(
    peers: RecordArray, vehicle: int, used: float, difference: float, variance: float
) -> None:
    """Add one comparison of two visits to the sums from which `shape_of` estimates the slope. The
    slope is the amount by which a friction value is too low per unit of unused grip.

    Both visits are of one vehicle to one cell, so that a constant relative error of the vehicle
    cancels in the difference of the two friction values.

    Args:
        peers: comparison records (`PeersRecord`), one row per vehicle.
        vehicle: index of the vehicle.
        used: difference of the grip used in the two visits, divided by the mean of the two values.
        difference: difference of the two friction values, divided by their mean.
        variance: variance of `difference`.
    """
    this = peers[vehicle]
    this.used_squares += np.float32(used * used / variance)
    this.used_products += np.float32(used * difference / variance)
    if this.used_squares > constants.SHAPE_MEMORY:
        this.used_squares *= np.float32(0.5)
        this.used_products *= np.float32(0.5)


@refcount_free
def _own_variance(mean: float, std: float) -> float:
    """Return the relative variance of a reported friction value, without the part that the
    vehicle's constant bias contributes.
    """
    return max((std / max(mean, mugrid.LOWER)) ** 2 - constants.BIAS_RELATIVE**2, _LEAST_VARIANCE)


@refcount_free
def _pair_rank(vehicle: int, other: int) -> int:
    """Return a fixed pseudo-random number of two vehicles, by which pairs of vehicles are ranked.
    It depends only on the permanent numbers of the two vehicles, so the order in which the vehicles
    report has no influence.

    A vehicle's record has only PEERS places for other vehicles, in groups of _GROUP places. If more
    vehicles need a place in a group, those with the lowest numbers get one. Without this rule, the
    vehicles that report most often would displace the rarely met ones.
    """
    mixed = np.uint64(vehicle) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(other) * np.uint64(
        0xBF58476D1CE4E5B9
    )
    mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0x94D049BB133111EB)
    return int(np.int64(mixed >> np.uint64(33)))


@refcount_free
def _record_meeting(
    peers: RecordArray, vehicle: int, other: int, rank: int, agreement: float
) -> None:
    this = peers[vehicle]
    first = rank % constants.PEERS // _GROUP * _GROUP
    place = first
    for k in range(first, first + _GROUP):
        if this.other[k] == other:
            place = k
            break
        if this.other[place] != NONE and (this.other[k] == NONE or this.rank[k] > this.rank[place]):
            place = k  # empty, or the vehicle with the highest number so far
    known = this.other[place]
    if known != other:
        if known != NONE and this.rank[place] < rank:
            return
        this.rank[place] = rank
        this.other[place] = other
        this.agreed[place] = 0.0
        this.met[place] = 0.0
    this.agreed[place] += agreement
    this.met[place] += 1.0
    if this.met[place] > constants.PEER_MEMORY:
        this.agreed[place] *= 0.5
        this.met[place] *= 0.5


def compute_vote_weights(
    peers: RecordArray, before: VoteWeights, epoch: int, *, enrolled: bool
) -> VoteWeights:
    """Return the vote weights (trust) of the vehicles (V,) from the minute `epoch` on, from their
    agreement with other vehicles. `before` contains the previous weights.

    A vehicle is known once it has been compared with enough others (ESTABLISHED_PEERS, counted by
    their weights). A service is established once ESTABLISHED_VEHICLES vehicles are known and
    trusted. In an established service, a vehicle that is not known is a newcomer: its weight is at
    most NEWCOMER, so that an attacker gains nothing by reporting under a new name.

    `enrolled` is True if the service accepts only vehicles on the operator's list. Then nobody can
    invent a name: no vehicle is a newcomer, and each starts with full weight (`initial_trust`).
    """
    weight = np.empty(len(before.weight), np.float32)
    known = np.empty(len(weight), np.bool_)
    established = _update_weights(peers, before.weight, enrolled, known, weight) == 1
    return VoteWeights(
        epoch,
        weight,
        initial_trust(established=established, enrolled=enrolled),
        heeded_flags(peers[: len(weight)]),
    )


@refcount_free_locked
def _update_weights(
    peers: RecordArray, before: Float32Array, enrolled: bool, known: BoolArray, out: Float32Array
) -> int:
    """Fill `out` (V,) with the new weights (trust) of the vehicles, computed from the previous
    weights `before`, and `known` (V,) with a mask of the vehicles compared with enough others.

    Return 1 if newcomers got less weight: the service knows and trusts enough vehicles, and accepts
    vehicles that are not on the operator's list. Otherwise return 0.
    """
    trusted = 0
    prior = _ENROLLED_AGREEMENT if enrolled else _AGREEMENT
    for v in range(len(out)):
        this = peers[v]
        weight_sum = 0.0
        agreed = 0.0
        for k in range(constants.PEERS):
            if this.other[k] != NONE:
                theirs = float(before[this.other[k]])
                met = float(this.met[k])
                weight = max(min(theirs, 1.0), constants.TRUST_HEARD_LEAST) * min(met, 1.0)
                weight_sum += weight
                agreed += weight * float(this.agreed[k]) / max(met, 1.0)
        mean = (prior * constants.TRUST_PRIOR_PEERS + agreed) / (
            constants.TRUST_PRIOR_PEERS + weight_sum
        )
        trust = _scale_trust(mean)
        known[v] = weight_sum >= constants.ESTABLISHED_PEERS
        if known[v]:
            trusted += trust >= constants.SOURCE_TRUST
        out[v] = _known_weight(mean) if known[v] or enrolled else trust
    if enrolled or trusted < constants.ESTABLISHED_VEHICLES:
        return 0
    for v in range(len(out)):
        if not known[v]:
            out[v] = min(float(out[v]), constants.NEWCOMER)
    return 1


def heeded_flags(peers: RecordArray) -> BoolArray:
    """Return a mask of vehicles (V,): True if interventions of the vehicle's slip controllers
    (flags) may support an alert.

    For each vehicle the service counts cells where other vehicles confirmed or contradicted a flag.
    The count starts with TRUST_PRIOR_PEERS imagined cells, of which a share 1 - CONTAMINATION was
    confirmed. If the share of confirmations is below TRUST_NONE, the flags support no alert. For
    example, the flags of a vehicle that always reports an intervention support no alert after two
    dry cells.
    """
    right = _AGREEMENT * constants.TRUST_PRIOR_PEERS + peers["flags_confirmed"]
    whole = constants.TRUST_PRIOR_PEERS + peers["flags_confirmed"] + peers["flags_contradicted"]
    return np.asarray(right >= constants.TRUST_NONE * whole)


def shape_of(peers: RecordArray, weight: Float32Array) -> Shape:
    """Return the slope λ in [0, 1] by which the fleet's values are too low per unit of μ left
    unused, and its standard error.

    The slope comes from differences between visits of the same vehicle to the same cell, in which a
    constant error of the vehicle cancels. λ does not correct values. It determines how far the
    interval of a value is widened upwards if little grip was used (`shared.Shape`).
    """
    vehicles = len(weight)
    trust = np.minimum(weight.astype(np.float64), 1.0)
    prior = 1.0 / constants.SHAPE_PRIOR**2
    squares = float((trust * peers["used_squares"][:vehicles]).sum())
    products = float((trust * peers["used_products"][:vehicles]).sum())
    slope = (products + constants.SHAPE_PRIOR * prior) / (squares + prior)
    return Shape(float(np.clip(slope, 0.0, 1.0)), (squares + prior) ** -0.5)


def initial_trust(*, established: bool = False, enrolled: bool = False) -> float:
    """Return the weight of a vehicle that has not been compared with others yet.

    If the service accepts only `enrolled` vehicles, it is the weight of a vehicle that agreed with
    all others. Otherwise it is at most NEWCOMER if the service is `established`, which means that
    it knows and trusts enough other vehicles.
    """
    if enrolled:
        return float(_known_weight(_ENROLLED_AGREEMENT))
    weight = _scale_trust(_AGREEMENT)
    return min(weight, constants.NEWCOMER) if established else weight


@refcount_free_locked
def _known_weight(agreement: float) -> float:
    """Return the vote weight r of a known or enrolled vehicle from its share of agreement g. It is
    above 1 if the vehicle disagreed with others in less than the share CONTAMINATION.
    """
    right = min(agreement, 1.0 - constants.CONTAMINATION_LEAST) / (1.0 - constants.CONTAMINATION)
    return _scale_trust(agreement) * max(right, 1.0)


@refcount_free_locked
def _scale_trust(mean: float) -> float:
    return min(
        max((mean - constants.TRUST_NONE) / (constants.TRUST_FULL - constants.TRUST_NONE), 0.0), 1.0
    )
