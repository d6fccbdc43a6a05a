"""Comparison of pairs of quantities that are equal by physics: gain, offset, lag and confidence.

    identity       left        right    checks
    lateral        a_y         v · r    unit and sign of a_y, v, r
    longitudinal   a_x         dv/dt    unit and sign of a_x, v
    steering       δ · v       L · r    unit and sign of δ, v, r (plus a term understeer · v² r)
    axle           r_w         r        which wheel is left, v, r
    ground         v_g         |v|      unit of v: the wheels' radius
    turning        d course    r        sign and unit of r

Symbols: v speed and r_w yaw rate from the wheels, r yaw rate of the gyroscope, δ steering angle, L
wheelbase, v_g speed over ground (see `drive`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from edge_agent.inputs.doctor.drive import (
    RATE_HZ,
    EvenDrive,
    correlate_series,
    find_median,
    smooth_twice,
)
from schemas.numeric import BoolArray, FloatArray

LONGEST_LAG_S: Final = 1.0  # [s] maximum lag that is searched
FEWEST_S: Final = 8.0  # [s] minimum time with excitation for any conclusion
# Excitation is a deviation of the regressor by more than this share of its 95 % quantile.
SLOW_SHARE: Final = 0.3
LEAST_LIKE: Final = 0.5  # minimum correlation at which a lag is used
# A lag is unknown if another peak of the correlation, further away than APART_S, is higher than the
# share RIVAL of the main peak.
APART_S = 0.3
RIVAL = 0.85
# Number of parts of the excited time; a gain is computed for each. A fault of a sensor appears in
# all parts, a slide only in some.
PARTS: Final = 8
# Share of the steering that understeer needs at the drive's high speed: mean and standard deviation
# over cars.
USUAL_BEND = 0.3
BEND_SPREAD = 0.4
# candidates for the share of the steering that understeer needs
BENDS: Final = np.linspace(-0.3, 1.8, 22)
# [1/m] yaw rate of the wheels per speed, from unequal radii: standard deviation over cars
UNLIKE_RADII: Final = 0.004
CORRELATED_S: Final = 1.0  # [s] two moments count as independent if they are this far apart


@dataclass(frozen=True)
class Fit:
    """Result of the fit left = gain · right + offset (+ further terms), where left and right are
    equal by physics. `left` and `right` are the fitted samples; the offset and the further terms
    are subtracted from `left`.

    `error` is the standard deviation of ln |gain|. `lag_s` is the delay of `left` relative to
    `right` [s]. `excited_s` is the time [s] in which the signals change enough.
    """

    gain: float
    offset: float
    correlation: float
    error: float
    excited_s: float
    lag_s: float
    lag_error_s: float
    left: FloatArray
    right: FloatArray
    further_gains: tuple[float, ...] = ()  # gains of the further terms of the left side
    parts: tuple[float, ...] = ()  # gain in each part of the excited time
    offset_error: float = np.inf  # standard deviation of the offset

    @property
    def is_known(self) -> bool:
        """Return True if the drive suffices to determine the gain of left over right. This requires
        enough time in which the signals change, a small error and a clear correlation.
        """
        return self.excited_s >= FEWEST_S and self.error < 0.3 and abs(self.correlation) > 0.45


NOTHING: Final = Fit(np.nan, np.nan, 0.0, np.inf, 0.0, 0.0, np.inf, np.zeros(0), np.zeros(0))


class Relation(NamedTuple):
    """The two sides of an identity (equation that holds by physics) and further terms, each an
    array (n,). The relation that is fitted is left = gain · right + offset + Σ k · term, with an
    unknown gain k for each further term.

    Attributes:
        left: left side.
        right: right side.
        per: factor (n,) by which the offset is multiplied; None means 1.
        bend: squared speed, divided by the square of the 95 % quantile of the drive's speed (n,),
            for the understeer of the car. The right side is then right · (1 + s · bend). The share
            s is unknown and has a prior, because at a single speed understeer cannot be separated
            from a steering gain. None means no understeer.
        loose: prior standard deviations of the gains k of the last further terms. These gains need
            a prior, because they are hard to separate from the main gain.
        length: wheelbase [m] if the right side contains it, else 1.
    """

    left: FloatArray
    right: FloatArray
    further_terms: tuple[FloatArray, ...] = ()
    per: FloatArray | None = None
    bend: FloatArray | None = None
    loose: tuple[float, ...] = ()
    length: float = 1.0  # [m] wheelbase, if the right side contains it


def _lateral_relation(d: EvenDrive) -> Relation:
    return Relation(d.ay, d.v * d.r)


def _longitudinal_relation(d: EvenDrive) -> Relation:
    # Remove slope, offset and drift, which lie below 0.1 Hz. What remains on both sides is braking
    # and accelerating.
    return Relation(d.ax - smooth_twice(d.ax, 10.0), d.v_dot - smooth_twice(d.v_dot, 10.0))


def _steering_relation(d: EvenDrive) -> Relation:
    # Multiply the equation by v. Otherwise turns at walking speed would outweigh all others; there
    # the angle is large and the steering linkage is not linear.
    v = np.where(np.abs(d.v) > 0.25 * d.fast, d.v, np.nan)
    return Relation(
        d.delta * v,
        d.wheelbase * d.r,
        per=v,
        bend=np.square(v / max(d.fast, 1e-9)),
        length=d.wheelbase,
    )


def _axle_relation(d: EvenDrive) -> Relation:
    return Relation(d.r_wheels, d.r, (d.v,), loose=(UNLIKE_RADII,))


def _ground_relation(d: EvenDrive) -> Relation:
    return Relation(d.v_ground, smooth_twice(np.abs(d.v)))


def _turning_relation(d: EvenDrive) -> Relation:
    fast = np.nanpercentile(d.v_ground, 95) if np.isfinite(d.v_ground).any() else 0.0
    known = np.isfinite(d.course) & (d.v_ground > 0.3 * fast)
    course = np.where(known, d.course, 0.0)
    rate = np.angle(np.exp(1j * np.diff(course, prepend=course[:1]))) * RATE_HZ
    rate = np.where(known & np.roll(known, 1), rate, np.nan)
    return Relation(smooth_twice(rate, 1.0), smooth_twice(smooth_twice(d.r, 1.0)))


IDENTITIES: Final[dict[str, Callable[[EvenDrive], Relation]]] = {
    "lateral": _lateral_relation,
    "longitudinal": _longitudinal_relation,
    "steering": _steering_relation,
    "axle": _axle_relation,
    "ground": _ground_relation,
    "turning": _turning_relation,
}


def fit_identities(drive: EvenDrive) -> dict[str, Fit]:
    """Fit every identity (two quantities that are equal by physics) to a drive; return the fits by
    name.
    """
    return {
        name: fit_identity(sides(drive), drive.moving, drive.grips, level=name == "ground")
        for name, sides in IDENTITIES.items()
    }


def fit_identity(sides: Relation, moving: FloatArray, grips: FloatArray, *, level: bool) -> Fit:
    """Fit left = gain · right + offset + Σ k · term over the moving part of the drive, after
    removal of the lag (delay) between both sides.

    The gain is the geometric mean of both regressions (left on right, right on left), so that noise
    on either side does not bias it.

    Args:
        sides: the two sides of the identity.
        moving: (n,) 1 where the car moves.
        grips: (n,) 0 where wheels slip; these samples are used for the lag, but not for the fit.
        level: True to fit without an offset, and to use every sample in motion; False to use only
            samples in which the signals change enough.
    """
    left = sides.left
    right = sides.right
    # A speed is large all the time and shows a lag only when it changes. So compare derivatives.
    if level:
        lag_s, lag_error_s = lag_of(
            np.gradient(smooth_twice(left, 1.0)), np.gradient(smooth_twice(right, 1.0)), moving
        )
    else:
        lag_s, lag_error_s = lag_of(left, right, moving)
    if np.isfinite(lag_error_s) and abs(lag_s) > 1.0 / RATE_HZ:
        left = shift_series(left, -lag_s)
    good = np.isfinite(left) & np.isfinite(right) & (moving > 0) & (grips > 0)
    for other in (
        *sides.further_terms,
        *(one for one in (sides.per, sides.bend) if one is not None),
    ):
        good &= np.isfinite(other)
    if good.sum() < FEWEST_S * RATE_HZ:
        return NOTHING
    fit = _fit_level(left[good], right[good]) if level else _fit_changes(sides, left, good)
    return replace(fit, lag_s=lag_s, lag_error_s=lag_error_s)


def _fit_level(y: FloatArray, x: FloatArray) -> Fit:
    """Fit y = gain · x without an offset to all n samples, (n,) each. The lag is not set."""
    excited_s = len(x) / RATE_HZ
    gain = _median_ratio(x, y)
    spread = float(np.std(y - gain * x)) / max(abs(gain) * float(np.sqrt(np.mean(x * x))), 1e-12)
    return Fit(
        gain=gain,
        offset=0.0,
        correlation=max(correlate_series(x, y), 1.0 - spread),
        error=spread / np.sqrt(max(excited_s / CORRELATED_S, 1.0)) + 0.003,
        excited_s=excited_s,
        lag_s=0.0,
        lag_error_s=np.inf,
        left=y,
        right=x,
        parts=_gains_of_parts(x, y, np.ones(len(x), bool)),
    )


def _fit_changes(sides: Relation, left: FloatArray, good: BoolArray) -> Fit:
    """Fit left = gain · right + offset + Σ k · term to the samples of the mask `good` in which the
    signals change enough. `left` is the left side after removal of the lag, which is not set.
    """
    x = sides.right[good]
    y = left[good]
    deviation = np.abs(x - find_median(x))
    excited = deviation > SLOW_SHARE * np.percentile(deviation, 95)
    excited_s = excited.sum() / RATE_HZ
    count = max(excited_s / CORRELATED_S, 1.0)
    constant = np.ones(len(x)) if sides.per is None else sides.per[good]
    bend = 0.0
    bend_error = 0.0
    if sides.bend is not None:
        bend, bend_error = _bend_of(x, y, constant, sides.bend[good], count)
        x = x * (1.0 + bend * sides.bend[good])
    table = np.stack([x, constant, *(other[good] for other in sides.further_terms)], axis=1)
    solution, errors = _fit_with_priors(table, y, sides.loose, count)
    rest = y - table[:, 1:] @ solution[1:]
    correlation = correlate_series(x, rest)
    gain = 0.0
    if correlation:
        slope = float(np.sign(correlation)) * float(rest.std() / max(x.std(), 1e-12))
        gain = float(np.sign(solution[0])) * float(np.sqrt(abs(solution[0] * slope)))
    error = float(np.sqrt(max(1.0 - correlation**2, 1e-6) / max(correlation**2, 1e-6) / count))
    further_gains = tuple(float(k) for k in solution[2:])
    if sides.bend is not None:
        per_square = find_median(sides.bend[good] / np.maximum(np.square(constant), 1e-12))
        further_gains = (gain * bend * per_square * sides.length,)
    return Fit(
        gain=gain,
        offset=float(solution[1]),
        correlation=correlation,
        error=float(np.hypot(error, bend_error)),
        excited_s=excited_s,
        lag_s=0.0,
        lag_error_s=np.inf,
        left=rest,
        right=x,
        further_gains=further_gains,
        parts=_gains_of_parts(x, rest, excited),
        offset_error=float(errors[1]),
    )


def _bend_of(
    x: FloatArray, y: FloatArray, constant: FloatArray, bend: FloatArray, count: float
) -> tuple[float, float]:
    """Estimate the understeer share s in y = gain · x · (1 + s · bend) + offset · constant. Return
    s, and the standard deviation of ln gain that follows from the uncertainty of s.

    x and y (n,) are the right and left side of the steering identity (steering angle against yaw
    rate). `bend` (n,) is the squared speed, divided by the square of the 95 % quantile of the
    drive's speed. At that quantile, a car with understeer needs 1 + s times the steering angle of a
    car without understeer.

    s is the posterior mean over the candidate values BENDS. The prior is the distribution over
    usual cars. The likelihood follows from the size of the residuals, which count as `count`
    independent samples.
    """
    costs = np.zeros(len(BENDS))
    gains = np.zeros(len(BENDS))
    least = 1e-3 * float(np.std(y)) + 1e-12
    for k, share in enumerate(BENDS):
        line = x * (1.0 + share * bend)
        gain, offset = _fit_line(line, constant, y)
        off = np.abs(y - gain * line - offset * constant)
        near = off <= 3.0 * 1.4826 * find_median(off) + 1e-12
        gain, offset = _fit_line(line[near], constant[near], y[near])
        left = find_median(np.abs(y - gain * line - offset * constant)) + least
        costs[k] = 2.0 * count * np.log(left) + ((share - USUAL_BEND) / BEND_SPREAD) ** 2
        gains[k] = np.log(max(abs(gain), 1e-12))
    weights = np.exp(-0.5 * (costs - costs.min()))
    weights /= weights.sum()
    centre = float(weights @ gains)
    return float(weights @ BENDS), float(np.sqrt(weights @ np.square(gains - centre)))


def _fit_line(x: FloatArray, constant: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return the gains k and o of the least-squares fit y = k · x + o · constant, with all arrays
    (n,). k is 0 if x is a multiple of `constant`.
    """
    square = constant @ constant
    centred = x - constant @ x / square * constant
    size = centred @ centred
    gain = float(centred @ y / size) if size > 1e-24 * (x @ x) else 0.0
    return gain, float(constant @ (y - gain * x) / square)


