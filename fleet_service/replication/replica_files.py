"""Names and paths of those files of an archive that are copied to its bucket replica."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final

from fleet_service.archive.format.layout import CHECKPOINTS
from fleet_service.archive.format.load import BAD
from fleet_service.replication.upload_journal import Stamp, stamp_of

LOG: Final = "inbox/"
KEYS: Final = "keys/"
# Order in which folders are listed. Compaction adds to later folders before it deletes from the
# inbox. Retention computes roll-ups before it deletes observations. So a moved row is always found.
FOLDERS: Final = (
    "inbox",
    "observations",
    "states",
    "rollup",
    "map",
    "weather",
    CHECKPOINTS,
    "keys",
)
MANIFEST: Final = "manifest.json"  # file that makes a folder a valid checkpoint
_PRIVATE: Final = ("tried",)  # files that concern only this disk and are not uploaded


class ReplicaFiles:
    """Files below the folder `root` of an archive that are copied to its bucket replica. Objects in
    the bucket have the names of the files, relative to the folder.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    def name_of(self, path: Path) -> str:
        """Return the name of the bucket object that corresponds to a file of the archive."""
        return path.relative_to(self.root).as_posix()

    def path_of(self, name: str) -> Path:
        """Return the path of the archive's file that corresponds to a bucket object."""
        return self.root / name

    def set_aside_path(self, name: str) -> Path:
        """Return the path to which the damaged file `name` of the archive is renamed, so that it is
        not read again.
        """
        return self.root / f"{name}{BAD}"

    def list_files(self, folders: Iterable[str] = FOLDERS) -> dict[str, Stamp]:
        """Return name and stamp (size and time of the last write) of each file that is copied to
        the bucket.

        The folders are listed in the given order. The default order ensures that a row is found
        even if compaction moves it to another folder during the listing. In this order, each folder
        comes before the folder to which its rows are moved.
        """
        found: dict[str, Stamp] = {}
        paths = (path for one in folders for path in sorted((self.root / one).rglob("*")))
        for path in paths:
            name = self.name_of(path)
            if is_copied(name):
                with suppress(FileNotFoundError):
                    if path.is_file():
                        found[name] = stamp_of(path)
        return found


def is_copied(name: str) -> bool:
    """Return True if a file of this name is copied to the archive's bucket replica; unfinished,
    damaged and private files are not.
    """
    folder, *rest = name.split("/")
    hidden = any(part.startswith(".") for part in rest)
    return (
        folder in FOLDERS
        and bool(rest)
        and not hidden
        and not name.endswith(BAD)
        and rest[-1] not in _PRIVATE
    )
