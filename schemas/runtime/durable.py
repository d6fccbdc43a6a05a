"""Files and folders that power loss does not forget, and files that are there whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedWriter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

ENDING: Final = ".tmp"
_OWN: Final = ".drafts-"


def draft_of(path: Path) -> Path:
    """Where a file is written before it has its name; the dot hides it from Spark and pyarrow."""
    return path.with_name(f".{path.name}{ENDING}")


@contextmanager
def written(path: Path, mode: int | None = None, *, named: bool = True) -> Iterator[BufferedWriter]:
    """A file to write, that appears under its name whole and durable when the block ends; as it was before if it fails.

    Args:
        path: of the file; one that is there is replaced.
        mode: permissions, which the draft has from its first byte on; those of every new file if None.
        named: whether its name is durable too at the end; else the caller syncs the folder.

    Raises:
        OSError: the disk is full or read-only; nothing is left of it.
    """
    draft = draft_of(path)
    try:
        if mode is not None:
            draft.unlink(missing_ok=True)  # of a process that died; its permissions may be others
            draft.touch(mode, exist_ok=False)
            draft.chmod(mode)  # whatever the process's mask took away
        with draft.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        draft.rename(path)
    except (Exception, KeyboardInterrupt):
        draft.unlink(missing_ok=True)
        raise
    if named:
        sync_directory(path.parent)


@contextmanager
def own_drafts(folder: Path) -> Iterator[Path]:
    """A folder within `folder` for drafts that are renamed when they are whole: two tries at one file, on one machine
    or on two, write different drafts. What a try leaves that is killed goes by `sweep_drafts`."""
    with TemporaryDirectory(prefix=_OWN, dir=folder) as drafts:
        yield Path(drafts)


def sweep_drafts(folder: Path) -> None:
    """Remove the drafts of tries that died, when none is under way."""
    for drafts in folder.glob(f"{_OWN}*"):
        shutil.rmtree(drafts, ignore_errors=True)


def sync_directory(folder: Path) -> None:
    """Make renames and new names in `folder` durable."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def make_folder(folder: Path) -> None:
    """Make a folder, and the ones above it, such that power loss does not forget them."""
    if not folder.exists():
        make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        sync_directory(folder.parent)
