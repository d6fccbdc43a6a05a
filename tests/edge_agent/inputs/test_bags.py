"""Tests of ROS bags whose topics have several publishers, several clocks or no fix."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest

from edge_agent.inputs.bring_in import read_source
from edge_agent.inputs.live.ros2 import CAN_FRAME
from edge_agent.inputs.names import FIXES, draft_profile
from edge_agent.inputs.profile import Channel, Profile
from edge_agent.inputs.readers.dbc import parse_dbc
from edge_agent.inputs.readers.rosbag import FRAME, align_stamps
from schemas.thresholds import NS

rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")
Message: TypeAlias = Any  # the library makes the types of messages at run time
STORE = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
STORE.register(typesys.get_types_from_msg(CAN_FRAME, FRAME))
DATE = 1_768_462_200 * NS
MS = 1_000_000


def make_message(kind: str, /, **fields: object) -> Message:
    return STORE.types[kind](**fields)


def make_header(stamp: int) -> Message:
    time = make_message("builtin_interfaces/msg/Time", sec=stamp // NS, nanosec=stamp % NS)
    return make_message("std_msgs/msg/Header", stamp=time, frame_id="")


def make_joints(stamp: int, **velocities: float) -> Message:
    values = np.array(list(velocities.values()))
    return make_message(
        "sensor_msgs/msg/JointState",
        header=make_header(stamp),
        name=list(velocities),
        position=values + 100.0,
        velocity=values,
        effort=np.empty(0),
    )


def make_fix(stamp: int, status: int) -> Message:
    return make_message(
        "sensor_msgs/msg/NavSatFix",
        header=make_header(stamp),
        status=make_message("sensor_msgs/msg/NavSatStatus", status=status, service=1),
        latitude=57.7 if status >= 0 else 0.0,
        longitude=12.0 if status >= 0 else 0.0,
        altitude=0.0,
        position_covariance=np.zeros(9),
        position_covariance_type=0,
    )


def make_frame(stamp: int, value: int) -> Message:
    data = np.zeros(8, np.uint8)
    data[0] = value
    return make_message(
        FRAME,
        header=make_header(stamp),
        id=170,
        is_rtr=False,
        is_extended=False,
        is_error=False,
        dlc=8,
        data=data,
    )


def write_bag(folder: Path, messages: Iterable[tuple[int, str, Message]]) -> Path:
    """Write messages, each with the recorder's time [ns] and its topic."""
    plugin = rosbag2.StoragePlugin.MCAP
    connections: dict[str, Any] = {}
    with rosbag2.Writer(folder, version=9, storage_plugin=plugin) as writer:
        for stored, topic, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], stored, STORE.serialize_cdr(message, kind))
    return folder


def test_joints_are_read_by_name_from_messages_of_several_publishers(tmp_path: Path) -> None:
    messages = []
    for k in range(30):
        at = DATE + k * 10 * MS
        kinds = (
            {"left": 1.0, "right": 2.0},
            {"right": 2.0, "left": 1.0},
            {"steering": 0.1},
        )
        messages.append((at, "/joint_states", make_joints(at, **kinds[k % 3])))
    signals = read_source(write_bag(tmp_path / "bag", messages), None, None).signals
    assert set(signals["/joint_states.velocity[left]"].values) == {1.0}
    assert set(signals["/joint_states.velocity[right]"].values) == {2.0}
    assert set(signals["/joint_states.position[steering]"].values) == {100.1}
    assert len(signals["/joint_states.velocity[left]"].t) == 20


def test_velocities_are_read_if_the_first_message_has_none(tmp_path: Path) -> None:
    messages = []
    for k in range(10):
        at = DATE + k * 10 * MS
        joints = make_joints(at, left=1.0)
        if k % 2 == 0:
            joints.velocity = np.empty(0)
        messages.append((at, "/joint_states", joints))
    signals = read_source(write_bag(tmp_path / "bag", messages), None, None).signals
    assert len(signals["/joint_states.position[left]"].t) == 10
    assert signals["/joint_states.velocity[left]"].values.tolist() == [1.0] * 5


def test_sensor_that_counts_from_its_start_is_put_on_the_clock_of_the_bag(tmp_path: Path) -> None:
    messages = []
    for k in range(20):
        at = DATE + k * 10 * MS
        messages.append((at + 3 * MS, "/wheels", make_joints(at, left=1.0)))
        messages.append(
            (at + (1 + k % 3) * MS, "/rear", make_joints(5 * NS + k * 10 * MS, rear=1.0))
        )
    recording = read_source(write_bag(tmp_path / "bag", messages), None, None)
    wheels = recording.signals["/wheels.velocity[left]"].t
    rear = recording.signals["/rear.velocity[rear]"].t
    assert rear - wheels == pytest.approx(np.full(20, 0.001), abs=1e-9)
    assert recording.notes == [
        f"bag: /rear has a clock of its own; {DATE / NS - 5 + 0.001:.3f} s added"
    ]