def _fit_with_priors(
    table: FloatArray, y: FloatArray, loose: tuple[float, ...], count: float
) -> tuple[FloatArray, FloatArray]:
    """Fit the gains of `y` = Σ gain · term by robust least squares, with the terms as columns of
    `table` (n, k). Return the gains (k,) and their standard deviations (k,).

    The gains of the last columns have a prior with mean 0 and the standard deviations `loose`.
    """
    solution = fit_robustly(table, y)
    off = np.abs(y - table @ solution)
    spread = max(1.4826 * find_median(off), 1e-9)
    near = off <= 3.0 * spread
    inside = table[near]
    weight = count / max(len(inside), 1) / spread**2
    normal = weight * (inside.T @ inside)
    first = len(normal) - len(loose)
    for k, std in enumerate(loose):
        normal[first + k, first + k] += 1.0 / std**2
    normal[np.diag_indices(len(normal))] += 1e-12 * np.trace(normal)
    inverse = np.linalg.inv(normal)
    if loose:
        solution = inverse @ (weight * (inside.T @ y[near]))
    return solution, np.sqrt(np.diag(inverse))


def _gains_of_parts(x: FloatArray, y: FloatArray, excited: BoolArray) -> tuple[float, ...]:
    """Return the gain of an identity (slope of y over x, two quantities that are equal by physics)
    in each of PARTS consecutive parts of a drive. Only the samples of the mask `excited`, in which
    the signals change enough, are used. Parts that are too short are left out.
    """
    found = []
    parts = (np.array_split(side[excited], PARTS) for side in (x, y))
    for right, left in zip(*parts, strict=True):
        if len(right) < 0.3 * RATE_HZ:
            continue
        size = np.sqrt(left @ left / max(right @ right, 1e-24))
        found.append(float(np.sign(right @ left) * size))
    return tuple(found)


