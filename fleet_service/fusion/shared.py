"""Error that all reports from one place have in common, and the belief about the road that allows
for this error. Pure (no I/O).

Vehicles that do the same manoeuvre in the same place make the same error. One cause is the shape of
the tyre's force curve, which each vehicle assumes: this error grows as the share of grip used
falls. Other causes depend on the manoeuvre. More vehicles do not average this error out; other
manoeuvres and a larger share of grip do. So the stored belief p is about μ as the whole *fleet*
measures it. A reader of the map gets a belief about μ of the road itself, which the kernel K
computes from p:

    road_i = Σ_j K_ij·p_j,    K_ij ∝ exp(-½·((μ_j - μ_i)/(μ_i·σ±))²),    rows sum to 1
    σ₋² = σ_c² + (COMMON_ABSOLUTE/μ_i)² + clip(slope·(SHARED_SHARE - ū/μ_i), 0, SHARED_MOST)²
           where the reading μ_j is lower than the road's μ_i
    σ₊² = σ_c² + (COMMON_HIGH/μ_i)²  elsewhere
    σ_c² = COMMON_ALWAYS² + (COMMON_MANOEUVRE² + σ_s²)/n_eff
    n_eff = (Σ w_k)²/Σ w_k²

The last term of σ₋² is the error from the tyre's force curve. It is only in σ₋, because a reading
that is too low wrongly excludes higher friction. A reading that is too high excludes nothing,
because the fusion uses it only as a lower bound of μ. The slope is this error per unit of unused
grip: the estimate of `trust.shape_of` plus SHAPE_DOUBT. An alarm uses the upper end of the slope's
confidence range, which narrows as the service compares more visits.

The standard deviation that a vehicle states covers its whole error. A part of this error, σ_s, is
common to all vehicles with the same manoeuvre, so a comparison of vehicles cannot show it: σ_s² =
SHARED_PART·stated² (relative, weighted mean of the cell's values).

Legend
    ū      mean grip used by the vehicles that gave values, weighted
    n_eff  effective number of kinds of manoeuvre: 1 if all values come from one kind
    w_k    weight of the values of manoeuvre k; newer values replace older ones
    COMMON_…, SHARED_…    parts of the error, see `constants`
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion import constants
from fleet_service.fusion.store.records import (
    MANOEUVRES,
    NONE,
    SHARED,
    USED,
    WEIGHT,
    ManoeuvreKind,
)
from schemas import mugrid
from schemas.numeric import ByteArray, Float32Array, FloatArray
from schemas.runtime.jit import refcount_free, refcount_free_inlined, refcount_free_locked
from schemas.runtime.records import RecordArray
from schemas.thresholds import NS, Z_95

# Axes of the table of kernels: mean grip used (USED_ROWS steps of USED_STEP), shared error σ_s (the
# nearest entry of STATED), n_eff (the next smaller entry of KINDS).
USED_STEP: Final = 0.08
USED_ROWS: Final = 16
STATED: Final = (0.0, 0.03, 0.06, 0.1, 0.15, 0.2)
_BORDERS: Final = tuple(0.5 * (a + b) for a, b in pairwise(STATED))
KINDS: Final = (1.0, 1.5, 2.2, 3.0)
TENTH_NS: Final = 360 * NS  # [ns] the weights of a cell fade in steps of this length
_FADES: Final = np.exp(-np.arange(64) * TENTH_NS / NS / constants.VOTE_RENEWAL_S).astype(np.float32)
_MOST: Final = np.iinfo(np.uint8).max


def manoeuvre_of(longitudinal: FloatArray, lateral: FloatArray) -> NDArray[np.int8]:
    """Return the kind of manoeuvre (`ManoeuvreKind`) of visits (n,), from the longitudinal and
    lateral grip used. Where either is NaN, return NONE, which counts as the cell's most frequent
    kind.
    """
    along = np.abs(longitudinal) >= np.abs(lateral)
    kind = np.where(
        along,
        np.where(longitudinal >= 0.0, ManoeuvreKind.DRIVING, ManoeuvreKind.BRAKING),
        np.where(lateral >= 0.0, ManoeuvreKind.LEFT, ManoeuvreKind.RIGHT),
    )
    return np.where(np.isfinite(longitudinal) & np.isfinite(lateral), kind, NONE).astype(np.int8)


def shared_parts(reported: Float32Array) -> ByteArray:
    """Return the relative error σ_s that the vehicles in a cell have in common, for each reported
    value (n, 3: mean, standard deviation, P(slippery)). The result (n,) is in units of 1/SHARED; 0
    for a report that is only a lower bound of friction.
    """
    out = np.empty(len(reported), np.uint8)
    _write_shared_parts(reported, out)
    return out


@refcount_free_locked
def _write_shared_parts(reported: Float32Array, out: ByteArray) -> None:
    for row in range(len(reported)):
        mean = reported[row, 0]
        std = reported[row, 1]
        if math.isnan(std):
            out[row] = 0
            continue
        if math.isnan(mean):
            mean = np.float32(1.0)
        relative = std / max(mean, np.float32(mugrid.LOWER))
        stated = relative * relative - np.float32(constants.BIAS_RELATIVE**2)
        hidden = np.float32(constants.SHARED_PART) * min(
            max(stated, np.float32(0.0)), np.float32(0.25)
        )
        share = min(np.float32(math.sqrt(hidden)), np.float32(STATED[-1]))
        out[row] = np.uint8(share * np.float32(SHARED))


class Shape(NamedTuple):
    """Error from the shape of the tyre's force curve. `slope` is the amount by which the fleet's
    friction values are too low per unit of grip left unused. `std` is the standard deviation of the
    estimated slope.
    """

    slope: float
    std: float

    @property
    def reader(self) -> float:
        """Return the slope (error of a friction value per unit of unused grip) by which intervals
        are widened for readers of the map.
        """
        return self.slope + constants.SHAPE_DOUBT

    @property
    def alarm(self) -> float:
        """Return the slope (error of a friction value per unit of unused grip) that an alarm
        assumes: the upper end of its one-sided 95 % interval.

        A new service assumes .5. After comparing many passages, a service assumes little more than
        the slope for readers. In simulations without misbehaving vehicles (seeds for tuning), the
        alerts missed a share of .010 of the icy cell-minutes. The share was .044 if services always
        assumed .5.
        """
        return self.reader + Z_95 * self.std


# Slopes (error of a value per unit of unused grip) with a table of kernels; the nearest is used.
SHAPES: Final = (0.1, 0.2, 0.35, 0.5, 0.7)
UNKNOWN_SHAPE: Final = Shape(constants.SHAPE_PRIOR, constants.SHAPE_PRIOR)


def shared_kernel(
    used: float | FloatArray,
    kinds: float | FloatArray,
    stated: float | FloatArray,
    slope: float = UNKNOWN_SHAPE.reader,
) -> FloatArray:
    """Return the kernel K, (..., 32, 32), which maps a belief about the friction that the fleet
    measures to a belief about the friction of the road. The first three arguments are numbers or
    arrays of the same shape (...).

    Args:
        used: mean grip used by the vehicles that measured friction in the cell.
        kinds: effective number n_eff of kinds of manoeuvre in the cell's values: 1 if all values
            come from one kind, larger if several kinds have similar weights.
        stated: relative error σ_s (standard deviation) that the cell's values have in common, as
            derived from the intervals that the vehicles reported (`shared_parts`).
        slope: error of a value per unit of unused grip.
    """
    centres = mugrid.CENTRES
    common = (
        constants.COMMON_ALWAYS**2 + (constants.COMMON_MANOEUVRE**2 + np.square(stated)) / kinds
    )
    unused = constants.SHARED_SHARE - np.asarray(used)[..., None] / centres
    shape = np.clip(slope * unused, 0.0, constants.SHARED_MOST)
    relative = np.sqrt(np.asarray(common))[..., None] * centres
    low = np.hypot(np.hypot(relative, constants.COMMON_ABSOLUTE), shape * centres)
    return _two_sided(low, np.hypot(relative, constants.COMMON_HIGH))


def base_kernel() -> FloatArray:
    """Return the kernel K, (32, 32), for cells where vehicles reported only lower bounds of
    friction and no values. K maps a belief about the friction that the fleet measures to a belief
    about the road.
    """
    relative = constants.COMMON_RELATIVE * mugrid.CENTRES
    return _two_sided(
        np.hypot(relative, constants.COMMON_ABSOLUTE), np.hypot(relative, constants.COMMON_HIGH)
    )


def _two_sided(below: FloatArray, above: FloatArray) -> FloatArray:
    """Return the kernel K, (..., 32, 32): row i is the distribution of the vehicles' reading on a
    road of friction bin i. Its standard deviation is `below` (..., 32) [μ] for readings that are
    too low, and `above` (..., 32) [μ] for readings that are too high. K maps measured friction to
    that of the road.
    """
    difference = mugrid.CENTRES[None, :] - mugrid.CENTRES[:, None]
    std = np.where(difference < 0.0, below[..., None], above[..., None])
    kernel = np.exp(-0.5 * np.square(difference / std))
    return np.asarray(kernel / kernel.sum(axis=-1, keepdims=True))


def _kernel_table(slope: float) -> Float32Array:
    """Return the kernels for one slope (error of a value per unit of unused grip), (kernels, 32,
    32). A kernel maps a belief about measured friction to one about the road.

    The first kernel is for cells without values. The others are for all combinations of mean grip
    used, effective number of kinds of manoeuvre (KINDS) and shared error (STATED). `kernel_of`
    gives the index. Each kernel is transposed, so that the 32 bins of one belief are contiguous in
    memory.
    """
    used = (np.arange(USED_ROWS) + 0.5) * USED_STEP
    axes = [axis.ravel() for axis in np.meshgrid(used, KINDS, STATED, indexing="ij")]
    kernels = np.concatenate([base_kernel()[None], shared_kernel(axes[0], axes[1], axes[2], slope)])
    return np.ascontiguousarray(kernels.swapaxes(1, 2), np.float32)


# One table of kernels per slope in SHAPES. Compiled functions get a table as an argument, because a
# global of this size would prevent the cache of compiled code.
KERNELS: Final = tuple(_kernel_table(slope) for slope in SHAPES)


def shape_class(slope: float) -> int:
    """Return the index of the number in SHAPES that is nearest to `slope`, the error of a friction
    value per unit of unused grip. Kernels are stored only for the slopes in SHAPES.
    """
    differences = [abs(shape - slope) for shape in SHAPES]
    return differences.index(min(differences))


@refcount_free_inlined
def kernel_of(cells: RecordArray, row: int) -> int:
    """Return the index, in a table of `_kernel_table`, of the kernel that fits the values in the
    cell in row `row` of `cells`. A kernel (32, 32) maps a belief about measured friction to one
    about the road.
    """
    whole = 0.0
    squares = 0.0
    for k in range(MANOEUVRES):
        weight = float(cells[row].manoeuvres[k])
        whole += weight
        squares += weight * weight
    if whole == 0.0:
        return 0
    kinds = whole * whole / squares
    column = 0
    for k in range(1, len(KINDS)):
        if kinds >= KINDS[k]:
            column = k
    used = min(int(cells[row].used / (USED * USED_STEP)), USED_ROWS - 1)
    stated = cells[row].shared / SHARED
    place = 0
    for border in _BORDERS:
        place += stated >= border
    return 1 + (used * len(KINDS) + column) * len(STATED) + place


@refcount_free_inlined
def read_road(
    kernels: Float32Array, cells: RecordArray, row: int, p: FloatArray, road: FloatArray
) -> None:
    """Compute the belief about a road's friction, `road` (32), from the stored belief `p` (32) of
    the cell in row `row`.

    The stored belief is about the friction that the vehicles measure, which contains the error that
    they have in common. The belief about the road is wider, because it allows for this error. It
    sums to one.
    """
    kernel = kernels[kernel_of(cells, row)]
    for i in range(mugrid.BINS):
        road[i] = 0.0
    for j in range(mugrid.BINS):
        for i in range(mugrid.BINS):
            road[i] += kernel[j, i] * p[j]
    whole = 0.0
    for i in range(mugrid.BINS):
        whole += road[i]
    for i in range(mugrid.BINS):
        road[i] /= whole


@refcount_free_inlined
def read_slippery(weights: FloatArray, cells: RecordArray, row: int, p: FloatArray) -> float:
    """Return P(slippery) of the belief about a road, see `read_road`, with a sixteenth of its
    multiplications. `weights` (kernels, 2, 32) are the contributions of each bin of `p` to
    P(slippery) of the road, and to the sum of its probabilities.
    """
    weight = weights[kernel_of(cells, row)]
    slippery = 0.0
    whole = 0.0
    for i in range(mugrid.BINS):
        slippery += weight[0, i] * p[i]
        whole += weight[1, i] * p[i]
    return slippery / whole


@refcount_free
def note_value(
    cells: RecordArray, row: int, entries: RecordArray, entry: int, strength: float
) -> None:
    """Update three weighted means of a cell for a new friction value, from which `kernel_of`
    chooses the cell's kernel: `used` (grip used), `shared` (relative error that the values have in
    common) and `manoeuvres` (weight per kind of manoeuvre).

    Row `entry` of `entries` is the observation, and `strength` in [0, 1] is its weight in the
    belief. Its weight in the means is smaller if the vehicle used little grip or if the value's
    shared error is large.
    """
    used = entries[entry].used / USED
    shared = entries[entry].shared / SHARED
    gentle = used / (max(float(entries[entry].mean), mugrid.LOWER) * constants.SHARED_SHARE)
    weight = (
        strength
        * min(max(gentle, constants.SHARED_LEAST), 1.0) ** 2
        / (1.0 + (shared / constants.SHARED_WIDE) ** 2)
    )
    before = 0.0
    largest = 0
    for k in range(MANOEUVRES):
        before += cells[row].manoeuvres[k]
        if cells[row].manoeuvres[k] > cells[row].manoeuvres[largest]:
            largest = k
    part = weight / (before / WEIGHT + weight)
    cells[row].used = _moving_mean(cells[row].used, used * USED, part)
    cells[row].shared = _moving_mean(cells[row].shared, shared * SHARED, part)
    kind = int(entries[entry].manoeuvre) if entries[entry].manoeuvre >= 0 else largest
    added = cells[row].manoeuvres[kind] + weight * WEIGHT + 0.5
    cells[row].manoeuvres[kind] = np.uint8(min(max(added, 1.0), _MOST))


@refcount_free_inlined
def _moving_mean(before: int, new: float, part: float) -> np.uint8:
    return np.uint8(min(before + part * (new - before) + 0.5, _MOST))


@refcount_free
def fade_weights(cells: RecordArray, row: int, begin: int, end: int) -> None:
    """Reduce two numbers of a cell by their decay from `begin` to `end` [ns]: the weight of each
    kind of manoeuvre, and the number of reports by untrusted vehicles.
    """
    borders = min(end // TENTH_NS - begin // TENTH_NS, len(_FADES) - 1)
    if borders > 0:
        for k in range(2):
            cells[row].untrusted[k] = np.uint16(cells[row].untrusted[k] * _FADES[borders])
        for k in range(MANOEUVRES):
            weight = cells[row].manoeuvres[k]
            if weight > 0:  # at least 1 remains, which records that the cell has had values
                cells[row].manoeuvres[k] = np.uint8(max(weight * _FADES[borders], 1.0))
