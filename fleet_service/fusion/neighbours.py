"""Beliefs for readers of the map: aged to the time of reading, combined with messages from slippery
neighbouring cells, and widened by the error that all reports share. A message is a factor on the
probabilities of a belief. Compiled.

A surface rarely ends at the border of a cell: snow and ice cover stretches. So a cell with slippery
neighbours is more probably slippery than a cell without any information. Each side of a cell
(before, behind, and the other direction of the road) sends it one message m, from the most
informative neighbour on that side:

    m_i = 1 + q·w·(n_i/p₀_i - 1)
    w = SAME_SURFACE^d·max(s - s₀, 0)/(1 - s₀)
    q = exp(-SILENCE·max(v_n·min(k/k_n, 1) - v, 0))

and a reader gets the normalised product K·(b·m₁·m₂·m₃).

Messages use only the reports of a neighbour's own visitors, never messages that it received, so no
information travels in a circle. They are computed when the map is read, so that no cell's own
belief depends on another's. The common error also applies to the neighbours' values, so K is
applied once, at the end.

Only slippery neighbours send these messages, because dry neighbours do not show that an unvisited
cell is dry. A cell without information sends no message, because its s is below s₀. The least value
of m is 1 - w, which is .1 next to ice. So a cell in which its own visitors found grip stays a cell
with grip. A neighbour with grip stops the messages of cells beyond it, because the stretch has
ended there. So does a border: two vehicles reported grip in one cell after two had reported ice in
the other (`sources.is_border`). Otherwise a single report from the wrong cell, which makes the
cell doubtful, would be confirmed by the ice on the other side of the border.

The factor q weakens a message if few visits to the cell itself gave a friction value. On the same
slippery surface, about as many visits would give a value as in the neighbouring cell: v_n, or
v_n·k/k_n if the cell had fewer visits. q falls below 1 if the cell has less than this. A visit
without a value does not show grip, so q never lowers P(slippery) below UNSURE. The weights v fade
with time, so that values from before a change of the road count little.

A *measured* cell also hears measured cells near it, grip included, because vehicles tested both: up
to HEARD_CELLS consecutive cells before it, as many behind it, and one of the other direction, but
none beyond a border. A cell is measured if vehicles gave values there, and if some friction is
HEARD_MOST times as probable as in the prior; otherwise its values have faded. The message is

    h_i = clip(1 + SAME_SURFACE^d·(n_i/p₀_i - 1), 1/HEARD_MOST, HEARD_MOST)

A reader gets K·(b·h₁·h₂·…), but P(slippery) stays that of K·(b·m₁·m₂·m₃): measured neighbours
narrow the interval of μ and never decide whether a road is slippery, so alerts do not depend on
them. Errors of neighbouring cells are partly alike, so HEARD_MOST limits the message.

Source of the method: Pearl, Probabilistic Reasoning in Intelligent Systems (1988), ch. 4. Here a
neighbour's message goes directly to the cell, and cells do not pass messages on.

Legend
    b      belief about the cell from its own reports                                     (32,)
    n      belief about the road of a neighbour from its own reports                       (32,)
    p₀     prior of an unmeasured road of the region                                      (32,)
    s, s₀  P(slippery) of n, and of p₀
    K      kernel that maps measured friction to that of the road, see `shared`        (32, 32)
    d      distance of the neighbour in cells; 1 to the cells of the other direction
    v, v_n total weight of recent values of the cell, and of the neighbour
    k, k_n number of visits to the cell, and to the neighbour
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from fleet_service.fusion import constants
from fleet_service.fusion.adjacent import (
    ACROSS,
    ACROSS_CELLS,
    BEFORE,
    BEHIND,
    SearchSide,
    find_neighbour,
)
from fleet_service.fusion.belief import PADDED, Bins, forget, unpack_belief
from fleet_service.fusion.shared import read_road, read_slippery
from fleet_service.fusion.sources import is_border
from fleet_service.fusion.store.records import AGED, MANOEUVRES, NONE, WEIGHT, Rows
from fleet_service.fusion.votes import ScratchRow
from fleet_service.fusion.weather import Weather, road_time
from schemas import grid, mugrid
from schemas.numeric import Float32Array, FloatArray, IntArray
from schemas.runtime.jit import refcount_free, refcount_free_inlined, refcount_free_locked
from schemas.runtime.records import RecordArray
from schemas.thresholds import NS

_BINS: Final = mugrid.BINS
# P(same surface) by distance in cells
_KEPT: Final[FloatArray] = np.power(constants.SAME_SURFACE, np.arange(constants.NEIGHBOURS + 1))
# number of cells in a tile, and largest number of aged beliefs that one reading keeps
_TILE_CELLS: Final = 4 ** (grid.CELL_ZOOM - grid.TILE_ZOOM)


@refcount_free_inlined
def _write_message(message: FloatArray, weight: float, road: FloatArray, prior: FloatArray) -> None:
    """Write to `message` (32,) the message m of a slippery neighbour: the factor for the
    probability of each friction bin of the cell that receives it.

    Args:
        message: array for the result.
        weight: weight w of the message, from 0 (no effect, all factors are 1) to 1.
        road: belief n about the neighbour's road (32,).
        prior: belief p₀ about an unmeasured road (32,).
    """
    for i in range(_BINS):
        message[i] = 1.0 - weight + weight * road[i] / prior[i]


class ReadRule(NamedTuple):
    """Parameters for the computation of beliefs about the road from stored beliefs.

    Attributes:
        kernels: table of kernels, (kernels, 32, 32). A kernel maps a belief about measured friction
            to a belief about the road; it adds the error that all reports in a cell share (see
            `shared`).
        slippery: table for P(slippery) with the same kernels, see `shared.read_slippery`.
        silence: constant SILENCE in the factor q of the module. This factor weakens messages from
            slippery neighbours if vehicles visited the cell but reported few friction values there.
            0 switches the factor off.
        narrow: True if measured neighbours narrow the belief about a measured cell.
    """

    kernels: Float32Array
    slippery: FloatArray
    silence: float
    narrow: bool


class MapParts(NamedTuple):
    """Arguments of `road_beliefs`: state of the slots (one per cell and heading sector), hash table
    that finds slots by key, weather, and parameters for reading beliefs (`ReadRule`).
    """

    live: Rows
    table: IntArray
    weather: Weather
    rule: ReadRule


class Readout(NamedTuple):
    """Slot whose belief is read, the time of reading [ns], and the row of the prior of its
    region.
    """

    slot: int
    now: int
    prior: int


class Buffers(NamedTuple):
    """Memory for intermediate results. `scratch` serves to age a belief. `own` (32) is the aged
    belief about the cell from its own reports, and `product` (32) the product of this belief and
    all messages (factors from neighbours). `quiet` (32) is the same product with messages that are
    weaker because visits gave no friction value. `message` (32) is one message, and `road` (32) the
    belief about the road of a neighbour.

    The aged beliefs of the last cells are kept, because cells that are read together are mostly
    neighbours: `kept` (K, 32). Row i, the slot modulo K, is for the slot and time `kept_for[i]`
    (2,), and for row `kept_prior[i]` of the priors.
    """

    scratch: FloatArray
    kept: FloatArray
    kept_for: IntArray
    kept_prior: IntArray
    own: FloatArray
    product: FloatArray
    quiet: FloatArray
    message: FloatArray
    road: FloatArray


def road_beliefs(
    live: Rows,
    table: IntArray,
    weather: Weather,
    rule: ReadRule,
    slots: IntArray,
    now: IntArray,
) -> FloatArray:
    """Return the belief about the road for each slot, (k, 32), at the times `now` (k,) [ns].
    `table` is the hash table that finds slots by key.
    """
    parts = MapParts(live, table, weather, rule)
    out = np.empty((len(slots), _BINS))
    kept = min(16 * len(slots), _TILE_CELLS)
    buffers = Buffers(
        np.empty((3, PADDED)),
        np.empty((kept, _BINS)),
        np.full((kept, 2), NONE),
        np.empty(kept, np.int64),
        np.empty(_BINS),
        np.empty(_BINS),
        np.empty(_BINS),
        np.empty(_BINS),
        np.empty(_BINS),
    )
    _read_beliefs(parts, slots, now, buffers, out)
    return out


@refcount_free_locked
def _read_beliefs(
    parts: MapParts, slots: IntArray, now: IntArray, buffers: Buffers, out: FloatArray
) -> None:
    """Write the belief about the road for each slot at the times `now` (k,) [ns] to `out` (k,
    32).
    """
    live = parts.live
    weather = parts.weather
    rule = parts.rule
    for k in range(len(slots)):
        prior = _age_belief(live, weather, slots[k], now[k], buffers)
        for i in range(_BINS):
            buffers.own[i] = buffers.scratch[ScratchRow.BELIEF, i]
        target = Readout(slots[k], now[k], prior)
        slippery = read_slippery(rule.slippery, live.cells, slots[k], buffers.own)
        if constants.DECIDED <= slippery <= 1.0 - constants.DECIDED:
            _multiply_messages(parts, target, buffers, out[k])
        else:
            read_road(rule.kernels, live.cells, slots[k], buffers.own, out[k])
        if rule.narrow and _is_measured(parts, target, slots[k], buffers.own):
            _narrow(parts, target, buffers, out[k])


@refcount_free_inlined
def _is_measured(parts: MapParts, target: Readout, row: int, belief: Bins) -> bool:
    """Return True if vehicles gave values in the cell in row `row`, and if its aged `belief` (32,)
    is still firmer than the prior by the factor HEARD_MOST.
    """
    if parts.live.cells[row].values <= 0.0:
        return False
    prior = parts.weather.prior[target.prior]
    firmest = 0.0
    for i in range(_BINS):
        firmest = max(firmest, belief[i] / prior[i])
    return firmest >= constants.HEARD_MOST


@refcount_free_inlined
def _narrow(parts: MapParts, target: Readout, buffers: Buffers, out: FloatArray) -> None:
    """Combine the belief about a measured cell with those of measured cells near it, and write
    the resulting belief about the road to `out` (32). On entry, `out` is the belief without them;
    its P(slippery) does not change.
    """
    for i in range(_BINS):
        buffers.product[i] = buffers.own[i]
    has_messages = False
    for side in (BEFORE, BEHIND, ACROSS):
        has_messages = _multiply_side(parts, target, side, buffers) or has_messages
    if has_messages:
        cells = parts.live.cells
        read_road(parts.rule.kernels, cells, target.slot, buffers.product, buffers.road)
        if _set_slippery(buffers.road, _slippery_probability(out)):
            for i in range(_BINS):
                out[i] = buffers.road[i]


@refcount_free_inlined
def _multiply_side(parts: MapParts, target: Readout, side: int, buffers: Buffers) -> bool:
    """Multiply `buffers.product` (32,) by the messages h of the measured cells on one side of a
    cell. Return False if there are none.

    Before and behind the cell, these are up to HEARD_CELLS consecutive cells. In the opposite
    direction of the road, it is the first cell that is measured.
    """
    cells = parts.live.cells
    search = SearchSide(cells[target.slot].key, side, target.now)
    across = side == ACROSS
    has_messages = False
    neighbour = search.key // grid.SECTORS
    for step in range(1, (ACROSS_CELLS if across else constants.HEARD_CELLS) + 1):
        neighbour, row = find_neighbour(parts.table, cells, search, neighbour, step)
        measured = row != NONE and _can_combine(parts, target, row, buffers)
        if measured:
            road = buffers.scratch[ScratchRow.BELIEF]
            kept = _KEPT[1 if across else step]
            _multiply_limited(buffers.product, road, parts.weather.prior[target.prior], kept)
            has_messages = True
        if measured == across:
            break
    return has_messages


@refcount_free_inlined
def _can_combine(parts: MapParts, target: Readout, row: int, buffers: Buffers) -> bool:
    """Return True if the cell in row `row` is measured and no border is known between it and the
    cell that is read. Then its aged belief is in `buffers.scratch`.
    """
    live = parts.live
    if live.cells[row].values <= 0.0 or is_border(live, target.slot, row, target.now):
        return False
    _age_belief(live, parts.weather, row, target.now, buffers)
    return _is_measured(parts, target, row, buffers.scratch[ScratchRow.BELIEF])


@refcount_free_inlined
def _multiply_limited(product: Bins, road: Bins, prior: Bins, kept: float) -> None:
    """Multiply `product` (32,) by the message h of a measured cell with the belief `road` (32,).
    `kept` is the probability that both cells have the same surface.
    """
    for i in range(_BINS):
        factor = 1.0 + kept * (road[i] / prior[i] - 1.0)
        product[i] *= min(max(factor, 1.0 / constants.HEARD_MOST), constants.HEARD_MOST)


@refcount_free_inlined
def _set_slippery(road: FloatArray, required: float) -> bool:
    """Set P(slippery) of a belief `road` (32,) in place to `required`, by factors that are linear
    in a bin's slippery share. Return False if this is not possible, and then leave it.
    """
    current = 0.0
    square = 0.0
    for i in range(_BINS):
        current += mugrid.SLIPPERY_SHARE[i] * road[i]
        square += mugrid.SLIPPERY_SHARE[i] ** 2 * road[i]
    spread = square - current**2
    missing = required - current
    if missing * current > spread or -missing * (1.0 - current) > spread or spread <= 0.0:
        return False
    for i in range(_BINS):
        road[i] *= 1.0 + missing / spread * (mugrid.SLIPPERY_SHARE[i] - current)
    return True


@refcount_free_inlined
def _multiply_messages(parts: MapParts, target: Readout, buffers: Buffers, out: FloatArray) -> None:
    """Multiply the belief about a cell by the messages (factors) from slippery neighbours on its
    three sides, and write the resulting belief about the road to `out` (32).
    """
    kernels = parts.rule.kernels
    cells = parts.live.cells
    for i in range(_BINS):
        buffers.product[i] = buffers.own[i]
        buffers.quiet[i] = buffers.own[i]
    unknown = _slippery_probability(parts.weather.prior[target.prior])
    weakened = False
    for side in (BEFORE, BEHIND, ACROSS):
        weight, strength = _choose_message(parts, target, side, unknown, buffers)
        if weight > 0.0:
            weakened = weakened or strength < 1.0
            for i in range(_BINS):
                buffers.product[i] *= buffers.message[i]
                buffers.quiet[i] *= 1.0 + strength * (buffers.message[i] - 1.0)
    read_road(kernels, cells, target.slot, buffers.product, out)
    if weakened:
        read_road(kernels, cells, target.slot, buffers.quiet, buffers.road)
        _lower_to_unsure(out, buffers.road)


@refcount_free_inlined
def _choose_message(
    parts: MapParts, target: Readout, side: int, unknown: float, buffers: Buffers
) -> tuple[float, float]:
    """Write the message (factors on a belief) of the most informative neighbour on one side of a
    cell to `buffers.message`. Return the message's weight w, which is 0 if no neighbour on this
    side sends a message. `unknown` is P(slippery) of an unmeasured road.

    Also return the factor q in (0, 1], by which the caller weakens the message: 1 + q·(m - 1)
    replaces each factor m. It is below 1 if few visits to the cell itself gave friction values.
    """
    live = parts.live
    cells = live.cells
    most = 0.0
    best = NONE
    search = SearchSide(cells[target.slot].key, side, target.now)
    neighbour = search.key // grid.SECTORS
    for step in range(1, (ACROSS_CELLS if side == ACROSS else constants.NEIGHBOURS) + 1):
        neighbour, row = find_neighbour(parts.table, cells, search, neighbour, step)
        if row == NONE:
            continue
        ended = _stored_slippery(live, row) < constants.NEIGHBOUR_GRIP
        if ended or is_border(live, target.slot, row, target.now):
            if side == ACROSS:
                continue
            break
        _age_belief(live, parts.weather, row, target.now, buffers)
        belief = buffers.scratch[ScratchRow.BELIEF]
        slippery = read_slippery(parts.rule.slippery, cells, row, belief)
        kept_surface = _KEPT[1 if side == ACROSS else step]
        weight = kept_surface * (slippery - unknown) / (1.0 - unknown)
        if weight > most:
            most = weight
            best = row
            for i in range(_BINS):
                buffers.message[i] = belief[i]
    if best == NONE:
        return 0.0, 1.0
    read_road(parts.rule.kernels, cells, best, buffers.message, buffers.road)
    _write_message(buffers.message, most, buffers.road, parts.weather.prior[target.prior])
    return most, _silence_factor(cells, target.slot, best, parts.rule.silence)


def stretches(live: Rows, table: IntArray, slots: IntArray) -> IntArray:
    """Return each slot, and the other slots that may belong to the same
    slippery stretch of road: slot numbers (k, 1 + 2·NEIGHBOURS + ACROSS_CELLS). First comes the
    slot itself, then those before it, those behind it, and those of the other direction of the
    road. Positions without such a slot are NONE.

    A stretch ends at a cell whose own reports make slippery road unlikely.
    """
    out = np.full((len(slots), 1 + 2 * constants.NEIGHBOURS + ACROSS_CELLS), NONE)
    _find_stretches(live, table, slots, out)
    return out


@refcount_free_locked
def _find_stretches(live: Rows, table: IntArray, slots: IntArray, out: IntArray) -> None:
    for k in range(len(slots)):
        out[k, 0] = slots[k]
        own = live.cells[slots[k]]
        for side in (BEFORE, BEHIND, ACROSS):
            search = SearchSide(own.key, side, own.time)
            neighbour = search.key // grid.SECTORS
            for step in range(ACROSS_CELLS if side == ACROSS else constants.NEIGHBOURS):
                neighbour, row = find_neighbour(table, live.cells, search, neighbour, step + 1)
                if row == NONE:
                    continue
                if _stored_slippery(live, row) >= constants.NEIGHBOUR_GRIP:
                    out[k, 1 + side * constants.NEIGHBOURS + step] = row
                elif side != ACROSS:
                    break


@refcount_free_inlined
def _lower_to_unsure(road: FloatArray, quiet: FloatArray) -> None:
    """Lower P(slippery) of a belief `road` (32,) in place to the P(slippery) of `quiet` (32,), but
    not below UNSURE. `quiet` is the same belief computed with weakened messages from neighbours.

    The messages were weakened only because visits gave no friction value. Such visits do not show
    grip, so they may not make slippery road improbable.
    """
    current = _slippery_probability(road)
    least = _slippery_probability(quiet)
    if current <= constants.UNSURE or least >= current:
        return
    kept = max((constants.UNSURE - least) / (current - least), 0.0)
    for i in range(_BINS):
        road[i] = kept * road[i] + (1.0 - kept) * quiet[i]


@refcount_free_inlined
def _silence_factor(cells: RecordArray, row: int, neighbour: int, silence: float) -> float:
    """Return the factor q in (0, 1] that weakens the message of a slippery neighbour if vehicles
    visited the cell in `row` but reported fewer friction values than expected.

    The expected number is the neighbour's number of recent values. If the cell has fewer visits
    than the neighbour, the expected number is lower in the same ratio. The factor is 1 if the cell
    has at least the expected number.
    """
    visits = float(cells[row].visits) / max(float(cells[neighbour].visits), 1.0)
    lacking = _recent_values(cells, neighbour) * min(visits, 1.0) - _recent_values(cells, row)
    return math.exp(-silence * max(lacking, 0.0))


@refcount_free_inlined
def _recent_values(cells: RecordArray, row: int) -> float:
    whole = 0.0
    for kind in range(MANOEUVRES):
        whole += float(cells[row].manoeuvres[kind])
    return whole / WEIGHT


@refcount_free_inlined
def _slippery_probability(road: Bins) -> float:
    whole = 0.0
    for i in range(_BINS):
        whole += mugrid.SLIPPERY_SHARE[i] * road[i]
    return whole


@refcount_free_inlined
def _stored_slippery(live: Rows, row: int) -> float:
    """Return P(slippery) of the belief that is stored for the cell in row `row`. The belief is not
    unpacked, so that the function takes a tenth of the time.
    """
    whole = 0.0
    slippery = 0.0
    for i in range(_BINS):
        whole += live.belief[row, i]
        slippery += mugrid.SLIPPERY_SHARE[i] * live.belief[row, i]
    return slippery / whole


@refcount_free
def _age_belief(live: Rows, weather: Weather, slot: int, now: int, buffers: Buffers) -> int:
    """Age the belief about a slot to `now` [ns] and write it to the row BELIEF of
    `buffers.scratch`, or copy it if it is still kept. Return the row number of the prior that the
    weather of the cell's region gives.
    """
    p = buffers.scratch[ScratchRow.BELIEF]
    place = slot % len(buffers.kept)
    if buffers.kept_for[place, 0] == slot and buffers.kept_for[place, 1] == now:
        for i in range(_BINS):
            p[i] = buffers.kept[place, i]
        return int(buffers.kept_prior[place])
    cells = live.cells
    unpack_belief(live.belief, slot, p)
    seconds = max((now - cells[slot].time) * 1e-9, 0.0) + cells[slot].aged / AGED
    drift, change, prior = road_time(weather, cells[slot].key, now - int(seconds * NS), now)
    if now > cells[slot].time:
        forget(p, drift, change, weather.prior[prior], buffers.scratch[ScratchRow.PADDED])
    buffers.kept_for[place, 0] = slot
    buffers.kept_for[place, 1] = now
    buffers.kept_prior[place] = prior
    for i in range(_BINS):
        buffers.kept[place, i] = p[i]
    return int(prior)
