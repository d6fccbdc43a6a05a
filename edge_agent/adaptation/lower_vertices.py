"""Triangular fuzzy sets whose lower vertices (feet) can be chosen freely: the sets that paper 004
tunes (section III.C, figures 2 and 3). They adapt the measurement noise R.

The input is the mismatch: actual over theoretical innovation variance, minus 1. The output is the
step: the change of ln R in one adaptation.

Legend
    peaks       upper vertices of the five sets of the mismatch [1] (5,)
    feet        two lower vertices between each pair of neighbouring peaks: right foot of set
                k, left foot of set k + 1 [1] (8,)
    out_peaks   upper vertices of the five sets of the step [nat] (5,)
    out_feet    lower vertices of the sets of the step, in the order of `feet` [nat] (8,)
    w_k         membership of the mismatch in set k
    c_k         centroid of output set k: (left foot + peak + right foot)/3

The step is sum(w_k*c_k)/sum(w_k). The outer sets are shoulders: beyond the outer peaks their
membership is 1. If the feet leave a gap and no set has a membership there, the step is zero.

The default estimator uses simpler sets (`memberships.Memberships`). Their feet always lie at the
neighbouring peaks, and their output sets are points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from edge_agent.adaptation.memberships import CLOSEST, MISMATCH_PEAKS, SETS, STEP_PEAKS
from schemas.errors import InputError
from schemas.numeric import FloatArray

FEET: Final = 2 * (SETS - 1)


@dataclass(frozen=True)
class LowerVertices:
    """Triangular fuzzy sets for the adaptation of the measurement noise R.

    The input sets describe the mismatch (actual over theoretical innovation variance, minus 1). The
    output sets describe the step, which is the change of ln R. The feet (lower corners) are given
    as shares of the distance between neighbouring peaks; a foot with share 1 lies at the
    neighbour's peak.

    Attributes:
        feet: two shares for each pair of neighbouring sets k and k + 1 [1]: the right foot of set
            k, measured from its peak, then the left foot of set k + 1, measured from its peak.
        out_feet: the same shares for the output sets.
        peaks: upper vertices of the input sets [1].
        out_peaks: upper vertices of the output sets [nat].

    Raises:
        InputError: a share is out of range, or peaks are not in increasing order.
    """

    feet: tuple[float, ...] = (1.0,) * FEET
    out_feet: tuple[float, ...] = (1.0,) * FEET
    peaks: tuple[float, ...] = MISMATCH_PEAKS
    out_peaks: tuple[float, ...] = STEP_PEAKS

    def __post_init__(self) -> None:
        for name in ("feet", "out_feet"):
            shares = np.asarray(getattr(self, name), float)
            if shares.shape != (FEET,) or not ((shares > 0.0) & (shares <= 2.0)).all():
                raise InputError(
                    f"lower_vertices.{name}", "out of range", f"give {FEET} shares in (0, 2]"
                )
        for name in ("peaks", "out_peaks"):
            peaks = np.asarray(getattr(self, name), float)
            if peaks.shape != (SETS,) or not (np.diff(peaks) > 0.0).all():
                raise InputError(
                    f"lower_vertices.{name}",
                    "are not in increasing order",
                    f"give {SETS} numbers in order",
                )
        pairs = np.asarray(self.feet).reshape(-1, 2)
        if (pairs.sum(axis=1) < 1.0 + CLOSEST).any():
            raise InputError(
                "lower_vertices.feet",
                "two neighbouring sets leave a gap",
                "let a pair sum to more than 1",
            )

    def triangle_sets(self) -> tuple[FloatArray, FloatArray]:
        """Return the vertices of the fuzzy sets as two arrays (5, 3) with the columns left foot,
        peak, right foot.

        The first array has the sets of the mismatch (actual over theoretical innovation variance,
        minus 1) [1]. The second has the sets of the step, the change of ln R [nat]. R is the
        measurement noise.
        """
        return _triangle_sets(self.peaks, self.feet), _triangle_sets(self.out_peaks, self.out_feet)

    def step(self, mismatch: float) -> float:
        """Return ln of the factor [nat] on the measurement noise R for a mismatch of the
        innovations (measurement minus prediction): actual/theoretical variance - 1 [1].
        """
        inputs, outputs = self.triangle_sets()
        weight = _membership_weights(inputs, mismatch)
        total = float(weight.sum())
        return float(weight @ outputs.mean(axis=1)) / total if total > 0.0 else 0.0

    def knot_table(self, knots: int) -> tuple[FloatArray, FloatArray]:
        """Return a table for linear interpolation of the function `step`, as two arrays (knots,).
        The first has mismatches (actual over theoretical innovation variance, minus 1) [1]. The
        second has, for each mismatch, the change of ln R [nat]. R is the measurement noise.
        """
        inputs, _ = self.triangle_sets()
        corners = np.unique(np.clip(inputs.ravel(), self.peaks[0], self.peaks[-1]))
        even = np.linspace(self.peaks[0], self.peaks[-1], knots - len(corners) + 2)
        at = np.unique(np.concatenate([corners, even]))[:knots]
        at = np.append(at, np.full(knots - len(at), at[-1]))
        return at, np.array([self.step(float(value)) for value in at])

    def to_vector(self) -> FloatArray:
        """Return the free parameters, (16,): the shares `feet` of the input sets, then the shares
        `out_feet` of the output sets.
        """
        return np.array([*self.feet, *self.out_feet])

    @classmethod
    def from_vector(cls, vector: FloatArray) -> LowerVertices:
        """Return the fuzzy sets with the free parameters `vector` (16,). If the vector would leave
        a gap between two neighbouring sets, both sets are widened.
        """
        shares = np.asarray(vector, float).copy()
        pairs = shares[:FEET].reshape(-1, 2)
        lack = np.maximum(1.0 + CLOSEST - pairs.sum(axis=1), 0.0)
        pairs += 0.5 * lack[:, None]
        return cls(tuple(map(float, shares[:FEET])), tuple(map(float, shares[FEET:])))

    @staticmethod
    def bounds() -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limits of the fuzzy sets' free parameters, (16,) each."""
        return np.full(2 * FEET, 0.3), np.full(2 * FEET, 1.8)


