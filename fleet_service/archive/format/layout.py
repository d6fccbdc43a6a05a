"""Layout of an archive: names are built and parsed only here.

    inbox/…                                                     the log, see `segments`
    observations/date=2026-01-31/zone=q1202310/NAME.parquet     compacted, sorted by cell and time
    states/date=…/zone=…/NAME.parquet                           compacted
    checkpoints/…                                               start of a restart, see
                                                                `replay.checkpoints`
    requests/…                                                  see `erasure_requests`
    drafts/                                                     files being written; nothing there
                                                                counts

The date is that of the measurement (UTC). NAME is that of the newest segment whose rows the file
holds. If services succeed each other by a lease, the epoch of the compacting service follows SHARD:
two services that compact at once, because one was frozen, never write the same name.
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
TIME: Final = {
    Kind.OBSERVATION: "leave_time",
    Kind.STATE: "time",
}  # of the measurement, by which rows are kept
FIRST_TIME: Final = {
    Kind.OBSERVATION: "enter_time",
    Kind.STATE: "time",
}  # by which a batch is too old, and its month
CHECKPOINTS: Final = "checkpoints"  # a folder
EPOCH_FILE: Final = "term"  # holds the epoch of the service that owns the folder
DAY_NS: Final = 86_400_000_000_000
# Days of observations that show in the map, and of batches that may come again
# (ServiceConfig.oldest_s is 30 days).
MAP_DAYS: Final = 31
_EPOCH: Final = date(1970, 1, 1)
_TERM: Final = re.compile(r"\.\d{10}$")
_NAMED: Final = re.compile(r"(\.(?P<term>\d{10}))?-(?P<epoch>\d{10,})-\d{8,}\.parquet$")
_OF_A_TERM: Final = {
    **dict.fromkeys(("inbox", "observations", "states", "rollup"), _NAMED),
    "weather": re.compile(r"\.(?P<term>\d{10})-(?P<epoch>\d{20})\.parquet$"),
    "keys": re.compile(r"(?P<epoch>)\.(?P<term>\d{10})\.witnesses$"),
}
_DAY: Final = re.compile(
    r"date=\d{4}-(0[1-9]|1[0-2])-(0[1-9]|[12]\d|3[01])"
)  # and no copy that somebody made of one


class Cut(NamedTuple):
    """Position in the log: everything up to this segment. Names only increase, independent of
    the clock.
    """

    epoch: int
    number: int


class Partition(NamedTuple):
    """Folder of compacted rows: days since 1970 and z7 zone."""

    day: int
    zone: int

    def folder(self, root: Path, table: str) -> Path:
        """Return the partition's folder. The letter before the zone keeps readers from parsing it
        as a number.
        """
        zone = f"zone=q{grid.quadkey(self.zone, grid.ZONE_ZOOM)}"
        return root / table / f"date={date_of(self.day)}" / zone


# What a service makes when it starts, and what compaction leaves: one of them is in every archive.
MARKS: Final = ("inbox", "observations", "states", "keys", "rollup", "map")


def require_archive(root: Path) -> None:
    """Raise unless a folder is an archive, because compaction would write into it.

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
    """Return day and zone of rows, (n,) each."""
    return time // DAY_NS, grid.zone_of(cell)


def date_of(day: int) -> date:
    """Return the date that is `day` days after 1970-01-01."""
    return _EPOCH + timedelta(days=day)


def day_of(folder: Path) -> int:
    """Return the days since 1970 of a folder `date=…`."""
    return (date.fromisoformat(folder.name.removeprefix("date=")) - _EPOCH).days


def partition_of(path: Path) -> Partition:
    """Return the partition in whose folder a file lies."""
    return Partition(
        day_of(path.parents[1]), grid.from_quadkey(path.parent.name.removeprefix("zone=q"))
    )


def compacted_files(
    root: Path, kind: Kind, since_day: int | None = None, until_day: int | None = None
) -> Iterator[Path]:
    """Yield the compacted files of a kind by date, zone and age; both days are included."""
    for folder in day_folders(root, TABLES[kind], since_day, until_day):
        yield from sorted(folder.glob("zone=*/*.parquet"))


def day_folders(
    root: Path, table: str, since_day: int | None = None, until_day: int | None = None
) -> list[Path]:
    """Return the folders of a table's days in order."""
    found = sorted(path for path in (root / table).glob("date=*") if _DAY.fullmatch(path.name))
    return [
        folder
        for folder in found
        if (since_day is None or day_of(folder) >= since_day)
        and (until_day is None or day_of(folder) <= until_day)
    ]


def segment_name(prefix: str, number: int) -> str:
    """Return the name of a segment; `prefix` is SHARD-EPOCH."""
    return f"{prefix}-{number:08d}.parquet"


def with_term(name: str, term: int) -> str:
    """Return the first part of a file's name with the writer's term instead of a former one, so
    that it replaces no other file; 0 without terms."""
    return f"{_TERM.sub('', name)}.{term:010d}" if term else name


def compacted_name(name: str, term: int) -> str:
    """Return the name of a compacted file from its newest segment and the term of the compacting
    service; 0 without terms."""
    shard, epoch, number = name.rsplit("-", 2)
    return f"{with_term(shard, term)}-{epoch}-{number}"


def term_of(name: str) -> int | None:
    """Return the epoch of the service that made an object of an archive's copy; None if its name
    has none.

    Segments, checkpoints, weather and vehicle identities have the epoch of their service; compacted
    files and their roll-ups that of the compacting service.
    """
    folder, _, rest = name.partition("/")
    if folder == CHECKPOINTS:
        return int(epoch) if (epoch := rest.partition("-")[0]).isdigit() else None
    found = _OF_A_TERM[folder].search(rest) if folder in _OF_A_TERM else None
    return None if found is None else int(found["term"] or found["epoch"])


def age_key(name: str) -> tuple[int, int, str]:
    """Return a sort key that orders segments, or files with their rows, from old to new: epoch,
    number, shard.
    """
    shard, epoch, number = Path(name).stem.rsplit("-", 2)
    return int(epoch), int(number), shard


def read_epoch(root: Path) -> int:
    """Return the epoch of the service that owns an archive folder; 0 without terms."""
    with suppress(OSError, ValueError):
        return int((root / EPOCH_FILE).read_text())
    return 0


def write_epoch(root: Path, epoch: int) -> None:
    """Write this epoch into the names of files compacted from now on.

    Raises:
        OSError: it cannot be written.
    """
    with open_durably(root / EPOCH_FILE) as file:
        file.write(f"{epoch}\n".encode())
