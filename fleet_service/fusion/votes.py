"""A vote is the effect of one observation on the belief about one cell. This module computes how
much of a vote is new information, and updates the cell. Compiled.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any, Final, NamedTuple

import numpy as np

from fleet_service.fusion import constants
from fleet_service.fusion.belief import (
    PADDED,
    REACH,
    Bins,
    ReportKind,
    apply_vote,
    convolve_bias,
    describe_likelihood,
    ensure_change,
    forget,
    kind_of,
    mean_of,
    mix_prior,
    pack_belief,
    unpack_belief,
)
from fleet_service.fusion.shared import UNKNOWN_SHAPE, fade_weights, note_value
from fleet_service.fusion.sources import note_source
from fleet_service.fusion.store.records import (
    AGED,
    FINE,
    HEEDED,
    LATE_NS,
    NONE,
    UNLIMITED,
    UNTRUSTED,
    USED,
    Rows,
    Side,
)
from fleet_service.fusion.store.settled import oldest_remembered, returning_bit
from fleet_service.fusion.weather import Weather, road_time
from schemas import mugrid
from schemas.excitation import value_probability
from schemas.numeric import Float32Array
from schemas.runtime.jit import refcount_free_inlined
from schemas.runtime.records import RecordArray
from schemas.thresholds import EXCITED_SHARE, NS, SLIPPERY_MU


class ScratchRow(IntEnum):
    """Row number in the scratch memory (3, PADDED), single precision, in which the belief about one
    cell is updated.
    """

    BELIEF = 0
    PADDED = 1  # padded copy for `forget` and `convolve_bias`
    LIKELIHOOD = 2


# A bound is a source of grip if its mean under the uniform prior is at least this, the mean of "μ
# is at least EXCITED_SHARE". Only dry road allows so much grip to be used. On the best roads values
# are cut off at the end of the grid and become bounds, so bounds must count.
_GRIP_MEAN: Final = 0.5 * (EXCITED_SHARE + mugrid.UPPER)
_GRIP_BIN: Final = int(np.searchsorted(mugrid.CENTRES, SLIPPERY_MU))  # first bin above SLIPPERY_MU
_WITNESS_SLOPE: Final = UNKNOWN_SHAPE.alarm
_UNIFORM: Final = np.ones(mugrid.BINS, np.float32)  # likelihood of mean 1 that says nothing
# probability of a value by grip used, in units of 1/USED, and friction bin (256, 32)
_VALUE_PROBABILITY: Final = value_probability(
    np.arange(np.iinfo(np.uint8).max + 1)[:, None] / USED / mugrid.CENTRES
)


@refcount_free_inlined
def describe_vote(entries: RecordArray, entry: int, reported: Float32Array, scratch: Bins) -> None:
    """Fill in four fields of the stored observation in row `entry` of `entries`: its kind (VALUE,
    or BOUND for a lower bound), and mean, standard deviation and P(slippery) of its friction. A
    lower bound gets no standard deviation. Write the observation's likelihood to `scratch` (work
    memory).

    If the vehicle reported a value, the last three fields are copied from `reported` (3,), which is
    otherwise NaN.
    """
    evidence = entries[entry].evidence
    likelihood = scratch[ScratchRow.LIKELIHOOD]
    known = not math.isnan(reported[0])
    kind = ReportKind.VALUE if known else kind_of(evidence)
    entries[entry].kind = kind
    load_likelihood(entries, entry, scratch)
    if known:
        entries[entry].mean = reported[0]
        entries[entry].std = reported[1]
        entries[entry].slippery = reported[2]
        return
    mean = mean_of(likelihood)
    entries[entry].mean = mean
    entries[entry].slippery = 0.0 if mean >= _GRIP_MEAN else constants.UNSURE
    if kind == ReportKind.VALUE:
        std, slippery = describe_likelihood(likelihood, mean)
        entries[entry].std = std
        entries[entry].slippery = slippery


@refcount_free_inlined
def load_likelihood(entries: RecordArray, entry: int, scratch: Bins) -> None:
    """Compute the likelihood of a stored entry (an observation in one cell) again from its reported
    log-likelihood, and write it to `scratch` (work memory).
    """
    _clear_padding(scratch)
    this = entries[entry]
    convolve_bias(
        this.evidence, int(this.kind), scratch[ScratchRow.PADDED], scratch[ScratchRow.LIKELIHOOD]
    )


@refcount_free_inlined
def _clear_padding(scratch: Bins) -> None:
    for i in range(REACH):
        scratch[ScratchRow.PADDED, i] = 0.0
        scratch[ScratchRow.PADDED, PADDED - 1 - i] = 0.0


@refcount_free_inlined
def discount_vote(entries: RecordArray, pairs: RecordArray, entry: int) -> None:
    """Compute the share `power` of a vote (effect of an observation on a cell) that is new
    information, given the vehicle's earlier reports in this cell. Write the result to row `entry`
    of `entries`. Reports that are not yet final are stored one by one, older ones in one record per
    vehicle and cell.

    All times are rounded to whole seconds, because the records of older reports have only whole
    seconds. The result then does not depend on the kind of storage.
    """
    kind = int(entries[entry].kind)
    now = entries[entry].time // NS
    before, is_known = _find_earlier(entries, pairs, entry)
    spent = np.float32(0.0)
    power = np.float32(1.0)
    new_mean = entries[entry].mean
    new_std = max(entries[entry].std, np.float32(constants.NOVELTY_STD))
    if before.time > 0 and before.time >= oldest_remembered(now, kind):
        renewed = -math.expm1(-max(now - before.time, 0) / constants.VOTE_RENEWAL_S)
        spent = before.spent * np.float32(1.0 - renewed)
        novelty = 0.0
        if now - before.time >= constants.REVISIT_S:
            novelty = _novel_share(
                kind, float(before.mean), float(before.std), float(new_mean), float(new_std)
            )
        power = np.float32(max(renewed, min(novelty, constants.VOTES - float(spent))))
        new_mean = before.mean + power * (new_mean - before.mean)
        new_std = before.std + power * (new_std - before.std)
    entries[entry].power = power
    entries[entry].last_mean = _to_parts(new_mean)
    entries[entry].last_std = _to_parts(new_std)
    entries[entry].spent = _to_parts(spent + power)
    entries[entry].fresh = 0 if is_known else 1


class EarlierReport(NamedTuple):
    """Earlier reports of one kind by one vehicle in one cell: time [s] of the last one, 0 for none,
    running mean and standard deviation of the friction, and number of votes that the vehicle has
    used up.
    """

    time: np.int64
    mean: np.float32
    std: np.float32
    spent: np.float32


@refcount_free_inlined
def _find_earlier(
    entries: RecordArray, pairs: RecordArray, entry: int
) -> tuple[EarlierReport, bool]:
    """Return the vehicle's earlier reports in the cell that have the same kind as the observation
    in row `entry`, and True if it has made a report of either kind there.
    """
    kind = int(entries[entry].kind)
    earlier = entries[entry].before
    is_known = earlier != NONE
    while earlier != NONE and entries[earlier].kind != kind:
        earlier = entries[earlier].before
    if earlier != NONE:
        last = entries[earlier]
        report = EarlierReport(
            np.int64(last.time // NS),
            _from_parts(last.last_mean),
            _from_parts(last.last_std),
            _from_parts(last.spent),
        )
        return report, is_known
    pair = pairs[entries[entry].pair]
    now = entries[entry].time // NS
    for other in (ReportKind.BOUND, ReportKind.VALUE):
        is_known = is_known or pair.time[other] >= max(oldest_remembered(now, other), 1)
    report = EarlierReport(
        np.int64(pair.time[kind]),
        _from_parts(pair.mean[kind]),
        _from_parts(pair.std),
        _from_parts(pair.spent[kind]),
    )
    return report, is_known


@refcount_free_inlined
def _to_parts(number: float | np.floating[Any]) -> np.uint16:
    """Convert a mean, a standard deviation or a number of votes to the integer that records store,
    in units of 1/FINE.
    """
    return np.uint16(
        min(max(number * np.float32(FINE) + np.float32(0.5), np.float32(0.0)), np.float32(65535.0))
    )


@refcount_free_inlined
def _from_parts(parts: int) -> np.float32:
    """Convert an integer that a record stores in units of 1/FINE to the mean, standard deviation or
    number of votes that it represents.
    """
    return np.float32(parts) * np.float32(1.0 / FINE)


@refcount_free_inlined
def _novel_share(kind: int, mean: float, std: float, new_mean: float, new_std: float) -> float:
    # If the bound u rises, the mean of "at least u" under the uniform prior rises by half as much.
    if kind == ReportKind.BOUND:
        # It is new in full from two standard deviations of the grip used on.
        share = (new_mean - mean) / constants.UTILISED_STD
    else:
        deviations = abs(new_mean - mean) / math.hypot(std, new_std)
        share = (deviations - constants.PEERS_AGREE) / (
            constants.PEERS_DISAGREE - constants.PEERS_AGREE
        )
    return min(max(share, 0.0), 1.0)


class CellPlace(NamedTuple):
    """Place of one cell in the arrays of `Rows`: row number of its state, and row number of its
    list of vehicles that recently reported ice or grip.
    """

    row: int
    sources: int


@refcount_free_inlined
def update_cell(
    rows: Rows,
    place: CellPlace,
    entries: RecordArray,
    entry: int,
    weather: Weather,
    scratch: Bins,
) -> None:
    """Update a cell by one entry (an observation), whose likelihood is in `scratch`."""
    row, sources = place
    cells = rows.cells
    time = entries[entry].time - entries[entry].late * LATE_NS
    is_value = entries[entry].kind == ReportKind.VALUE
    is_new = cells[row].time == 0
    is_outdated = time < cells[row].time
    p = scratch[ScratchRow.BELIEF]
    unpack_belief(rows.belief, row, p)
    change = 0.0
    prior = 0
    if is_outdated:
        _age_likelihood(scratch, weather, cells[row].key, time, cells[row].time)
    else:
        change, prior = _age_belief(cells, row, time, weather, scratch)
    weight = _limited_weight(cells, row, entries, entry, is_outdated)
    strength = weight * entries[entry].power * entries[entry].share
    if is_value:
        if not is_new and not is_outdated:
            ensure_change(p, change, min(strength, 1.0), weather.prior[prior])
        certainty = min(
            (1.0 - constants.CONTAMINATION) * strength, 1.0 - constants.CONTAMINATION_LEAST
        )
        apply_vote(p, scratch[ScratchRow.LIKELIHOOD], certainty)
    else:
        certainty = (1.0 - constants.BOUND_CONTAMINATION) * min(strength, 1.0)
        apply_vote(p, scratch[ScratchRow.LIKELIHOOD], certainty)
        if entries[entry].limited <= 0 and not is_outdated:
            values = float(cells[row].values)
            noticed = values / (float(cells[row].visits) + 1.0)  # this visit included
            note_silence(p, constants.SILENCE * min(noticed * strength, 1.0), weather.prior[prior])
            if entries[entry].limited == UNLIMITED:
                doubted = (1.0 - constants.BOUND_CONTAMINATION) * min(values, 1.0)
                note_silent_use(p, int(entries[entry].used), doubted * min(strength, 1.0))
    pack_belief(p, rows.belief, row)
    cells[row].time = max(time, cells[row].time)
    _count_visit(cells, row, entries, entry)
    if is_value:
        cells[row].values += np.float32(strength)
        if strength > 0.0:
            note_value(cells, row, entries, entry, strength)
    if entries[entry].weight >= constants.SOURCE_TRUST:
        _note_source(rows, sources, entries, entry, time)


@refcount_free_inlined
def _age_belief(
    cells: RecordArray, row: int, time: int, weather: Weather, scratch: Bins
) -> tuple[float, int]:
    """Age the belief in `scratch` about the cell in row `row` from its last visit to `time` [ns]. A
    cell without visits gets the weather's prior instead.

    Return the road time [s] of sudden changes that the ageing covers (0 if none), and the row of
    `weather.prior` that it mixes in (0: uniform). Ageing for less than FORGET_S is postponed to a
    later visit.
    """
    p = scratch[ScratchRow.BELIEF]
    seconds = 0.0
    if cells[row].time == 0:
        cells[row].first = time
        _, _, initial = road_time(weather, cells[row].key, time, time)
        if initial:
            mix_prior(p, 1.0, weather.prior[initial])
    else:
        seconds = (time - cells[row].time) * 1e-9 + cells[row].aged / AGED
        fade_weights(cells, row, cells[row].time, time)
    if seconds < constants.FORGET_S:
        cells[row].aged = _remembered_parts(seconds)
        return 0.0, 0
    drift, change, prior = road_time(weather, cells[row].key, time - int(seconds * NS), time)
    forget(p, drift, change, weather.prior[prior], scratch[ScratchRow.PADDED])
    cells[row].aged = np.uint16(0)
    return change, prior


@refcount_free_inlined
def _note_source(rows: Rows, sources: int, entries: RecordArray, entry: int, time: int) -> None:
    """Record the vehicle of an observation (row `entry`) of the visit at `time` [ns] in the cell's
    list of vehicles that reported ice or grip (row `sources`), if it shows either clearly.
    """
    vehicle = entries[entry].vehicle
    if is_ice_source(entries, entry):
        note_source(rows.reporters, sources, Side.ICE, vehicle, time)
    elif entries[entry].slippery <= 1.0 - constants.SOURCE_SHARE:
        note_source(rows.reporters, sources, Side.GRIP, vehicle, time)


@refcount_free_inlined
def note_silence(p: Bins, noticed: float, prior: Bins) -> None:
    """Lower P(slippery) of a belief `p` (32,) in place after a visit without a value and without an
    intervention of a slip controller. `noticed` is the probability that a visitor of a slippery
    road gives a value.

    P(slippery) does not fall below the larger of UNSURE and the prior's P(slippery), because such a
    visit can end the certainty of ice but does not show grip.
    """
    if noticed <= 0.0:
        return
    whole = 0.0
    slippery = 0.0
    least = 0.0
    for i in range(mugrid.BINS):
        whole += p[i]
        slippery += mugrid.SLIPPERY_SHARE[i] * p[i]
        least += mugrid.SLIPPERY_SHARE[i] * prior[i]
    least = max(least, constants.UNSURE)
    share = slippery / whole
    if share <= least:
        return
    kept = max(1.0 - noticed, least * (1.0 - share) / (share * (1.0 - least)))
    scale = whole / (whole - (1.0 - kept) * slippery)
    for i in range(mugrid.BINS):
        p[i] *= scale * (1.0 - (1.0 - kept) * mugrid.SLIPPERY_SHARE[i])


@refcount_free_inlined
def note_silent_use(p: Bins, used: int, strength: float) -> None:
    """Lower, in a belief `p` (32,) in place, the probability of roads on which the grip `used`, in
    units of 1/USED, is almost all of the grip, after a visit without a value to a cell with values
    (`schemas.excitation`). `strength` in [0, 1) is the weight of the visit's evidence. Only visits
    of vehicles that state this count (UNLIMITED), because other vehicles may be unable to give a
    value.

    Without this evidence, the few values that gentle drivers give of a dry road count more than the
    many visits that used as much grip and gave none.

    Only the probabilities of grip change among each other. P(slippery) does not change, because a
    visit without a value does not show grip (see `note_silence`). Cells without values do not
    change, so that bounds alone never raise the lower end of an interval above the grip used.
    """
    if strength <= 0.0:
        return
    value_rates = _VALUE_PROBABILITY[used]
    mass_before = 0.0
    mass_after = 0.0
    for i in range(_GRIP_BIN, mugrid.BINS):
        mass_before += p[i]
        mass_after += p[i] * (1.0 - strength * value_rates[i])
    if mass_after == mass_before:
        return
    for i in range(_GRIP_BIN, mugrid.BINS):
        p[i] *= (1.0 - strength * value_rates[i]) * mass_before / mass_after


@refcount_free_inlined
def _remembered_parts(seconds: float) -> np.uint16:
    """Convert a duration [s], limited to FORGET_S, to the integer that cell records store, in units
    of 1/AGED s.
    """
    return np.uint16(min(seconds, constants.FORGET_S) * AGED + 0.5)


@refcount_free_inlined
def is_ice_source(entries: RecordArray, entry: int) -> bool:
    """Return True if a visit supports an ice alert: by its friction value, or by an intervention of
    a slip controller (ABS, ESC, traction control) that the visit's friction value does not
    contradict.

    An intervention while little grip is used confirms the reports of other vehicles. The
    intervention itself never changes the belief: the controller and the visit's likelihood observe
    the same sliding wheel, so this evidence would count twice.
    """
    slippery = entries[entry].slippery
    if (
        slippery >= constants.SOURCE_SHARE
        and ice_evidence(entries, entry) >= constants.EVIDENCE_NATS
    ):
        return True
    return bool(entries[entry].limited == HEEDED and slippery > 1.0 - constants.SOURCE_SHARE)


@refcount_free_inlined
def ice_evidence(entries: RecordArray, entry: int) -> float:
    """Return the evidence [nat] that one observation (row `entry`) gives for ice (μ < SLIPPERY)
    against grip (μ ≥ SLIPPERY). It is the logarithm of the ratio of their largest likelihoods, at
    least 0.

    The ratio allows for the tyre-curve error. A vehicle that uses less than the share SHARED_SHARE
    of the grip may report too low a value. If the vehicle used the grip u on a road of friction μ,
    this error has the standard deviation d(μ) = μ·clip(λ·(SHARED_SHARE - u/μ), 0, SHARED_MOST). λ
    is the error per unit of unused grip that alerts assume for a fleet about which nothing has been
    learned (`shared.Shape.alarm`). SHARED_MOST is the largest relative standard deviation.

    The function computes the largest likelihood of grip: the maximum of L(r)·exp(-½·((μ -
    r)/d(μ))²) over all μ ≥ SLIPPERY and r ≤ μ. L(r) is the reported likelihood of a reading r,
    scaled to maximum 1. The result is minus the logarithm of this number.

    The likelihood of ice needs no computation. If the maximum of L is at ice, the likelihood of ice
    is 1, so the result is exact. If the maximum is at grip, the likelihood of grip is 1 and the
    result is 0.
    """
    evidence = entries[entry].evidence
    used = entries[entry].used / USED
    least = math.inf
    for i in range(_GRIP_BIN, mugrid.BINS):
        road = mugrid.CENTRES[i]
        doubt = (
            min(
                max(_WITNESS_SLOPE * (constants.SHARED_SHARE - used / road), 0.0),
                constants.SHARED_MOST,
            )
            * road
        )
        for j in range(i, -1, -1):
            excess = road - mugrid.CENTRES[j]
            if excess > 3.0 * doubt:
                break
            nats = evidence[j] / mugrid.STEPS_PER_NAT + (
                0.5 * (excess / doubt) ** 2 if excess > 0.0 else 0.0
            )
            least = min(least, nats)
    return float(least)


@refcount_free_inlined
def needs_reporters(entries: RecordArray, entry: int) -> bool:
    """Return True if the vehicle of this entry (an observation in a cell) must be stored in the
    cell's list of recent reporters: if the entry is a friction value or shows grip, or if a slip
    controller intervened.
    """
    return bool(
        entries[entry].kind == ReportKind.VALUE
        or entries[entry].limited > 0
        or entries[entry].slippery <= 1.0 - constants.SOURCE_SHARE
    )


@refcount_free_inlined
def _count_visit(cells: RecordArray, row: int, entries: RecordArray, entry: int) -> None:
    """Count one visit of a vehicle to a cell, and the vehicle if it is new there."""
    cells[row].visits += np.uint32(1)
    if entries[entry].fresh and not cells[row].returned & returning_bit(entries[entry].number):
        cells[row].vehicles += np.uint32(1)


@refcount_free_inlined
def _limited_weight(
    cells: RecordArray, row: int, entries: RecordArray, entry: int, is_outdated: bool
) -> float:
    """Return the weight in [0, 1] of an observation (row `entry`) in a cell. It is reduced, and the
    vote is counted, if the vehicle is untrusted or the visit is older than the cell's last one
    (`is_outdated`). The k-th vote of these two sorts counts 1/k², so all together count at most 1.6
    votes.

    Therefore an attacker gains nothing from many new names. And many old reports do not overrule
    the few of the road as it is now, because one change of the road makes all of them wrong.
    Repeated votes of one vehicle are already discounted by `power` (share of new information).
    """
    weight = float(entries[entry].weight)
    if not is_outdated and not 0.0 < weight < constants.SOURCE_TRUST:
        return weight
    kind = int(entries[entry].kind)
    power = float(entries[entry].power)
    others = np.float32(cells[row].untrusted[kind] / UNTRUSTED)
    cells[row].untrusted[kind] = np.uint16(min(float(others + power) * UNTRUSTED + 0.5, 65535.0))
    return weight / float((np.float32(1.0) + others) ** 2)


@refcount_free_inlined
def _age_likelihood(scratch: Bins, weather: Weather, key: int, begin: int, end: int) -> None:
    """Age the likelihood in `scratch` from the time `begin` of its visit to `end` [ns].

    The model of a changing road is a Markov chain: a diffusion with reflecting ends, and sudden
    changes to any friction. The chain is reversible, so a likelihood ages like a belief.
    """
    drift, change, _ = road_time(weather, key, begin, end)
    likelihood = scratch[ScratchRow.LIKELIHOOD]
    forget(likelihood, drift, change, _UNIFORM, scratch[ScratchRow.PADDED])
    _clear_padding(scratch)
