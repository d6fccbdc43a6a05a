"""Terms: the times of the services that had an archive's copy one after the other, and what counts of the former ones.

    fence/NUMBER-TURN       in the bucket, {"epoch", "names"}: the highest counts
    ARCHIVE/term            the epoch of the service that has the folder

An object of the term's epoch or a later one counts, one of a former term if it is on the fence's list, and one whose
name tells no epoch always. The list is made after nobody of a former term can acknowledge any more, and before anything
is acknowledged in the new one. Who was frozen meanwhile and wakes may put more: it has an older epoch and is not on the
list. Nobody acknowledged it, its senders send it again, and it counts for nothing, whoever reads the bucket later.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from fleet_service.archive import layout
from fleet_service.archive.bucket import ObjectBucket
from schemas.runtime.durable import written

FOLDER: Final = "fence"
NAME: Final = "term"


class Term(NamedTuple):
    """A service's time with the copy: which since there were any, and the epoch of the names that it gives."""

    number: int
    epoch: int


class Fence(NamedTuple):
    """All from `epoch` on counts, and these names of former terms."""

    epoch: int
    names: frozenset[str]

    def passes(self, name: str) -> bool:
        """Whether an object counts."""
        epoch = layout.term_of(name)
        return epoch is None or epoch >= self.epoch or name in self.names


def put_fence(bucket: ObjectBucket, number: int, turn: int, fence: Fence) -> None:
    """Fix what counts; each turn has a name of its own, so that none that lands late takes the place of a later one.

    Raises:
        CopyError: it is not known to have landed.
    """
    content = json.dumps({"epoch": fence.epoch, "names": sorted(fence.names)}).encode()
    bucket.put(f"{FOLDER}/{number:010d}-{turn:06d}.json.gz", gzip.compress(content, 6, mtime=0))


def fence_of(bucket: ObjectBucket) -> Fence:
    """The fence of who took over last; with none all counts.

    Raises:
        CopyError: it cannot be read.
    """
    names = bucket.names(FOLDER)
    content = bucket.get(max(names)) if names else None
    if content is None:
        return Fence(0, frozenset())
    document = json.loads(gzip.decompress(content))
    return Fence(int(document["epoch"]), frozenset(document["names"]))


def newest(names: Iterable[str]) -> int:
    """The largest epoch that names tell, or 0."""
    return max((layout.term_of(name) or 0 for name in names), default=0)


def of(root: Path) -> int:
    """Epoch of the service that has a folder; 0: there are no terms."""
    with suppress(OSError, ValueError):
        return int((root / NAME).read_text())
    return 0


def note(root: Path, epoch: int) -> None:
    """Let what is compacted from now on bear this epoch.

    Raises:
        OSError: it cannot be written.
    """
    with written(root / NAME) as file:
        file.write(f"{epoch}\n".encode())
