"""Records of the data that were erased from an archive: a month, or one vehicle's rows of a month.
Their measurements are not accepted again.

    keys/2026-01.UNTIL.erased             empty file: measurements of that month before UNTIL [ns]
                                          are refused
    keys/2026-01.PSEUDONYM.UNTIL.erased   the same for the vehicle with this pseudonym; removed with
                                          the month's key

Reason for the refusal: without the month's key, the service cannot recognise batches that it has
already received, so a repeated batch would count twice. The same holds for a vehicle whose rows
were removed. UNTIL is the end of the month. In the current month, UNTIL is the time of the newest
measurement in the archive, so no clock is needed.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date, timedelta
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from fleet_service.archive.format.layout import DAY_NS
from fleet_service.archive.identity.pseudonyms import pseudonym_number
from schemas.errors import InputError
from schemas.numeric import BoolArray, IntArray
from schemas.runtime.durable import sync_directory
from schemas.thresholds import US_STEP

_NAME: Final = re.compile(r"(\d{4}-\d{2})\.(?:([0-9a-f]{16})\.)?(\d{1,19})\.erased")
_EPOCH: Final = date(1970, 1, 1)


class Span(NamedTuple):
    """Time range [ns] whose measurements were erased: `begin` is included, `until` is excluded."""

    begin: int
    until: int


def first_day(month: str) -> date:
    """Return the first day of a month given as text (2026-01).

    Raises:
        InputError: the text is not a month.
    """
    try:
        return date.fromisoformat(f"{month}-01")
    except ValueError as error:
        raise InputError("period", f"{month!r} is not a month", "give one like 2026-01") from error


def span_of(month: str) -> Span:
    """Return the time range of a month given as text (2026-01).

    Raises:
        InputError: the text is not a month.
    """
    first = first_day(month)
    following = (first.replace(day=28) + timedelta(days=4)).replace(day=1)
    return Span((first - _EPOCH).days * DAY_NS, (following - _EPOCH).days * DAY_NS)


def record_erasure(folder: Path, month: str, newest: int, pseudonym: str | None = None) -> None:
    """Record that measurements of a month, or of one vehicle in it, are refused from now on. The
    refusal covers times up to `newest` [ns], the newest measurement in the archive. The record is
    durable when this returns.

    Raises:
        OSError: the disk is full or broken.
    """
    until = min(newest + US_STEP, span_of(month).until)  # the archive keeps times in whole steps
    if pseudonym is not None:
        (folder / f"{month}.{pseudonym}.{max(until, 0)}.erased").touch(0o600)
    else:
        # The erasure of a month replaces the records of single vehicles. Such a record may extend
        # beyond the newest remaining row.
        names = [
            name
            for path in folder.glob(f"{month}.*.erased")
            if (name := _NAME.fullmatch(path.name)) and name[2]
        ]
        until = max([until, *(int(name[3]) for name in names)])
        (folder / f"{month}.{max(until, 0)}.erased").touch(0o600)
        sync_directory(folder)
        for name in names:
            (folder / name[0]).unlink()
    sync_directory(folder)


class ErasedData(NamedTuple):
    """Erased data: time ranges whose rows are refused for all vehicles, and, per pseudonym number,
    the time [ns] before which the rows of that vehicle are refused.
    """

    months: list[Span]
    vehicles: dict[int, int]


def read_erasures(folder: Path) -> ErasedData:
    """Return which data have been erased, as recorded in the folder of keys."""
    months = list[Span]()
    vehicles = dict[int, int]()
    for path in sorted(folder.glob("*.erased")):
        if (name := _NAME.fullmatch(path.name)) is None:
            continue
        month = name[1]
        pseudonym = name[2]
        until = int(name[3])
        if pseudonym is None:
            months.append(Span(span_of(month).begin, until))
        else:
            vehicles[pseudonym_number(pseudonym)] = max(
                until, vehicles.get(pseudonym_number(pseudonym), 0)
            )
    return ErasedData(months, vehicles)


def in_spans(spans: Sequence[Span], time: IntArray) -> BoolArray:
    """Return a mask of times (n,) [ns]: True if the time lies in one of the erased time ranges."""
    out = np.zeros(len(time), bool)
    for begin, until in spans:
        out |= (time >= begin) & (time < until)
    return out