def _median_ratio(x: FloatArray, y: FloatArray) -> float:
    big = np.abs(x) > 0.3 * np.percentile(np.abs(x), 95)
    return find_median(y[big] / x[big]) if big.any() else 0.0


def fit_robustly(table: FloatArray, y: FloatArray) -> FloatArray:
    """Return the least-squares solution x (k,) of table · x = y for a table (n, k), fitted twice.
    The second fit leaves out the rows whose residual in the first fit exceeds three robust standard
    deviations.
    """
    solution = np.linalg.lstsq(table, y, rcond=None)[0]
    off = np.abs(y - table @ solution)
    near = off <= 3.0 * 1.4826 * find_median(off) + 1e-12
    if near.sum() > 10 * table.shape[1]:
        solution = np.linalg.lstsq(table[near], y[near], rcond=None)[0]
    return np.asarray(solution)


def shift_series(x: FloatArray, seconds: float) -> FloatArray:
    """Return an evenly sampled signal x (n,) delayed by `seconds`. A positive delay corrects a
    signal that is early, a negative delay one that is late.
    """
    n = np.arange(len(x))
    good = np.isfinite(x)
    if good.sum() < 2:
        return x
    at = n - seconds * RATE_HZ
    moved = np.interp(at, n[good], x[good])
    return np.where(np.interp(at, n, good.astype(float), left=0.0, right=0.0) > 0.5, moved, np.nan)


