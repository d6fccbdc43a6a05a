"""Times of observations that arrive after the checkpoint (the time before which observations are
final). Pure (no I/O).

A late visit is fused at the checkpoint, but with the time of the visit (`EntryRecord.late`). If no
other vehicle visited the cell since, it counts as in time. Otherwise it is an old report about the
present road: its likelihood is aged to the newest visit, and its weight is limited, because one
change of the road makes all old reports wrong (`votes.update_cell`).

All late visits get times directly after the checkpoint, the newest visit first. So of several
visits of one vehicle to a cell, the newest counts fully and the older ones as repetitions. The
order of arrival between two checkpoints does not matter.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from fleet_service.fusion import constants
from schemas.numeric import IntArray
from schemas.thresholds import NS, US_STEP

# [ns] A late visit is fused only if it is at most this much older than the checkpoint. After this
# time, the road has probably changed.
LATE_MOST_NS: Final = int(constants.CHANGE_S) * NS
# [ns] Interval directly after the checkpoint in which late visits get their times.
_PLACES_NS: Final = NS


def fused_at(time: IntArray, checkpoint: int) -> IntArray:
    """Return the time [ns] at which each late visit is fused, given the visits' end times `time`
    (n,) [ns]. All returned times lie within one second after `checkpoint` [ns], because older
    observations are final. The newest visit gets the earliest time, so that it is fused first and
    counts fully; older visits of the same vehicle then count as repetitions. The delays after the
    checkpoint are whole microseconds, the resolution of times in the archive.
    """
    age = np.clip(checkpoint - time, 0, LATE_MOST_NS)
    return np.asarray(checkpoint + age // (LATE_MOST_NS // _PLACES_NS) // US_STEP * US_STEP)
