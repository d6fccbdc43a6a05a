"""Test recording: one minute of a Toyota RAV4, with CAN log, GNSS log and vehicle file in
tests/data. The module has their paths, the recorded CAN frames, and functions that write the frames
in other log formats.
"""

from __future__ import annotations

from pathlib import Path

import can

from tests.benchmarks.inputs.formats import as_bag, as_csv, as_log, as_mf4

DATA = Path(__file__).parents[2] / "data"
BLF = DATA / "rav4.blf"
NMEA = DATA / "rav4.nmea"
VEHICLE = DATA / "rav4.json"


def frames(most: int | None = None) -> list[can.Message]:
    """Return the first `most` CAN frames of the recording. Their times are in whole microseconds,
    as most loggers store them.
    """
    with can.BLFReader(BLF) as reader:
        found = [message for _, message in zip(range(most or 10**9), reader, strict=False)]
    for message in found:
        message.timestamp = round(message.timestamp, 6)
    return found


__all__ = ["BLF", "DATA", "NMEA", "VEHICLE", "as_bag", "as_csv", "as_log", "as_mf4", "frames"]
