"""Paths of files that the agent writes."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryFile

from schemas.errors import InputError
from schemas.vehicle_classes import PREFIX


def prepare_path(field: str, path: Path, kept: Iterable[Path] = ()) -> Path:
    """Create the folder that will contain the file `path`, if it does not exist; return the path.
    `kept` are files that must not be overwritten.

    Raises:
        InputError: the path is a folder, a vehicle class or one of `kept`, or its folder cannot be
            written.
    """
    if str(path).startswith(PREFIX):
        raise InputError(field, f"{path} is a class of vehicles, not a file", "name a file")
    if path.resolve() in {one.resolve() for one in kept}:
        raise InputError(field, f"{path} is another file of this command", "name another file")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Only a trial shows whether a file can be created: in /proc the permissions allow it.
        with TemporaryFile(dir=path.parent):
            reason = "is a folder" if path.is_dir() else ""
    except OSError as error:
        reason = error.strerror or str(error)
    if reason:
        raise InputError(
            field, f"cannot write {path} ({reason})", "name a file in a writable folder"
        )
    return path
