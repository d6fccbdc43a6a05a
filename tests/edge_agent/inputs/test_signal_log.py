"""Tests of reading a signal log. Channels must come in their order, and a missing optional column
must count as missing readings. A bad log must be refused in one line that names the fault.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from edge_agent.inputs.signal_log import SignalLog, read_log
from schemas.errors import InputError
from schemas.signals import CHANNELS, S, per_wheel
from tests.edge_agent.fakes import BAD_LOGS, a_log

NS = 1_000_000_000


def read(tmp_path: Path, columns: dict[str, Any]) -> SignalLog:
    path = tmp_path / "log.parquet"
    pq.write_table(pa.table(columns), path)
    return read_log(path)


def test_the_channels_come_in_their_order(tmp_path: Path) -> None:
    columns = a_log(50)
    log = read(tmp_path, columns | {"someone_elses": np.ones(50)})
    assert np.array_equal(log.t, columns["t"])
    for index, name in enumerate(CHANNELS):
        assert np.array_equal(log.signals[:, index], columns[name])
    assert log.start_ns is None


def test_absent_columns_nulls_and_infinities_are_missing_readings(
    tmp_path: Path,
) -> None:
    columns = {
        name: c
        for name, c in a_log(5).items()
        if not name.startswith(("torque", "latitude", "yaw"))
    }
    columns |= {
        "yaw_rate": pa.array([0.1, None, 0.1, 0.1, 0.1]),
        "ax": np.array([1.0, np.inf, np.nan, -np.inf, 1.0]),
    }
    log = read(tmp_path, columns)
    assert np.isnan(log.signals[:, [S.LATITUDE, S.YAW, S.TORQUE, S.TORQUE + 3]]).all()
    assert np.isnan(log.signals[:, S.YAW_RATE]).tolist() == [False, True, False, False, False]
    assert np.isnan(log.signals[:, S.AX]).tolist() == [False, True, True, True, False]


@pytest.mark.parametrize(
    ("without", "expected"),
    [
        ((), [0.1, 0.2, 0.3, 0.4]),
        (("delta_rl", "delta_rr"), [0.1, 0.2, 0.0, 0.0]),
        (("delta_fr", "delta_rl", "delta_rr"), [0.1, 0.1, 0.0, 0.0]),
        (("delta_fl",), [0.2, 0.2, 0.3, 0.4]),
    ],
)
def test_steering_without_column_copies_the_front_and_is_zero_at_the_rear(
    tmp_path: Path, without: tuple[str, ...], expected: list[float]
) -> None:
    columns = a_log(3) | {
        name: np.full(3, 0.1 * (i + 1)) for i, name in enumerate(per_wheel("delta"))
    }
    log = read(tmp_path, {name: c for name, c in columns.items() if name not in without})
    assert log.signals[0, S.DELTA : S.DELTA + 4].tolist() == pytest.approx(expected)


MOMENTS = 1_767_225_600 * NS + np.array([0, 10, 25]) * 10_000_000


@pytest.mark.parametrize(
    "column",
    [
        pa.array(MOMENTS, pa.timestamp("ns", tz="UTC")),
        pa.array(MOMENTS // 1000, pa.timestamp("us")),
        pa.array(MOMENTS, pa.int64()),
        pa.array(MOMENTS / NS, pa.float64()),
    ],
    ids=["ns UTC", "us", "int64 ns", "float s"],
)
def test_a_timestamp_gives_seconds_from_its_first_and_the_time_of_day(
    tmp_path: Path, column: pa.Array[Any]
) -> None:
    columns = {name: c for name, c in a_log(3).items() if name != "t"} | {"timestamp": column}
    log = read(tmp_path, columns)
    assert np.allclose(log.t, [0.0, 0.1, 0.25], atol=1e-6)
    assert log.start_ns == pytest.approx(int(MOMENTS[0]), abs=1000)


def test_blocks_contain_each_sample_once_with_its_absolute_time(tmp_path: Path) -> None:
    columns = a_log(25)
    log = read(tmp_path, columns)
    blocks = list(log.blocks(7 * NS, rows=10))
    assert [len(b.t) for b in blocks] == [10, 10, 5]
    assert np.array_equal(np.concatenate([b.t for b in blocks])[:, 0], columns["t"])
    times = np.concatenate([b.time for b in blocks])[:, 0]
    assert np.array_equal(times, 7 * NS + np.arange(25) * 10_000_000)
    assert blocks[0].signals.shape == (10, 1, len(CHANNELS))


def test_equal_times_of_rows_are_accepted(tmp_path: Path) -> None:
    columns = a_log(3) | {"t": np.array([0.0, 0.0, 0.01])}
    assert read(tmp_path, columns).t.tolist() == [0.0, 0.0, 0.01]


@pytest.mark.parametrize(("spoil", "message"), BAD_LOGS.values(), ids=BAD_LOGS)
def test_a_bad_log_is_refused_in_one_line_that_names_field_and_fix(
    tmp_path: Path, spoil: Callable[[Path], None], message: str
) -> None:
    path = tmp_path / "log.parquet"
    spoil(path)
    with pytest.raises(InputError, match=message) as caught:
        read_log(path)
    assert "\n" not in str(caught.value)
    assert caught.value.fix


def test_a_column_that_occurs_twice_is_refused(tmp_path: Path) -> None:
    table = pa.table(a_log(3))
    pq.write_table(table.append_column("ax", table["ay"]), tmp_path / "log.parquet")
    with pytest.raises(InputError, match="^ax: .* has this column 2 times; keep one of them"):
        read_log(tmp_path / "log.parquet")


@pytest.mark.parametrize(("unit", "factor"), [("s", NS), ("ms", 1_000_000), ("us", 1000)])
def test_whole_timestamps_in_another_unit_are_refused(
    tmp_path: Path, unit: str, factor: int
) -> None:
    columns = {name: c for name, c in a_log(3).items() if name != "t"}
    columns["timestamp"] = pa.array(MOMENTS // factor, pa.int64())
    words = f"^timestamp: is a date in {unit}, not in ns .*; multiply it by {factor}, or"
    with pytest.raises(InputError, match=words):
        read(tmp_path, columns)


def test_whole_timestamps_that_count_from_a_start_are_accepted(
    tmp_path: Path,
) -> None:
    columns = {name: c for name, c in a_log(3).items() if name != "t"}
    uptime = 1200 * NS + MOMENTS - MOMENTS[0]  # as ms, a date in the year 2008
    log = read(tmp_path, columns | {"timestamp": pa.array(uptime, pa.int64())})
    assert log.t.tolist() == [0.0, 0.1, 0.25]
