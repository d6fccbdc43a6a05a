"""Clock for elapsed time that never jumps and that counts suspensions of the machine."""

from __future__ import annotations

import time
from typing import Final

_BOOTTIME: Final[int | None] = getattr(time, "CLOCK_BOOTTIME", None)


def elapsed_seconds() -> float:
    """Return elapsed time [s] of a monotonic clock. On Linux it includes time in which the machine
    was suspended; `time.monotonic` does not.
    """
    return time.monotonic() if _BOOTTIME is None else time.clock_gettime(_BOOTTIME)
