"""Folders and file names of an archive; names are built and parsed only here.

    inbox/…                                                     new rows, see `segments`
    observations/date=2026-01-31/zone=q1202310/NAME.parquet     compacted, sorted by cell and time
    states/date=…/zone=…/NAME.parquet                           compacted
    checkpoints/…                                               state for a fast restart, see
                                                                `replay.checkpoints`
    requests/…                                                  see `erasure_requests`
    drafts/                                                     unfinished files, ignored by readers

The date is that of the measurement (UTC). NAME is the name of the newest segment (SHARD-EPOCH-SEQ,
see `segments`) from which the file contains rows. If several services own the archive in turn (by a
lease), the epoch of the compacting service follows SHARD. If a service was frozen during its
compaction, two services may compact at once. The epoch ensures that they never write the same name.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from datetime import date, timedelta
from pathlib import Path
from typing import Final, NamedTuple

from schemas import grid
from schemas.errors import InputError
from schemas.numeric import IntArray
from schemas.runtime.durable import open_durably
from schemas.wire import Kind

TABLES: Final = {Kind.OBSERVATION: "observations", Kind.STATE: "states"}
# column with the time of the measurement, which decides how long rows are kept
TIME: Final = {Kind.OBSERVATION: "leave_time", Kind.STATE: "time"}
# column with the time that decides the month of a batch, and whether it is too old
FIRST_TIME: Final = {Kind.OBSERVATION: "enter_time", Kind.STATE: "time"}
CHECKPOINTS: Final = "checkpoints"  # name of the folder
EPOCH_FILE: Final = "term"  # file with the epoch of the service that owns the folder
DAY_NS: Final = 86_400_000_000_000
# Number of days whose observations affect the map. Batches may be sent again for 30 days
# (ServiceConfig.oldest_s).
MAP_DAYS: Final = 31
_EPOCH: Final = date(1970, 1, 1)
_TERM: Final = re.compile(r"\.\d{10}$")
_NAMED: Final = re.compile(r"(\.(?P<term>\d{10}))?-(?P<epoch>\d{10,})-\d{8,}\.parquet$")
_OF_A_TERM: Final = {
    **dict.fromkeys(("inbox", "observations", "states", "rollup"), _NAMED),
    "weather": re.compile(r"\.(?P<term>\d{10})-(?P<epoch>\d{20})\.parquet$"),
    "keys": re.compile(r"(?P<epoch>)\.(?P<term>\d{10})\.witnesses$"),
}
# The expression does not match copies of folders that a person has made.
_DAY: Final = re.compile(r"date=\d{4}-(0[1-9]|1[0-2])-(0[1-9]|[12]\d|3[01])")


class Cut(NamedTuple):
    """Position of a segment (file of new rows) in the sequence of all segments: the epoch and the
    number in the segment's name. The position stands for all rows in this segment and in earlier
    ones. A later segment always has a larger position, even if the system clock is set back.
    """

    epoch: int
    number: int


class Partition(NamedTuple):
    """Partition of the compacted (sorted) files: day (days since 1970) and zone (a map square of
    zoom 7).
    """

    day: int
    zone: int

    def folder(self, root: Path, table: str) -> Path:
        """Return the folder of the partition (day and zone) in the archive. A letter precedes the
        digits of the zone (map square of zoom 7) in the name, so that readers do not parse them as
        a number.
        """
        zone = f"zone=q{grid.quadkey(self.zone, grid.ZONE_ZOOM)}"
        return root / table / f"date={date_of(self.day)}" / zone


# Folders that a started service or a compaction creates. Every archive has at least one of them.
MARKS: Final = ("inbox", "observations", "states", "keys", "rollup", "map")


def require_archive(root: Path) -> None:
    """Raise unless a folder is an archive. This check prevents compaction (move of new rows into
    sorted files) from writing into other folders.

    Raises:
        InputError: it is not a folder, or no service created it.
    """
    if not root.is_dir():
        raise InputError(
            "archive", f"{root} is not a folder", "give the archive folder of a service"
        )
    if not any((root / name).is_dir() for name in MARKS):
        raise InputError(
            "archive",
            f"{root} is not an archive: {MARKS[0]} is missing",
            "give the archive folder of a service",
        )


def partitions_of(time: IntArray, cell: IntArray) -> tuple[IntArray, IntArray]:
    """Return two arrays (n,), computed from the times [ns] and cells of rows: the day (days since
    1970) and the zone of each row.
    """
    return time // DAY_NS, grid.zone_of(cell)


def date_of(day: int) -> date:
    """Return the date that is `day` days after 1970-01-01."""
    return _EPOCH + timedelta(days=day)


def day_of(folder: Path) -> int:
    """Return the day (days since 1970) of a folder named `date=…`."""
    return (date.fromisoformat(folder.name.removeprefix("date=")) - _EPOCH).days


def partition_of(path: Path) -> Partition:
    """Return the partition of a compacted (sorted) file: its day and its zone. Both are read from
    the names of the folders in which the file lies.
    """
    return Partition(
        day_of(path.parents[1]), grid.from_quadkey(path.parent.name.removeprefix("zone=q"))
    )


def compacted_files(
    root: Path, kind: Kind, since_day: int | None = None, until_day: int | None = None
) -> Iterator[Path]:
    """Yield the compacted (sorted) files of a kind (observations or states), sorted by date, zone
    and age. Only days (since 1970) from `since_day` to `until_day`, both included, are read; None
    means no limit.
    """
    for folder in day_folders(root, TABLES[kind], since_day, until_day):
        yield from sorted(folder.glob("zone=*/*.parquet"))


def day_folders(
    root: Path, table: str, since_day: int | None = None, until_day: int | None = None
) -> list[Path]:
    """Return the folders of a table's days (since 1970) from `since_day` to `until_day`, both
    included, in order of time; None means no limit.
    """
    found = sorted(path for path in (root / table).glob("date=*") if _DAY.fullmatch(path.name))
    return [
        folder
        for folder in found
        if (since_day is None or day_of(folder) >= since_day)
        and (until_day is None or day_of(folder) <= until_day)
    ]


def segment_name(prefix: str, number: int) -> str:
    """Return the file name of a segment; `prefix` has the form SHARD-EPOCH: name of the service,
    and number of its start.
    """
    return f"{prefix}-{number:08d}.parquet"


def with_term(name: str, term: int) -> str:
    """Return `name`, the beginning of a file name, with the term (lease epoch) of the service that
    writes the file appended: NAME.0000000012. If `name` ends with the term of another service, that
    term is replaced. Thus two services never write the same file. For term 0 (no lease), `name` is
    returned unchanged.
    """
    return f"{_TERM.sub('', name)}.{term:010d}" if term else name


def compacted_name(name: str, term: int) -> str:
    """Return the name of a compacted (sorted) file. It is made from the name of the file's newest
    segment and the term (lease epoch) of the compacting service; the term is 0 without a lease.
    """
    shard, epoch, number = name.rsplit("-", 2)
    return f"{with_term(shard, term)}-{epoch}-{number}"


def term_of(name: str) -> int | None:
    """Return the term (lease epoch) in the name of a file of the archive's copy; None if the name
    contains none.

    It is the term of the service that wrote the file. For compacted (sorted) files and their
    roll-ups (hourly statistics), this is the compacting service.
    """
    folder, _, rest = name.partition("/")
    if folder == CHECKPOINTS:
        return int(epoch) if (epoch := rest.partition("-")[0]).isdigit() else None
    found = _OF_A_TERM[folder].search(rest) if folder in _OF_A_TERM else None
    return None if found is None else int(found["term"] or found["epoch"])


def age_key(name: str) -> tuple[int, int, str]:
    """Return a sort key for the name of a segment or of a compacted (sorted) file. Sorting by the
    key gives the order from old to new. The key consists of the epoch (number of the writer's
    start), the number of the segment, and the name of the service.
    """
    shard, epoch, number = Path(name).stem.rsplit("-", 2)
    return int(epoch), int(number), shard


def read_epoch(root: Path) -> int:
    """Return the epoch (number of the owner's lease term) of the service that owns an archive
    folder; 0 if the archive is used without a lease.
    """
    with suppress(OSError, ValueError):
        return int((root / EPOCH_FILE).read_text())
    return 0


def write_epoch(root: Path, epoch: int) -> None:
    """Store the epoch (number of the owner's lease term) that the names of files compacted from now
    on must contain.

    Raises:
        OSError: the file cannot be written.
    """
    with open_durably(root / EPOCH_FILE) as file:
        file.write(f"{epoch}\n".encode())
