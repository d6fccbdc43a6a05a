"""Reader of ASAM MDF 4 files, which contain measured channels or the frames of a logged bus.

The library asammdf decodes the file. It can loop forever on a block that refers to itself or to an
address outside the file. Therefore `check_blocks` first follows the chains of data groups, channel
groups, channels and data lists, and visits each address at most once.
"""

from __future__ import annotations

import resource
import struct
from concurrent.futures import ProcessPoolExecutor
from datetime import UTC
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np

from edge_agent.inputs.memory import MOST_BYTES, limit_memory
from edge_agent.inputs.readers.can_log import Frames, Log, no_database, require_steady_clock
from edge_agent.inputs.recording import Recording, Series, foreign_errors, import_optional
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.thresholds import NS

SUFFIXES: Final = (".mf4", ".mdf")
MOST_BLOCKS: Final = 1_000_000
MOST_CPU_S: Final = 600  # [s] processor time; a file of 10 GB takes less
TIME: Final = 1  # synchronisation type of a master channel that contains time
MOST_NAMES: Final = 6  # maximum number of channel names in a note
HEADER: Final = 64  # [byte] size of the identification block
# Numbers of the followed links in each kind of block: first the next block, then its subordinate
# blocks.
LINKS: Final = {
    b"##HD": (0,),
    b"##DG": (0, 1, 2),
    b"##CG": (0, 1),
    b"##CN": (0, 1),
    b"##DL": (0,),
    b"##HL": (0,),
    b"##CA": (0,),
}


