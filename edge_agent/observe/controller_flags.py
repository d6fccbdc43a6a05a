"""Filter for implausible flags of controllers (ABS, ESC, traction control), such as a lamp that is
always on or a wrongly decoded bit. Such a flag counts as unknown.

A flag is implausible in three cases:

- It is on, and has not yet been off for OFF_S in this trip. A flag that is never off carries no
  information.
- It has been on for STANDING_S while the vehicle stood. No controller acts on wheels that do not
  turn. This case ends when the flag has been off for OFF_S.
- In about the last MEMORY_S it was on for at least LEAST_ACTIVE_S, and for more than the share
  MOST_ACTIVE of the time. This case ends when the share falls again.

The module is pure (no I/O). A `FlagRecord` per vehicle and flag is kept between blocks, so that any
division of the samples into blocks gives the same result.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

import numpy as np

from edge_agent.estimators.common.readings import GAP_S
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.runtime.records import RecordArray, Records, records
from schemas.signals import FLAGS, S

# Design parameters.
OFF_S: Final = 1.0  # [s] time for which a flag must have been off before it is used
# [s] time at standstill after which an active flag is implausible. Locked wheels stand too, but a
# controller releases them within a fraction of a second.
STANDING_S: Final = 5.0
# [1] largest plausible share of active time. A long icy road reaches less, an average winter drive
# far less.
MOST_ACTIVE: Final = 0.3
# [s] shortest active time after which a flag can count as on too often. Braking from 30 m/s to rest
# on ice of friction .1 takes this long.
LEAST_ACTIVE_S: Final = 30.0
MEMORY_S: Final = 600.0  # [s] time constant of forgetting in the share of active time
STANDING_RATE: Final = 1.0  # [rad/s] the vehicle stands if no wheel is faster (about .3 m/s)


class Doubt(IntEnum):
    """Reason why a controller flag is implausible, as a bit value. Several reasons are added."""

    NEVER_OFF = 1
    STANDING = 2
    TOO_OFTEN = 4


REASONS: Final = {
    Doubt.NEVER_OFF: "has been on since the start",
    Doubt.STANDING: "is on while the vehicle stands",
    Doubt.TOO_OFTEN: "is on too often",
}


class FlagRecord:
    """State of one controller flag of one vehicle, from which the filter decides whether the flag
    is implausible. It is updated with each sample in which the flag is known.
    """

    time: float  # [s] time of the flag's last known sample
    off: float  # [s] time for which it has been off without interruption
    active: float  # [s] time for which it was on, with exponential forgetting (MEMORY_S)
    known: float  # [s] time for which it was known, with the same forgetting
    standing: float  # [s] time for which it was on at standstill, since it was last off for OFF_S
    was_off: bool  # True once it was off for OFF_S without interruption
    doubt: int  # sum of the reasons why it is implausible (`Doubt`); 0 if plausible


def new_flag_records(vehicles: int) -> RecordArray:
    """Return the initial state of the controller flags of N vehicles, (N, len(FLAGS)) records; no
    flag has been read yet.
    """
    flag_records = records(FlagRecord, vehicles, len(FLAGS))
    flag_records["time"] = np.nan
    return flag_records


def trusted_context(
    before: RecordArray, t: FloatArray, signals: FloatArray, context: FloatArray
) -> tuple[RecordArray, FloatArray]:
    """Replace implausible controller flags in the context signals by NaN (unknown).

    Args:
        before: (N, len(FLAGS)) states of the flags after the previous block.
        t: (T, N) times of the samples [s].
        signals: (T, N, channels); the wheel speeds show whether the vehicle stands.
        context: (T, N, len(CONTEXT)) context signals, which contain the flags.

    Returns:
        the states for the next block, and the context signals with NaN for implausible flags.
    """
    after = before.copy()
    checked = context.copy()
    wheels = np.abs(signals[..., S.OMEGA : S.OMEGA + 4])
    with np.errstate(invalid="ignore"):
        standing = np.where(
            np.isfinite(wheels).any(axis=-1),
            np.nan_to_num(wheels).max(axis=-1) < STANDING_RATE,
            False,
        )
    _check_flags(after, t, standing.astype(np.float64), checked)
    return after, checked


def doubted_flags(record: RecordArray) -> list[tuple[int, str, str]]:
    """Return a list of the controller flags that are implausible now, as (index of the vehicle,
    name of the flag, reason).
    """
    return [
        (
            int(n),
            FLAGS[flag],
            " and ".join(
                REASONS[reason] for reason in REASONS if record["doubt"][n, flag] & reason
            ),
        )
        for n, flag in np.argwhere(record["doubt"] > 0)
    ]


@compiled
def _check_flags(
    flags: Records[FlagRecord], t: FloatArray, standing: FloatArray, context: FloatArray
) -> None:
    """Update the states of all controller flags sample by sample, and set implausible flags in the
    context signals to NaN; this is the compiled part of `trusted_context`.
    """
    for k in range(t.shape[0]):
        for n in range(t.shape[1]):
            for i in range(3):
                value = context[k, n, i]
                if not np.isfinite(value):
                    continue
                record = flags[n, i]
                dt = (
                    min(max(t[k, n] - record.time, 0.0), GAP_S) if np.isfinite(record.time) else 0.0
                )
                record.time = t[k, n]
                _count_sample(record, dt, value > 0.5, standing[k, n] > 0.5)
                if value > 0.5 and record.doubt > 0:
                    context[k, n, i] = np.nan


@compiled
def _count_sample(record: FlagRecord, dt: float, on: bool, stands: bool) -> None:
    """Update the state of one controller flag with a new sample, and decide whether the flag is
    implausible (`record.doubt`).

    Args:
        record: state of the flag, which is changed.
        dt: time since the flag's previous known sample [s].
        on: True if the flag is on in this sample.
        stands: True if the vehicle stands in this sample.
    """
    keep = np.exp(-dt / MEMORY_S)
    record.known = record.known * keep + dt
    record.active = record.active * keep + (dt if on else 0.0)
    if on:
        record.off = 0.0
        if stands:
            record.standing += dt
    else:
        record.off += dt
        if record.off >= OFF_S:
            record.was_off = True
            record.standing = 0.0
    record.doubt = 0
    if on and not record.was_off:
        record.doubt += Doubt.NEVER_OFF
    if record.standing >= STANDING_S:
        record.doubt += Doubt.STANDING
    if record.active >= LEAST_ACTIVE_S and record.active > MOST_ACTIVE * record.known:
        record.doubt += Doubt.TOO_OFTEN
