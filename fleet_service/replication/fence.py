"""Fence of an archive's bucket copy: it excludes files that a former owner uploads too late. A term
is the time during which one service owns the copy. An epoch is a number in file names; it is larger
in each later term.

    fence/NUMBER-TURN       in the bucket: {"epoch", "names"}, epoch of the term and list of valid
                            objects. NUMBER is the owner's lease number, TURN the count of fences
                            that this owner has written. The fence with the highest name is valid.
    ARCHIVE/term            epoch of the service that owns the folder

An object is valid in three cases: it has the epoch of the current term or a later one, the fence
lists it, or its name contains no epoch.

The owner writes the fence at the start of its term, after the last time at which a former owner
may acknowledge data. The owner itself acknowledges nothing before the fence is written. A former
owner that was frozen may wake up and upload more objects. They have an older epoch and are not in
the list, so all later readers of the bucket ignore them. No data are lost: these objects were never
acknowledged, so the vehicles send their content again.
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
    """Term: ownership of the archive's copy by one service. It consists of the lease number and the
    epoch, a number in the names of all files that the service writes.
    """

    number: int
    epoch: int


class Fence(NamedTuple):
    """Fence of a bucket (object store): the list of valid objects. Objects are valid if they have
    the epoch (number of the owner's term) `epoch` or a later one, or if they are in `names`.
    """

    epoch: int
    names: frozenset[str]

    def counts_object(self, name: str) -> bool:
        """Return True if the object with this name is valid according to the fence (list of the
        valid objects of former owners).
        """
        epoch = layout.term_of(name)
        return epoch is None or epoch >= self.epoch or name in self.names


def put_fence(bucket: ObjectBucket, number: int, turn: int, fence: Fence) -> None:
    """Upload the fence (list of valid objects) to the bucket. Its name contains the `number` of the
    owner's lease and `turn`, the count of fences that this owner has written. Therefore a delayed
    upload never replaces a later fence.

    Raises:
        CopyError: it is unknown whether the upload succeeded.
    """
    content = json.dumps({"epoch": fence.epoch, "names": sorted(fence.names)}).encode()
    bucket.put(f"{FOLDER}/{number:010d}-{turn:06d}.json.gz", gzip.compress(content, 6, mtime=0))


def fence_of(bucket: ObjectBucket) -> Fence:
    """Return the last owner's fence from the bucket. If there is none, return a fence for which all
    objects are valid.

    Raises:
        CopyError: the fence cannot be read.
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
    """Return the largest epoch (number of an owner's term) in the given file names, or 0."""
    return max((layout.term_of(name) or 0 for name in names), default=0)
