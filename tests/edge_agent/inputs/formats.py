"""The real minute in other formats, written by the libraries that others write them with."""

from __future__ import annotations

import csv
import warnings
from pathlib import Path

import can
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

DATA = Path(__file__).parents[2] / "data"
BLF, NMEA, VEHICLE = DATA / "rav4.blf", DATA / "rav4.nmea", DATA / "rav4.json"
NS = 1_000_000_000


def frames(most: int | None = None) -> list[can.Message]:
    """The first frames of the real minute, at whole microseconds, as most loggers stamp them."""
    with can.BLFReader(BLF) as reader:
        found = [message for _, message in zip(range(most or 10**9), reader, strict=False)]
    for message in found:
        message.timestamp = round(message.timestamp, 6)
    return found


def as_log(path: Path, messages: list[can.Message]) -> Path:
    """A CAN log by python-can; the ending says which."""
    with can.Logger(str(path)) as writer:
        for message in messages:
            writer(message)
    return path


def as_mf4(path: Path, messages: list[can.Message]) -> Path:
    """A bus log by asammdf, in the layout of its standard."""
    import asammdf

    types = np.dtype([
        ("CAN_DataFrame.BusChannel", "<u1"), ("CAN_DataFrame.ID", "<u4"), ("CAN_DataFrame.IDE", "<u1"),
        ("CAN_DataFrame.DLC", "<u1"), ("CAN_DataFrame.DataLength", "<u1"), ("CAN_DataFrame.DataBytes", "(64,)u1"),
    ])  # fmt: skip
    rows = np.zeros(len(messages), types)
    for place, message in enumerate(messages):
        size = len(message.data)
        data = np.frombuffer(bytes(message.data).ljust(64, b"\0"), np.uint8)
        rows[place] = (message.channel, message.arbitration_id, message.is_extended_id, size, size, data)
    t = np.array([message.timestamp for message in messages])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with asammdf.MDF(version="4.10") as mdf:
            mdf.append(asammdf.Signal(rows, t - t[0], name="CAN_DataFrame"), common_timebase=True)
            mdf.save(path, overwrite=True)
    return path


def as_bag(folder: Path, messages: list[can.Message], storage: str = "mcap") -> Path:
    """A bag of can_msgs/Frame by rosbags."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    text = "std_msgs/Header header\nuint32 id\nbool is_rtr\nbool is_extended\nbool is_error\nuint8 dlc\nuint8[8] data\n"
    types.register(get_types_from_msg(text, "can_msgs/msg/Frame"))
    kind, header, time = (
        types.types[f"{name}"] for name in ("can_msgs/msg/Frame", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    with Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        connection = writer.add_connection("/can1", "can_msgs/msg/Frame", typestore=types)
        for m in messages:
            ns = round(m.timestamp * 1e6) * 1000
            stamp = header(stamp=time(sec=ns // NS, nanosec=ns % NS), frame_id="")
            data = np.frombuffer(bytes(m.data).ljust(8, b"\0"), np.uint8)
            frame = kind(stamp, m.arbitration_id, False, m.is_extended_id, False, m.dlc, data)
            writer.write(connection, ns, types.serialize_cdr(frame, "can_msgs/msg/Frame"))
    return folder


def as_csv(path: Path, log: Path, *, mark: str = ",") -> Path:
    """A signal log as CSV, to the last digit."""
    table = pq.read_table(log)
    names = table.column_names
    t = np.array(table["timestamp"].cast(pa.int64()))
    columns = [t, *(np.array(table[name].to_pylist(), dtype=float) for name in names[1:])]
    with path.open("w", newline="") as file:
        writer = csv.writer(file, delimiter=mark)
        writer.writerow(names)
        for row in zip(*columns, strict=True):
            writer.writerow([int(row[0]), *("" if np.isnan(v) else repr(float(v)) for v in row[1:])])
    return path
