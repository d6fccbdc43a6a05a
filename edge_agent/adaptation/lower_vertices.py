"""Triangular fuzzy sets whose lower vertices (feet) can be chosen freely: the sets that paper 004
tunes (section III.C, figures 2 and 3).

Legend
    peaks       upper vertices of the five sets of the mismatch [1] (5,)
    feet        their lower vertices between the peaks: right foot of set k, left foot of set k + 1
                [1] (8,)
    out_peaks   upper vertices of the five sets of the step, ln of the factor on R [nat] (5,)
    out_feet    their lower vertices [nat] (8,)
    w_k, c_k    membership of set k, and centroid (left foot + peak + right foot)/3 of its output
                set

The step is sum(w_k*c_k)/sum(w_k). The outer sets are shoulders: beyond the outer peaks their
membership is 1. With the feet at the neighbouring peaks and out_feet at the neighbouring out_peaks,
these are almost the sets of `memberships.Memberships`, whose feet always lie at the neighbouring
peaks and whose output sets are points. If the feet leave a gap and no set has a membership there,
the step is zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from edge_agent.adaptation.memberships import SETS
from schemas.errors import InputError
from schemas.numeric import FloatArray

FEET: Final = 2 * (SETS - 1)
# [1] smallest overlap of neighbouring sets over the distance of their peaks
LEAST_OVERLAP: Final = 0.02


@dataclass(frozen=True)
class LowerVertices:
    """Triangular fuzzy sets of the mismatch (of the innovation variance) and of the step of ln R.
    Their feet (lower corners) can be chosen, as shares of the distance between neighbouring peaks.

    Attributes:
        feet: for each pair of neighbours, how far set k extends towards peak k + 1, then how far
            set k + 1 extends towards peak k [1]; 1 means up to the peak.
        out_feet: the same shares for the output sets (sets of the step of ln R).
        peaks: upper vertices of the sets of the mismatch [1].
        out_peaks: upper vertices of the output sets [nat].

    Raises:
        InputError: a share is out of range, or peaks are not in increasing order.
    """

    feet: tuple[float, ...] = (1.0,) * FEET
    out_feet: tuple[float, ...] = (1.0,) * FEET
    peaks: tuple[float, ...] = (-0.8, -0.4, 0.0, 1.0, 4.0)
    out_peaks: tuple[float, ...] = (-0.10, -0.04, 0.0, 0.06, 0.20)

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
        if (pairs.sum(axis=1) < 1.0 + LEAST_OVERLAP).any():
            raise InputError(
                "lower_vertices.feet",
                "two neighbouring sets leave a gap",
                "let a pair sum to more than 1",
            )

    def triangle_sets(self) -> tuple[FloatArray, FloatArray]:
        """Return two arrays (5, 3): the fuzzy sets of the mismatch (actual over theoretical
        innovation variance, minus 1) and those of the step of ln R (measurement noise). The columns
        are left foot, peak, right foot.
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
        """Return a table for linear interpolation of the function `step`, as two arrays (knots,):
        the mismatches (actual over theoretical variance of the innovations, minus 1) [1], and the
        steps of ln R [nat] for them. R is the measurement noise.
        """
        inputs, _ = self.triangle_sets()
        corners = np.unique(np.clip(inputs.ravel(), self.peaks[0], self.peaks[-1]))
        even = np.linspace(self.peaks[0], self.peaks[-1], knots - len(corners) + 2)
        at = np.unique(np.concatenate([corners, even]))[:knots]
        at = np.append(at, np.full(knots - len(at), at[-1]))
        return at, np.array([self.step(float(value)) for value in at])

    def to_vector(self) -> FloatArray:
        """Return the free parameters, (16,): the shares `feet` of the input sets, then the shares
        `out_feet` of the output sets."""
        return np.array([*self.feet, *self.out_feet])

    @classmethod
    def from_vector(cls, vector: FloatArray) -> LowerVertices:
        """Return the fuzzy sets with the free parameters `vector` (16,). If the vector would leave
        a gap between two neighbouring sets, both sets are widened.
        """
        shares = np.asarray(vector, float).copy()
        pairs = shares[:FEET].reshape(-1, 2)
        lack = np.maximum(1.0 + LEAST_OVERLAP - pairs.sum(axis=1), 0.0)
        pairs += 0.5 * lack[:, None]
        return cls(tuple(map(float, shares[:FEET])), tuple(map(float, shares[FEET:])))

    @staticmethod
    def bounds() -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limits of the fuzzy sets' free parameters, (16,) each."""
        return np.full(2 * FEET, 0.3), np.full(2 * FEET, 1.8)


def _triangle_sets(peaks: tuple[float, ...], feet: tuple[float, ...]) -> FloatArray:
    """Return left foot, peak and right foot of five triangular fuzzy sets, (5, 3), from their
    `peaks` (5,) and their feet between the peaks `feet` (8,). The outer feet of the first and last
    set lie at their peaks.
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
