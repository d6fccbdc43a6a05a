"""Estimates -> what is worth telling: one observation per cell visit, and states at a set rate.

For each block of samples: `located` says where visits end (`cell_tracker`), the estimator bank is advanced with these
`closes`, and `observe` makes the records. What must be carried is an `Open`; any split of the samples gives the same
records in the same order. Pure.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_agent.observe.cell_tracker import NOWHERE, Located
from schemas import mugrid
from schemas.config import AgentConfig
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.runtime.jit import compiled
from schemas.thresholds import EXCITED_SHARE, NS, UTILISED_WINDOW_S
from schemas.wire import Columns, Kind, column_types

if TYPE_CHECKING:
    from edge_agent.estimators import Estimates

ABS_UNKNOWN: Final = -1  # no slip controller is read yet

# columns of an open visit
_ENTER, _LEAVE, _SAMPLES, _CELL, _SECTOR, _HEALTH = range(6)
_SPEED, _USED, _MU, _LOWER, _UPPER, _LATITUDE, _LONGITUDE, _YAW = range(8)
_WHOLES, _NUMBERS = 6, 8


class Records(NamedTuple):
    """Records of one kind: wire columns (n, …), the vehicle's index (n,), and which are to be sent at once (n,)."""

    kind: Kind
    columns: Columns
    vehicle: IntArray
    urgent: BoolArray


@dataclass(frozen=True)
class Open:
    """Visits under way (N, …) and the number of the last state slot (N,)."""

    wholes: IntArray
    numbers: FloatArray
    slot: IntArray

    @staticmethod
    def start(vehicles: int) -> Open:
        """No visit yet."""
        wholes = np.zeros((vehicles, _WHOLES), dtype=np.int64)
        wholes[:, _CELL] = NOWHERE
        return Open(wholes, np.zeros((vehicles, _NUMBERS)), np.full(vehicles, np.iinfo(np.int64).min))


def observe(
    before: Open, time: IntArray, located: Located, estimates: Estimates, config: AgentConfig
) -> tuple[Open, Records, Records]:
    """Records of a block: time (T, N) [ns UTC] -> the carried visits, observations, states."""
    after = Open(before.wholes.copy(), before.numbers.copy(), before.slot.copy())
    ended = int(np.count_nonzero(located.closes))
    row = np.zeros((ended, 2), dtype=np.int64)
    wholes = np.zeros((ended, _WHOLES), dtype=np.int64)
    numbers = np.zeros((ended, _NUMBERS))
    speed = np.hypot(estimates.vx, estimates.vy)
    told = np.stack([speed, estimates.mu_utilised, estimates.mu, estimates.mu_lower, estimates.mu_upper], axis=-1)
    pose = np.stack([located.latitude, located.longitude, located.yaw], axis=-1)
    place = np.stack([located.cell, located.sector, estimates.health.astype(np.int64)], axis=-1)
    count = _visit(
        time, place, pose, told, located.closes, located.inside, after.wholes, after.numbers, row, wholes, numbers
    )
    observations = _observations(row[:count], wholes[:count], numbers[:count], estimates.evidence, config)
    return after, observations, _states(after, time, located, estimates, config)


@compiled
def _visit(
    time: IntArray,
    place: IntArray,
    pose: FloatArray,
    told: FloatArray,
    closes: BoolArray,
    inside: BoolArray,
    open_wholes: IntArray,
    open_numbers: FloatArray,
    row: IntArray,
    wholes: IntArray,
    numbers: FloatArray,
) -> int:
    """Sequential core: add each sample to its visit, write out a visit when the next begins; returns how many."""
    window = np.int64(UTILISED_WINDOW_S * NS)
    count = 0
    for k in range(time.shape[0]):
        for n in range(time.shape[1]):
            whole, number = open_wholes[n], open_numbers[n]
            if closes[k, n]:
                if whole[_CELL] != NOWHERE:
                    row[count, 0], row[count, 1] = k, n
                    wholes[count], numbers[count] = whole, number
                    count += 1
                whole[:] = 0
                number[:] = 0.0
                whole[_ENTER], whole[_CELL], whole[_SECTOR] = time[k, n], place[k, n, 0], place[k, n, 1]
            if whole[_CELL] == NOWHERE:
                continue
            whole[_LEAVE] = time[k, n]
            whole[_SAMPLES] += 1
            whole[_HEALTH] |= place[k, n, 2]
            number[_SPEED] += told[k, n, 0]
            grown = whole[_LEAVE] - whole[_ENTER] > window
            number[_USED] = max(number[_USED], told[k, n, 1]) if grown else told[k, n, 1]
            number[_MU : _UPPER + 1] = told[k, n, 2:]
            if inside[k, n]:
                number[_LATITUDE : _YAW + 1] = pose[k, n]
    return count


