"""Test senders ("peers") for live sources, run as processes:
`python -m tests.benchmarks.inputs.peers KIND ADDRESS SAMPLES RATE`.

A peer prints `ready`, waits for a line on its input, sends SAMPLES samples at RATE per second and
prints the number of messages. It ends when its input ends, so it can be killed and restarted at the
same address. The databroker peer implements the published interface kuksa.val.v2; it is not the
broker itself.
"""

from __future__ import annotations

import json
import struct
import sys
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np

from edge_agent.inputs.profile import Channel, Profile
from edge_agent.inputs.recording import import_optional
from edge_agent.inputs.units import DEG
from schemas.config import ZenohSettings
from schemas.runtime.zenoh_session import open_session
from schemas.signals import per_wheel
from schemas.thresholds import NS
from tests.benchmarks.inputs.databroker import Databroker

# Speed of the car [m/s] and radius of its wheels [m].
SPEED = 15.0
RADIUS = 0.3
CHANNELS: Final = ("ax", "ay", "yaw_rate", "delta_fl", *per_wheel("omega"))
STEP: Final = 1e-6  # scale of a number on the bus: value per bit
DBC: Final = "".join(
    f"BO_ {256 + k} M{k}: 8 X\n"
    + "".join(
        f' SG_ {name} : {32 * n}|32@1- ({STEP},0) [0|0] "" X\n'
        for n, name in enumerate(CHANNELS[2 * k :][:2])
    )
    for k in range(len(CHANNELS) // 2)
)
TOPIC: Final = "/car/imu"
HASH: Final = "RIHS01_" + "0" * 64


def drive_at(t: float) -> dict[str, float]:
    """Return the readings of the channels at time t [s] during a slow slalom."""
    rate = 0.2 * np.sin(1.5 * t)
    return {
        "ax": 0.0,
        "ay": SPEED * rate,
        "yaw_rate": rate,
        "delta_fl": 2.7 * rate / SPEED,
        **dict.fromkeys(per_wheel("omega"), SPEED / RADIUS),
    }


def profile_of(kind: str) -> Profile:
    """Return the profile (assignment of signals to channels) with which an agent reads the signals
    of a test sender ("peer") of this kind.
    """
    if kind == "can":
        return Profile(
            name=kind,
            channels={n: Channel(signal=n, message=f"M{k // 2}") for k, n in enumerate(CHANNELS)},
        )
    fields = {
        "ax": ".linear_acceleration.x",
        "ay": ".linear_acceleration.y",
        "yaw_rate": ".angular_velocity.z",
    }
    wheels = {name: f"/car/joints.velocity[{name}]" for name in CHANNELS if name not in fields}
    named = {name: f"{TOPIC}{field}" for name, field in fields.items()} | wheels
    return Profile(
        name=kind, channels={name: Channel(signal=signal) for name, signal in named.items()}
    )


def pace_samples(samples: int, rate: float) -> Iterator[float]:
    """Wait for the due time of each of `samples` samples at `rate` per second, and then yield its
    time since the first sample [s].
    """
    began = time.monotonic()
    for k in range(samples):
        time.sleep(max(0.0, began + k / rate - time.monotonic()))
        yield k / rate


def send_can(address: str, samples: int, rate: float) -> int:
    """Send four messages per sample on a CAN bus; the address is interface/channel/port. Return the
    number of messages.
    """
    interface, channel, port = address.split("/")
    made = import_optional("can")
    with made.Bus(interface=interface, channel=channel, port=int(port)) as bus:
        report_ready()
        for t in pace_samples(samples, rate):
            values = [round(value / STEP) for value in drive_at(t).values()]
            for k in range(0, len(values), 2):
                data = struct.pack("<ii", *values[k : k + 2])
                bus.send(made.Message(arbitration_id=256 + k // 2, is_extended_id=False, data=data))
    return samples * len(CHANNELS) // 2


def send_ros2(address: str, samples: int, rate: float) -> int:
    """Send an Imu and a JointState message per sample in the form of rmw_zenoh; the function opens
    a Zenoh router at the address. Return the number of messages.
    """
    session = open_session(
        ZenohSettings(connect=[], config={"mode": "router", "listen/endpoints": [address]})
    )
    assert session is not None
    typesys = import_optional("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    of = store.types
    header, stamp, vector, turned, imu, joints = (
        of[name]
        for name in (
            "std_msgs/msg/Header",
            "builtin_interfaces/msg/Time",
            "geometry_msgs/msg/Vector3",
            "geometry_msgs/msg/Quaternion",
            "sensor_msgs/msg/Imu",
            "sensor_msgs/msg/JointState",
        )
    )
    names = [name for name in CHANNELS if name not in ("ax", "ay", "yaw_rate")]
    none = np.zeros(9)
    with session:
        put = [
            session.declare_publisher(
                f"0/{topic}/sensor_msgs::msg::dds_::{kind}_/{HASH}",
                congestion_control=import_optional("zenoh").CongestionControl.BLOCK,
            )
            for topic, kind in (("car/imu", "Imu"), ("car/joints", "JointState"))
        ]
        report_ready()
        # The stubs declare `matching` as a bool.
        while not all(
            publisher.matching_status.matching  # type: ignore[attr-defined]
            for publisher in put
        ):
            time.sleep(0.01)
        for k, t in enumerate(pace_samples(samples, rate)):
            now = time.time_ns()
            values = drive_at(t)
            head = header(stamp(now // NS, now % NS), "")
            turn = vector(0.0, 0.0, values["yaw_rate"])
            pull = vector(values["ax"], values["ay"], 9.8)
            speeds = np.array([values[name] for name in names])
            messages = (
                imu(head, turned(0, 0, 0, 1), none, turn, none, pull, none),
                joints(head, names, np.zeros(0), speeds, np.zeros(0)),
            )
            for number, (publisher, message) in enumerate(zip(put, messages, strict=True)):
                attachment = struct.pack("<qqB", k, now, 16) + bytes([number] * 16)
                publisher.put(
                    bytes(store.serialize_cdr(message, message.__msgtype__)), attachment=attachment
                )
        wait_for_line()  # messages in transit arrive before the session closes
    return 2 * samples


def send_vss(address: str, samples: int, rate: float) -> int:
    """Run a simulated databroker and publish the samples on it; the address is host:port. Return
    the number of values.
    """
    from edge_agent.inputs.live.sources import VSS_PROFILE
    from edge_agent.inputs.profile import load_profile

    paths = {
        name: channel.signals[0] for name, channel in load_profile(VSS_PROFILE)[0].channels.items()
    }
    published = [name for name in CHANNELS if name in paths]
    degrees = [name for name in published if name not in ("ax", "ay")]
    with Databroker(address, [paths[name] for name in published]) as broker:
        report_ready()
        for t in pace_samples(samples, rate):
            now = time.time_ns()
            values = drive_at(t)
            broker.publish(
                {paths[n]: values[n] / (DEG if n in degrees else 1.0) for n in published}, now
            )
        wait_for_line()
    return samples * len(published)


def send_gpsd(address: str, samples: int, rate: float) -> int:
    """Act as a gpsd server: send position fixes of a simulated car that drives east; the address is
    host:port. Return the number of fixes.
    """
    import socket

    host, port = address.split(":")
    with socket.create_server((host, int(port))) as server:
        print("listening", flush=True)
        connection, _ = server.accept()
        with connection:
            report_ready()
            for t in pace_samples(samples, rate):
                place = {
                    "lat": 57.7,
                    "lon": 11.9 + t * SPEED / 59_500.0,
                    "speed": SPEED,
                    "track": 90.0,
                }
                report = {"class": "TPV", "mode": 3, "time": datetime.now(UTC).isoformat(), **place}
                connection.sendall(json.dumps(report).encode() + b"\n")
            wait_for_line()
    return samples


def report_ready() -> None:
    """Print `ready`, and wait for a line on standard input, which starts the sending of this test
    sender.
    """
    print("ready", flush=True)
    wait_for_line()


def wait_for_line() -> None:
    """Wait until a line arrives on standard input, or the input ends."""
    sys.stdin.readline()


PEERS: Final[dict[str, Callable[[str, int, float], int]]] = {
    "can": send_can,
    "ros2": send_ros2,
    "vss": send_vss,
    "gpsd": send_gpsd,
}


def main(words: Any) -> None:  # noqa: ANN401
    """Run a test sender (peer) with the given command-line arguments, and print the number of
    messages sent.
    """
    kind, address, samples, rate = words
    print(json.dumps({"sent": PEERS[kind](address, int(samples), float(rate))}), flush=True)
    wait_for_line()


if __name__ == "__main__":
    main(sys.argv[1:])
