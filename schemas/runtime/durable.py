"""Durable writing of files: a file survives power loss, and is either complete or absent."""

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
    """Return the path of the draft (temporary file) in which the file `path` is first written. The
    leading dot of the draft's name hides it from Spark and pyarrow.
    """
    return path.with_name(f".{path.name}{ENDING}")


@contextmanager
def open_durably(
    path: Path, mode: int | None = None, *, named: bool = True
) -> Iterator[BufferedWriter]:
    """Open a draft (temporary file) for writing. When the `with` block ends, rename the draft to
    `path`, complete and durable. If the block raises an exception, the draft is removed and an
    existing file at `path` stays unchanged.

    Args:
        path: path of the file; an existing file is replaced.
        mode: permissions of the file, which the draft has from the beginning; None for default
            permissions.
        named: True to sync the folder too, so that the file name is durable; False if the caller
            syncs the folder.

    Raises:
        OSError: the disk is full or read-only; no draft is left.
    """
    draft = draft_of(path)
    try:
        if mode is not None:
            # A crashed process may have left this file with other permissions.
            draft.unlink(missing_ok=True)
            draft.touch(mode, exist_ok=False)
            draft.chmod(mode)  # `touch` applies the umask, `chmod` does not
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


def write_durably(path: Path, text: str) -> None:
    """Write a text file, complete and durable; if that fails, an existing file stays unchanged."""
    with open_durably(path) as file:
        file.write(text.encode())


@contextmanager
def own_drafts(folder: Path) -> Iterator[Path]:
    """Provide a temporary folder within `folder` for drafts (unfinished files) that the caller
    renames when they are complete.

    Two concurrent attempts to write one file thus write different drafts. `sweep_drafts` removes
    the drafts of a killed attempt.
    """
    with TemporaryDirectory(prefix=_OWN, dir=folder) as drafts:
        yield Path(drafts)


def sweep_drafts(folder: Path) -> None:
    """Remove the folders of drafts (unfinished files) that killed attempts have left in `folder`;
    call this only while no attempt is running.
    """
    for drafts in folder.glob(f"{_OWN}*"):
        shutil.rmtree(drafts, ignore_errors=True)


def sync_directory(folder: Path) -> None:
    """Sync `folder` to disk (fsync), so that renames and new files in it survive power loss."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def make_folder(folder: Path) -> None:
    """Create a folder and its missing parents, and sync each parent folder to disk, so that the new
    folders survive power loss.
    """
    if not folder.exists():
        make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        sync_directory(folder.parent)
