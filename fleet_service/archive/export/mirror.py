"""Mirror of an archive's compacted (sorted) files, map snapshots and roll-ups (hourly statistics)
on another file system: a folder, S3, GCS or HDFS.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Final

import pyarrow as pa
from pyarrow import fs

from fleet_service.archive.format.layout import TABLES
from schemas.errors import InputError

FOLDERS: Final = (*TABLES.values(), "map", "rollup")
_CHUNK: Final = 1 << 22


def copy_new_files(root: Path, uri: str, again: Collection[Path] = ()) -> int:
    """Copy files that are new or have another size to the mirror at `uri`; return the number of
    copied files.

    Files that were removed from the archive stay in the mirror. A file appears under its name only
    when it is complete. Files in `again` are copied even if their size is unchanged.

    Raises:
        InputError: the destination cannot be used.
        OSError: a file cannot be read or written.
    """
    try:
        destination, base = fs.FileSystem.from_uri(uri)
        destination.create_dir(base, recursive=True)
        sizes = {
            info.path: info.size
            for info in destination.get_file_info(fs.FileSelector(base, recursive=True))
        }
    except (pa.ArrowInvalid, OSError) as error:
        raise InputError(
            "put_to", f"cannot use {uri} ({error})", "give a URI such as s3://bucket/folder"
        ) from error
    count = 0
    for path in sorted(path for folder in FOLDERS for path in (root / folder).rglob("*.parquet")):
        target = f"{base}/{path.relative_to(root).as_posix()}"
        if path in again or sizes.get(target) != path.stat().st_size:
            _copy_file(path, destination, target)
            count += 1
    return count


def _copy_file(path: Path, destination: fs.FileSystem, target: str) -> None:
    folder, _, name = target.rpartition("/")
    destination.create_dir(folder, recursive=True)
    draft = f"{folder}/.{name}.tmp"
    with path.open("rb") as source, destination.open_output_stream(draft) as sink:
        while chunk := source.read(_CHUNK):
            sink.write(chunk)
    destination.move(draft, target)
