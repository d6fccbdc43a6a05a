"""Tests of live sources of signals. The values from all sources must share one clock, losses must
be reported, and no error may end the program.
"""

from __future__ import annotations

import json
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edge_agent.cli import main
from edge_agent.inputs import live
from edge_agent.inputs.live.feed import HostClock
from edge_agent.inputs.live.gpsd import GpsdFeed
from edge_agent.inputs.live.ros2 import MOST_MESSAGE, MOST_PUBLISHERS, Ros2Feed, RosTopics, type_of
from edge_agent.inputs.live.rows import LiveRows
from edge_agent.inputs.live.sources import is_live, open_sources
from edge_agent.inputs.profile import Channel, Profile
from edge_agent.lab.simulation.presets import PRESETS
from schemas.errors import InputError
from schemas.signals import CHANNELS as ALL
from schemas.signals import S
from schemas.thresholds import NS
from schemas.wire import Kind
from tests.benchmarks.inputs.databroker import Databroker
from tests.benchmarks.inputs.live_benchmark import (
    COUNTED,
    count_lost,
    peer_addresses,
    run_peer,
    write_profile,
)
from tests.benchmarks.inputs.peers import CHANNELS, RADIUS, SPEED
from tests.edge_agent.service import Router, Service
from tests.ports import free_ports
from tests.waiting import until

CAR = PRESETS["sedan"].vehicle


@pytest.mark.campaign
@pytest.mark.parametrize("kind", COUNTED)
def test_no_sample_of_a_live_source_is_lost(kind: str, tmp_path: Path) -> None:
    assert count_lost(kind, tmp_path, 1.0) == (0, 100)


@pytest.mark.campaign
def test_the_values_of_every_peer_are_those_that_were_sent(tmp_path: Path) -> None:
    for kind in COUNTED:
        place, source = peer_addresses(kind)
        name, dbc = write_profile(kind, tmp_path)
        feeds, profile, clock = open_sources([source], name, dbc)
        rows = LiveRows(feeds, profile, CAR, clock)
        with run_peer(kind, place, 100_000) as running:
            running.wait_for("ready")
            blocks = rows.blocks()
            got = next(blocks).signals
            running.send_go()
            patience = iter(range(200))
            while not np.isfinite(got[..., [ALL.index(name) for name in CHANNELS]]).all():
                got = next(blocks).signals
                next(patience)
            blocks.close()
        assert got[..., S.OMEGA : S.OMEGA + 4] == pytest.approx(SPEED / RADIUS, rel=1e-6)
        # The arrival times of the readings vary.
        assert got[..., S.AY] == pytest.approx(SPEED * got[..., S.YAW_RATE], abs=1e-2)
        assert got[..., S.DELTA] == pytest.approx(2.7 * got[..., S.YAW_RATE] / SPEED, abs=1e-3)


@pytest.mark.parametrize("kind", [*COUNTED, "gpsd"])
@pytest.mark.campaign
def test_restarted_source_is_read_again(kind: str, tmp_path: Path) -> None:
    place, source = peer_addresses(kind)
    name, dbc = write_profile("can" if kind == "gpsd" else kind, tmp_path)
    feeds, _, _ = open_sources([source], name, dbc)
    feed = feeds[0]
    feed.start()
    try:
        for _ in range(2):
            with run_peer(kind, place, 100_000) as running:
                running.send_go()
                running.wait_for("ready")
                running.send_go()
                before = feed.received_count
                until(lambda: feed.received_count > before + 20)  # noqa: B023 waited for here
            until(lambda: feed.silence_message is not None)
    finally:
        feed.close()
    assert feed.broken == 0


