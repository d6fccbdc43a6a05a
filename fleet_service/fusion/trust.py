"""What vehicles are worth, from what others found in the same cells. Pure, compiled where per row.

Each vehicle keeps a table of the others that it met: how often (`met`) and how well they agreed (`agreed`). Every other
one counts once, however often they met, and in the measure of its own trust. So a group that agrees only with itself is
as large as the number of its members and no larger, in however many cells it drives alone; and once the many distrust
it, its word about others is worth nothing.

Values of trusted vehicles that agree tell of each other's errors too. Of the relative differences d of a pair the mean
is the difference of their biases; the fleet's biases are a normal of FLEET_BIAS about nought, which anchors what only
differences show. What the differences of those who did the same scatter beyond the biases, against what both state, is
their spread: more than one, and they are surer than they should be; less, and the rest of what they state is an error
that they share (`shared`). And where who used more of the grip reads more, all read too low who used little: that slope
is the fleet's, for one estimator and one kind of tyre have one shape.

So errors have three levels: the fleet, the kind of tyres where it is told, the vehicle. A level that little is known of
is drawn towards the one above: biases of a kind are a normal of TYRE_BIAS about the fleet's, its slope one of
TYRE_SLOPE_STD about the fleet's. A vehicle that nobody met has the errors of its kind.

Legend
    q    agreement of two values: 1 within PEERS_AGREE standard deviations, 0 from PEERS_DISAGREE on
    ā    mean q of a pair of vehicles over their last meetings
    m    how much the other counts: its trust, TRUST_HEARD_LEAST at least
    g    share that agreed, (a₀ + Σ m·ā) / (n₀ + Σ m)
    T    trust, clip((g - TRUST_NONE) / (TRUST_FULL - TRUST_NONE), 0, 1)
    r    weight: T·min(g, 1 - CONTAMINATION_LEAST) / (1 - CONTAMINATION), T at the least known
    b    bias, mean of d + b_other by weight 1/(σ_d²/n + σ_b_other²), and 1/FLEET_BIAS² of its kind's
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from fleet_service.fusion import constants as c
from fleet_service.fusion.standing import TYRES, Standing
from fleet_service.fusion.store.records import LATE, NOBODY, USED
from schemas import mugrid
from schemas.numeric import Float32Array, FloatArray
from schemas.runtime.jit import compiled, refcount_free
from schemas.runtime.records import RecordArray
from schemas.thresholds import NS

_LEAST_VARIANCE: Final = 1e-4  # nobody reads to a hundredth


class Comparison(NamedTuple):
    """A comparison: agreement, relative differences of the values and of the grip used, variance that both state of the
    first; 0 where the values are not of one road; whether both did the same, and whether both have tyres of one kind
    and are so sure of themselves that the shape of these is not in what they state; variance of the noise of the grip
    used, relative."""

    agreement: float
    difference: float
    used: float
    variance: float
    alike: bool
    shaped: bool
    noise: float


@refcount_free
def compare(
    reporters: RecordArray, row: int, peers: RecordArray, names: RecordArray, entries: RecordArray, entry: int
) -> None:  # fmt: skip
    """Compare a value with those that others gave here lately; it takes the place of its vehicle's own, or the oldest.

    `names` (V,) are the vehicles' numbers, by index. Who was more probably elsewhere, or comes late, is compared with
    nobody.
    """
    here = reporters[row]
    if entries[entry].share < c.HERE_SHARE or entries[entry].tyre == LATE:
        return
    vehicle, now = int(entries[entry].vehicle), entries[entry].time // NS
    peers[vehicle].tyre = entries[entry].tyre
    mean, std = float(entries[entry].mean), float(entries[entry].std)
    used, manoeuvre = entries[entry].used / USED, int(entries[entry].manoeuvre)
    own = _own_variance(mean, std) if entries[entry].weight >= c.TELLING_TRUST else 0.0
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
        spread = math.hypot(max(std, c.NOVELTY_STD), max(float(here.std[k]), c.NOVELTY_STD))
        if spread > c.PEER_STD:
            continue
        deviations = abs(mean - here.mean[k]) / spread
        agreement = (c.PEERS_DISAGREE - deviations) / (c.PEERS_DISAGREE - c.PEERS_AGREE)
        agreement = min(max(agreement, 0.0), 1.0)
        both = 0.5 * (mean + here.mean[k])
        variance = own + here.own[k] if own > 0.0 and here.own[k] > 0.0 and agreement > 0.0 else 0.0
        alike = manoeuvre == here.manoeuvre[k] and abs(used - here.used[k]) < c.ALIKE_USED * both
        shaped = max(own, here.own[k]) < c.SHAPED_VARIANCE and peers[vehicle].tyre == peers[other].tyre
        noise = c.USED_NOISE**2 + (c.USED_NOISE_ABSOLUTE / both) ** 2
        found = Comparison(
            agreement, (mean - here.mean[k]) / both, (used - here.used[k]) / both, variance, alike, shaped, noise
        )
        opposite = Comparison(agreement, -found.difference, -found.used, variance, alike, shaped, noise)
        _note(peers, vehicle, other, _rank(names[vehicle].key, names[other].key), found)
        _note(peers, other, vehicle, _rank(names[other].key, names[vehicle].key), opposite)
    reporter[place] = vehicle
    reported[place] = now
    here.mean[place] = mean
    here.std[place] = std
    here.own[place] = own
    here.used[place] = used
    here.manoeuvre[place] = manoeuvre


@refcount_free
def _own_variance(mean: float, std: float) -> float:
    """Relative variance of a value beside its bias."""
    return max((std / max(mean, mugrid.LOWER)) ** 2 - c.BIAS_RELATIVE**2, _LEAST_VARIANCE)


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
def _note(peers: RecordArray, vehicle: int, other: int, rank: int, found: Comparison) -> None:
    this, variance = peers[vehicle], found.variance
    agreement, difference = found.agreement, found.difference
    if variance > 0.0 and found.alike:
        this.stated += np.float32(variance)
        this.found += np.float32(difference * difference - 2.0 * c.BIAS_RELATIVE**2)
        if this.stated > c.SPREAD_MEMORY:
            this.stated *= np.float32(0.5)
            this.found *= np.float32(0.5)
    if variance > 0.0 and found.shaped:
        this.used_squares += np.float32((found.used * found.used - 2.0 * found.noise) / variance)
        this.used_products += np.float32(found.used * difference / variance)
        if this.used_squares > c.SLOPE_MEMORY:
            this.used_squares *= np.float32(0.5)
            this.used_products *= np.float32(0.5)
    place = rank % c.PEERS
    known = this.other[place]
    if known != other:
        if known != NOBODY and this.rank[place] < rank:
            return
        this.rank[place] = rank
        this.other[place] = other
        this.agreed[place] = 0.0
        this.met[place] = 0.0
        this.weight[place] = 0.0
        this.difference[place] = 0.0
    this.agreed[place] += agreement
    this.met[place] += 1.0
    if this.met[place] > c.PEER_MEMORY:
        this.agreed[place] *= 0.5
        this.met[place] *= 0.5
    if variance > 0.0:
        this.weight[place] += np.float32(1.0 / variance)
        this.difference[place] += np.float32(difference / variance)
        if this.weight[place] > c.BIAS_MEMORY:
            this.weight[place] *= np.float32(0.5)
            this.difference[place] *= np.float32(0.5)


def judged(peers: RecordArray, before: Standing, epoch: int) -> Standing:
    """Standing of the vehicles (V,) from an epoch on, from whom they met and how these stood `before`.

    In an established service, who has met few that are trusted is a newcomer.
    """
    vehicles = len(before.weight)
    weight, error = np.empty(vehicles, np.float32), np.empty((vehicles, 4), np.float32)
    established = _weigh(peers, before.weight, weight)
    kinds = np.empty((TYRES, 4), np.float32)
    found = _find_kinds(peers, before.weight, before.error, kinds)
    _find_errors(peers, found, kinds, error)
    return Standing(epoch, weight, error, initial_trust(established), kinds)


@compiled
def _weigh(peers: RecordArray, before: Float32Array, out: Float32Array) -> bool:
    """Fill the weights of vehicles (V,), from those `before`; returns whether the service is established."""
    known, trusted = np.empty(len(out), np.bool_), 0
    for v in range(len(out)):
        this, heard, agreed = peers[v], 0.0, 0.0
        for k in range(c.PEERS):
            if this.other[k] != NOBODY:
                theirs, met = float(before[this.other[k]]), float(this.met[k])
                weight = max(min(theirs, 1.0), c.TRUST_HEARD_LEAST) * min(met, 1.0)
                heard += weight
                agreed += weight * float(this.agreed[k]) / max(met, 1.0)
        mean = (c.TRUST_PRIOR * c.TRUST_PRIOR_PEERS + agreed) / (c.TRUST_PRIOR_PEERS + heard)
        known[v], trust = heard >= c.ESTABLISHED_PEERS, _scaled(mean)
        if known[v]:
            trusted += trust >= c.SOURCE_TRUST
            trust *= max(min(mean, 1.0 - c.CONTAMINATION_LEAST) / (1.0 - c.CONTAMINATION), 1.0)
        out[v] = trust
    if trusted < c.ESTABLISHED_VEHICLES:
        return False
    for v in range(len(out)):
        if not known[v]:
            out[v] = min(float(out[v]), c.NEWCOMER)
    return True


@compiled
def _find_kinds(peers: RecordArray, before: Float32Array, error: Float32Array, out: Float32Array) -> FloatArray:
    """Fill the errors (TYRES, 4) of vehicles that nobody met by the kind of their tyres, from weights (V,) and errors
    (V, 4) before; each vehicle counts in the measure of its weight. Returns what `_biases` does.

    λ says how much too low values are for each μ that was left: regression of the differences of values upon those of
    the grip used, in the same places. A kind that nobody told is the fleet.
    """
    found, stated, squares, products = np.zeros(TYRES), np.zeros(TYRES), np.zeros(TYRES), np.zeros(TYRES)
    for v in range(len(before)):
        own = min(float(before[v]), 1.0)
        kind = peers[v].tyre
        found[kind] += own * float(peers[v].found)
        stated[kind] += own * float(peers[v].stated)
        squares[kind] += own * float(peers[v].used_squares)
        products[kind] += own * float(peers[v].used_products)
    fleet = (found.sum() + c.SPREAD_FIRST**2 * c.SPREAD_PRIOR) / (stated.sum() + c.SPREAD_PRIOR)
    slope = products.sum() + c.SLOPE_PRIOR / c.SLOPE_STD**2
    slope /= max(squares.sum(), 0.0) + 1.0 / c.SLOPE_STD**2
    biases, bias = _biases(peers, before, error), np.zeros(TYRES)
    whole, products_of = np.full(TYRES, 1.0 / c.TYRE_BIAS**2), np.zeros(TYRES)
    for v in range(len(before)):
        precision = biases[v, 1]
        if precision > 0.0:
            own = min(float(before[v]), 1.0) / (1.0 / precision + c.FLEET_BIAS**2)
            whole[peers[v].tyre] += own
            products_of[peers[v].tyre] += own * biases[v, 0]
    for k in range(TYRES):
        told = k > 0
        bias[k] = products_of[k] / whole[k] if told else 0.0
        of_kind = (found[k] + fleet * c.SPREAD_PRIOR) / (stated[k] + c.SPREAD_PRIOR) if told else fleet
        prior = 1.0 / c.TYRE_SLOPE_STD**2
        of_shape = (products[k] + slope * prior) / (max(squares[k], 0.0) + prior) if told else slope
        out[k, 0] = min(max(bias[k], -c.BIAS_MOST), c.BIAS_MOST)
        out[k, 1] = c.BIAS_RELATIVE
        out[k, 2] = _spread(of_kind, 0.0, 0.0)
        out[k, 3] = min(max(of_shape, 0.0), c.SLOPE_MOST)
    return biases


@compiled
def _biases(peers: RecordArray, before: Float32Array, error: Float32Array) -> FloatArray:
    """What others tell of the vehicles' biases, and how precise it is, (V, 2); precision 0 where nobody does."""
    out = np.zeros((len(before), 2))
    for v in range(len(before)):
        this, precisions, differences = peers[v], 0.0, 0.0
        for k in range(c.PEERS):
            other, weight = this.other[k], float(this.weight[k])
            if other != NOBODY and weight > 0.0:
                precision = 1.0 / max(weight, 1e-9) + c.BIAS_PAIR**2 + float(error[other, 1]) ** 2
                precision = min(float(before[other]), 1.0) / precision
                precisions += precision
                differences += precision * (float(this.difference[k]) / max(weight, 1e-9) + float(error[other, 0]))
        if precisions > 0.0:
            out[v, 0], out[v, 1] = differences / precisions, precisions
    return out