def _triangle_sets(peaks: tuple[float, ...], feet: tuple[float, ...]) -> FloatArray:
    """Return left foot, peak and right foot of five triangular fuzzy sets, (5, 3).

    `peaks` (5,) are the peaks. `feet` (8,) are the distances of the feet from the peaks of their
    sets, as shares of the distance between neighbouring peaks. Each pair of neighbours has two
    entries: right foot of the lower set, left foot of the upper set. The first set has no left
    slope and the last no right slope, so these outer feet lie at the peaks.
    """
    sets = np.repeat(np.asarray(peaks, float)[:, None], 3, axis=1)
    for k in range(SETS - 1):
        gap = peaks[k + 1] - peaks[k]
        sets[k, 2] += feet[2 * k] * gap
        sets[k + 1, 0] -= feet[2 * k + 1] * gap
    return sets


def _membership_weights(sets: FloatArray, mismatch: float) -> FloatArray:
    """Return the memberships (5,), degrees from 0 to 1, of a mismatch (actual over theoretical
    variance, minus 1) in five fuzzy sets. Beyond the outer peaks the membership in the outer set is
    1.
    """
    weight = np.zeros(SETS)
    for k, (left, peak, right) in enumerate(sets):
        if mismatch <= peak:
            shoulder = k == 0
            rising = (mismatch - left) / (peak - left) if peak > left else 0.0
            weight[k] = 1.0 if shoulder or mismatch == peak else max(rising, 0.0)
        else:
            shoulder = k == SETS - 1
            falling = (right - mismatch) / (right - peak) if right > peak else 0.0
            weight[k] = 1.0 if shoulder else max(falling, 0.0)
    return weight
