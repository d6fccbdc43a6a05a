"""`python -m tests.faults.cluster_service …`: `fleet-service` that prints when it compacts and
uploads, so that a campaign can interrupt these operations.

It compacts and uploads more often than usual. A printed beginning without a printed end shows that
the operation was interrupted.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Sequence
from typing import Final

from fleet_service.app import jobs, subprocess_job
from fleet_service.cli import main
from fleet_service.replication.file_transfer import FileTransfer
from fleet_service.replication.replica import BucketReplica

COMPACTING = "compacting"
COPYING = "copying"
BEGINS = "begins"
ENDS = "ends"
FOLLOW_S: Final = 3.0

_run = subprocess_job.run_module
_follow = BucketReplica.sync
_put_there = FileTransfer.upload_if_present
_copying = threading.local()


def _print_mark(sign: str, what: str) -> None:
    print(f"{what} {sign}", flush=True)


def run(
    what: str, module: str, words: Sequence[str], stop: threading.Event, stdin: str | None = None
) -> str | None:
    """Run a module in a subprocess, as the service does for compaction, and print a line when the
    subprocess begins and when it ends.
    """
    _print_mark(BEGINS, COMPACTING)
    output = _run(what, module, words, stop, stdin)
    _print_mark(ENDS, COMPACTING)
    return output


def sync_and_report(copy: BucketReplica) -> int:
    """Bring the archive's copy in the bucket (object store) up to date once. Print a line at the
    end if anything was uploaded. Return the number of changed objects.
    """
    _copying.at = False
    changed = _follow(copy)
    if _copying.at:
        _print_mark(ENDS, COPYING)
    return changed


def put_there(transfer: FileTransfer, name: str) -> bool:
    """Upload one file to the archive's copy in the bucket (object store). Before the first upload
    of a synchronisation, print a line, so that a campaign can interrupt the upload.
    """
    if getattr(_copying, "at", None) is False:
        _copying.at = True
        _print_mark(BEGINS, COPYING)
    return _put_there(transfer, name)


if __name__ == "__main__":
    subprocess_job.run_module = run  # type: ignore[assignment]
    BucketReplica.sync = sync_and_report  # type: ignore[method-assign,assignment]
    FileTransfer.upload_if_present = put_there  # type: ignore[method-assign,assignment]
    jobs.FOLLOW_S = FOLLOW_S  # type: ignore[misc]
    sys.exit(main())
