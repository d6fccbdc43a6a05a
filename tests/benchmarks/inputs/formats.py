"""Writers of one drive in every supported bus log format, each with a library that is commonly used
for the format.
"""

from __future__ import annotations

import csv
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from edge_agent.inputs.live.ros2 import CAN_FRAME
from edge_agent.inputs.readers.rosbag import FRAME
from edge_agent.inputs.recording import import_optional
from schemas.thresholds import NS


def as_log(path: Path, messages: Sequence[Any]) -> Path:
    """Write CAN messages as a log file with python-can, and return its path. The suffix of the path
    selects the log format.
    """
    with import_optional("can").Logger(str(path)) as writer:
        for message in messages:
            writer(message)
    return path


def as_mf4(path: Path, messages: Sequence[Any]) -> Path:
    """Write CAN messages with asammdf as an MDF 4 file, in the bus-logging layout of ASAM. Return
    the path.
    """
    asammdf = import_optional("asammdf")
    types = np.dtype(
        [
            ("CAN_DataFrame.BusChannel", "<u1"),
            ("CAN_DataFrame.ID", "<u4"),
            ("CAN_DataFrame.IDE", "<u1"),
            ("CAN_DataFrame.DLC", "<u1"),
            ("CAN_DataFrame.DataLength", "<u1"),
            ("CAN_DataFrame.DataBytes", "(64,)u1"),
        ]
    )
    rows = np.zeros(len(messages), types)
    for place, message in enumerate(messages):
        size = len(message.data)
        data = np.frombuffer(bytes(message.data).ljust(64, b"\0"), np.uint8)
        rows[place] = (
            message.channel,
            message.arbitration_id,
            message.is_extended_id,
            size,
            size,
            data,
        )
    t = np.array([message.timestamp for message in messages])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with asammdf.MDF(version="4.10") as mdf:
            mdf.append(asammdf.Signal(rows, t - t[0], name="CAN_DataFrame"), common_timebase=True)
            mdf.save(path, overwrite=True)
    return path


def as_bag(folder: Path, messages: Sequence[Any], storage: str = "mcap") -> Path:
    """Write CAN messages with rosbags as a bag of can_msgs/Frame. Return the folder."""
    rosbag2 = import_optional("rosbags.rosbag2")
    typesys = import_optional("rosbags.typesys")
    types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    types.register(typesys.get_types_from_msg(CAN_FRAME, FRAME))
    kind, header, time = (
        types.types[name] for name in (FRAME, "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    plugin = rosbag2.StoragePlugin[storage.upper()]
    with rosbag2.Writer(folder, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/can1", FRAME, typestore=types)
        for m in messages:
            ns = round(m.timestamp * 1e6) * 1000
            stamp = header(stamp=time(sec=ns // NS, nanosec=ns % NS), frame_id="")
            data = np.frombuffer(bytes(m.data).ljust(8, b"\0"), np.uint8)
            frame = kind(stamp, m.arbitration_id, False, m.is_extended_id, False, m.dlc, data)
            writer.write(connection, ns, types.serialize_cdr(frame, FRAME))
    return folder


def as_csv(path: Path, log: Path, *, mark: str = ",") -> Path:
    """Write the signal log `log` as CSV with full precision, and return the path of the CSV file.
    `mark` is the character between columns.
    """
    table = pq.read_table(log)
    names = table.column_names
    t = np.array(table["timestamp"].cast(pa.int64()))
    columns = [t, *(np.array(table[name].to_pylist(), dtype=float) for name in names[1:])]
    with path.open("w", newline="") as file:
        writer = csv.writer(file, delimiter=mark)
        writer.writerow(names)
        for row in zip(*columns, strict=True):
            writer.writerow(
                [int(row[0]), *("" if np.isnan(v) else repr(float(v)) for v in row[1:])]
            )
    return path
