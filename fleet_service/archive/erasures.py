"""Months, and vehicles in a month, that were forgotten: what was measured in them is not let in again.

    keys/2026-01.UNTIL.erased             empty; of that month, what was measured before UNTIL [ns]
    keys/2026-01.PSEUDONYM.UNTIL.erased   likewise, of the vehicle that had this pseudonym; goes with the month's key

Without the month's key nobody can tell which batches are there already, so that one which is sent again would count
twice; and of a vehicle whose rows were removed nothing tells either that they were there. UNTIL is the end of the
month, or in a month that goes on the newest that the archive holds: no clock decides.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date, timedelta
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from fleet_service.archive.layout import DAY_NS
from fleet_service.archive.pseudonyms import number
from schemas.errors import InputError
from schemas.numeric import BoolArray, IntArray
from schemas.runtime.durable import sync_directory
from schemas.tables import US_STEP

_NAME: Final = re.compile(r"(\d{4}-\d{2})\.(?:([0-9a-f]{16})\.)?(\d{1,19})\.erased")
_EPOCH: Final = date(1970, 1, 1)


class Span(NamedTuple):
    """Times [ns] from `begin` on and before `until`."""

    begin: int
    until: int


def first_day(month: str) -> date:
    """First day of a month (2026-01).

    Raises:
        InputError: it is none.
    """
    try:
        return date.fromisoformat(f"{month}-01")
    except ValueError as error:
        raise InputError("period", f"{month!r} is no month", "give one like 2026-01") from error


def span_of(month: str) -> Span:
    """A whole month.

    Raises:
        InputError: as `first_day`.
    """
    first = first_day(month)
    following = (first.replace(day=28) + timedelta(days=4)).replace(day=1)
    return Span((first - _EPOCH).days * DAY_NS, (following - _EPOCH).days * DAY_NS)


def note(folder: Path, month: str, newest: int, pseudonym: str | None = None) -> None:
    """Let nothing of a month, or of one vehicle in it, in again that was measured until `newest` [ns], the newest that
    the archive holds; durable when it returns.

    Raises:
        OSError: the disk is full or broken.
    """
    until = min(newest + US_STEP, span_of(month).until)  # the archive keeps times in whole steps
    if pseudonym is not None:
        (folder / f"{month}.{pseudonym}.{max(until, 0)}.erased").touch(0o600)
    else:  # the month's says more than those of its vehicles; what these forgot may be newer than all that is there
        names = [name for path in folder.glob(f"{month}.*.erased") if (name := _NAME.fullmatch(path.name)) and name[2]]
        until = max([until, *(int(name[3]) for name in names)])
        (folder / f"{month}.{max(until, 0)}.erased").touch(0o600)
        sync_directory(folder)
        for name in names:
            (folder / name[0]).unlink()
    sync_directory(folder)


class Erased(NamedTuple):
    """What is not let in again: spans of all vehicles, and until when [ns] of a pseudonym, by its number."""

    months: list[Span]
    vehicles: dict[int, int]


def read(folder: Path) -> Erased:
    """As the folder of the keys has it."""
    months, vehicles = list[Span](), dict[int, int]()
    for path in sorted(folder.glob("*.erased")):
        if (name := _NAME.fullmatch(path.name)) is None:
            continue
        month, pseudonym, until = name[1], name[2], int(name[3])
        if pseudonym is None:
            months.append(Span(span_of(month).begin, until))
        else:
            vehicles[number(pseudonym)] = max(until, vehicles.get(number(pseudonym), 0))
    return Erased(months, vehicles)


def within(spans: Sequence[Span], time: IntArray) -> BoolArray:
    """Which times (n,) [ns] lie in one of the spans."""
    out = np.zeros(len(time), bool)
    for begin, until in spans:
        out |= (time >= begin) & (time < until)
    return out
