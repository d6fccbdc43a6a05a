"""Reader of ROS bags (version 2 folders and MCAP files, and version 1) by the library rosbags,
without a ROS installation.

A signal is called `/topic.field.field`; elements of short arrays are `/topic.field[0]`, and joints
`/topic.velocity[NAME]`. The time of a reading is the time stamp in the message if there is one,
else the recorder's; see `align_stamps`. Topics with the type can_msgs/Frame are read as a CAN log,
on the same clock.
"""

from __future__ import annotations

import shlex
from array import array
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge_agent.inputs.readers.can_log import DATED_S, Frames, Key, Log
from edge_agent.inputs.recording import Recording, Series, foreign_errors, import_optional
from schemas.errors import InputError
from schemas.numeric import IntArray
from schemas.thresholds import NS

SUFFIXES: Final = (".mcap", ".db3", ".bag")
FRAME: Final = "can_msgs/msg/Frame"
LONGEST_ARRAY: Final = 36  # longer arrays are images and scans, and their elements are not read
DEEPEST: Final = 5
MOST_KINDS: Final = 1000  # combinations of topic, names and lengths that are remembered
OWN_CLOCK_NS: Final = 10 * NS  # a larger delay is the difference of two clocks
DATED_NS: Final = round(DATED_S * NS)
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

    Raises:
        InputError: the bag cannot be read, or its metadata are missing.
    """
    if path.suffix == ".db3" and path.exists() and not (path.parent / "metadata.yaml").is_file():
        fix = f"run ros2 bag reindex {shlex.quote(str(path.parent))}, then give the folder"
        raise InputError("source", f"{path} has no metadata.yaml next to it", fix)
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
    for storage in (part, *getattr(part, "storages", ()), getattr(part, "storage", None)):
        if (file := getattr(storage, "bio", None)) is not None:
            file.close()


def has_frames(reader: Any) -> bool:  # noqa: ANN401
    """Return True if a topic of the bag contains CAN frames."""
    return any(connection.msgtype == FRAME for connection in reader.connections)


@dataclass
class BagContent:
    """Content of a ROS bag: its CAN frames, the time of the first frame [s since 1970 UTC, or since
    the start of the recorder's clock], and the signals of its other topics.

    Frames and signals have the same clock. The time of the topics' signals counts from the first
    frame; in a bag without frames, from the first message.
    """

    frames: Log
    first_frame_s: float
    topics: Recording


def read_bag(
    reader: Any,  # noqa: ANN401
    path: Path,
    requested: set[str] | None,
    identifiers: set[int] | None = None,
) -> BagContent:
    """Return the content of a ROS bag.

    Args:
        reader: the open bag.
        path: path of the bag, for messages.
        requested: names of the topics' signals to read; None for all signals.
        identifiers: identifiers of the CAN frames to read; None for no frames. Each topic of
            frames counts as a bus.
    """
    with_frames = [c for c in reader.connections if c.msgtype == FRAME and identifiers is not None]
    connections = with_frames + [
        connection
        for connection in reader.connections
        if connection.msgtype != FRAME and _is_requested(connection.topic, requested)
    ]
    stamps: dict[str, array[int]] = {}
    readings: dict[str, _Readings] = {}
    frames = _BagFrames([connection.topic for connection in with_frames], identifiers or set())
    numbers = RequestedNumbers(requested)
    with foreign_errors(path, "ROS bag"):
        for connection, stored, stamp, message in _read_messages(reader, connections):
            topic = connection.topic
            if connection.msgtype == FRAME:
                frames.add(topic, message)
            elif leaves := numbers.find_leaves(topic, message):
                row = len(stamps.get(topic, ())) // 2
                for name, take in leaves:
                    one = readings.setdefault(name, _Readings(topic))
                    one.rows.append(row)
                    one.values.append(float(take(message)))
            else:
                continue
            stamps.setdefault(topic, array("q")).extend((stored, stamp))
    clocks, notes = align_stamps(
        {topic: np.array(pairs, np.int64).reshape(-1, 2) for topic, pairs in stamps.items()}
    )
    first = min((int(clocks[topic].min()) for topic in frames.counts or clocks), default=0)
    return BagContent(
        frames.to_log(clocks), first / NS, _make_recording(path, readings, clocks, first, notes)
    )


def _make_recording(
    path: Path,
    readings: Mapping[str, _Readings],
    clocks: Mapping[str, IntArray],
    first: int,
    notes: list[str],
) -> Recording:
    """Return the readings of a bag's topics as a recording with the notes. `clocks` are the times
    [ns] of the messages of each topic, and `first` the time [ns] of t = 0.
    """
    start_ns = first if first > DATED_NS else None
    recording = Recording(path.name, {}, start_ns, notes=[f"{path.name}: {note}" for note in notes])
    for name, one in readings.items():
        t = (clocks[one.topic][one.rows] - first) / NS
        order = np.argsort(t, kind="stable")
        recording.signals[name] = Series(t[order], np.array(one.values)[order])
    return recording


def _is_requested(topic: str, requested: set[str] | None) -> bool:
    """Return True if the names `requested` include a signal of a topic; None means all signals."""
    return requested is None or any(name.startswith(f"{topic}.") for name in requested)


@dataclass
class _Readings:
    """Readings of one signal: its topic, the numbers of the messages, and the values."""

    topic: str
    rows: list[int] = field(default_factory=list)
    values: list[float] = field(default_factory=list)


class _BagFrames:
    """CAN frames of a bag whose times are not aligned yet."""

    def __init__(self, topics: list[str], identifiers: set[int]) -> None:
        """Collect the frames of these topics with these identifiers."""
        self.counts: dict[str, int] = {}  # number of messages by topic
        self._topics = topics  # a topic's position is the number of its bus
        self._identifiers = identifiers
        self._log: Log = {}
        self._rows: dict[Key, list[int]] = {}

    def add(self, topic: str, message: Any) -> None:  # noqa: ANN401
        """Count the next message of a topic, and keep its frame if it is requested."""
        row = self.counts.get(topic, 0)
        self.counts[topic] = row + 1
        if message.id in self._identifiers and not message.is_error and not message.is_rtr:
            key = self._topics.index(topic), int(message.id), bool(message.is_extended)
            self._log.setdefault(key, Frames()).add(0.0, bytes(message.data)[: message.dlc])
            self._rows.setdefault(key, []).append(row)

    def to_log(self, clocks: Mapping[str, IntArray]) -> Log:
        """Return the frames with their times. `clocks` are the times [ns] of the messages of each
        topic.
        """
        for key, frames in self._log.items():
            frames.times = (clocks[self._topics[key[0]]][self._rows[key]] / NS).tolist()
        return self._log


def align_stamps(stamps: Mapping[str, IntArray]) -> tuple[dict[str, IntArray], list[str]]:
    """Return the times [ns] of the messages of each topic on one clock, and notes.

    The time of a message is its stamp, or the recorder's time if it has none. Stamps of another
    clock, for example of a sensor that counts from its start, are shifted by the smallest delay.
    Topics whose clocks agree have a common shift. If all stamps of a bag are dates that agree, the
    bag was recorded from a replay: then the stamps are right, and the recorder's time is shifted.

    Args:
        stamps: topic -> pairs (recorder's time, stamp) (n, 2) [ns]; a missing stamp is 0.
    """
    delays = {
        topic: int(np.min(pairs[has_stamp, 0] - pairs[has_stamp, 1]))
        for topic, pairs in stamps.items()
        if (has_stamp := pairs[:, 1] > 0).any()
    }
    is_replay = (
        bool(delays)
        and min(abs(delay) for delay in delays.values()) > OWN_CLOCK_NS
        and max(delays.values()) - min(delays.values()) <= OWN_CLOCK_NS
        and min(int(stamps[topic][:, 1].max()) for topic in delays) > DATED_NS
    )
    recorder_shift = -min(delays.values()) if is_replay else 0
    foreign = [delay for delay in delays.values() if abs(delay) > OWN_CLOCK_NS]
    times = {}
    notes = []
    for topic, pairs in stamps.items():
        delay = delays.get(topic, 0)
        is_own_clock = not is_replay and abs(delay) > OWN_CLOCK_NS
        near = [other for other in foreign if abs(other - delay) <= OWN_CLOCK_NS]
        shift = min(near) if is_own_clock else 0
        times[topic] = np.where(pairs[:, 1] > 0, pairs[:, 1] + shift, pairs[:, 0] + recorder_shift)
        if is_own_clock:
            notes.append(f"{topic} has a clock of its own; {shift / NS:.3f} s added")
    if is_replay:
        notes.append(f"recorded {-recorder_shift / NS:.0f} s after the date of its messages")
    return times, notes


def add_topics(decoded: Recording, topics: Recording) -> Recording:
    """Return the signals of CAN frames (`decoded`) together with the signals of other topics of
    the same bag, whose times also count from the first frame.
    """
    return replace(
        decoded,
        signals=topics.signals | decoded.signals,
        start_ns=topics.start_ns,
        notes=[*decoded.notes, *topics.notes],
    )


def _read_messages(
    reader: Any,  # noqa: ANN401
    connections: list[Any],
) -> Iterator[tuple[Any, int, int, Any]]:
    """Yield (connection, time of the recorder [ns], stamp of the message [ns], message) for each
    message in a ROS bag; a connection is a recorded topic, and a missing stamp is 0.
    """
    if not connections:
        return
    for connection, stored, raw in reader.messages(connections=connections):
        message = reader.deserialize(raw, connection.msgtype)
        yield connection, stored, stamp_of(message), message


class RequestedNumbers:
    """The requested numbers in messages of each topic.

    Messages of one topic may name different joints, or the same ones in another order, or give no
    velocities, because several programs publish them. Each combination of names and array lengths
    has its own list of numbers.
    """

    def __init__(self, requested: set[str] | None) -> None:
        """Request the signals with these names; all if it is None."""
        self._requested = requested
        self._leaves: dict[tuple[str, tuple[str, ...], tuple[int, ...]], list[Leaf]] = {}

    def find_leaves(self, topic: str, message: Any) -> list[Leaf]:  # noqa: ANN401
        """Return signal name and function for each requested number in a message of a topic."""
        key = topic, tuple(_labels_of(message) or ()), _array_lengths(message)
        if key not in self._leaves:
            if len(self._leaves) >= MOST_KINDS:
                self._leaves.clear()
            found = [(f"{topic}{name}", take) for name, take in leaves_of(message)]
            self._leaves[key] = [
                leaf for leaf in found if self._requested is None or leaf[0] in self._requested
            ]
        return self._leaves[key]


def _array_lengths(message: Any) -> tuple[int, ...]:  # noqa: ANN401
    """Return the lengths of a message's own arrays. Lengths above LONGEST_ARRAY count as one."""
    return tuple(
        min(len(value), LONGEST_ARRAY + 1)
        for value in vars(message).values()
        if isinstance(value, np.ndarray | list | tuple)
    )


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
    labels = None if prefix else _labels_of(message)
    if labels is None or len(labels) != len(value):
        labels = [str(index) for index in range(len(value))]
    take = attrgetter(path[1:])
    for index, label in enumerate(labels):
        yield f"{path}[{label}]", _element_at(take, index)


def _labels_of(message: Any) -> list[str] | None:  # noqa: ANN401
    """Return the names of the elements of a message's arrays, such as joints; None if it states
    no names.
    """
    labels = getattr(message, "name", None)
    return labels if isinstance(labels, list) else None


def _element_at(take: Callable[[Any], Any], index: int) -> Callable[[Any], Any]:
    def take_element(message: Any) -> Any:  # noqa: ANN401
        values = take(message)
        return values[index] if index < len(values) else float("nan")

    return take_element
