"""Checkpoints. A checkpoint is the state of a service after all rows up to a certain segment (file
of new rows); a restart replays only later segments.

    checkpoints/EPOCH-NUMBER/NAME.arrow          tables; the folder is named after the newest
                                                 segment that is included
    checkpoints/EPOCH-NUMBER/manifest.json       a digest of every file, and the names of the
                                                 weather files that are included

A folder appears only when it is complete. Compiled code uses row numbers from a checkpoint without
checks, so all digests are verified before use. If a service died several times shortly after
starting from a checkpoint, the checkpoint is not used again. A checkpoint that is missing, damaged
or of another version only costs the time of a replay.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final, NamedTuple

import pyarrow as pa

from fleet_service.archive.format.layout import CHECKPOINTS, Cut
from fleet_service.archive.format.version import KEY, VERSION
from schemas.errors import InputError
from schemas.runtime.durable import open_durably, sync_directory

# Number of checkpoints that are kept: the newest, and the one before it in case the newest is
# damaged.
KEPT: Final = 2
# After this number of failed starts from a checkpoint, a service starts from the archived rows.
TRIES: Final = 4
_DRAFT: Final = ".draft"
_MANIFEST: Final = "manifest.json"
_TRIED: Final = "tried"
_CHUNK: Final = 1 << 22


class Taken(NamedTuple):
    """Content of a checkpoint (saved state of a service).

    Attributes:
        tables: tables by name.
        cut: position of the last segment that the tables include.
        weather: names of the files of weather reports that the tables include.
    """

    tables: dict[str, pa.Table]
    cut: Cut
    weather: tuple[str, ...] = ()


def save_checkpoint(root: Path, taken: Taken) -> Path:
    """Store a checkpoint, and keep the previous one; return the folder.

    Raises:
        OSError: the disk is full; earlier checkpoints stay.
    """
    folder = root / CHECKPOINTS
    draft = folder / _DRAFT
    path = folder / f"{taken.cut.epoch:010d}-{taken.cut.number:012d}"
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    for name, table in taken.tables.items():
        with open_durably(draft / f"{name}.arrow", named=False) as file:
            metadata = {**(table.schema.metadata or {}), KEY.encode(): str(VERSION).encode()}
            with pa.ipc.new_file(file, table.schema.with_metadata(metadata)) as writer:
                writer.write_table(table.replace_schema_metadata(metadata))
    content = {
        "files": {file.name: file_digest(file) for file in sorted(draft.iterdir())},
        "weather": list(taken.weather),
    }
    with open_durably(draft / _MANIFEST, named=False) as file:
        file.write(json.dumps({"content": content, "digest": _digest_of(content)}).encode())
    sync_directory(draft)
    shutil.rmtree(path, ignore_errors=True)
    draft.rename(path)
    sync_directory(folder)
    sync_directory(root)
    for old in _checkpoint_folders(root)[:-KEPT]:
        shutil.rmtree(old, ignore_errors=True)
    return path


def list_checkpoints(root: Path) -> list[Path]:
    """Return the folders of an archive's checkpoints (saved states of its service), newest
    first.
    """
    return _checkpoint_folders(root)[::-1]


def load_checkpoint(path: Path) -> Taken:
    """Return a checkpoint after verification.

    Raises:
        InputError: the checkpoint is damaged, has an old form, or too many starts with it have
            failed.
        OSError: a file cannot be read.
    """
    try:
        manifest = json.loads((path / _MANIFEST).read_bytes())
        content: dict[str, Any] = manifest["content"]
        right = manifest["digest"] == _digest_of(content)
    except (ValueError, KeyError, TypeError, FileNotFoundError) as error:
        raise _checkpoint_error(path, "has no readable manifest") from error
    if not right or not _are_whole(path, content["files"]):
        raise _checkpoint_error(path, "is damaged")
    if _count_tries(path) >= TRIES:
        raise _checkpoint_error(path, f"made the service fail at {TRIES} starts")
    tables = {}
    for name in content["files"]:
        with pa.memory_map(str(path / name)) as source:
            tables[Path(name).stem] = pa.ipc.open_file(source).read_all()
    epoch, number = path.name.split("-")
    return Taken(tables, Cut(int(epoch), int(number)), tuple(content["weather"]))


def mark_begun(path: Path) -> None:
    """Record that a service is starting from a checkpoint; `mark_survived` removes the record."""
    with suppress(OSError):  # a service must start even if the disk is full
        (path / _TRIED).write_text(str(_count_tries(path) + 1))


def mark_survived(root: Path) -> None:
    """Record that the service runs well with the checkpoint from which it started."""
    for path in _checkpoint_folders(root):
        (path / _TRIED).unlink(missing_ok=True)


def file_digest(path: Path) -> str:
    """Return the hash of a file of a checkpoint; if the file does not exist, the hash of empty
    content.
    """
    state = blake2b(digest_size=16)
    with suppress(FileNotFoundError), path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            state.update(chunk)
    return state.hexdigest()


def _are_whole(folder: Path, expected_digests: dict[str, str]) -> bool:
    """Return True if each file of a checkpoint's folder has the expected digest."""
    with ThreadPoolExecutor() as threads:
        actual_digests = threads.map(file_digest, (folder / name for name in expected_digests))
        return list(actual_digests) == list(expected_digests.values())


def _count_tries(path: Path) -> int:
    try:
        return int((path / _TRIED).read_text())
    except (OSError, ValueError):
        return 0


def _digest_of(content: Sequence[Any] | dict[str, Any]) -> str:
    return blake2b(json.dumps(content, sort_keys=True).encode(), digest_size=16).hexdigest()


def _checkpoint_error(path: Path, problem: str) -> InputError:
    return InputError(
        "checkpoint", f"{path.name} {problem}", "the service uses the previous one, or the log"
    )


def _checkpoint_folders(root: Path) -> list[Path]:
    return sorted(path for path in (root / CHECKPOINTS).glob("[0-9]*") if path.is_dir())
