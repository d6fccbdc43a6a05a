"""Observations of friction for the fusion into a map, made from the columns of messages or of the
archive. Pure (no I/O).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion.likelihoods import (
    find_limited,
    find_slides,
    make_evidence,
    states_more_grip,
)
from fleet_service.fusion.shared import manoeuvre_of
from fleet_service.fusion.space import position_weights
from schemas import grid
from schemas.numeric import BoolArray, ByteArray, Float32Array, IntArray
from schemas.thresholds import MU_RANGE, SLIPPERY_MU, US_STEP
from schemas.wire import MAX_ROWS

SmallArray = NDArray[np.int8]
# Share of its value that a vehicle is assumed to have used if it does not report the grip used. It
# is below EXCITED_SHARE, so the assumption is cautious.
UNTOLD_SHARE: Final = 0.5


@dataclass(frozen=True, kw_only=True)
class Observations:
    """Admitted visits, arrays of shape (n,). A visit is one pass of a vehicle through a cell.

    Attributes:
        time: end of the visit [ns].
        cell, sector, second: cell and heading sector; `second` is the neighbouring sector if the
            heading is near its edge, else -1.
        vehicle, boot, region, sequence: identity of the row. `vehicle` is the vehicle's number, and
            `boot` a random number of its agent's start. `sequence` orders the rows that it sent
            about `region` since then.
        evidence: (n, 32) log-likelihood in steps, see `likelihoods.make_evidence`.
        reported: (n, 3) mean, standard deviation and P(slippery) of a value as it was reported; NaN
            for a lower bound.
        used: (n,) grip used; if the sender does not report it, UNTOLD_SHARE of the value.
        manoeuvre: (n,) kind of manoeuvre, see `shared.manoeuvre_of`.
        limited: (n,) 1 if a slip controller intervened at so little grip used that only slippery
            road explains it; -1 if the likelihood states that the road has more grip than was used;
            else 0.
        share: (n,) weight of the visit in `cell`, below 1 if the position is inaccurate.
    """

    time: IntArray
    cell: IntArray
    sector: SmallArray
    second: SmallArray
    vehicle: IntArray
    boot: IntArray
    region: IntArray
    sequence: IntArray
    evidence: ByteArray
    reported: Float32Array
    used: Float32Array
    manoeuvre: SmallArray
    limited: SmallArray
    share: Float32Array

    def take(self, rows: IntArray | BoolArray | slice) -> Observations:
        """Return the observations that the indices or mask `rows` selects."""
        return Observations(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})


def observations_of(columns: Mapping[str, NDArray[Any]], vehicle: IntArray) -> Observations:
    """Return the columns (n,) of admitted rows as observations that a `Fusion` accepts.

    Args:
        columns: columns of the archive, times in ns; `with_likelihood` (n,) is true for rows with a
            `log_likelihood`.
        vehicle: (n,) number of each vehicle.

    Times are rounded down to whole microseconds, as in the archive.
    """
    _, second = grid.sectors_touched(np.nan_to_num(columns["yaw"]))
    first = columns["sector"].astype(np.int8)
    limited = find_limited(columns, columns["mu_utilised"])
    steps, reported = make_evidence(columns, columns["with_likelihood"])
    used = np.where(
        np.isnan(columns["mu_utilised"]), UNTOLD_SHARE * reported[:, 0], columns["mu_utilised"]
    )
    # A sliding vehicle used all of the grip, so the error of the tyre curve does not apply.
    used = np.where(find_slides(columns, columns["with_likelihood"], limited), SLIPPERY_MU, used)
    used = np.clip(np.nan_to_num(used), *MU_RANGE).astype(np.float32)
    return Observations(
        time=columns["leave_time"] // US_STEP * US_STEP,
        cell=columns["cell"],
        sector=first,
        second=np.where(np.isnan(columns["yaw"]) | (second == first), -1, second).astype(np.int8),
        vehicle=vehicle,
        boot=columns["boot"],
        region=columns["region"],
        sequence=columns["seq"] * MAX_ROWS + columns["row"],
        evidence=steps,
        reported=reported,
        used=used,
        manoeuvre=manoeuvre_of(columns["used_longitudinal"], columns["used_lateral"]),
        limited=np.where(limited, 1, -1 * states_more_grip(columns, used)).astype(np.int8),
        share=position_weights(columns["latitude"], columns["yaw"], columns["position_std"]),
    )
