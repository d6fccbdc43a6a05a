"""Reserved space on the archive's disk. When the disk is full, the space is released, so that
retention and compaction (move of new rows into sorted files) can run and make room.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Final

SIZE: Final = 64 << 20  # [bytes] space for a round of compaction and its roll-ups
NAME: Final = "reserve"
_LEAST_FREE: Final = 4 * SIZE


def allocate(root: Path) -> None:
    """Allocate the reserved space (a large file) on the archive's disk if the disk has plenty of
    free space.
    """
    path = root / NAME
    with suppress(OSError):
        if not path.exists() and shutil.disk_usage(root).free > _LEAST_FREE:
            with path.open("wb") as file:
                os.posix_fallocate(file.fileno(), 0, SIZE)


def release(root: Path) -> bool:
    """Release the reserved space on the archive's disk (delete its file) if the disk is full;
    return True if it was released.
    """
    path = root / NAME
    if not path.exists() or shutil.disk_usage(root).free > SIZE:
        return False
    path.unlink()
    return True
