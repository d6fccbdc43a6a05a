"""Where a restart begins: the newest checkpoint that can be read, or nothing; the log tells the rest."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Final, NamedTuple

import pyarrow as pa

from fleet_service.fusion import Fusion
from fleet_service.replay import checkpoints
from fleet_service.replay.checkpoint_tables import fusion_from, tables_of
from schemas.errors import InputError
from schemas.wire import Alert

ALERTS: Final = "alerts"  # table of a checkpoint, beside those of the fusion


class Restart(NamedTuple):
    """What a service begins with.

    Attributes:
        fusion: of the checkpoint, or a new one.
        standing: alerts that stood then.
        received: everything received until then is in it [ns]; None: nothing is.
        refused: checkpoints that could not be read: damaged, or of another version.
    """

    fusion: Fusion
    standing: list[Alert]
    received: int | None
    refused: int


def restart(root: Path, lateness_s: float) -> Restart:
    """Begin from the archive in a folder."""
    refused = 0
    for path in checkpoints.newest(root):
        try:
            tables, received = checkpoints.load(path)
            standing = [Alert(**row) for row in tables.pop(ALERTS).to_pylist()]
            return Restart(fusion_from(tables, lateness_s), standing, received, refused)
        except (OSError, pa.ArrowInvalid, InputError, KeyError, TypeError):
            refused += 1
    return Restart(Fusion(lateness_s), [], None, refused)


def image_of(fusion: Fusion, standing: list[Alert]) -> dict[str, pa.Table]:
    """Tables of a checkpoint: what `restart` finds again."""
    return tables_of(fusion) | {ALERTS: pa.Table.from_pylist([asdict(alert) for alert in standing])}
