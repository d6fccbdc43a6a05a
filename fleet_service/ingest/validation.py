"""Validation of batches (messages with records of one vehicle). Pure (no I/O): the time is an
argument.

Three checks are made in this order, cheap ones first:
    identity   does the key belong to the sender, and do batch and key agree?      per message
    novelty    was this (vehicle, start, kind, region, seq) accepted before?       per message
    rows       is every value finite, in range, in its region and in time?         all rows at once

One invalid row refuses its batch, with row number and reason, and the batch need not be sent again.
The reason that a sender reads is the text of the broken rule.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache, lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas import grid, keys, tables
from schemas.errors import InputError
from schemas.numeric import IntArray
from schemas.wire import NEEDED, Columns, Kind
from schemas.wire.batches import Heads

BATCH: Final = -1  # row number of a refusal that concerns the batch as a whole
MAX_VISIT_NS: Final = 86_400_000_000_000  # [ns] a car may park in its cell for a day
# [ns] Longest time between rows of a batch. Agents send every second, and end a batch after ten
# minutes at the latest.
MAX_SPAN_NS: Final = 3_600_000_000_000
# [rad] Largest angle between yaw and the axis of the heading sector: 45°, and the bend in one
# visit.
YAW_TOLERANCE: Final = np.radians(75.0)
ESTIMATOR_PATTERN: Final = r"[a-z0-9][a-z0-9-]{0,63}"
# Number of parsed keys that are cached; a vehicle has two. Parsing one costs as much as all other
# checks of a message.
KEYS_REMEMBERED: Final = 1 << 16
_TOPIC: Final = {Kind.OBSERVATION: "obs", Kind.STATE: "state"}


class Range(NamedTuple):
    """Validation rule: the values of a report's column must lie in [least, most]. If `optional`,
    NaN is allowed too and means 'absent'.
    """

    column: str
    least: float
    most: float
    optional: bool = True


RANGES: Final = {
    kind: tuple(
        Range(f.name, *f.range, optional=f.name not in NEEDED[kind])
        for f in fields
        if f.range is not None
    )
    for kind, fields in ((Kind.OBSERVATION, tables.OBSERVATION), (Kind.STATE, tables.STATE))
}


class Clock(NamedTuple):
    """Time of the service, and limits for the time of a record, all in ns. A record is accepted if
    its time lies between `horizon` and `now` + `ahead`. The property `horizon` is `now` - `oldest`,
    or earlier if the clock may be wrong.

    Attributes:
        now: time of the service.
        ahead: how much later than `now` the time of an accepted record may be.
        oldest: largest age of an accepted record. Its age is counted from `now`, or from
            `earliest` if that is earlier.
        doubt: records that are later than `now` + `ahead`, by at most this much, are neither
            accepted nor refused; their senders repeat them.
        earliest: earliest time that the true time may be, if the service's clock may be wrong;
            None if the clock is reliable.
    """

    now: int
    ahead: int
    oldest: int
    doubt: int = 0
    earliest: int | None = None

    @property
    def horizon(self) -> int:
        """Return the oldest time [ns] that an accepted record may have. Streams (batches of one
        vehicle, start, kind and region) without newer records are dropped.
        """
        return (self.now if self.earliest is None else min(self.earliest, self.now)) - self.oldest


class Refusal(NamedTuple):
    """Reason for refusing a batch: name of the broken rule (for counting), row number, and text for
    the sender.
    """

    rule: str
    row: int
    reason: str


def is_doubted(refusal: Refusal, time: int, clock: Clock) -> bool:
    """Return True if a record at `time` [ns] is too far in the future only because the service's
    clock may be wrong. Its batch is then neither accepted nor refused, so the sender keeps and
    repeats it.
    """
    return refusal.rule == "time" and 0 < time - clock.now - clock.ahead <= clock.doubt


def check_heads(
    kind: Kind, owners: Sequence[keys.Parsed], heads: Heads, time: IntArray, clock: Clock
) -> tuple[IntArray, tuple[Refusal, ...]]:
    """Check the heads (fields other than records) of batches: owner and region must agree with the
    key, sequence numbers must be valid, and times must be acceptable.

    Args:
        kind: kind of the batches.
        owners: vehicle and region from each batch's key, (k,).
        heads: heads of the batches.
        time: time of each batch's first record [ns], (k,).
        clock: time of the service, and how far a record's time may differ from it.

    Returns:
        index of the first broken rule of each batch, (k,), -1 for a valid batch; and the rules to
        which the indices refer.
    """
    topic = _TOPIC[kind]
    held = heads.first_held
    wrong_owner = [
        o.name != name or o.topic.name != topic
        for o, name in zip(owners, heads.vehicle, strict=True)
    ]
    wrong_region = np.array([owner.quadint for owner in owners], np.int64) != heads.region
    bad_names = {name for name in set(heads.estimator) if name and not _is_estimator(name)}
    bad_name = (
        [name in bad_names for name in heads.estimator]
        if bad_names
        else np.zeros(len(owners), bool)
    )
    broken = (
        np.array(wrong_owner, bool),
        wrong_region,
        (heads.boot < 0) | (held < 1) | (held > heads.seq),
        np.array(bad_name, bool),
        _is_untimely(time, time, clock),
    )
    return _first_broken(broken), _HEAD_RULES


_HEAD_RULES: Final = (
    Refusal(
        "vehicle",
        BATCH,
        "vehicle: is not the vehicle of the key; publish on the key of this vehicle",
    ),
    Refusal(
        "region", BATCH, "region: is not the region of the key; start a new batch for each region"
    ),
    Refusal(
        "seq",
        BATCH,
        "seq: boot >= 0 and 1 <= first_held <= seq do not hold; count from 1 without gaps",
    ),
    Refusal("estimator", BATCH, "estimator: is not a name; use up to 64 of a-z, 0-9 and -"),
    Refusal("time", 0, "time: too old or in the future; set the clock"),
)


def _first_broken(broken: Sequence[NDArray[np.bool_]]) -> IntArray:
    """Return the index of the first broken rule for each item (n,), -1 if all rules hold. Each
    element of `broken` is the mask of one rule.
    """
    out = np.full(len(broken[0]), -1)
    for index in reversed(range(len(broken))):
        if broken[index].any():
            out[broken[index]] = index
    return out


@lru_cache(1024)
def _is_estimator(name: str) -> bool:
    return re.fullmatch(ESTIMATOR_PATTERN, name) is not None


@lru_cache(KEYS_REMEMBERED)
def owner_of(key: str) -> keys.Parsed | None:
    """Return the vehicle and region that a Zenoh key names; None if it is not a concrete key of a
    vehicle.
    """
    try:
        parsed = keys.parse(key)
    except InputError:
        return None
    return None if parsed.name is None else parsed


def check_rows(
    kind: Kind, columns: Columns, region: IntArray, clock: Clock
) -> tuple[IntArray, tuple[Refusal, ...]]:
    """Check every row (record) of batches, and return the first rule that it breaks.

    Args:
        kind: kind of the batches.
        columns: columns of `wire.Batch`, (n,).
        region: region of each row's batch, (n,).
        clock: time of the service, and how far a record's time may differ from it.

    Returns:
        index of the first broken rule of each row, (n,), -1 for a valid row; and the rules to which
        the indices refer.
    """
    broken = _broken_ranges(kind, columns)
    extra = (
        _broken_observation(columns, clock)
        if kind is Kind.OBSERVATION
        else _broken_state(columns, clock)
    )
    cell = columns["cell"] if kind is Kind.OBSERVATION else _cell_of(columns)
    extra.append(
        (
            grid.region_of(cell) != region,
            "region",
            "cell: lies outside the batch's region; start a new batch",
        )
    )
    broken += [rows for rows, _, _ in extra]
    others = (Refusal(rule, 0, reason) for _, rule, reason in extra)
    return _first_broken(broken), (*_range_rules(kind), *others)


ERASED: Final = Refusal(
    "erased", BATCH, "time: the data of this month or vehicle were erased; delete the batch"
)
TOO_LONG: Final = Refusal(
    "time", BATCH, "time: more than an hour between the batch's records; send one each second"
)


def too_long(time: IntArray, sizes: IntArray) -> NDArray[np.bool_]:
    """Return a mask of batches (k,): True if the batch spans more than MAX_SPAN_NS. `time` (n,)
    [ns] contains the times of all rows, `sizes` (k,) the number of rows of each batch.
    """
    if not len(time):
        return np.zeros(len(sizes), bool)
    starts = np.cumsum(sizes) - sizes
    return np.asarray(
        np.maximum.reduceat(time, starts) - np.minimum.reduceat(time, starts) > MAX_SPAN_NS
    )


def _broken_ranges(kind: Kind, columns: Columns) -> list[NDArray[np.bool_]]:
    broken = []
    for column, least, most, optional in RANGES[kind]:
        values = columns[column]
        broken.append(
            (values < least) | (values > most)
            if optional
            else ~((values >= least) & (values <= most))
        )
    return broken


@cache
def _range_rules(kind: Kind) -> tuple[Refusal, ...]:
    """Return the refusals for the rules of `_broken_ranges`."""
    return tuple(
        Refusal(
            column, 0, f"{column}: lies outside [{least:g}, {most:g}]; correct it at the source"
        )
        for column, least, most, _ in RANGES[kind]
    )


def _cell_of(columns: Columns) -> IntArray:
    """Return the cell of each row's position, (n,). For a position that is not finite the cell is
    arbitrary, because another rule refuses the row.
    """
    return grid.cell_of(
        *(np.nan_to_num(np.clip(columns[n], -180.0, 180.0)) for n in ("latitude", "longitude"))
    )


def _broken_observation(columns: Columns, clock: Clock) -> list[tuple[NDArray[np.bool_], str, str]]:
    enter = columns["enter_time"]
    leave = columns["leave_time"]
    cell = columns["cell"]
    at = _cell_of(columns)
    wrong_cell = at != cell
    mismatched = np.flatnonzero(wrong_cell)
    if len(mismatched):
        wrong_cell[mismatched] = ~(grid.neighbours(at[mismatched]) == cell[mismatched, None]).any(
            axis=1
        )
    with np.errstate(invalid="ignore"):  # an infinite yaw violates its range and is refused there
        turned = np.cos(columns["yaw"] - columns["sector"] * (np.pi / 2)) < np.cos(YAW_TOLERANCE)
    mu = columns["mu"]
    lower = columns["mu_lower"]
    upper = columns["mu_upper"]
    no_peak = columns["with_likelihood"] & (columns["log_likelihood"].min(axis=1) > 0)
    return [
        (
            _is_untimely(enter, leave, clock),
            "time",
            "leave_time: too old or in the future; set the clock",
        ),
        (
            (leave < enter) | (leave - enter > MAX_VISIT_NS),
            "time",
            "leave_time: before or long after enter_time; correct it at the source",
        ),
        (
            wrong_cell,
            "cell",
            "cell: does not contain the position; use the z21 quadint of latitude and longitude",
        ),
        (turned, "sector", "sector: does not match the yaw; use 0 east, 1 north, 2 west, 3 south"),
        (
            no_peak,
            "log_likelihood",
            "log_likelihood: has no maximum; give steps below it, so that the maximum is 0",
        ),
        (
            (lower > mu) | (mu > upper) | (lower > upper),
            "mu",
            "mu: mu_lower <= mu <= mu_upper does not hold; correct it at the source",
        ),
    ]


def _broken_state(columns: Columns, clock: Clock) -> list[tuple[NDArray[np.bool_], str, str]]:
    time = columns["time"]
    return [
        (_is_untimely(time, time, clock), "time", "time: too old or in the future; set the clock")
    ]


def _is_untimely(first: IntArray, last: IntArray, clock: Clock) -> NDArray[np.bool_]:
    return (first < clock.horizon) | (last > clock.now + clock.ahead)
