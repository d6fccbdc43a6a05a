"""The estimator bank: a compiled function advances the filters of N vehicles in one call.

The filter state of each vehicle is stored in a record of its own. Therefore results are bit-equal
whatever N is and however the samples are split into calls.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from edge_agent.estimators.estimates import ONE_FRICTION, Estimates
from edge_agent.estimators.shares import check_arrays, in_shares
from schemas.mugrid import BINS
from schemas.numeric import BoolArray, FloatArray
from schemas.runtime.jit import entry_point
from schemas.runtime.records import RecordArray

Part: TypeAlias = tuple[int, int, int]
"""Part of a bank for one thread: index of the context that only this thread uses, and its range of
vehicles [first, last).
"""

Kernel: TypeAlias = Callable[..., None]
"""Compiled function that advances filters: kernel(filters, contexts, t, signals, outputs, part). A
bank with evidence passes (outputs, closes, evidence) in place of `outputs`.

It reads t (T, N) and signals (T, N, 18) of the vehicles of `part`, changes their filters (N,), and
writes outputs (T, N, …), indexed by Column. It writes evidence (T, N, 32) where closes (T, N) is
True and where friction jumps within a visit; closes with shape (0, N) means nowhere. A context
contains the tables that all filters read, and scratch arrays that a step writes before it reads
them.
"""


class EstimatorBank:
    """Filters of N vehicles that are advanced together, all of one estimator. The function `create`
    of `registry` makes a bank.
    """

    def __init__(
        self,
        filters: RecordArray,
        context: RecordArray,
        kernel: Kernel,
        *,
        columns: int = ONE_FRICTION,
        evidence: bool = False,
        beliefs: Kernel | None = None,
    ) -> None:
        self._beliefs = beliefs
        self._filters = filters
        self._contexts = context
        self._kernel = kernel
        self._columns = columns
        self._entered = kernel
        count = len(filters)
        self._nowhere = (
            (np.zeros((0, count), np.bool_), np.zeros((0, count, BINS))) if evidence else ()
        )

    def advance(
        self,
        t: FloatArray,
        signals: FloatArray,
        closes: BoolArray | None = None,
        *,
        threads: int = 1,
    ) -> Estimates:
        """Advance all vehicles by the next samples.

        Args:
            t: (T, N) measurement time [s]; a sample whose time does not increase is skipped, and
                its health flags show this.
            signals: (T, N, 18) in the order of schemas.signals.CHANNELS; NaN is a missing reading.
            closes: (T, N), True at the first sample of a new visit (the passage of one map cell).
                With None, the bank does not separate visits.
            threads: number of threads that share the vehicles; the result does not depend on it.

        Returns:
            Estimates at the same samples. The field `evidence` (log-likelihood of the measurements
            for each friction) has values only where a visit ends or where friction jumps. At all
            other samples it is NaN. No other field contains NaN.

        Raises:
            InputError: an array has the wrong shape for the bank, or threads is below 1.
        """
        count = len(self._filters)
        t, signals = check_arrays(t, signals, closes, count)
        samples = t.shape[0]
        visits = self._nowhere
        evidence = None
        values = np.empty((samples, count, self._columns))
        if visits and closes is not None:
            evidence = np.full((samples, count, BINS), np.nan)
            visits = (np.ascontiguousarray(closes, np.bool_), evidence)
        results = (values, *visits) if visits else values
        if threads == 1:
            self._entered(self._filters, self._contexts, t, signals, results, (0, 0, count))
            if self._entered is self._kernel:
                # `check_arrays` ensures that the arguments always have the same types.
                self._entered = entry_point(self._kernel)
            return _pack_estimates(values, evidence, closes)
        if threads > len(self._contexts):
            self._contexts = np.repeat(self._contexts[:1], threads)
        whole = (self._filters, self._contexts, t, signals, results)
        in_shares(
            lambda share, first, last: self._kernel(*whole, (share, first, last)), count, threads
        )
        return _pack_estimates(values, evidence, closes)

    def memory(self, name: str) -> FloatArray:
        """Return a copy of one field of the filter's internal state, given by `name`, for all
        vehicles, (N, …).

        Plots use it to show the internal state of a filter.
        """
        return np.array(self._filters[name])

    def beliefs(self) -> tuple[FloatArray, FloatArray] | None:
        """Return the current beliefs about friction on the 32 bins of the friction grid, or None.

        The result is a pair of (N, 32) arrays: log(posterior/uniform) of the filter, and the
        log-likelihood of the measurements in the current visit (passage of one map cell) so far.
        Each row has maximum 0. Return None where the estimator has no belief on the grid.
        """
        if self._beliefs is None:
            return None
        own, visit = np.zeros((2, len(self._filters), BINS))
        self._beliefs(self._filters, self._contexts, own, visit)
        return own, visit


def _pack_estimates(
    values: FloatArray, evidence: FloatArray | None, closes: BoolArray | None
) -> Estimates:
    if evidence is None or closes is None:
        return Estimates(values)
    return Estimates(
        values, evidence, np.isfinite(evidence[..., 0]) & ~np.asarray(closes, np.bool_)
    )
