"""From the archive back to what a service knows, or knew: which batches it holds, and what it believes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import reduce
from operator import and_
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from fleet_service.archive import layout, reading, segments
from fleet_service.archive.load import Damaged, pass_over
from fleet_service.archive.pseudonyms import number
from fleet_service.fusion import Fusion, Updated, observations_of
from fleet_service.fusion.constants import EPOCH_NS
from fleet_service.ingest.dedup import SequenceTrackers
from fleet_service.ingest.weather import archived
from schemas.numeric import IntArray
from schemas.tables import US, US_STEP
from schemas.wire import Kind

IDENTITY: Final = ["vehicle", "boot", "region", "seq"]
_FIRST_TIME: Final = {Kind.OBSERVATION: "enter_time", Kind.STATE: "time"}  # by which a batch is too old
COLUMNS: Final = [
    *("leave_time", "cell", "sector", "latitude", "longitude", "position_std", "yaw", "mu", "mu_lower", "mu_upper"),
    *("mu_utilised", "log_likelihood", *IDENTITY, "row", "received_at", "late", "weight"),
]  # of what the fusion takes
Box = tuple[float, float, float, float]  # west, south, east, north [deg]
MARGIN_DEG: Final = 0.002  # around a box: over 100 m, more than a visit's position error moves what it tells


def restore_streams(root: Path, streams: SequenceTrackers, damaged: Damaged = pass_over) -> int:
    """Note every archived batch as admitted; returns the latest time at which one was received [ns], or 0."""
    seen = 0
    for kind, first in _FIRST_TIME.items():
        columns = (*IDENTITY, "first_held", first, "received_at")
        tables = list(reading.read(root, kind, columns, damaged=damaged))
        table = pa.concat_tables(tables) if tables else segments.SCHEMAS[kind].empty_table()
        seen = max(seen, int(segments.nanoseconds(table["received_at"]).max(initial=0)))
        vehicle = _numbers(table["vehicle"].to_numpy().astype(str))
        boot, region, seq, first_held = (table[name].to_numpy() for name in (*IDENTITY[1:], "first_held"))
        streams.restore(kind, vehicle, boot, region, seq, first_held, segments.nanoseconds(table[first]))
    return seen


def _numbers(pseudonyms: NDArray[np.str_]) -> IntArray:
    distinct, index = np.unique(pseudonyms, return_inverse=True)
    return np.array([number(p) for p in distinct.tolist()], np.int64)[index]


class Since(NamedTuple):
    """Which rows a replay takes: received after `received` and until `until` [ns], near `box` [deg].

    Cells do not depend on each other once weights are known, so that those well inside a box come out as in a whole
    replay.
    """

    received: int | None = None
    until: int | None = None
    box: Box | None = None

    def where(self) -> pc.Expression | None:
        """The rows as a filter, or None for all."""
        parts = []
        received_at = pc.field("received_at")
        if self.received is not None:
            parts.append(received_at > _time(self.received))
        if self.until is not None:
            parts.append(received_at <= _time(self.until))
        if self.box is not None:
            west, south, east, north = self.box
            parts.append((pc.field("longitude") > west - MARGIN_DEG) & (pc.field("longitude") < east + MARGIN_DEG))
            parts.append((pc.field("latitude") > south - MARGIN_DEG) & (pc.field("latitude") < north + MARGIN_DEG))
        return reduce(and_, parts) if parts else None


def _time(ns: int) -> pa.Scalar[Any]:
    return pa.scalar(ns // US_STEP, pa.int64()).cast(US)


def past(root: Path, lateness_s: float, until: int, box: Box | None = None) -> Fusion:
    """The fusion of a service that had received everything until a moment [ns], near a box [deg].

    Raises:
        OSError: the archive cannot be read.
    """
    fusion = Fusion(lateness_s)
    fusion.update_weather(archived(root, received_until=until))
    for _ in replay(root, fusion, Since(until=until, box=box)):
        pass  # the alerts of then are history
    return fusion


def replay(
    root: Path,
    fusion: Fusion,
    since: Since = Since(),  # noqa: B008 immutable
    damaged: Damaged = pass_over,
) -> Iterator[Updated]:
    """Replay the archive into `fusion` in order of time, with the weights that were used; yields once per epoch.

    Args:
        root: of the archive.
        fusion: a new one, or one that holds everything that was received before.
        since: the rows wanted.
        damaged: is called with a damaged file.
    """
    days = (None, None if since.until is None else since.until // layout.DAY_NS + 1)
    tables = list(reading.read(root, Kind.OBSERVATION, COLUMNS, since.where(), days, damaged))
    if not tables:
        return
    table = pa.concat_tables(tables)
    rows = segments.rows_of(table.sort_by("leave_time"))
    o = observations_of(rows, _numbers(rows["vehicle"].astype(str)))
    borders = np.flatnonzero(np.diff(o.time // EPOCH_NS)) + 1
    for part in np.split(np.arange(len(o.time)), borders):
        if len(part):
            yield fusion.update(o.take(part), rows["weight"][part], rows["late"][part].astype(bool))
