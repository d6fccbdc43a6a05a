"""Live source for ROS 2 topics by the Zenoh transport of ROS (rmw_zenoh), without a ROS
installation.

The source subscribes to the topics at a Zenoh router, and the library rosbags decodes the messages.
The key of a topic is DOMAIN/TOPIC/PACKAGE::msg::dds_::TYPE_/HASH, and the payload is CDR. The
attachment begins with a sequence number and the time of publication (int64 each, little endian;
rmw_zenoh_cpp, design.md), so lost messages can be counted. Signals have the same names as in a bag,
/topic.field.field. Topics with the type can_msgs/Frame are CAN buses.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge_agent.inputs.live.can_bus import Decoder
from edge_agent.inputs.live.feed import Feed, HostClock, Received
from edge_agent.inputs.readers.rosbag import FRAME, RequestedNumbers, stamp_of
from edge_agent.inputs.recording import Series, import_optional
from schemas.config import ZenohSettings
from schemas.errors import InputError
from schemas.runtime.zenoh_session import open_session
from schemas.thresholds import NS

DDS: Final = "::dds_::"
# Sequence number and time [ns]; the publisher's identity follows.
ATTACHMENT: Final = struct.Struct("<qq")
# The year 2000 [ns UTC]. An earlier stamp counts from the start of a simulation.
OLDEST_NS: Final = 946_684_800 * NS
CAN_FRAME: Final = "\n".join(
    (
        "std_msgs/Header header",
        "uint32 id",
        "bool is_rtr",
        "bool is_extended",
        "bool is_error",
        "uint8 dlc",
        "uint8[8] data",
        "",
    )
)


# [byte] largest accepted message; motion and bus messages have a few hundred
MOST_MESSAGE: Final = 1 << 20
MOST_IDENTITY: Final = 64  # [byte] part of a publisher's identity that is used
MOST_PUBLISHERS: Final = 1000  # publishers whose sequence numbers are followed


@dataclass(frozen=True)
class RosTopics:
    """Topics that a ROS 2 source receives, and their decoding.

    Attributes:
        domain: ROS_DOMAIN_ID.
        signals: needed signals; each name begins with its topic.
        decoder: decoder for topics of CAN frames, if there is a CAN database.
        buses: topics of CAN frames.
        types: folder of PACKAGE/NAME.msg files, for message types that no ROS distribution has.
    """

    domain: int
    signals: Sequence[str]
    decoder: Decoder | None = None
    buses: Sequence[str] = ()
    types: Path | None = None


class Ros2Feed(Feed):
    """Live source for topics of one ROS domain.

    Args:
        name: name of the source.
        clock: clock of the host.
        settings: Zenoh settings to reach the router.
        topics: topics to receive.

    Raises:
        InputError: rosbags is not installed, no signal names a topic, or a message type is invalid.
    """

    def __init__(
        self,
        name: str,
        clock: HostClock,
        settings: ZenohSettings,
        topics: RosTopics,
    ) -> None:
        super().__init__(name, clock)
        self._settings = settings
        self._domain = topics.domain
        self._decoder = topics.decoder
        requested = {signal for signal in topics.signals if signal.startswith("/")}
        named_topics = {signal.partition(".")[0] for signal in requested}
        self._topics = sorted(named_topics | set(topics.buses))
        if not self._topics:
            raise InputError(
                "profile",
                "names no topic",
                "call its signals /topic.field, as import drafts them from a bag",
            )
        self._store = _load_typestore(topics.types)
        self._numbers = RequestedNumbers(requested)
        self._next_numbers: dict[bytes, int] = {}  # publisher -> next expected sequence number

    def listen(self) -> None:
        """Receive messages until the source is stopped. The method does not handle a lost router,
        because Zenoh itself reconnects.
        """
        session = open_session(self._settings, self.stopping)
        if session is None:
            return
        with session:
            subscribers = [
                session.declare_subscriber(
                    f"{self._domain}/{topic.strip('/')}/*/*", self._make_listener(topic)
                )
                for topic in self._topics
            ]
            self.openings += 1
            self.stopping.wait()
            for subscriber in subscribers:
                subscriber.undeclare()

    def series(self, received: list[Received]) -> dict[str, Series]:
        """Return the values in received ROS messages by signal name. CAN frames are decoded with
        the CAN database.
        """
        frames = [(time, message) for time, message in received if isinstance(message, tuple)]
        found = self._decoder.series(frames) if self._decoder and frames else {}
        times: dict[str, list[float]] = {}
        values: dict[str, list[float]] = {}
        for time, message in received:
            if isinstance(message, dict):
                for name, value in message.items():
                    times.setdefault(name, []).append(time)
                    values.setdefault(name, []).append(value)
        return found | {
            name: Series(np.array(times[name]), np.array(values[name])) for name in times
        }

    def _make_listener(self, topic: str) -> Any:  # noqa: ANN401
        def receive_sample(sample: Any) -> None:  # noqa: ANN401 Zenoh exports no type for it
            try:
                self._take_sample(topic, sample)
            # Hostile bytes may raise any error, which Zenoh would discard silently.
            except Exception as error:  # noqa: BLE001
                self.unreadable(f"{topic}: a message that cannot be read ({type(error).__name__})")

        return receive_sample

    def _take_sample(self, topic: str, sample: Any) -> None:  # noqa: ANN401
        if len(sample.payload) > MOST_MESSAGE:
            raise ValueError("too large")
        kind = type_of(str(sample.key_expr))
        published = self._publication_time(
            sample.attachment.to_bytes() if sample.attachment is not None else b""
        )
        message = self._store.deserialize_cdr(sample.payload.to_bytes(), kind)
        stamp = stamp_of(message)
        at = stamp if stamp > OLDEST_NS or not published else published
        if kind == FRAME:
            if not (message.is_error or message.is_rtr):
                data = bytes(message.data)[: message.dlc]
                self.store_message(at, (int(message.id), bool(message.is_extended), data))
            return
        leaves = self._numbers.find_leaves(topic, message)
        self.store_message(at, {name: float(take(message)) for name, take in leaves})

    def _publication_time(self, attachment: bytes) -> int:
        """Return the time of publication [ns] that a message's attachment contains; 0 if it is
        missing. Gaps in the sequence numbers of the attachments are counted as lost messages.
        """
        if len(attachment) < ATTACHMENT.size:
            return 0
        number, at = ATTACHMENT.unpack_from(attachment)
        publisher = attachment[ATTACHMENT.size :][:MOST_IDENTITY]
        if publisher not in self._next_numbers and len(self._next_numbers) >= MOST_PUBLISHERS:
            self._next_numbers.pop(next(iter(self._next_numbers)))
        expected = self._next_numbers.get(publisher, number)
        self.lost += max(number - expected, 0)
        self._next_numbers[publisher] = max(number + 1, expected)
        return int(at)


def type_of(key: str) -> str:
    """Return the ROS message type that a Zenoh key of rmw_zenoh contains, for example
    sensor_msgs/msg/Imu for `sensor_msgs::msg::dds_::Imu_`.

    Raises:
        ValueError: the key contains no type.
    """
    place, mark, name = key.split("/")[-2].partition(DDS)
    if not mark or not name.endswith("_"):
        raise ValueError("no type in the key")
    return f"{place.replace('::', '/')}/{name[:-1]}"


def _load_typestore(folder: Path | None) -> Any:  # noqa: ANN401
    typesys = import_optional("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    texts = {FRAME: CAN_FRAME}
    if folder is not None:
        files = sorted(folder.glob("*/*.msg"))
        if not files:
            raise InputError(
                "source",
                f"{folder} contains no PACKAGE/NAME.msg",
                "name a folder of message definitions",
            )
        for file in files:
            texts[f"{file.parent.name}/msg/{file.stem}"] = file.read_text(encoding="utf-8")
    try:
        for kind, text in texts.items():
            store.register(typesys.get_types_from_msg(text, kind))
    except Exception as error:  # the library's parser may raise any error
        raise InputError(
            "source", f"a message definition is invalid ({error})", "correct it"
        ) from error
    return store
