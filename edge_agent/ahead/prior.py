"""The map as prior knowledge about the friction in the vehicle's current cell. The module is pure
(no I/O).

The estimator itself does not use the map. Its results, and the published evidence of a visit
(passage of one cell), are bit-equal with and without a map. This module computes a second belief
(probabilities of friction). It is the belief that the estimator would have if it had started the
visit with the map's belief.

At the border of a cell, the filter's and the map's belief give the initial belief q. Inside the
cell, the measurements turn q into p_M. The result p is a mean of p_M and the filter's own belief w,
weighted by the probability β' that the map is wrong:

    q(μ)  ∝  [(1 - h)·w⁻(μ) + h·u(μ)] · m(μ)/u(μ)     at the border of a cell
    p_M   ∝  q · L            p  =  (1 - β')·p_M + β'·w            inside the cell

Legend
    w⁻, w   the filter's own belief at the border, and now             (32,)
    m       the map's belief about this cell, faded with its age        (32,)
    u       uniform distribution on the friction grid                   (32,)
    h       probability that the road changes at this border
    L       likelihood of the visit's measurements so far               (32,)
    q, p_M  belief with the map at the border, and now                  (32,)
    p       result: mixture of the beliefs with and without the map     (32,)
    β, β'   probability that the map is wrong here, before and after the measurements

h is the total variation distance between the map's beliefs about the last cell and this cell. If
the map knows only this cell, h is BLIND. Otherwise h is at least LEAST_CHANGE.

β' follows from Bayes' rule: β' = β·Z_W/(β·Z_W + (1 - β)·Z_M) with Z_M = Σ q·L and Z_W = Σ w⁻·L. In
the first cell β is SHARE, its lowest value. At each later border β = SHARE + KEPT·(β' - SHARE).

At a border, only the filter's own belief is carried to the next cell, never the mixture p.
Otherwise the map's belief about one cell would be counted again in the next. The mixture p is an
instance of Bayesian model averaging (Hoeting et al., Stat. Sci. 14, 1999).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from schemas import mugrid
from schemas.numeric import FloatArray, IntArray

# Share of cells in which a map with narrow intervals is wrong, because of other tyres, small
# patches or positions assigned to the wrong cell.
SHARE: Final = 0.2
MOST: Final = 0.98  # maximum of β, so that the map can always be trusted again
# Share of the distrust that passes to the next cell. After ten cells (a hundred metres), a map that
# was wrong is mostly trusted again.
KEPT: Final = 0.9
BLIND: Final = 0.5  # assumed value of h if the map knows only one of the two cells
# Minimum probability that the friction changes at the border of a cell. For cells of ten metres, it
# corresponds to the estimator's mean of 190 m between changes.
LEAST_CHANGE: Final = 0.05
NOWHERE: Final = -1


class MapPrior:
    """Combination of the map's beliefs with the beliefs of the filters of N vehicles."""

    def __init__(self, vehicles: int) -> None:
        self._key = np.full(vehicles, NOWHERE)
        self._map: list[FloatArray | None] = [None] * vehicles
        # q of the legend: belief with the map, at the border
        self._entry = np.tile(mugrid.PRIOR, (vehicles, 1))
        # w⁻ of the legend: the filter's own belief at the border
        self._border = np.tile(mugrid.PRIOR, (vehicles, 1))
        # w of the legend: the filter's own belief at the last step
        self._own = np.tile(mugrid.PRIOR, (vehicles, 1))
        self._wrong = np.full(vehicles, SHARE)  # β of the legend, at the border
        self._found = np.full(vehicles, SHARE)  # β' of the legend, now

    def entered_vehicles(self, keys: IntArray) -> list[int]:
        """Return the indices of the vehicles that have entered another place (one map cell and
        heading sector) since the last call of `step`. For each of them the caller must pass the
        map's belief about the new place to the next call of `step`.
        """
        return np.flatnonzero(keys != self._key).tolist()

    def step(
        self,
        keys: IntArray,
        own: FloatArray,
        visit: FloatArray,
        map_beliefs: dict[int, FloatArray | None],
    ) -> FloatArray:
        """Combine the friction beliefs of the vehicles' filters with the map; return the results,
        (N, 32) probabilities.

        Args:
            keys: (N,) current place (cell·4 + sector) of each vehicle, NOWHERE where unknown.
            own: (N, 32) log(belief/uniform): logarithm of each filter's own belief relative to the
                uniform distribution.
            visit: (N, 32) log-likelihood of the measurements in the current visit (passage of one
                place) so far.
            map_beliefs: for each index that `entered_vehicles` returned, the map's belief about
                that vehicle's new place; None if the map has no data there.
        """
        now = _normalise_rows(np.exp(own))
        out = now.copy()
        for k, belief in map_beliefs.items():
            self._enter_place(k, int(keys[k]), belief)
        for k in [k for k, known in enumerate(self._map) if known is not None]:
            likelihood = np.exp(visit[k])
            informed = self._entry[k] * likelihood
            right = informed.sum()
            wrong = (self._border[k] * likelihood).sum()
            share = (
                self._wrong[k] * wrong / (self._wrong[k] * wrong + (1.0 - self._wrong[k]) * right)
            )
            self._found[k] = min(max(share, SHARE), MOST)
            out[k] = (1.0 - self._found[k]) * informed / right + self._found[k] * now[k]
        self._own = now
        return out

    def _enter_place(self, k: int, key: int, belief: FloatArray | None) -> None:
        before = self._map[k]
        self._map[k] = belief
        self._key[k] = key
        share = SHARE + KEPT * (self._found[k] - SHARE)
        self._wrong[k] = share
        self._found[k] = share
        if belief is None:
            return
        change = (
            BLIND
            if before is None
            else max(1.0 - float(np.minimum(before, belief).sum()), LEAST_CHANGE)
        )
        self._border[k] = (1.0 - LEAST_CHANGE) * self._own[k] + LEAST_CHANGE * mugrid.PRIOR
        carried = (1.0 - change) * self._own[k] + change * mugrid.PRIOR
        self._entry[k] = _normalise_rows((carried * belief)[None])[0]


def _normalise_rows(weights: FloatArray) -> FloatArray:
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
