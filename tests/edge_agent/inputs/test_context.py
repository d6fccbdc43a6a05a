"""Tests of context signals (controllers, temperature, wipers). Each kind of source must fill them,
logs without them must stay unchanged, and a value that is too old must count as unknown.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import can
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from edge_agent.cli import main
from edge_agent.inputs.bring_in import read_source, write_log
from edge_agent.inputs.context import HELD_S, context_block, context_values, held_readings
from edge_agent.inputs.live.databroker import DatabrokerFeed
from edge_agent.inputs.live.rows import LiveRows
from edge_agent.inputs.live.sources import open_sources
from edge_agent.inputs.merge import merge_recordings
from edge_agent.inputs.names import draft_profile
from edge_agent.inputs.profile import FOLDER, Channel, Profile, load_profile, shipped_profiles
from edge_agent.inputs.readers.dbc import read_dbc
from edge_agent.inputs.recording import Series
from edge_agent.inputs.signal_log import SignalLog, read_log
from edge_agent.lab.simulation.presets import PRESETS
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, CONTEXT, FLAGS, C
from schemas.thresholds import NS
from tests.benchmarks.inputs.databroker import Databroker
from tests.edge_agent.fakes import a_log
from tests.edge_agent.inputs import formats
from tests.edge_agent.inputs.test_live_rows import Scripted, Steered
from tests.ports import free_ports
from tests.waiting import until

CAR = PRESETS["sedan"].vehicle
# Properties of the drives in this module.
SECONDS = 20
RATE = 50
START_S = 1_700_000_000.0
AIR = -3.5
WIPES = 1.0
ENOUGH = 0.9  # share of rows that must be filled for a profile with these signals
FLAGS_AT = {"abs_active": (5.0, 7.0), "esc_active": (9.0, 10.0), "tcs_active": (12.0, 15.0)}
OF_PROFILE: dict[str, dict[str, dict[str, str]]] = {  # channels by CAN message and signal
    "hyundai-can": {
        "TCS11": {"ABS_ACT": "abs_active", "ESP_CTL": "esc_active", "TCS_CTL": "tcs_active"},
        "FATC11": {"CR_Fatc_OutTemp": "air_temperature"},
        "CGW1": {"CF_Gway_WiperHighSw": "wiper"},
    },
    "vw-mqb": {
        "ESP_21": {
            "ABS_Bremsung": "abs_active",
            "ESP_Eingriff": "esc_active",
            "EDS_Eingriff": "tcs_active",
        },
        "Kombi_02": {"KBI_Aussen_Temp_gef": "air_temperature"},
        "Gateway_72": {"Wischer_vorne_aktiv": "wiper"},
    },
}
SLOW = {"FATC11", "CGW1", "Kombi_02", "Gateway_72"}  # CAN messages that are sent once a second


def told_at(t: float) -> dict[str, float]:
    """Return the true values of the context signals (controllers, temperature, wipers) at the time
    t [s].
    """
    flags = {name: float(first <= t < last) for name, (first, last) in FLAGS_AT.items()}
    return flags | {"air_temperature": AIR, "wiper": WIPES}


def frames_of(name: str) -> list[can.Message]:
    """Return the CAN frames of a drive with all messages of a car's CAN database. `name` is the
    shipped profile (assignment of signals to channels) of this car.
    """
    cantools = pytest.importorskip("cantools")
    database = cantools.database.load_file(FOLDER / f"{name}.dbc", strict=False)
    frames = []
    for k in range(SECONDS * RATE):
        t = k / RATE
        for message in database.messages:
            if message.name in SLOW and k % RATE:
                continue
            values: dict[str, float] = {
                signal.name: max(0.0, signal.offset or 0.0) for signal in message.signals
            }
            values |= {
                s: told_at(t)[what] for s, what in OF_PROFILE[name].get(message.name, {}).items()
            }
            data = message.encode(values, padding=True, strict=False)
            frames.append(
                can.Message(
                    timestamp=round(START_S + t, 6),
                    arbitration_id=message.frame_id,
                    data=data,
                    is_extended_id=False,
                    channel=1,
                )
            )
    return frames


def import_log(path: Path, profile: Profile, out: Path) -> SignalLog:
    """Import a recording as a signal log, without a check that it has the signals that an estimator
    needs.
    """
    database = None if profile.dbc is None else read_dbc(FOLDER / profile.dbc)
    merged = merge_recordings(
        [read_source(path, profile, database)], profile, wheel_radius=0.3, steering_ratio=16.0
    )
    write_log(out, merged, profile, [path.name])
    table = pq.read_table(out)
    context = np.full((table.num_rows, len(CONTEXT)), np.nan)
    for index, name in enumerate(CONTEXT):
        context[:, index] = np.array(table[name].to_pylist(), dtype=float)
    return SignalLog(
        merged.t, np.full((table.num_rows, len(CHANNELS)), np.nan), None, context=context
    )


def assert_filled(log: SignalLog) -> None:
    """Assert that a log contains all context signals (such as temperature and wipers), and that
    their values are the true ones.
    """
    assert log.context is not None
    assert len(log.t) > 500
    assert (np.isfinite(log.context).mean(axis=0) >= ENOUGH).all(), np.isfinite(log.context).mean(
        axis=0
    )
    assert np.nanmax(np.abs(log.context[:, C.AIR_TEMPERATURE] - AIR)) < 0.3
    assert np.nanmin(log.context[:, C.WIPER]) == pytest.approx(WIPES)
    for index, name in enumerate(FLAGS):
        first, last = FLAGS_AT[name]
        # A row begins with the second reading, so the samples near a change are left out.
        clear = np.min(np.abs(log.t[:, None] - [first, last]), axis=1) > 0.1
        inside = (log.t >= first) & (log.t < last)
        known = np.isfinite(log.context[:, index]) & clear
        assert (log.context[known, index] == inside[known]).all(), name


@pytest.mark.parametrize("name", OF_PROFILE)
@pytest.mark.parametrize("kind", ["blf", "mf4", "bag"])
def test_a_bus_fills_the_context_that_its_profile_reads(
    tmp_path: Path, name: str, kind: str
) -> None:
    frames = frames_of(name)
    profile = load_profile(name)[0]
    writers: dict[str, Any] = {"blf": formats.as_log, "mf4": formats.as_mf4, "bag": formats.as_bag}
    path = writers[kind](tmp_path / ("bag" if kind == "bag" else f"a.{kind}"), frames)
    assert_filled(import_log(path, profile, tmp_path / "o.parquet"))


def plain_profile(names: dict[str, str]) -> Profile:
    """Return a profile (assignment of signals to channels). `names` gives, for each channel, the
    name of the signal from which it is read.
    """
    return Profile(
        name="p", channels={channel: Channel(signal=signal) for channel, signal in names.items()}
    )


def test_a_measurement_file_fills_the_context(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    t = np.arange(SECONDS * RATE) / RATE
    names = {"omega_fl": "Wheel", **{name: f"{name}_signal" for name in CONTEXT}}
    mdf = asammdf.MDF(version="4.10")
    mdf.append(asammdf.Signal(np.full(len(t), 30.0), t, name="Wheel", unit="rad/s"))
    for name in FLAGS:
        values = np.array([told_at(x)[name] for x in t], dtype=np.uint8)
        mdf.append(asammdf.Signal(values, t, name=names[name]))
    slow = t[::RATE]
    mdf.append(
        asammdf.Signal(
            np.full(len(slow), AIR * 1.8 + 32.0), slow, name=names["air_temperature"], unit="°F"
        )
    )
    mdf.append(asammdf.Signal(np.full(len(slow), 100.0), slow, name=names["wiper"], unit="%"))
    mdf.save(tmp_path / "lab.mf4")
    mdf.close()
    assert_filled(import_log(tmp_path / "lab.mf4", plain_profile(names), tmp_path / "o.parquet"))


def test_topics_of_a_bag_fill_the_context(tmp_path: Path) -> None:
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    flag = store.types["std_msgs/msg/Bool"]
    number = store.types["std_msgs/msg/Float32"]
    names = {"omega_fl": "/wheel.data", **{name: f"/{name}.data" for name in CONTEXT}}
    with rosbag2.Writer(tmp_path / "bag", version=9) as writer:
        topics = {
            topic: writer.add_connection(
                topic,
                f"std_msgs/msg/{'Bool' if topic[1:] in FLAGS else 'Float32'}",
                typestore=store,
            )
            for topic in ("/wheel", *(f"/{name}" for name in CONTEXT))
        }
        for k in range(SECONDS * RATE):
            ns = round(START_S * NS) + k * NS // RATE
            for topic, connection in topics.items():
                name = topic[1:]
                message = (
                    flag(bool(told_at(k / RATE)[name]))
                    if name in FLAGS
                    else number(told_at(k / RATE).get(name, 30.0))
                )
                writer.write(connection, ns, store.serialize_cdr(message, connection.msgtype))
    assert_filled(import_log(tmp_path / "bag", plain_profile(names), tmp_path / "o.parquet"))


def test_a_table_fills_the_context_and_keeps_its_rows(tmp_path: Path) -> None:
    t = np.arange(SECONDS * RATE) / RATE
    columns = {name: np.array([told_at(x)[name] for x in t]) for name in CONTEXT}
    pq.write_table(
        pa.table({"t": t, "omega_fl": np.full(len(t), 30.0), **columns}), tmp_path / "a.parquet"
    )
    log = import_log(
        tmp_path / "a.parquet",
        plain_profile({"omega_fl": "omega_fl"} | dict(zip(CONTEXT, CONTEXT, strict=True))),
        tmp_path / "o.parquet",
    )
    assert_filled(log)
    assert log.context is not None
    assert np.array_equal(log.context, np.stack([columns[name] for name in CONTEXT], axis=1))


def live_blocks(values: dict[str, float], every: int, blocks: int, profile: Profile) -> FloatArray:
    """Return the context signals (T, 5) in the first `blocks` blocks that `LiveRows` makes from a
    simulated live source.

    The source sends 50 messages per second. One message in `every` also contains the context
    signals `values`, given by name.
    """
    clock = Steered()
    feed = Scripted("bus", clock)
    numbers = iter(range(100_000))

    def wait(seconds: float) -> None:
        for _ in range(max(1, round(seconds * RATE))):
            clock.move(1.0 / RATE)
            k = next(numbers)
            feed.tell(clock.now(), ax=0.0, **(values if k % every == 0 else {}))

    rows = LiveRows([feed], profile, CAR, clock, wait=wait)
    running = rows.blocks()
    parts = [next(running).context for _ in range(blocks)]
    running.close()
    return np.concatenate([part[:, 0] for part in parts if part is not None])


@pytest.mark.parametrize("every", [1, 10, 40])
def test_a_live_bus_fills_the_context_between_its_messages(every: int) -> None:
    profile = plain_profile({name: name for name in ("ax", *CONTEXT)})
    found = live_blocks(told_at(6.0), every, 100, profile)
    assert (np.isfinite(found[20:]).mean(axis=0) >= ENOUGH).all()
    assert (found[np.isfinite(found[:, C.ABS]), C.ABS] == 1.0).all()


def test_live_source_without_context_signals_leaves_them_unknown() -> None:
    profile = plain_profile({name: name for name in ("ax", *CONTEXT)})
    assert np.isnan(live_blocks({}, 1, 20, profile)).all()


def test_flag_sent_on_change_is_held_only_if_the_profile_says_so() -> None:
    names = ("ax", *CONTEXT)
    lasting = Profile(
        name="p", channels={n: Channel(signal=n, lasting=n in CONTEXT) for n in names}
    )
    for profile, flags_known in ((lasting, True), (plain_profile({n: n for n in names}), False)):
        found = live_blocks(told_at(6.0), 100_000, 100, profile)[-100:]
        assert (np.isfinite(found[:, C.ABS]) == flags_known).all()
        assert np.isfinite(found[:, C.AIR_TEMPERATURE]).all()


def test_databroker_sends_lasting_signals_first_and_then_changes() -> None:
    (port,) = free_ports(1)
    profile = load_profile("vss")[0]
    air, abs_ = (profile.channels[name].signals[0] for name in ("air_temperature", "abs_active"))
    with Databroker(f"127.0.0.1:{port}", [air, abs_, "Vehicle.Acceleration.Lateral"]) as broker:
        broker.publish(
            {air: AIR, abs_: 0.0, "Vehicle.Acceleration.Lateral": 5.0}, time.time_ns() - 3600 * NS
        )
        (feed,), _, clock = open_sources([f"vss:127.0.0.1:{port}"], None)
        assert isinstance(feed, DatabrokerFeed)
        feed.start()
        until(lambda: feed.received_count >= 2)
        standing = feed.take()
        assert {name: series.values.tolist() for name, series in standing.items()} == {
            air: [AIR],
            abs_: [0.0],
        }
        assert abs(float(standing[air].t[0]) - clock.now()) < 30.0, (
            "the value of now, however old its stamp"
        )
        broker.publish({abs_: 1.0}, time.time_ns())
        until(lambda: feed.received_count >= 3)
        assert feed.take()[abs_].values.tolist() == [1.0]
        feed.close()


def test_reading_is_held_for_a_limited_time() -> None:
    series = Series(np.array([1.0, 2.0, 2.1]), np.array([1.0, np.nan, 0.0]))
    t = np.array([0.9, 1.0, 2.05, 2.1, 3.0, 3.2])
    found = held_readings("abs_active", series, t, lasting=False)
    assert np.array_equal(found, [np.nan, 1.0, np.nan, 0.0, 0.0, np.nan], equal_nan=True)
    assert held_readings("abs_active", series, t, lasting=True)[1:].tolist() == [
        1.0,
        1.0,
        0.0,
        0.0,
        0.0,
    ]
    assert np.isfinite(
        held_readings(
            "air_temperature", series, np.array([2.1 + HELD_S["air_temperature"]]), lasting=False
        )
    )
    empty = Series(np.zeros(0), np.zeros(0))
    assert np.isnan(held_readings("wiper", empty, t, lasting=True)).all()


def test_values_that_cannot_be_true_are_unknown() -> None:
    air = context_values("air_temperature", np.array([87.5, -70.0, 20.0, np.nan]), None)
    assert np.array_equal(air, [np.nan, np.nan, 20.0, np.nan], equal_nan=True)
    assert context_values("wiper", np.array([-0.1, 0.5, 3.0]), None).tolist() == [0.0, 0.5, 1.0]
    assert np.array_equal(
        context_values("esc_active", np.array([0.0, 1.0, 3.0, np.nan]), [3.0]),
        [0.0, 0.0, 1.0, np.nan],
        equal_nan=True,
    )


def test_context_changes_no_other_column_of_a_log(tmp_path: Path) -> None:
    frames = frames_of("hyundai-can")
    name = "hyundai-can"
    profile = load_profile(name)[0]
    bare = profile.model_copy(
        update={"channels": {n: c for n, c in profile.channels.items() if n not in CONTEXT}}
    )
    path = formats.as_log(tmp_path / "a.blf", frames)
    tables = []
    for one in (profile, bare):
        merged = merge_recordings(
            [read_source(path, one, read_dbc(FOLDER / f"{name}.dbc"))], one, wheel_radius=0.3
        )
        tables.append(merged)
    assert np.array_equal(tables[0].t, tables[1].t)
    assert tables[0].columns.keys() - tables[1].columns.keys() == set(CONTEXT)
    for channel, column in tables[1].columns.items():
        assert np.array_equal(column, tables[0].columns[channel], equal_nan=True), channel


def test_a_log_has_the_context_of_its_columns_and_none_without_them(tmp_path: Path) -> None:
    def read(columns: dict[str, Any]) -> SignalLog:
        pq.write_table(pa.table(columns), tmp_path / "log.parquet")
        return read_log(tmp_path / "log.parquet")

    plain = read(a_log(50))
    assert plain.context is None
    assert next(plain.blocks(0)).context is None
    log = read(
        a_log(50) | {"abs_active": [True] * 25 + [None] * 25, "air_temperature": np.full(50, 4.0)}
    )
    assert log.context is not None
    assert np.array_equal(log.signals, plain.signals, equal_nan=True)
    assert np.array_equal(log.context[[0, 49], C.ABS], [1.0, np.nan], equal_nan=True)
    assert np.isnan(log.context[:, C.WIPER]).all()
    parts = [block.context for block in log.blocks(0, rows=20)]
    assert np.array_equal(
        np.concatenate([part[:, 0] for part in parts if part is not None]),
        log.context,
        equal_nan=True,
    )


def test_context_block_has_the_given_context_signals() -> None:
    block = context_block(
        4, 2, {"abs_active": np.array([[False, True]] * 4), "air_temperature": -3.0}
    )
    assert block.shape == (4, 2, len(CONTEXT))
    assert block[:, :, C.ABS].tolist() == [[0.0, 1.0]] * 4
    assert (block[..., C.AIR_TEMPERATURE] == -3.0).all()
    assert np.isnan(block[..., [C.ESC, C.TCS, C.WIPER]]).all()
    with pytest.raises(KeyError, match="rain is not a context signal"):
        context_block(1, 1, {"rain": 1.0})


@pytest.mark.parametrize("field", [{"lasting": True}, {"active": [1.0]}])
def test_fields_of_context_are_refused_elsewhere(field: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="ax"):
        Profile(name="p", channels={"ax": Channel(signal="a", **field)})


def test_context_alone_is_no_drive(tmp_path: Path) -> None:
    pq.write_table(pa.table({"t": [0.0, 0.1], "abs_active": [0.0, 1.0]}), tmp_path / "a.parquet")
    profile = plain_profile({"abs_active": "abs_active"})
    with pytest.raises(InputError, match="needs more than context signals"):
        merge_recordings([read_source(tmp_path / "a.parquet", profile, None)], profile)


def test_shipped_profiles_with_controllers_read_all_context() -> None:
    found = {
        name: set(CONTEXT) & set(load_profile(name)[0].channels) for name in shipped_profiles()
    }
    carried = {"hyundai-can", "vw-mqb", "vss"}
    assert found == {
        name: set(CONTEXT) if name in carried else set() for name in shipped_profiles()
    }


def test_names_of_context_signals_are_drafted() -> None:
    names = {
        "TCS11.ABS_ACT": "abs_active",
        "ESP_21.ESP_Eingriff": "esc_active",
        "ESP_21.ASR_Anf": "tcs_active",
        "FATC11.CR_Fatc_OutTemp": "air_temperature",
        "Gateway_72.Wischer_vorne_aktiv": "wiper",
    }
    others = [
        "TCS11.ABS_DEF",
        "TCS11.ESP_PAS",
        "X.Rear_Wiper_Active",
        "EMS12.TEMP_ENG",
        "Vehicle.ADAS.ABS.IsEnabled",
    ]
    drafted = draft_profile(dict.fromkeys([*names, *others], ""), "p")
    assert {c.full_name(str(c.signal)): name for name, c in drafted.channels.items()} == names


def test_german_names_with_umlauts_are_recognised() -> None:
    names = {"Längsbeschleunigung": "g", "Außentemperatur": "°C"}
    assert set(draft_profile(names, "p").channels) == {"ax", "air_temperature"}


def test_check_names_a_flag_that_is_always_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pq.write_table(pa.table(a_log(3000) | {"esc_active": np.ones(3000)}), tmp_path / "log.parquet")
    (tmp_path / "log.json").write_text(CAR.model_dump_json(exclude_none=True))
    main(["check", str(tmp_path / "log.parquet")])
    assert (
        "esc_active has been on since the start: it is treated as unknown"
        in capsys.readouterr().out
    )
