"""Test of estimates as MCAP: the format's reference reader finds every sample and value."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from mcap.reader import make_reader

from edge_agent.app.estimates_file import write_table
from edge_agent.app.mcap_file import TOPIC
from schemas.tables import ESTIMATES_SCHEMA


def samples(count: int) -> pa.Table:
    draw = np.random.default_rng(5)
    columns = []
    for field in ESTIMATES_SCHEMA:
        values = 0.01 * np.arange(count) + 1.0 if field.name == "t" else draw.normal(size=count)
        columns.append(pa.array(values).cast(field.type, safe=False))
    place = ESTIMATES_SCHEMA.get_field_index("mu_fl")
    # Like a bank that gives one value for all wheels.
    columns[place] = pa.nulls(count, pa.float64())
    return pa.Table.from_arrays(columns, schema=ESTIMATES_SCHEMA)


@pytest.mark.parametrize("count", [0, 1, 2500])
def test_reader_finds_every_sample_with_its_schema(tmp_path: Path, count: int) -> None:
    table = samples(count)
    path = tmp_path / "drive.mcap"
    write_table("out", path, table)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = list(reader.iter_messages())
        summary = reader.get_summary()
    rows = table.to_pylist()
    assert len(found) == count
    assert summary is not None
    assert {channel.topic for channel in summary.channels.values()} == {TOPIC}
    described = json.loads(next(iter(summary.schemas.values())).data)
    assert set(described["properties"]) == set(ESTIMATES_SCHEMA.names)
    for (schema, _, message), row in zip(found, rows, strict=True):
        assert schema is not None
        assert message.log_time == round(row["t"] * 1e9)
        assert json.loads(message.data) == {
            name: value for name, value in row.items() if value is not None
        }
