"""Terms: successive owners of an archive's copy, and the files of former owners that count.

    fence/NUMBER-TURN       in the bucket, {"epoch", "names"}: the highest counts
    ARCHIVE/term            the epoch of the service that has the folder

An object counts if it has the term's epoch or a later one, if the fence lists it, or if its name
has no epoch. The list is made after no former owner can acknowledge any more, and before anything
is acknowledged in the new term. A service that was frozen and wakes may upload more. Such objects
have an older epoch and are not on the list. They were never acknowledged, their senders send them
again, and they do not count for any later reader of the bucket.
"""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Iterable
from typing import Final, NamedTuple

from fleet_service.archive.format import layout
from fleet_service.replication.bucket import CopyError, ObjectBucket

FOLDER: Final = "fence"


class Term(NamedTuple):
    """Ownership of the copy by one service: its number, and the epoch in its file names."""

    number: int
    epoch: int


class Fence(NamedTuple):
    """Objects that count: all from `epoch` on, and these names of former terms."""

    epoch: int
    names: frozenset[str]

    def counts_object(self, name: str) -> bool:
        """Return True if an object counts."""
        epoch = layout.term_of(name)
        return epoch is None or epoch >= self.epoch or name in self.names


def put_fence(bucket: ObjectBucket, number: int, turn: int, fence: Fence) -> None:
    """Write the fence; each turn has a name of its own, so that a delayed upload never replaces a
    later one.

    Raises:
        CopyError: it is unknown whether the upload succeeded.
    """
    content = json.dumps({"epoch": fence.epoch, "names": sorted(fence.names)}).encode()
    bucket.put(f"{FOLDER}/{number:010d}-{turn:06d}.json.gz", gzip.compress(content, 6, mtime=0))


def fence_of(bucket: ObjectBucket) -> Fence:
    """Return the fence of the last owner; without one, everything counts.

    Raises:
        CopyError: it cannot be read.
    """
    names = bucket.list_names(FOLDER)
    content = bucket.get(max(names)) if names else None
    if content is None:
        return Fence(0, frozenset())
    try:
        document = json.loads(gzip.decompress(content))
        return Fence(int(document["epoch"]), frozenset(document["names"]))
    except (EOFError, zlib.error, OSError, ValueError, KeyError, TypeError) as error:
        raise CopyError(f"{max(names)} is damaged") from error


def largest_epoch(names: Iterable[str]) -> int:
    """Return the largest epoch in names, or 0."""
    return max((layout.term_of(name) or 0 for name in names), default=0)
