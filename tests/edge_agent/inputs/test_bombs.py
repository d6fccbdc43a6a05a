"""Tests that a small compressed recording which expands to a very large one is refused with an
error, before it fills the memory.
"""

from __future__ import annotations

import resource
import struct
from pathlib import Path

import numpy as np
import pytest

from edge_agent.inputs import bring_in, memory
from edge_agent.inputs.memory import bounded_memory
from edge_agent.inputs.readers import mdf
from schemas.errors import InputError

MOST = 400 << 20
LARGE = 900 << 20
MAGIC = b"\x89MCAP0\r\n"


def record(kind: int, body: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(body)) + body


def text(words: str) -> bytes:
    return struct.pack("<I", len(words)) + words.encode()


def write_mcap_bomb(path: Path) -> Path:
    """Write a ROS bag with one message and a compressed chunk of LARGE zeros, and
    return its path.
    """
    lz4 = pytest.importorskip("lz4.frame")
    second = 10**9
    schema = struct.pack("<H", 1) + text("std_msgs/msg/Float64") + text("ros2msg")
    channel = struct.pack("<HH", 1, 1) + text("/speed") + text("cdr") + struct.pack("<I", 0)
    about = record(3, schema + text("float64 data\n")) + record(4, channel)
    number = b"\0\1\0\0" + struct.pack("<d", 1.0)
    message = record(5, struct.pack("<HIQQ", 1, 0, second, second) + number)
    content = about + message + struct.pack("<BQ", 0x80, LARGE) + bytes(LARGE)
    packed = text("lz4") + struct.pack("<Q", len(lz4_bytes := lz4.compress(content)))
    size = len(content)
    del content
    head = MAGIC + record(1, text("ros2") + text("x"))
    chunk = record(6, struct.pack("<QQQI", second, second, size, 0) + packed + lz4_bytes)
    entry = struct.pack("<HIQQ", 1, 16, second, len(about))
    file = head + chunk + record(7, entry)
    where = struct.pack("<IHQQ", 10, 1, len(head) + len(chunk), len(record(7, entry)))
    sizes = struct.pack("<QQ", len(lz4_bytes), size)
    places = struct.pack("<QQQQ", second, second, len(head), len(chunk))
    file += record(15, bytes(4))
    begin = len(file)
    counts = struct.pack("<QHIIIIQQIHQ", 1, 1, 1, 0, 0, 1, second, second, 10, 1, 1)
    file += about + record(11, counts) + record(8, places + where + text("lz4") + sizes)
    path.write_bytes(file + record(2, struct.pack("<QQI", begin, 0, 0)) + MAGIC)
    return path


def write_mdf_bomb(path: Path) -> Path:
    """Write an MDF file with a measurement of LARGE zeros in compressed (DZ) blocks, and return its
    path.
    """
    asammdf = pytest.importorskip("asammdf")
    values = np.zeros(LARGE // 16)
    with asammdf.MDF(version="4.10") as file:
        file.append(asammdf.Signal(values, np.arange(len(values)) * 0.0, name="Speed"))
        file.save(path, compression=2, overwrite=True)
    return path


@pytest.mark.campaign
@pytest.mark.parametrize("kind", ["mcap", "mf4"])
def test_bomb_is_refused_with_a_bounded_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    write = write_mcap_bomb if kind == "mcap" else write_mdf_bomb
    path = write(tmp_path / f"bomb.{kind}")
    assert path.stat().st_size < LARGE / 100
    before = resource.getrlimit(resource.RLIMIT_AS)
    monkeypatch.setattr(bring_in, "bounded_memory", lambda path: bounded_memory(path, MOST))
    monkeypatch.setattr(mdf, "MOST_BYTES", MOST)
    with pytest.raises(InputError, match=r"bomb\.m.* (needs more than 400 MB|is not a valid)"):
        bring_in.read_source(path, None, None)
    assert resource.getrlimit(resource.RLIMIT_AS) == before


@pytest.mark.campaign
def test_memory_limit_is_enforced_and_then_removed(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    with (
        pytest.raises(InputError, match="needs more than 400 MB of memory"),
        bounded_memory(path, MOST),
    ):
        bytearray(LARGE)
    assert len(bytearray(LARGE)) == LARGE
    assert memory.MOST_BYTES > MOST
