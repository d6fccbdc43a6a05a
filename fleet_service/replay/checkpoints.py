"""Checkpoints: what a service knew when everything received until a moment was on disk; a restart replays the rest.

    checkpoints/RECEIVED/NAME.arrow      RECEIVED is that moment in ns

A folder appears when it is whole. The log decides; a checkpoint that is missing, damaged or of another version only
costs the time of a replay.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Final

import pyarrow as pa

from fleet_service.archive.layout import CHECKPOINTS
from fleet_service.archive.version import KEY, VERSION
from schemas.runtime.durable import sync_directory, written

KEPT: Final = 2  # the newest, and the one before, should the newest be damaged
_DRAFT: Final = ".draft"


def save(root: Path, tables: dict[str, pa.Table], received: int) -> Path:
    """Keep a checkpoint of everything received until a moment [ns], and the one before it.

    Raises:
        OSError: the disk is full; the checkpoints before stay.
    """
    folder = root / CHECKPOINTS
    draft, path = folder / _DRAFT, folder / f"{received:020d}"
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    for name, table in tables.items():
        with written(draft / f"{name}.arrow", named=False) as file:
            metadata = {**(table.schema.metadata or {}), KEY.encode(): str(VERSION).encode()}
            with pa.ipc.new_file(file, table.schema.with_metadata(metadata)) as writer:
                writer.write_table(table.replace_schema_metadata(metadata))
    sync_directory(draft)
    shutil.rmtree(path, ignore_errors=True)
    draft.rename(path)
    sync_directory(folder)
    for old in _folders(root)[:-KEPT]:
        shutil.rmtree(old, ignore_errors=True)
    return path


def newest(root: Path) -> list[Path]:
    """Checkpoints, newest first."""
    return _folders(root)[::-1]


def load(path: Path) -> tuple[dict[str, pa.Table], int]:
    """Tables of a checkpoint by name, and until when everything received is in it [ns].

    Raises:
        OSError, pa.ArrowInvalid: it is damaged.
    """
    tables = {}
    for file in sorted(path.glob("*.arrow")):
        with pa.memory_map(str(file)) as source:
            tables[file.stem] = pa.ipc.open_file(source).read_all()
    return tables, int(path.name)


def _folders(root: Path) -> list[Path]:
    return sorted(path for path in (root / CHECKPOINTS).glob("[0-9]*") if path.is_dir())
