"""Reader of ROS bags (version 2 folders and MCAP files, and version 1) by the library rosbags,
without a ROS installation.

A signal is called `/topic.field.field`; elements of short arrays are `/topic.field[0]`, and joints
`/topic.velocity[NAME]`. The time of a reading is the time stamp in the message if there is one,
else the recorder's. Topics with the type can_msgs/Frame are read as a CAN log.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge_agent.inputs.readers.can_log import Frames, Log
from edge_agent.inputs.recording import Recording, Series, foreign_errors, import_optional
from schemas.thresholds import NS

SUFFIXES: Final = (".mcap", ".db3", ".bag")
FRAME: Final = "can_msgs/msg/Frame"
LONGEST_ARRAY: Final = 36  # longer arrays are images and scans, and their elements are not read
DEEPEST: Final = 5
SKIPPED: Final = ("header", "covariance")
Leaf = tuple[str, Callable[[Any], Any]]


def is_bag(path: Path) -> bool:
    """Return True if the path is a bag: by its suffix, or because it is a folder with a bag's
    metadata.
    """
    return path.suffix.lower() in SUFFIXES or (path / "metadata.yaml").is_file()


@contextmanager
def open_bag(path: Path) -> Iterator[Any]:
    """Open a ROS bag for a `with` block, and close it at the end of the block. If `path` is a
    database file of a bag folder, the folder is opened.
    """
    highlevel = import_optional("rosbags.highlevel")
    typesys = import_optional("rosbags.typesys")
    inside = (
        path.parent if path.suffix == ".db3" or (path.parent / "metadata.yaml").is_file() else path
    )
    with foreign_errors(path, "ROS bag"):
        types = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
        reader = highlevel.AnyReader([inside], default_typestore=types)
        try:
            with reader:
                yield reader
        finally:
            for part in reader.readers:
                _close_files(part)


def _close_files(part: Any) -> None:  # noqa: ANN401
    """Close the files that the reader of a ROS bag has opened. This is necessary because the
    library rosbags leaves a file open if it cannot read it as a bag.
    """
    for held in (part, *getattr(part, "storages", ()), getattr(part, "storage", None)):
        if (file := getattr(held, "bio", None)) is not None:
            file.close()


def has_frames(reader: Any) -> bool:  # noqa: ANN401
    """Return True if a topic of the bag contains CAN frames."""
    return any(connection.msgtype == FRAME for connection in reader.connections)


def bag_frames(reader: Any, path: Path, identifiers: set[int]) -> tuple[Log, float]:  # noqa: ANN401
    """Return the CAN frames of a ROS bag whose identifier is in `identifiers`, and the time of the
    first frame [s since 1970 UTC]. Each topic counts as a bus.
    """
    log: Log = {}
    first = np.inf
    topics = [connection for connection in reader.connections if connection.msgtype == FRAME]
    with foreign_errors(path, "ROS bag"):
        for connection, _, time, message in _read_messages(reader, topics):
            first = min(first, time)
            if message.id in identifiers and not message.is_error and not message.is_rtr:
                key = topics.index(connection), int(message.id), bool(message.is_extended)
                log.setdefault(key, Frames()).add(time / NS, bytes(message.data)[: message.dlc])
    return log, first / NS if np.isfinite(first) else 0.0


def read_bag(reader: Any, path: Path, requested: set[str] | None) -> Recording:  # noqa: ANN401
    """Return the signals `requested` of a ROS bag by name; all signals if it is None."""
    topics = [
        c
        for c in reader.connections
        if requested is None or any(name.startswith(f"{c.topic}.") for name in requested)
    ]
    times: dict[str, list[int]] = {}
    values: dict[str, list[float]] = {}
    first: int | None = None
    with foreign_errors(path, "ROS bag"):
        leaves: dict[str, list[Leaf]] = {}
        for connection, stored, time, message in _read_messages(reader, topics):
            first = stored if first is None else min(first, stored)
            topic = connection.topic
            if topic not in leaves:
                found = [(f"{topic}{name}", take) for name, take in leaves_of(message)]
                leaves[topic] = [
                    leaf for leaf in found if requested is None or leaf[0] in requested
                ]
            for name, take in leaves[topic]:
                times.setdefault(name, []).append(time)
                values.setdefault(name, []).append(float(take(message)))
    recording = Recording(path.name, {}, first)
    for name, stamps in times.items():
        t = (np.array(stamps, dtype=np.int64) - (first or 0)) / NS
        order = np.argsort(t, kind="stable")
        recording.signals[name] = Series(t[order], np.array(values[name])[order])
    return recording


def _read_messages(
    reader: Any,  # noqa: ANN401
    connections: list[Any],
) -> Iterator[tuple[Any, int, int, Any]]:
    """Yield (connection, time of the recorder [ns], time of the message [ns], message) for each
    message in a ROS bag; a connection is a recorded topic.
    """
    if not connections:
        return
    for connection, stored, raw in reader.messages(connections=connections):
        message = reader.deserialize(raw, connection.msgtype)
        yield connection, stored, stamp_of(message) or stored, message


def stamp_of(message: Any) -> int:  # noqa: ANN401
    """Return the time stamp [ns] in the header of a ROS message; 0 if it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0 if stamp is None else int(stamp.sec) * NS + int(stamp.nanosec)


def leaves_of(message: Any, prefix: str = "", depth: int = 0) -> Iterator[Leaf]:  # noqa: ANN401
    """Yield a pair for each number in a ROS message: the signal name, which begins with `prefix`,
    and a function that reads the number from a message of the same type. `depth` is the level of
    nesting.
    """
    for name in getattr(message, "__dataclass_fields__", {}):
        if name.startswith("__") or any(name.endswith(word) for word in SKIPPED):
            continue
        path = f"{prefix}.{name}"
        value = getattr(message, name)
        take = attrgetter(path[1:])
        if isinstance(value, bool | int | float | np.number):
            yield path, take
        elif isinstance(value, np.ndarray | list | tuple):
            yield from _array_leaves(message, path, value, prefix)
        elif depth < DEEPEST:
            yield from leaves_of(value, path, depth + 1)


def _array_leaves(
    message: Any,  # noqa: ANN401
    path: str,
    value: Any,  # noqa: ANN401
    prefix: str,
) -> Iterator[Leaf]:
    if not 0 < len(value) <= LONGEST_ARRAY or not all(
        isinstance(v, int | float | np.number) for v in value
    ):
        return
    labels = getattr(message, "name", None) if not prefix else None
    has_labels = isinstance(labels, list) and len(labels) == len(value)
    take = attrgetter(path[1:])
    for index in range(len(value)):
        label = labels[index] if has_labels else index  # type: ignore[index]
        yield f"{path}[{label}]", _element_at(take, index)


def _element_at(take: Callable[[Any], Any], index: int) -> Callable[[Any], Any]:
    def take_element(message: Any) -> Any:  # noqa: ANN401
        values = take(message)
        return values[index] if index < len(values) else float("nan")

    return take_element