def test_bag_of_a_replay_keeps_the_dates_of_its_messages() -> None:
    at = DATE + np.arange(5) * 10 * MS
    stamps = {
        "/a": np.column_stack([at + 86400 * NS + 2 * MS, at]),
        "/b": np.column_stack([at + 86400 * NS + 2 * MS, np.zeros(5, np.int64)]),
    }
    times, notes = align_stamps(stamps)
    assert np.array_equal(times["/a"], at)
    assert np.array_equal(times["/b"], at)
    assert notes == ["recorded 86400 s after the date of its messages"]


def test_simulated_time_has_one_shift_for_all_topics() -> None:
    clock = NS + np.arange(5) * 10 * MS
    stamps = {
        "/a": np.column_stack([DATE + clock + 2 * MS, clock]),
        "/b": np.column_stack([DATE + clock + 7 * MS, clock]),
    }
    times, _ = align_stamps(stamps)
    assert np.array_equal(times["/a"], DATE + clock + 2 * MS)
    assert np.array_equal(times["/a"], times["/b"])


def test_late_topic_does_not_change_the_shift_of_another_clock() -> None:
    clock = DATE + np.arange(5) * 10 * MS
    stamps = {
        "/late": np.column_stack([clock + 5 * NS, clock]),
        "/own": np.column_stack([clock + 11 * NS, clock]),
    }
    times, notes = align_stamps(stamps)
    assert np.array_equal(times["/late"], clock)
    assert np.array_equal(times["/own"], clock + 11 * NS)
    assert notes == ["/own has a clock of its own; 11.000 s added"]


def test_draft_requires_a_fix_for_the_position_of_a_receiver(tmp_path: Path) -> None:
    messages = [(DATE + k * NS, "/fix", make_fix(DATE + k * NS, -(k % 2))) for k in range(10)]
    recording = read_source(write_bag(tmp_path / "bag", messages), None, None)
    profile = draft_profile(dict.fromkeys(recording.signals, ""), "bag")
    for name in ("latitude", "longitude"):
        assert profile.channels[name].gates == {"/fix.status.status": FIXES}


def test_steered_joints_are_road_wheels() -> None:
    names = ["/joints.position[steering_left_joint]", "/joints.position[steering_right_joint]"]
    channels = draft_profile(dict.fromkeys(names, ""), "bag").channels
    assert channels["delta_fl"].signal == names[0]
    assert channels["delta_fr"].signal == names[1]
    assert channels["delta_fl"].at == "road wheel"


def test_other_topics_of_a_bag_with_frames_are_read(tmp_path: Path) -> None:
    database = parse_dbc('BO_ 170 M: 8 X\n SG_ S : 0|8@1+ (1,0) [0|0] "" X\n')
    messages = []
    for k in range(10):
        at = DATE + k * 10 * MS
        messages.append((at, "/can", make_frame(at + MS, k)))
        messages.append((at, "/fix", make_fix(at + 4 * MS, 0)))
    bag = write_bag(tmp_path / "bag", messages)
    recording = read_source(bag, None, database)
    assert recording.start_ns == pytest.approx(DATE + MS, abs=1000)
    assert recording.signals["M.S"].values.tolist() == list(range(10))
    assert recording.signals["/fix.latitude"].t[0] == pytest.approx(0.003, abs=1e-6)
    topics = Profile(name="own", channels={"latitude": Channel(signal="/fix.latitude")})
    assert read_source(bag, topics, None).signals.keys() == {"/fix.latitude"}


def test_frames_that_count_from_a_start_are_put_on_the_clock_of_the_bag(tmp_path: Path) -> None:
    database = parse_dbc('BO_ 170 M: 8 X\n SG_ S : 0|8@1+ (1,0) [0|0] "" X\n')
    messages = []
    for k in range(10):
        at = DATE + k * 10 * MS
        messages.append((at + 2 * MS, "/can", make_frame(5 * NS + k * 10 * MS, k)))
        messages.append((at + 3 * MS, "/fix", make_fix(at, 0)))
    recording = read_source(write_bag(tmp_path / "bag", messages), None, database)
    assert recording.start_ns == DATE + 2 * MS
    assert recording.signals["M.S"].t == pytest.approx(np.arange(10) * 0.01, abs=1e-6)
    assert recording.signals["/fix.latitude"].t[0] == pytest.approx(-0.002, abs=1e-9)
    shift = DATE / NS - 5 + 0.002
    assert recording.notes == [f"bag: /can has a clock of its own; {shift:.3f} s added"]


def test_recorder_without_a_date_gives_a_recording_without_one(tmp_path: Path) -> None:
    database = parse_dbc('BO_ 170 M: 8 X\n SG_ S : 0|8@1+ (1,0) [0|0] "" X\n')
    messages = []
    for k in range(10):
        at = 7 * NS + k * 10 * MS
        messages.append((at, "/can", make_frame(at, k)))
        messages.append((at, "/fix", make_fix(at + 4 * MS, 0)))
    recording = read_source(write_bag(tmp_path / "bag", messages), None, database)
    assert recording.start_ns is None
    assert recording.signals.keys() >= {"M.S", "/fix.latitude"}
    assert recording.signals["/fix.latitude"].t[0] == pytest.approx(0.004, abs=1e-9)
