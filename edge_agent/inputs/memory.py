"""Limit for the memory that reading a file may use, because a small compressed file may expand to a
large one.
"""

from __future__ import annotations

import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from schemas.errors import InputError

# Half of the machine's memory, so that the machine stays usable.
MOST_BYTES: Final = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
# file with the size of this process's address space [pages]
_PAGES: Final = Path("/proc/self/statm")


@contextmanager
def bounded_memory(path: Path, most: int = MOST_BYTES) -> Iterator[None]:
    """Limit the memory that this process allocates within the `with` block to `most` bytes in
    addition to the memory already used.

    On a system that does not report the used memory, nothing is limited.

    Raises:
        InputError: the file needs more memory.
    """
    before = resource.getrlimit(resource.RLIMIT_AS)
    try:
        limit_memory(most)
        yield
    except MemoryError as error:
        raise InputError(
            "source",
            f"{path} needs more than {most >> 20} MB of memory",
            "cut it into shorter recordings",
        ) from error
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def limit_memory(most: int) -> None:
    """Limit the memory of this process to `most` bytes more than now. If the process already has a
    lower limit, that limit remains.
    """
    with suppress(FileNotFoundError):
        used = int(_PAGES.read_text().split()[0]) * resource.getpagesize()
        limits = [used + most, *resource.getrlimit(resource.RLIMIT_AS)]
        limit = min(one for one in limits if one != resource.RLIM_INFINITY)
        resource.setrlimit(resource.RLIMIT_AS, (limit, limits[2]))
