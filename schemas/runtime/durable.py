"""Files and folders that power loss does not forget, and files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedWriter
from pathlib import Path
from typing import Final

ENDING: Final = ".tmp"


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