def lag_of(left: FloatArray, right: FloatArray, moving: FloatArray) -> tuple[float, float]:
    """Return the delay of `left` (n,) relative to `right` (n,) [s] and the error of this delay [s].
    The delay is at the peak of |correlation| over the samples with `moving` = 1.

    The error is infinite if the delay is unknown. It grows with the difference between the lags of
    the two halves of the drive.
    """
    lag, sharp = _correlation_peak(left, right, moving)
    if not sharp:
        return 0.0, np.inf
    half = len(left) // 2
    parts = [
        _correlation_peak(left[p], right[p], moving[p])
        for p in (slice(None, half), slice(half, None))
    ]
    differences = [abs(part[0] - lag) for part in parts if part[1]]
    return lag, 0.02 + (0.7 * float(np.mean(differences)) if differences else 0.1)


def _correlation_peak(
    left: FloatArray, right: FloatArray, moving: FloatArray
) -> tuple[float, bool]:
    good = np.isfinite(left) & np.isfinite(right) & moving.astype(bool)
    if good.sum() < FEWEST_S * RATE_HZ:
        return 0.0, False
    x = np.where(good, right - np.mean(right[good]), 0.0)
    y = np.where(good, left - np.mean(left[good]), 0.0)
    most = round(LONGEST_LAG_S * RATE_HZ)
    size = len(x) + round(LONGEST_LAG_S * RATE_HZ)
    spectrum = np.fft.irfft(np.fft.rfft(y, size) * np.conj(np.fft.rfft(x, size)), size)
    across = np.abs(np.concatenate([spectrum[-most:], spectrum[: most + 1]]))
    scale = np.sqrt(float(np.sum(x * x)) * float(np.sum(y * y)))
    top = int(np.argmax(across))
    if scale == 0.0 or across[top] < LEAST_LIKE * scale or top in (0, 2 * most):
        return 0.0, False
    before, here, after = across[top - 1 : top + 2]
    bend = before - 2.0 * here + after
    lag = (top - most + (0.5 * (before - after) / bend if bend < 0.0 else 0.0)) / RATE_HZ
    far = np.abs(np.arange(len(across)) - top) > round(APART_S * RATE_HZ)
    inner = np.arange(1, len(across) - 1)
    peaks = inner[(across[1:-1] >= across[:-2]) & (across[1:-1] > across[2:])]
    # In a periodic drive, lags that differ by half a period fit equally well.
    if np.any(across[peaks[far[peaks]]] > RIVAL * here):
        return 0.0, False
    sharp = (
        across[max(top - 15, 0)] < 0.985 * here or across[min(top + 15, 2 * most)] < 0.985 * here
    )
    return float(lag), bool(sharp)