def _typed(kind: Kind, columns: dict[str, NDArray[np.generic]]) -> Columns:
    return {name: columns[name].astype(dtype, copy=False) for name, dtype in column_types(kind).items()}


def _observations(
    row: IntArray, wholes: IntArray, numbers: FloatArray, evidence: FloatArray | None, config: AgentConfig
) -> Records:
    n = len(row)
    mu, upper, used = numbers[:, _MU], numbers[:, _UPPER], numbers[:, _USED]
    columns: dict[str, NDArray[np.generic]] = {
        "enter_time": wholes[:, _ENTER],
        "leave_time": wholes[:, _LEAVE],
        "cell": wholes[:, _CELL],
        "sector": wholes[:, _SECTOR],
        "latitude": numbers[:, _LATITUDE],
        "longitude": numbers[:, _LONGITUDE],
        "position_std": np.full(n, config.position_std),
        "yaw": numbers[:, _YAW],
        "yaw_std": np.full(n, config.yaw_std),
        "speed": numbers[:, _SPEED] / np.maximum(wholes[:, _SAMPLES], 1),
        "mu": mu,
        "mu_lower": numbers[:, _LOWER],
        "mu_upper": upper,
        "mu_utilised": used,
        "log_likelihood": _likelihood(row, evidence),
        "health": wholes[:, _HEALTH],
        "tyre_season": np.full(n, config.tyre_season),
        "air_temperature": np.full(n, np.nan),
        "abs_active": np.full(n, ABS_UNKNOWN),
    }
    limit = config.slippery_mu
    urgent = (upper < limit) | ((mu < limit) & (used >= EXCITED_SHARE * mu))
    return Records(Kind.OBSERVATION, _typed(Kind.OBSERVATION, columns), row[:, 1], urgent)


def _likelihood(row: IntArray, evidence: FloatArray | None) -> NDArray[np.uint8]:
    """Bytes (n, 32); (n, 0) of a bank without evidence. A visit that the bank did not follow from its start is flat."""
    if evidence is None:
        return np.zeros((len(row), 0), dtype=np.uint8)
    told = evidence[row[:, 0], row[:, 1]]
    known = np.isfinite(told).all(axis=-1, keepdims=True)
    return mugrid.encode_log_likelihood(np.where(known, told, 0.0))


def _states(after: Open, time: IntArray, located: Located, estimates: Estimates, config: AgentConfig) -> Records:
    """The first sample of each time slot, where the position is known; moves `after.slot` on."""
    slot = np.floor_divide(time, round(NS / config.state_rate_hz))
    earlier = np.vstack([after.slot[None], slot[:-1]])
    after.slot[:] = slot[-1] if len(slot) else after.slot
    k, n = np.nonzero((slot > earlier) & np.isfinite(located.latitude))
    columns: dict[str, NDArray[np.generic]] = {
        "time": time[k, n],
        "latitude": located.latitude[k, n],
        "longitude": located.longitude[k, n],
        "position_std": np.full(len(k), config.position_std),
        "yaw": located.yaw[k, n],
        **{
            name: getattr(estimates, name)[k, n]
            for name in ("vx", "vy", "yaw_rate", "sideslip", "mu", "mu_lower", "mu_upper", "health")
        },
    }
    return Records(Kind.STATE, _typed(Kind.STATE, columns), n.astype(np.int64), np.zeros(len(k), dtype=np.bool_))
