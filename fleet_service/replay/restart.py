"""Start of a service: load the newest readable checkpoint (saved state), or an empty state. The
caller then replays the rows archived later.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa

from fleet_service.archive.format.layout import Cut
from fleet_service.fusion import Fusion
from fleet_service.ingest.dedup import SequenceTrackers
from fleet_service.replay import checkpoints
from fleet_service.replay.checkpoint_tables import fusion_from, tables_of
from schemas.numeric import IntArray
from schemas.wire import Alert

log = logging.getLogger(__name__)
# names of the tables of a checkpoint that do not belong to the fusion
ALERTS: Final = "alerts"
STREAMS: Final = "streams"
ABOVE: Final = "streams_above"


class Restart(NamedTuple):
    """Initial state of a service, from a checkpoint.

    Attributes:
        fusion: fusion (beliefs about the friction of all cells) of the checkpoint, or a new one.
        streams: record of the batches (messages with records) that were accepted when the
            checkpoint was taken.
        standing: alerts that were active ("standing") when the checkpoint was taken.
        cut: position of the last segment (file of new rows) that is included; None without a
            checkpoint.
        weather: names of the weather files that are included.
        refused: number of checkpoints that could not be used: damaged, or of another version.
        extra_tables: additional tables of the checkpoint, as columns.
    """

    fusion: Fusion
    streams: SequenceTrackers
    standing: list[Alert]
    cut: Cut | None
    weather: frozenset[str]
    refused: int
    extra_tables: dict[str, dict[str, IntArray]]


def load_restart(
    root: Path, lateness_s: float, extra_tables: Sequence[str] = (), *, enrolled: bool = False
) -> Restart:
    """Return the initial state from the newest usable checkpoint of an archive; an empty state if
    there is none.

    A checkpoint contains the tables that `image_of` makes. The service may have added further
    tables; `extra_tables` are the names of those to read. `enrolled` is True if the service accepts
    only vehicles on the operator's list.
    """
    refused = 0
    for path in checkpoints.list_checkpoints(root):
        try:
            taken = checkpoints.load_checkpoint(path)
            tables = dict(taken.tables)
            standing = [Alert(**row) for row in tables.pop(ALERTS).to_pylist()]
            runs = tables.pop(ABOVE)
            above = np.stack([runs[name].to_numpy() for name in ("first", "end")], axis=1)
            columns = tables.pop(STREAMS)
            streams = SequenceTrackers.of(
                {name: columns[name].to_numpy() for name in columns.column_names}, above
            )
            extra = {name: tables.pop(name) for name in extra_tables if name in tables}
            others = {
                n: {column: t[column].to_numpy() for column in t.column_names}
                for n, t in extra.items()
            }
            fusion = fusion_from(tables, lateness_s)
            fusion.enrolled = enrolled
        except Exception as error:  # noqa: BLE001 for any problem: the archive has all rows
            log.warning("checkpoint %s is not used: %s", path.name, error)
            refused += 1
            continue
        checkpoints.mark_begun(path)
        return Restart(
            fusion, streams, standing, taken.cut, frozenset(taken.weather), refused, others
        )
    fusion = Fusion(lateness_s, enrolled=enrolled)
    return Restart(fusion, SequenceTrackers(), [], None, frozenset(), refused, {})


def image_of(
    fusion: Fusion, standing: list[Alert], streams: SequenceTrackers
) -> dict[str, pa.Table]:
    """Return the tables of a checkpoint by name: the tables of the fusion, the active alerts, and
    the record of accepted batches. `load_restart` restores the state from them.
    """
    columns, above = streams.columns()
    return tables_of(fusion) | {
        ALERTS: pa.Table.from_pylist([asdict(alert) for alert in standing]),
        STREAMS: pa.table({name: pa.array(column) for name, column in columns.items()}),
        ABOVE: pa.table({"first": pa.array(above[:, 0]), "end": pa.array(above[:, 1])}),
    }
