"""Upload and download of single files between an archive's folder and its bucket replica. The
upload journal (list of uploaded files) records each file that both have.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from pathlib import Path

from fleet_service.archive.format.files import sync_tree
from fleet_service.archive.format.layout import CHECKPOINTS
from fleet_service.replication.bucket import ObjectBucket
from fleet_service.replication.fenced_bucket import FencedBucket
from fleet_service.replication.replica_files import KEYS, LOG, MANIFEST, ReplicaFiles, is_copied
from fleet_service.replication.upload_journal import UploadJournal, stamp_of
from schemas.runtime.durable import open_durably


class FileTransfer:
    """Transfer of files between the archive's folder and its bucket (object store), several at once
    in the threads of `pool`.
    """

    def __init__(
        self,
        files: ReplicaFiles,
        bucket: FencedBucket,
        journal: UploadJournal,
        pool: ThreadPoolExecutor,
    ) -> None:
        self._files = files
        self._bucket = bucket
        self._journal = journal
        self._pool = pool

    def upload_file(self, path: Path, bucket: ObjectBucket) -> None:
        """Upload a file through `bucket`, and record it in the upload journal. The caller chooses a
        `bucket` whose time limit for a request suits this file.

        Raises:
            CopyError: it is unknown whether the upload succeeded.
            FileNotFoundError: the file has been removed meanwhile.
        """
        name = self._files.name_of(path)
        stamp = stamp_of(path)
        is_new = self._journal.find_stamp(name) is None
        if is_new and name.startswith(LOG):
            bucket.put_new(name, path.read_bytes())
        elif is_new and name.endswith(".key"):
            self._bucket.create_key(name, path.read_bytes(), bucket)
        elif name.startswith(KEYS):
            # The file of vehicle identities may grow during the upload. It is then uploaded again.
            bucket.put(name, path.read_bytes())
        else:
            bucket.put(name, path)
        self._journal.add(name, stamp)

    def upload_if_present(self, name: str) -> bool:
        """Upload a file of the archive to the bucket; return False if the file has been removed
        meanwhile.
        """
        try:
            self.upload_file(self._files.path_of(name), self._bucket.objects)
        except FileNotFoundError:
            return False
        return True

    def download_missing(self, remote_sizes: Mapping[str, int]) -> int:
        """Download the files that only the bucket has; return their number. Also remove from the
        journal the entries of files that the bucket lacks, or has with another size.

        `remote_sizes` contains the names and sizes [bytes] of the valid objects in the bucket.
        """
        local = self._files.list_files()
        for name in self._journal.copy_stamps():
            if name not in remote_sizes or (
                name in local and local[name].size != remote_sizes[name]
            ):
                self._journal.remove(name)
        known = self._journal.copy_stamps()
        complete = {
            name.rpartition("/")[0] for name in remote_sizes if name.endswith(f"/{MANIFEST}")
        }

        def is_wanted(name: str) -> bool:
            if name in local or not is_copied(name):
                return False
            was_deleted_here = name in known and not self._files.set_aside_path(name).exists()
            is_incomplete = name.startswith(CHECKPOINTS) and name.rpartition("/")[0] not in complete
            return not was_deleted_here and not is_incomplete

        missing = [name for name in remote_sizes if is_wanted(name)]
        self._download_files(missing)
        paths = [self._files.path_of(name) for name in missing]
        sync_tree(self._files.root, {path.parent for path in paths})
        # Record the files only now. After a power loss, recorded but missing files would count as
        # deleted.
        for name, path in zip(missing, paths, strict=True):
            self._journal.add(name, stamp_of(path))
            self._files.set_aside_path(name).unlink(missing_ok=True)
        return len(missing)

    def _download_files(self, names: Sequence[str]) -> None:
        """Download files, several at once. After a failure, start no further download, and wait for
        the running ones: they would write the same drafts as those of the next attempt.
        """
        downloads = [self._pool.submit(self._download_file, name) for name in names]
        wait(downloads, return_when=FIRST_EXCEPTION)
        started = [download for download in downloads if not download.cancel()]
        wait(started)
        for download in started:
            download.result()

    def _download_file(self, name: str) -> None:
        path = self._files.path_of(name)
        secret = name.startswith(KEYS)
        path.parent.mkdir(mode=0o700 if secret else 0o777, parents=True, exist_ok=True)
        with open_durably(path, 0o600 if secret else None, named=False) as file:
            for part in self._bucket.objects.read_parts(name):
                file.write(part)
