"""Who and what is let in. Pure: the time and the batches are arguments.

Three questions, in this order, the cheap ones first:
    identity   is the key the sender's own, and does the batch say the same place and name?      per message
    novelty    was this (vehicle, boot, kind, region, seq) admitted before?                      per message
    rows       is every value finite, in range, at its place and in its time?                    all rows at once

A batch with one bad row is refused whole, with row and reason; the refusal settles it. Rules are tables: the reason
that a sender reads is the text of the rule.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas import grid, keys
from schemas.errors import InputError
from schemas.numeric import IntArray
from schemas.wire import Batch, Columns, Kind

BATCH: Final = -1  # row number of a refusal that concerns the batch as a whole
MAX_AHEAD: Final = 1 << 20  # seqs between watermark and newest: a bitmap of 128 kB; a full spool holds fewer batches
MAX_VISIT_NS: Final = 86_400_000_000_000  # a car may park in its cell for a day
YAW_TOLERANCE: Final = np.radians(75.0)  # between yaw and the sector's axis: 45° and what a bend turns in one visit
_TOPIC: Final = {Kind.OBSERVATION: "obs", Kind.STATE: "state"}


class Range(NamedTuple):
    """A column must lie in [least, most]; NaN is 'absent' where `optional`."""

    column: str
    least: float
    most: float
    optional: bool = True


_POSE: Final = (
    Range("latitude", -grid.MAX_LATITUDE, grid.MAX_LATITUDE, optional=False),
    Range("longitude", -180.0, 180.0, optional=False),
    Range("position_std", 0.0, 100.0),
    Range("yaw", -1000.0, 1000.0),
)
_MU: Final = tuple(Range(name, 0.0, 2.0) for name in ("mu", "mu_lower", "mu_upper"))
RANGES: Final = {
    Kind.OBSERVATION: (
        *_POSE, *_MU,
        Range("mu_utilised", 0.0, 2.0), Range("yaw_std", 0.0, 10.0), Range("speed", 0.0, 100.0),
        Range("sector", 0, grid.SECTORS - 1), Range("tyre_season", 0, 3), Range("abs_active", -1, 1),
        Range("air_temperature", -90.0, 80.0),
    ),
    Kind.STATE: (
        *_POSE, *_MU,
        Range("vx", -100.0, 100.0), Range("vy", -100.0, 100.0), Range("yaw_rate", -20.0, 20.0),
        Range("sideslip", -4.0, 4.0),
    ),
}  # fmt: skip


class Clock(NamedTuple):
    """The service's time and how far a record may be from it, all in ns."""

    now: int
    ahead: int
    oldest: int


class Refusal(NamedTuple):
    """Why a batch was refused: the rule (what is counted), the row, and the text for the sender."""

    rule: str
    row: int
    reason: str


def check_identity(parsed: keys.Parsed, batch: Batch) -> Refusal | None:
    """Whether the batch is the key owner's, for the key's region, with a usable sequence number."""
    if parsed.topic.name != _TOPIC[batch.kind] or parsed.who != batch.vehicle:
        return Refusal("vehicle", BATCH, "vehicle: is not the one of the key; publish on your own key")
    if parsed.place != batch.region:
        return Refusal("region", BATCH, "region: is not the one of the key; never let a batch span regions")
    if batch.boot < 0 or not 1 <= batch.first_held <= batch.seq:
        return Refusal("seq", BATCH, "seq: boot >= 0 and 1 <= first_held <= seq do not hold; count from 1 without gaps")
    return None


def owner_of(key: str) -> keys.Parsed | None:
    """Whose key this is, and for which region; None if it is no concrete key of ours."""
    try:
        return keys.parse(key)
    except InputError:
        return None


def check_rows(kind: Kind, columns: Columns, region: IntArray, clock: Clock) -> tuple[IntArray, tuple[Refusal, ...]]:
    """The first broken rule of every row.

    Args:
        kind: of the columns.
        columns: those of `wire.Batch`, (n,).
        region: (n,) region of each row's batch.
        clock: service time and bounds.

    Returns:
        (n,) index into the second value, -1 for a good row; and the rules.
    """
    broken, rules = _broken_ranges(kind, columns)
    extra = _broken_observation(columns, clock) if kind is Kind.OBSERVATION else _broken_state(columns, clock)
    cell = columns["cell"] if kind is Kind.OBSERVATION else _cell_of(columns)
    extra.append((grid.region_of(cell) != region, "region", "cell: lies outside the batch's region; start a batch"))
    broken += [rows for rows, _, _ in extra]
    rules += [Refusal(rule, 0, reason) for _, rule, reason in extra]
    stacked = np.stack(broken)
    return np.where(stacked.any(axis=0), stacked.argmax(axis=0), -1), tuple(rules)


