"""`fleet-service forget`: remove one vehicle's data of a month, or make all data of a month
anonymous by destroying the secret key of the month's pseudonyms. If a service is running, it
carries out the erasure.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from fleet_service.cli.common import (
    ArchiveReport,
    add_archive,
    add_dry_run,
    confirm_deletion,
    on_archive,
)
from schemas.errors import InputError

if TYPE_CHECKING:
    from fleet_service.archive.identity.erasure_requests import Erasure
    from fleet_service.archive.maintenance.retention import ErasureResult

ASK_S: Final = 0.5  # [s] period of the checks whether the service has answered
LOOK_S: Final = 5.0  # [s] period of the checks whether the service is still running


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `fleet-service forget`."""
    add_archive(parser)
    parser.add_argument(
        "--period", metavar="MONTH", required=True, help="month to forget, e.g. 2026-01"
    )
    parser.add_argument("--vehicle", metavar="NAME", help="remove only this vehicle's rows")
    parser.add_argument(
        "--config",
        metavar="FILE",
        help="the service's configuration, which names the archive's copy",
    )
    parser.add_argument(
        "--put-to", metavar="URI", help="mirror to which rewritten files are copied again"
    )
    add_dry_run(parser)


def run(arguments: argparse.Namespace) -> int:
    """Erase the selected vehicle's rows of a month. If no vehicle is selected, destroy the secret
    key of the month's pseudonyms, so that the month's rows can no longer be attributed to vehicles.
    """
    return on_archive(arguments, _forget_data)


def _forget_data(arguments: argparse.Namespace) -> ArchiveReport:
    from fleet_service.archive.export import mirror
    from fleet_service.archive.identity.erasure_requests import Erasure
    from fleet_service.archive.maintenance.retention import key_of, rows_of_vehicle

    root = arguments.archive
    month = arguments.period
    vehicle = arguments.vehicle
    key_of(root, month)
    rows = 0 if vehicle is None else rows_of_vehicle(root, vehicle, month)
    what = (
        f"the key of {month} is destroyed"
        if vehicle is None
        else f"{rows} rows of {vehicle} are removed"
    )
    if arguments.dry_run:
        return ArchiveReport(f"would be done: {what}", {"rows": 0, "key": False})
    if not confirm_deletion(arguments, what):
        return ArchiveReport("nothing removed", {"rows": 0, "key": False})
    done = _erase_or_request(root, Erasure(month, vehicle), arguments.config)
    copy_notice = (
        ""
        if done.reason_kept is None
        else f"; the copy still contains them, and the service tries again ({done.reason_kept})"
    )
    if vehicle is None:
        return ArchiveReport(what + copy_notice, {"rows": 0, "key": True, "copy": done.reason_kept})
    removed = (
        f"{done.rows} rows removed"
        if done.rows
        else f"no rows of {vehicle} in {month}: nothing removed"
    )
    line = removed + copy_notice
    report: dict[str, object] = {
        "rows": done.rows,
        "key": False,
        "files": len(done.files),
        "copy": done.reason_kept,
    }
    if arguments.put_to is not None:
        report["put"] = mirror.copy_new_files(root, arguments.put_to, done.files)
        line += f", {report['put']} files put to {arguments.put_to}"
    return ArchiveReport(line, report)


def _erase_or_request(root: Path, erasure: Erasure, config: str | None) -> ErasureResult:
    """Erase the requested data in the archive and in its copy. If a service is running on the
    archive, let the service do this.

    Raises:
        InputError: the archive has no key for the month, a file is damaged, or the copy cannot be
            reached.
        OSError: a file cannot be read or written.
    """
    from fleet_service.archive.format.files import is_served
    from fleet_service.archive.identity import erasure_requests
    from fleet_service.archive.maintenance.retention import (
        ErasureResult,
        forget_period,
        forget_vehicle,
    )

    question = erasure_requests.write_request(root, erasure) if is_served(root) else None
    looked = time.monotonic()
    # If the service ends before it answers, this process carries out the erasure.
    while question is not None:
        if (answer := erasure_requests.answer_to(question)) is not None:
            return ErasureResult(
                answer["rows"], tuple(root / path for path in answer["files"]), answer.get("copy")
            )
        time.sleep(ASK_S)
        if time.monotonic() - looked > LOOK_S:
            looked = time.monotonic()
            if not is_served(root):
                question.unlink(missing_ok=True)
                question = None
    with _sync_copy(root, config):
        if erasure.vehicle is None:
            forget_period(root, erasure.month)
            return ErasureResult(0, ())
        return forget_vehicle(root, erasure.vehicle, erasure.month)


@contextmanager
def _sync_copy(root: Path, path: str | None) -> Iterator[None]:
    """Run the `with` block, which erases data, and then synchronise the archive's copy in a bucket
    (object store), if any.

    Raises:
        InputError: the archive has a copy, but the configuration does not name it (nothing is
            erased then); or the copy could not be reached.
    """
    from fleet_service.replication.replica import BucketReplica
    from fleet_service.replication.upload_journal import last_copy_url
    from schemas.config import ServiceConfig, load_config

    config = load_config(path, ServiceConfig)
    url = config.archive.second or last_copy_url(root)
    if url is None:
        yield
        return
    if config.archive.second is None:
        fix = "give --config with the service's configuration"
        raise InputError(
            "config", f"the archive has a copy at {url}, where the data must be removed too", fix
        )
    with closing(BucketReplica(root, url, config.archive.options)) as copy:
        # First download files that only the bucket has. They may contain rows of the vehicle.
        copy.sync_without_lease(config.name)
        yield
        try:
            copy.sync()
        except OSError as error:
            fix = "start the service when the copy can be reached; it finishes the removal"
            raise InputError(
                "archive.copy", f"the data are removed here, but not yet at {url} ({error})", fix
            ) from error
