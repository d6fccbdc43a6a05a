"""Room set aside on the archive's disk, so that a full one leaves retention and compaction some to make more in."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Final

SIZE: Final = 64 << 20  # a round of compaction and its roll-ups
NAME: Final = "reserve"
_LEAST_FREE: Final = 4 * SIZE


def keep(root: Path) -> None:
    """Set room aside, if there is plenty."""
    path = root / NAME
    with suppress(OSError):
        if not path.exists() and shutil.disk_usage(root).free > _LEAST_FREE:
            with path.open("wb") as file:
                os.posix_fallocate(file.fileno(), 0, SIZE)


def give(root: Path) -> bool:
    """Give the room free if the disk is full; whether that was so."""
    path = root / NAME
    if not path.exists() or shutil.disk_usage(root).free > SIZE:
        return False
    path.unlink()
    return True