def _broken_ranges(kind: Kind, columns: Columns) -> tuple[list[NDArray[np.bool_]], list[Refusal]]:
    broken, rules = [], []
    for column, least, most, optional in RANGES[kind]:
        values = columns[column]
        inside = (values >= least) & (values <= most)
        broken.append(~(inside | np.isnan(values)) if optional and values.dtype.kind == "f" else ~inside)
        rules.append(Refusal(column, 0, f"{column}: lies outside [{least:g}, {most:g}]; correct it at the source"))
    return broken, rules


def _cell_of(columns: Columns) -> IntArray:
    """Cell of the pose; of nowhere, where the pose is not finite (which another rule refuses)."""
    return grid.cell_of(*(np.nan_to_num(np.clip(columns[n], -180.0, 180.0)) for n in ("latitude", "longitude")))


def _broken_observation(columns: Columns, clock: Clock) -> list[tuple[NDArray[np.bool_], str, str]]:
    enter, leave, cell = columns["enter_time"], columns["leave_time"], columns["cell"]
    at = _cell_of(columns)
    elsewhere = (at != cell) & ~(grid.neighbours(at) == cell[:, None]).any(axis=1)
    with np.errstate(invalid="ignore"):  # an infinite yaw is out of range anyway
        turned = np.cos(columns["yaw"] - columns["sector"] * (np.pi / 2)) < np.cos(YAW_TOLERANCE)
    mu, lower, upper = columns["mu"], columns["mu_lower"], columns["mu_upper"]
    return [
        (_untimely(enter, leave, clock), "time", "leave_time: too old or in the future; set the clock"),
        ((leave < enter) | (leave - enter > MAX_VISIT_NS), "time", "leave_time: before or long after enter_time; mend"),
        (elsewhere, "cell", "cell: is not at the pose; use the z21 quadint of latitude and longitude"),
        (turned, "sector", "sector: is not the yaw's; 0 east, 1 north, 2 west, 3 south"),
        ((lower > mu) | (mu > upper) | (lower > upper), "mu", "mu: not mu_lower <= mu <= mu_upper; correct it"),
    ]  # fmt: skip


def _broken_state(columns: Columns, clock: Clock) -> list[tuple[NDArray[np.bool_], str, str]]:
    time = columns["time"]
    return [(_untimely(time, time, clock), "time", "time: too old or in the future; set the clock")]


def _untimely(first: IntArray, last: IntArray, clock: Clock) -> NDArray[np.bool_]:
    return (first < clock.now - clock.oldest) | (last > clock.now + clock.ahead)


@dataclass
class Stream:
    """Which batches of one (vehicle, boot, kind, region) were admitted: watermark and gap bitmap.

    Attributes:
        low: every seq up to here is settled, or will never come.
        seen: bit k is set if low + 1 + k was admitted.
        pending: admitted, not yet on disk.
    """

    low: int = 0
    seen: int = 0
    pending: set[int] = field(default_factory=set)

    def admitted(self, seq: int) -> bool:
        """Whether this seq was admitted before."""
        return seq <= self.low or bool(self.seen >> (seq - self.low - 1) & 1)

    def admit(self, seq: int) -> bool:
        """Note a seq; False if it is too far ahead for the bitmap (not noted)."""
        if seq - self.low > MAX_AHEAD:
            return False
        if seq > self.low:
            self.seen |= 1 << (seq - self.low - 1)
            self._close()
        return True

    def raise_to(self, first_held: int) -> None:
        """Older than `first_held` never comes."""
        if first_held - 1 > self.low:
            self.seen >>= first_held - 1 - self.low
            self.low = first_held - 1
        self._close()

    def _close(self) -> None:
        ones = (~self.seen & (self.seen + 1)).bit_length() - 1  # length of the run of set bits at the bottom
        self.seen >>= ones
        self.low += ones


StreamKey = tuple[int, int, Kind, int]


class Streams:
    """All streams of one service, by (vehicle number, boot, kind, region)."""

    def __init__(self) -> None:
        self._streams: dict[StreamKey, Stream] = {}

    def __getitem__(self, key: StreamKey) -> Stream:
        return self._streams.setdefault(key, Stream())

    def __len__(self) -> int:
        return len(self._streams)


def rows_of(batch: Batch) -> dict[str, Any]:
    """Columns of a batch with the likelihood always (n, 32), and `told` (n,): whether it was there."""
    columns: dict[str, Any] = dict(batch.columns)
    if batch.kind is Kind.OBSERVATION:
        sent = columns["log_likelihood"]
        columns["told"] = np.full(batch.rows, sent.shape[1] > 0)
        if not sent.shape[1]:
            columns["log_likelihood"] = np.zeros((batch.rows, 32), np.uint8)
    return columns
