"""Bucket (object store) under the lease and the fence of its owner. The lease (ownership limited in
time) decides which service may write to the bucket, and the fence (list of valid objects) decides
which objects readers must ignore.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from fleet_service.archive.format import layout
from fleet_service.replication.bucket import ObjectBucket
from fleet_service.replication.fence import Fence, Term, fence_of, put_fence


class FencedBucket:
    """Bucket of a replica, with the lease of its owner if there is one, and with the fence against
    former owners.

    Attributes:
        objects: the bucket.
        may_write: function that returns True if this service certainly has the lease.
        assert_alone: function that checks in the bucket that no later lease exists; None without a
            lease. It raises CopyError if a later lease exists or the check fails.
    """

    def __init__(self, objects: ObjectBucket) -> None:
        self.objects = objects
        self.may_write: Callable[[], bool] = lambda: True
        self.assert_alone: Callable[[], None] | None = None
        self._term = Term(0, 0)
        self._fence = Fence(0, frozenset())
        self._turn = 0

    def attach_lease(self, may_write: Callable[[], bool], assert_alone: Callable[[], None]) -> None:
        """From now on, check the lease before files in the bucket are changed or deleted.

        Args:
            may_write: returns True while this service certainly has the lease; makes no request to
                the bucket.
            assert_alone: checks in the bucket that no later lease exists, and raises CopyError if
                one exists or the check fails.
        """
        self.may_write = may_write
        self.assert_alone = assert_alone

    def require_lease(self) -> None:
        """Check in the bucket that no later lease exists.

        Raises:
            CopyError: a later lease exists, or the check fails.
        """
        if self.assert_alone is not None:
            self.assert_alone()

    def list_valid(self) -> dict[str, int]:
        """Return names and sizes [bytes] of the objects that are valid according to the bucket's
        fence.

        Raises:
            CopyError: the bucket cannot be read.
        """
        sizes = self.objects.list_sizes()
        fence = fence_of(self.objects)
        return {name: size for name, size in sizes.items() if fence.counts_object(name)}

    def raise_fence(self, term: Term, names: Iterable[str]) -> None:
        """Write the fence of a new owner, and delete all objects that are not valid.

        Args:
            term: lease number and epoch (number in file names) of the new owner.
            names: names of all files of the archive. Files of former owners have an older epoch, so
                the fence lists them. All other files are valid without the list: they have the
                epoch of the new owner or a later one, or none.
        """
        older = [name for name in names if (layout.term_of(name) or term.epoch) < term.epoch]
        fence = Fence(term.epoch, frozenset(older))
        self._put_fence(term, fence)
        self.require_lease()
        for name in self.objects.list_sizes():
            if not fence.counts_object(name):  # no later service writes an object of this name
                self.objects.delete(name)

    def admit_objects(self, names: Iterable[str]) -> None:
        """Add to the fence those of the owner's uploaded objects that are not valid yet. Such an
        object was written by a compaction (merge of files) that started before the owner's term.
        Its name therefore has an older epoch (number of a term).
        """
        if strays := [name for name in names if not self._fence.counts_object(name)]:
            fence = self._fence._replace(names=self._fence.names.union(strays))
            self._put_fence(self._term, fence)

    def _put_fence(self, term: Term, fence: Fence) -> None:
        self._turn += 1
        put_fence(self.objects, term.number, self._turn, fence)
        self._term = term
        self._fence = fence

    def create_key(self, name: str, content: bytes, bucket: ObjectBucket) -> None:
        """Upload a file of the archive's secret keys to the bucket; its name must be new. There is
        one exception. If a former service uploaded a file of this name after it had lost its lease,
        the file belongs to rows that are not valid, and is replaced.
        """
        if self.assert_alone is None or bucket.create(name, content):
            bucket.put_new(name, content)
        else:
            self.assert_alone()
            bucket.put(name, content)