def test_hostile_bytes_on_a_topic_are_counted_and_the_next_message_is_read(tmp_path: Path) -> None:
    from schemas.config import ZenohSettings
    from schemas.runtime.zenoh_session import open_session

    router = Router()
    feed = Ros2Feed(
        "ros2:", HostClock(), router.settings, RosTopics(0, ["/imu.angular_velocity.z"])
    )
    feed.start()
    session = open_session(ZenohSettings(connect=[router.endpoint]))
    assert session is not None
    key = "0/imu/sensor_msgs::msg::dds_::Imu_/RIHS01_0"
    rng = np.random.default_rng(3)

    def hears(payload: bytes, is_received: Callable[[], bool]) -> None:
        def has_heard() -> bool:
            session.put(key, payload)
            return is_received()

        until(has_heard)

    hears(b"\x00\x01\x00\x00", lambda: feed.broken > 0)
    for _ in range(200):
        session.put(key, rng.bytes(int(rng.integers(400))))
    good = b"\x00\x01\x00\x00" + bytes(8) + b"\x01\x00\x00\x00" + bytes(300)
    hears(good, lambda: feed.received_count > 0)
    assert list(feed.take()) == ["/imu.angular_velocity.z"]
    broken = feed.broken
    hears(good + bytes(MOST_MESSAGE), lambda: feed.broken > broken)
    for number in range(2 * MOST_PUBLISHERS):
        feed._publication_time(struct.pack("<qqq", 1, 2, number))
    assert len(feed._next_numbers) == MOST_PUBLISHERS
    session.put("0/imu/nonsense/RIHS01_0", good)
    session.close()
    feed.close()
    router.stop()
    with pytest.raises(ValueError, match="no type"):
        type_of("0/imu/nonsense/RIHS01_0")
    assert type_of(key) == "sensor_msgs/msg/Imu"


def test_hostile_lines_of_a_receiver_are_counted() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        feed = GpsdFeed("gpsd:", HostClock(), ("127.0.0.1", server.getsockname()[1]))
        feed.start()
        connection, _ = server.accept()
        fix = {"class": "TPV", "mode": 3, "lat": 50.0, "lon": 10.0}
        bad = [
            b"\xff\xfe{",
            b"{" * 90_000,
            b"[1]",
            json.dumps(fix | {"lat": 1e9, "time": "2026-01-01T00:00:00Z"}).encode(),
        ]
        with connection:
            connection.sendall(b"\n".join([*bad, b'{"class":"TPV","mode":3,"time":"soon"}', b""]))
            now = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
            connection.sendall(json.dumps(fix | {"time": now}).encode() + b"\n")
            until(lambda: feed.received_count)
            assert feed.broken == 5
            assert set(feed.take()) == {"latitude", "longitude", "speed", "course"}
            connection.sendall(b"x" * 200_000)  # a real receiver sends no endless line
            until(lambda: feed.losses)
        feed.close()


def test_databroker_is_queried_and_old_values_are_no_readings(
    caplog: pytest.LogCaptureFixture,
) -> None:
    (port,) = free_ports(1)
    paths = ["Vehicle.Acceleration.Longitudinal", "Vehicle.Acceleration.Lateral"]
    with Databroker(f"127.0.0.1:{port}", paths) as broker:
        broker.publish({paths[0]: 5.0}, time.time_ns() - 3600 * NS)
        (feed,), _, _ = open_sources([f"vss:127.0.0.1:{port}"], None)
        feed.start()
        until(lambda: broker.subscribers)
        broker.publish({paths[1]: 2.0}, time.time_ns())
        until(lambda: feed.received_count)
        assert {name: series.values.tolist() for name, series in feed.take().items()} == {
            paths[1]: [2.0]
        }
        feed.close()
    assert "has no signal Vehicle.AngularVelocity.Yaw" in caplog.text