def check_blocks(path: Path) -> None:
    """Check the links between the blocks (data structures) of an MDF file by following all chains.

    Raises:
        InputError: a link leads out of the file or into a circle, or a group states more records
            than fit into the file.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        # A file of a logger that lost its power begins with "UnFinMF"; asammdf can read it.
        if file.read(3) not in (b"MDF", b"UnF"):
            raise InputError(
                "source", f"{path} is not an MDF file", "give a measurement of version 4"
            )
        file.seek(28)
        version = struct.unpack("<H", file.read(2).ljust(2, b"\0"))[0]
        if version < 400:
            raise InputError(
                "source", f"{path} is MDF {version / 100:.2f}", "convert it to version 4"
            )
        seen: set[int] = set()
        waiting = [HEADER]
        while waiting:
            address = waiting.pop()
            if address in seen:
                raise InputError(
                    "source",
                    f"{path} has blocks that refer to each other in a circle at byte {address}",
                    "record it again",
                )
            if address + 24 > size or len(seen) > MOST_BLOCKS:
                raise InputError(
                    "source", f"{path} refers to byte {address}, beyond its end", "record it again"
                )
            seen.add(address)
            waiting += _linked_blocks(file, address, size, path)


def _linked_blocks(file: BinaryIO, address: int, size: int, path: Path) -> list[int]:
    file.seek(address)
    kind, _, length, count = struct.unpack("<4sIQQ", file.read(24))
    if not kind.startswith(b"##") or length > size or count > (length - 24) // 8:
        raise InputError(
            "source", f"{path} has no valid block at byte {address}", "record it again"
        )
    links = struct.unpack(f"<{count}Q", file.read(8 * count).ljust(8 * count, b"\0"))
    if kind == b"##CG":
        _, cycles = struct.unpack("<QQ", file.read(16).ljust(16, b"\0"))
        if cycles > 1000 * size:  # deflate expands a byte to about a thousand at most
            raise InputError(
                "source", f"{path} declares {cycles} records in {size} bytes", "record it again"
            )
    return [links[place] for place in LINKS.get(kind, ()) if place < count and links[place]]


class MdfContent(NamedTuple):
    """Content of an MDF file: either CAN frames and the time of the first one [s since 1970 UTC],
    or the channels of a measurement. The unused field is None.
    """

    frames: tuple[Log, float] | None
    recording: Recording | None


def read_isolated(path: Path, identifiers: set[int] | None, names: set[str] | None) -> MdfContent:
    """Read an MDF file in a separate process, because asammdf's compiled parts crash on some broken
    files.

    Args:
        path: path of the file.
        identifiers: frame identifiers to read from a bus log; None if no database can decode
            the frames.
        names: channels to read from a measurement; None for all.

    Raises:
        InputError: the file is broken, or asammdf is missing.
    """
    with foreign_errors(path, "MDF 4"):
        check_blocks(path)
    import_optional("asammdf")
    with (
        foreign_errors(path, "MDF 4"),
        ProcessPoolExecutor(1, get_context("spawn"), _limit_resources) as pool,
    ):
        return pool.submit(_read_content, path, identifiers, names).result()


def _limit_resources() -> None:
    limit_memory(MOST_BYTES)
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_CPU_S, MOST_CPU_S))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _read_content(path: Path, identifiers: set[int] | None, names: set[str] | None) -> MdfContent:
    with import_optional("asammdf").MDF(path) as file:
        if not has_frames(file):
            return MdfContent(None, read_mdf(file, path, names))
        if identifiers is None:
            raise no_database(path)
        return MdfContent(mdf_frames(file, path, identifiers), None)


def has_frames(mdf: Any) -> bool:  # noqa: ANN401
    """Return True if an MDF file contains the frames of a logged bus."""
    return any("CAN_DataFrame" in name for name in mdf.channels_db)


def mdf_frames(
    mdf: Any,  # noqa: ANN401
    path: Path,
    needed_identifiers: set[int],
) -> tuple[Log, float]:
    """Return the CAN frames of an MDF file whose identifier is in `needed_identifiers`, and
    the time of the log's first frame [s since 1970 UTC].
    """
    log: Log = {}
    first = np.inf
    start, _ = start_of(mdf)
    for group, index in mdf.channels_db["CAN_DataFrame"]:
        channel = mdf.get("CAN_DataFrame", group=group, index=index, raw=True)
        if not len(channel.timestamps):
            continue
        first = min(first, float(channel.timestamps.min()))
        rows = channel.samples
        identifiers = rows["CAN_DataFrame.ID"].astype(np.int64)
        extended = identifiers & (1 << 31) != 0
        if "CAN_DataFrame.IDE" in rows.dtype.names:
            extended |= rows["CAN_DataFrame.IDE"].astype(bool)
        identifiers &= (1 << 29) - 1
        buses = rows["CAN_DataFrame.BusChannel"].astype(np.int64)
        lengths = rows["CAN_DataFrame.DataLength"].astype(np.int64)
        data = rows["CAN_DataFrame.DataBytes"]
        for row in np.flatnonzero(np.isin(identifiers, list(needed_identifiers))):
            key = int(buses[row]), int(identifiers[row]), bool(extended[row])
            frame = bytes(data[row][: lengths[row]])
            log.setdefault(key, Frames()).add(float(channel.timestamps[row]), frame)
    if not np.isfinite(first):
        return log, start
    for frames in log.values():
        frames.times = [start + time for time in frames.times]
    return require_steady_clock(path, log), start + first


def read_mdf(mdf: Any, path: Path, requested: set[str] | None) -> Recording:  # noqa: ANN401
    """Return the channels `requested` of a measurement in an MDF file, by name; all
    channels if `requested` is None.

    Parts of a channel in several groups are joined if they are one after the other, in the same
    unit. Else the first one with samples is used, and a note names the channel.
    """
    seconds, has_zone = start_of(mdf)
    dated = round(seconds * NS) if seconds > 0 else None
    recording = Recording(path.name, {}, dated, has_zone=has_zone)
    if dated is not None and not has_zone:
        recording.notes.append(f"{path.name}: its date has no time zone; taken as UTC")
    separate: list[str] = []
    with foreign_errors(path, "MDF 4"):
        timed = {group for group in mdf.masters_db if _has_time(mdf, group)}
        for name, places in mdf.channels_db.items():
            if requested is not None and name not in requested:
                continue
            parts = [
                part
                for group, index in places
                if group in timed and index != mdf.masters_db[group]
                if (part := _read_channel(mdf, name, group, index)) is not None
            ]
            if parts:
                recording.signals[name], are_joined = _join_parts(parts)
                separate += [] if are_joined else [name]
    _note_left_out(recording, len(mdf.groups) - len(timed), separate)
    return recording


def start_of(mdf: Any) -> tuple[float, bool]:  # noqa: ANN401
    """Return the start of a measurement [s since 1970], and True if it is known to be UTC.

    A file may state local time without a zone. This time is returned as if it were UTC, so that
    the result does not depend on the time zone of this machine.
    """
    start = mdf.header.start_time
    has_zone = start.tzinfo is not None
    return (start if has_zone else start.replace(tzinfo=UTC)).timestamp(), has_zone


def _has_time(mdf: Any, group: int) -> bool:  # noqa: ANN401
    """Return True if the master channel of a group contains time, and not an angle, a distance or
    an index.
    """
    return bool(mdf.groups[group].channels[mdf.masters_db[group]].sync_type == TIME)


def _read_channel(mdf: Any, name: str, group: int, index: int) -> Series | None:  # noqa: ANN401
    """Return the valid readings of a channel; None if it has none, or they are not numbers."""
    signal = mdf.get(name, group=group, index=index, raw=True)
    values = np.asarray(signal.samples)
    if values.ndim != 1 or values.dtype.kind not in "fiub" or not len(values):
        return None
    rule = signal.conversion
    if rule is not None:
        values = _convert_samples(rule, values)
    # The channel's unit takes precedence over that of its conversion; many programs write only
    # the latter.
    unit = str(mdf.groups[group].channels[index].unit or (rule and rule.unit) or "")
    t = np.asarray(signal.timestamps, dtype=np.float64)
    order = np.argsort(t, kind="stable")
    return Series(t[order], values[order].astype(np.float64), unit)


def _convert_samples(rule: Any, raw: FloatArray) -> FloatArray:  # noqa: ANN401
    """Return raw samples (n,) as physical values.

    If a rule gives text for some values, for example "not available", these values are NaN. If it
    gives only texts, for example the states of a controller, the raw numbers are returned.
    """
    values = np.asarray(rule.convert(raw))
    if values.dtype.kind in "fiub":
        return values
    referenced = (rule.referenced_blocks or {}).values()
    has_numbers = any(hasattr(block, "conversion_type") for block in referenced)
    return np.full(len(raw), np.nan) if has_numbers else raw


def _join_parts(parts: list[Series]) -> tuple[Series, bool]:
    """Return the parts of a channel as one series and True. If two of them overlap in time or have
    different units, return the first part and False.
    """
    if len(parts) == 1:
        return parts[0], True
    in_order = sorted(parts, key=lambda part: part.t[0])
    have_one_unit = len({part.unit for part in parts}) == 1
    if not have_one_unit or any(later.t[0] <= part.t[-1] for part, later in pairwise(in_order)):
        return parts[0], False
    t = np.concatenate([part.t for part in in_order])
    return Series(t, np.concatenate([part.values for part in in_order]), parts[0].unit), True


def _note_left_out(recording: Recording, untimed: int, separate: list[str]) -> None:
    """Add notes about the number of groups without time, and the channels whose parts in several
    groups are not joined, to a recording.
    """
    if untimed:
        recording.notes.append(f"{recording.name}: {untimed} groups without time left out")
    if separate:
        names = ", ".join(sorted(separate)[:MOST_NAMES])
        more = len(separate) - MOST_NAMES
        recording.notes.append(
            f"{recording.name}: in several groups at the same time or in other units, the first is "
            f"used: {names}" + (f" and {more} more" if more > 0 else "")
        )
