"""Reader of ASAM MDF 4 files, which contain measured channels or the frames of a logged bus.

The library asammdf decodes the file. It can loop forever on a block that refers to itself or to an
address outside the file. Therefore `check_blocks` first follows the chains of data groups, channel
groups, channels and data lists, and visits each address at most once.
"""

from __future__ import annotations

import resource
import struct
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np

from edge_agent.inputs.memory import MOST_BYTES, limit_memory
from edge_agent.inputs.readers.can_log import Frames, Log, no_database
from edge_agent.inputs.recording import Recording, Series, foreign_errors, import_optional
from schemas.errors import InputError
from schemas.thresholds import NS

SUFFIXES: Final = (".mf4", ".mdf")
MOST_BLOCKS: Final = 1_000_000
MOST_CPU_S: Final = 600  # [s] processor time; a file of 10 GB takes less
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
        return MdfContent(mdf_frames(file, identifiers), None)


def has_frames(mdf: Any) -> bool:  # noqa: ANN401
    """Return True if an MDF file contains the frames of a logged bus."""
    return any("CAN_DataFrame" in name for name in mdf.channels_db)


def mdf_frames(mdf: Any, needed_identifiers: set[int]) -> tuple[Log, float]:  # noqa: ANN401
    """Return the CAN frames of an MDF file whose identifier is in `needed_identifiers`, and
    the start of the log [s since 1970 UTC].
    """
    log: Log = {}
    first = np.inf
    start = float(mdf.header.start_time.timestamp())
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
    first = first if np.isfinite(first) else 0.0
    for frames in log.values():
        frames.times = [start + (time - first) for time in frames.times]
    return log, start


def read_mdf(mdf: Any, path: Path, requested: set[str] | None) -> Recording:  # noqa: ANN401
    """Return the channels `requested` of a measurement in an MDF file, by name; all
    channels if `requested` is None.

    If several channels have the same name, the first one with samples is used.
    """
    start = mdf.header.start_time.timestamp()
    recording = Recording(path.name, {}, round(start * NS) if start > 0 else None)
    with foreign_errors(path, "MDF 4"):
        for name, places in mdf.channels_db.items():
            if requested is not None and name not in requested:
                continue
            for group, index in places:
                if index == mdf.masters_db.get(group):
                    continue
                channel = mdf.get(name, group=group, index=index)
                values = np.asarray(channel.samples)
                if values.ndim == 1 and values.dtype.kind in "fiub" and len(values):
                    t = np.asarray(channel.timestamps, dtype=np.float64)
                    recording.signals[name] = Series(
                        t, values.astype(np.float64), str(channel.unit or "")
                    )
                    break
    return recording