def test_reason_of_a_lost_databroker_is_its_code_and_details(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("edge_agent.inputs.live.databroker.BUFFER", 5000)
    with Databroker("127.0.0.1:0", ["Vehicle.Acceleration.Lateral"]) as broker:
        feeds, _, _ = open_sources([f"vss:127.0.0.1:{broker.port}"], None)
        feeds[0].start()
        until(lambda: "lost (INVALID_ARGUMENT: no path, or too long a buffer)" in caplog.text)
        feeds[0].close()


@pytest.mark.parametrize(
    ("source", "profile", "named"),
    [
        ("can:socketcan", "toyota", "channel"),
        ("can:virtual/a", "vss", "dbc"),
        ("gpsd:here:there", "toyota", "port"),
        ("can:virtual/a", None, "profile"),
        ("ros2:?domain=x", "vss", "domain"),
        ("ros2:", "vss", "topic"),
        ("can:virtual/a?bus", "toyota", "options"),
        ("can:virtual/a?bus=x", "toyota", "bus is not a number"),
        ("vss:?token=/nowhere", None, "token|nowhere"),
        ("can:virtual/a", "no such profile", "profile"),
        ("ros2:?messages=/nowhere", "vss", "topic"),
        ("gpsd:127.0.0.1:99999", "toyota", "port"),
        ("gpsd:?port=1", "toyota", "option port is unknown; remove it"),
        ("ros2:?domian=1", "vss", "option domian is unknown; use domain, frames"),
        ("vss:127.0.0.1", None, "port"),
        ("vss:127.0.0.1:99999", None, "port"),
        ("vss:?tokn=/nowhere", None, "option tokn is unknown; use ca, token"),
        (f"vss:?ca={__file__}", None, "has no certificate"),
        (f"vss:?token={__file__}", None, "is not a token"),
        ("can:socketcam/can0", "toyota", "no interface socketcam; use one of .*socketcan"),
    ],
)
def test_a_source_that_makes_no_sense_is_one_clear_error(
    source: str, profile: str | None, named: str
) -> None:
    assert is_live(source)
    with pytest.raises(InputError, match=named):
        open_sources([source], profile)


def test_decoder_reads_only_the_bus_of_the_profile() -> None:
    from edge_agent.inputs.live.can_bus import Decoder
    from edge_agent.inputs.profile import FOLDER
    from edge_agent.inputs.readers.dbc import read_dbc

    database = read_dbc(FOLDER / "toyota.dbc")
    on = Profile(name="p", channels={"ax": Channel(signal="ACCEL_X", message="KINEMATICS", bus=1)})
    assert [len(Decoder(on, database, bus).identifiers) for bus in (None, 0, 1)] == [1, 0, 1]


@pytest.mark.campaign
def test_a_live_car_is_driven_by_its_bus_and_its_receiver(service: Service, tmp_path: Path) -> None:
    (bus, can) = peer_addresses("can")
    (receiver, gpsd) = peer_addresses("gpsd")
    name, dbc = write_profile("can", tmp_path)
    (tmp_path / "car.json").write_text(CAR.model_dump_json(exclude_none=True))
    config = {
        "zenoh": service.router.settings.model_dump(),
        "spool": str(tmp_path / "s.sqlite"),
        "flush_s": 0.1,
    }
    (tmp_path / "agent.json").write_text(json.dumps(config))
    words = [
        "run",
        "--source",
        can,
        "--source",
        gpsd,
        "--profile",
        name,
        "--dbc",
        str(dbc),
        "--trust",
    ]
    words += [
        "--vehicle",
        str(tmp_path / "car.json"),
        "--config",
        str(tmp_path / "agent.json"),
        "--estimator",
        "ckf",
    ]
    command = [sys.executable, "-m", "edge_agent.cli"]
    agent = subprocess.Popen(
        [*command, *words, "--name", "car-one"], stdout=subprocess.PIPE, text=True
    )
    with run_peer("can", bus, 100_000) as one, run_peer("gpsd", receiver, 100_000, 5.0) as other:
        for running in (one, other):
            running.wait_for("ready")
            running.send_go()
        service.wait(lambda batches: sum(batch.kind == Kind.OBSERVATION for batch in batches) >= 2)
        agent.terminate()
        stdout, _ = agent.communicate(timeout=60)
    assert agent.returncode == 0
    assert json.loads(stdout.splitlines()[-1])["acknowledged"] > 0
    assert {batch.vehicle for batch in service.batches} == {"car-one"}


def test_live_sources_and_a_log_cannot_be_combined(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "car.json").write_text(CAR.model_dump_json(exclude_none=True))
    assert (
        main(
            [
                "run",
                "--source",
                "gpsd:",
                "--source",
                "simulated",
                "--vehicle",
                str(tmp_path / "car.json"),
            ]
        )
        == 2
    )
    assert "cannot be combined" in capsys.readouterr().err
    assert main(["run", "--source", "gpsd:", "--profile", "toyota"]) == 2
    assert "--vehicle" in capsys.readouterr().err


def test_the_module_of_the_messages_is_the_one_that_the_proto_gives(tmp_path: Path) -> None:
    from tests.schemas.test_documents import read_descriptor

    folder = Path(live.__file__).parent / "kuksa"
    words = [
        "-m",
        "grpc_tools.protoc",
        "-I",
        str(folder),
        f"--python_out={tmp_path}",
        "broker.proto",
    ]
    subprocess.run([sys.executable, *words], check=True)
    made, kept = ((place / "broker_pb2.py").read_text() for place in (tmp_path, folder))
    assert read_descriptor(made) == read_descriptor(kept)


def test_nothing_is_left_running() -> None:
    names = {thread.name for thread in threading.enumerate()}
    assert not [name for name in names if is_live(name)]