@compiled
def _find_errors(peers: RecordArray, biases: FloatArray, kinds: Float32Array, out: Float32Array) -> None:
    """Fill bias, how well it is known, spread, slope, (V, 4): what others tell (V, 2), drawn towards that of the kind
    of its tyres (TYRES, 4)."""
    for v in range(len(out)):
        kind, precision = kinds[peers[v].tyre], biases[v, 1]
        whole = precision + 1.0 / c.FLEET_BIAS**2
        std = max(math.sqrt(1.0 / whole), c.BIAS_KNOWN_LEAST)
        known = precision > 0.0 and std < c.BIAS_RELATIVE
        bias = (precision * biases[v, 0] + float(kind[0]) / c.FLEET_BIAS**2) / whole
        out[v, 0] = min(max(bias, -c.BIAS_MOST), c.BIAS_MOST) if known else kind[0]
        out[v, 1] = std if known else c.BIAS_RELATIVE
        out[v, 2] = _spread(float(kind[2]) ** 2, float(peers[v].found), float(peers[v].stated))
        out[v, 3] = kind[3]


@compiled
def _spread(fleet: float, found: float, stated: float) -> float:
    """κ of a vehicle from the κ² of the fleet: the fleet's until it is known."""
    squared = (max(fleet, c.SPREAD_FLOOR**2) * c.SPREAD_PRIOR + found) / (c.SPREAD_PRIOR + stated)
    return math.sqrt(min(max(squared, c.SPREAD_FLOOR**2), c.SPREAD_CEILING**2))


def slope_std(peers: RecordArray, standing: Standing) -> float:
    """How well the slope of the fleet's values is known: its standard deviation, SLOPE_STD before anybody told."""
    vehicles = len(standing.weight)
    trust = np.minimum(standing.weight.astype(np.float64), 1.0)
    information = max(float((trust * peers["used_squares"][:vehicles]).sum()), 0.0)
    return float(1.0 / np.sqrt(information + 1.0 / c.SLOPE_STD**2))


def initial_trust(established: bool) -> float:
    """Weight of a vehicle that was compared with nobody yet."""
    weight = _scaled(c.TRUST_PRIOR)
    return min(weight, c.NEWCOMER) if established else weight


@compiled
def _scaled(mean: float) -> float:
    return min(max((mean - c.TRUST_NONE) / (c.TRUST_FULL - c.TRUST_NONE), 0.0), 1.0)
