"""Recorded drives as input of a search for memberships (parameters of the fuzzy sets). The true
friction of recorded drives is unknown. Therefore memberships are scored only by how well the filter
predicts the next measurements.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from edge_agent.inputs.correct import correct_log
from edge_agent.inputs.signal_log import SignalLog
from edge_agent.lab.tuning.objectives import TuningSet
from schemas.errors import InputError
from schemas.vehicle import Vehicle

MOST_PARTS: Final = 24  # maximum number of parts, similar to the number of simulated drives
FEWEST_PARTS: Final = 3
HELD_OUT: Final = 3  # the last third of the parts is held out


def own_drives(
    logs: Sequence[tuple[SignalLog, Vehicle]], duration_s: float
) -> tuple[TuningSet, TuningSet]:
    """Cut recordings into parts of `duration_s` [s]; return the parts for the search and the
    held-out parts.

    The last third of the parts is held out. All parts have the same number of samples: the number
    that the recording with the lowest sampling rate has in `duration_s`. Recordings are not
    resampled. Therefore parts of recordings with a higher rate are shorter than `duration_s`.

    Raises:
        InputError: the recordings are too short.
    """
    samples = min(round(duration_s / sample_step(log)) for log, _ in logs)
    parts = [
        (log, vehicle, first)
        for log, vehicle in logs
        for first in range(0, len(log.t) - samples + 1, samples)
    ]
    if len(parts) < FEWEST_PARTS or samples < 2:
        raise InputError(
            "log",
            f"{len(parts)} parts of {duration_s:g} s are too few",
            f"give {FEWEST_PARTS} at least, better twenty",
        )
    chosen = [
        parts[k] for k in np.unique(np.linspace(0, len(parts) - 1, MOST_PARTS).round().astype(int))
    ]
    train = len(chosen) - max(1, len(chosen) // HELD_OUT)
    return _side_by_side(chosen[:train], samples), _side_by_side(chosen[train:], samples)


def sample_step(log: SignalLog) -> float:
    """Return the median time between two samples of a log [s]; 0 if it has only one sample."""
    return float(np.median(np.diff(log.t))) if len(log.t) > 1 else 0.0


def _side_by_side(parts: Sequence[tuple[SignalLog, Vehicle, int]], samples: int) -> TuningSet:
    t = np.stack([log.t[first : first + samples] - log.t[first] for log, _, first in parts], axis=1)
    signals = np.stack(
        [
            correct_log(t[:, n], log.signals[first : first + samples], vehicle)
            for n, (log, vehicle, first) in enumerate(parts)
        ],
        axis=1,
    )
    unknown = np.full(t.shape, np.nan)
    return TuningSet(tuple(vehicle for _, vehicle, _ in parts), t, signals, unknown, unknown)
